//! Topics that go to another flow of the layer by load, and come from one.

use blaze_brokers::Begin;
use blaze_proto::link::link_control::{Advertise, Egress};

use super::*;
use crate::lane::load::{Loads, TopicLoad};
use crate::registry::{carrying_states, entry_hash};
use crate::world::{Carrying, Handover};

const TOPICS: [&str; 3] = ["t0", "t1", "t2"];
const KIB: u64 = 1024;

fn topic(name: &str) -> TopicName {
    name.parse().unwrap()
}

fn other() -> FlowId {
    "fog/fog-2".parse().unwrap()
}

/// `fog/fog-1`, which carries three topics to a robot, and `fog/fog-2`, which could.
struct Pair {
    bench: Bench,
    /// What `fog/fog-2` says that it carries.
    load: Option<u64>,
    /// What each topic weighs in KiB/s.
    weights: [u64; 3],
    /// Topics that could be handed over exactly.
    may_move: &'static [&'static str],
    version: u64,
    /// What `fog/fog-2` has announced.
    entries: BTreeMap<String, Entry>,
    /// What is given up has arrived at once.
    arrives: bool,
    steps: u64,
    /// Who carries what was to change, in order.
    duties: Vec<(TopicName, Duty)>,
}

impl Pair {
    fn new(load: Option<u64>, weights: [u64; 3]) -> Self {
        let mut pair = Self {
            bench: Bench::inside(),
            load,
            weights,
            may_move: &TOPICS,
            version: 0,
            entries: BTreeMap::new(),
            arrives: false,
            steps: 0,
            duties: Vec::new(),
        };
        let hello =
            Hello { registry_version: 1, ..said_by(&"edge/r".parse().unwrap(), Kind::Edge) };
        pair.bench.link_says(hello, 1, TOPICS.map(asks_for).into());
        for name in TOPICS {
            pair.bench.send(Scope::Layer, &lease("advertise", name));
        }
        pair.bench.step(300);
        pair.serve();
        assert_eq!(pair.carried(), TOPICS);
        pair.duties.clear();
        pair.hello();
        pair.tell(&TOPICS.map(|name| (name, Carrying::No)));
        pair
    }

    fn say(&mut self, body: Body) {
        self.bench.fog_2_says(body, Some(0));
    }

    fn hello(&mut self) {
        let hello = Hello {
            registry_version: self.version,
            registry_digest: self.entries.values().map(entry_hash).fold(0, u64::wrapping_add),
            egress: Some(Egress {
                demand_bytes_per_s: self.load.unwrap_or(0) * KIB,
                limit_bytes_per_s: 0,
            }),
            ingress_bytes_per_s: self.load.map(|_| 0),
            ..said_by(&other(), Kind::Fog)
        };
        self.say(Body::Hello(hello));
    }

    /// What `fog/fog-2` does for topics.
    fn tell(&mut self, parts: &[(&str, Carrying)]) {
        let entry = |(name, carrying): &(&str, Carrying)| Entry {
            topic: (*name).into(),
            layer_advertise: Some(Advertise::default()),
            route_state: carrying_states(&other(), carrying),
            ..Entry::default()
        };
        let entries: Vec<Entry> = parts.iter().map(entry).collect();
        self.entries.extend(entries.iter().map(|entry| (entry.topic.clone(), entry.clone())));
        self.version += 1;
        self.say(Body::Delta(delta(self.version, entries)));
    }

    /// Does what the executor does.
    fn serve(&mut self) {
        for output in std::mem::take(&mut self.bench.outputs) {
            if let Output::Plan { topic, duty, .. } = output {
                if duty == Duty::GivesUp {
                    let now = self.bench.now;
                    self.bench.core.given_up(now, 0, &topic, Some(vec![7]));
                }
                if duty != Duty::Same {
                    self.duties.push((topic, duty));
                }
            }
        }
        for topic in self.bench.core.emptying().into_iter().filter(|_| self.arrives) {
            let now = self.bench.now;
            self.bench.core.emptied(now, 0, &topic);
        }
    }

    fn step(&mut self) {
        self.steps += 1;
        if self.steps.is_multiple_of(25) {
            self.hello();
        }
        if self.steps.is_multiple_of(50) {
            let carried: Vec<TopicLoad> = (TOPICS.iter().zip(self.weights))
                .filter(|(name, _)| self.carried().contains(*name))
                .map(|(name, weight)| TopicLoad {
                    topic: topic(name),
                    bytes_per_s: weight * KIB,
                    may_move: self.may_move.contains(name),
                })
                .collect();
            let loads = Loads {
                out_bytes_per_s: carried.iter().map(|load| load.bytes_per_s).sum(),
                in_bytes_per_s: 0,
                carried,
            };
            self.bench.core.set_loads(self.bench.now, &loads, 0);
        }
        self.bench.step(20);
        self.serve();
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms / 20 {
            self.step();
        }
    }

    /// Runs until a topic is given up, or for so long.
    fn run_until_given_up(&mut self, ms: u64) -> Option<u64> {
        (1..=ms / 20).find_map(|step| {
            self.step();
            (!self.bench.core.emptying().is_empty()).then_some(step * 20)
        })
    }

    fn carried(&self) -> Vec<&'static str> {
        let plans = self.bench.core.plans();
        let carries = |name: &&str| plans.get(&topic(name)).is_some_and(TopicPlan::carries_out);
        TOPICS.into_iter().filter(carries).collect()
    }

    fn told(&self, name: &str) -> &Carrying {
        &self.bench.core.world().own().unwrap().parts[&topic(name)].carrying
    }
}

pub(super) fn said_by(flow: &FlowId, kind: Kind) -> Hello {
    let layer_scope_id = if kind == Kind::Fog { LayerScopeId::kafka("").0 } else { 0 };
    Hello { layer_scope_id, ..hello_of(flow, kind) }
}

fn handed_to(flow: FlowId) -> Carrying {
    Carrying::HandedOver(Handover { to: Some(flow), ..[7].into() })
}

#[test]
fn a_topic_goes_by_name_when_everything_of_it_has_arrived() {
    let mut pair = Pair::new(Some(0), [300, 200, 100]);
    let after = pair.run_until_given_up(20_000).unwrap();
    assert!((5_000..10_000).contains(&after), "settled after 5 s, uneven for 3 s: {after}");
    assert_eq!(pair.bench.core.emptying(), [topic("t0")], "half of what is between them");
    assert_eq!(pair.told("t0"), &Carrying::Carries, "until it has arrived");
    let now = pair.bench.now;
    pair.bench.core.emptied(now, 0, &topic("t1"));
    assert_eq!(pair.bench.core.emptying().len(), 1);
    pair.bench.core.emptied(now, 0, &topic("t0"));
    assert_eq!(pair.told("t0"), &handed_to(other()));
    let moves = pair.bench.core.moves().clone();
    let last = moves.last.unwrap();
    assert_eq!((moves.by_load, moves.settled, moves.taken_back), (1, 0, 0));
    assert_eq!((last.topic, last.to, last.reason), (topic("t0"), Some(other()), MoveReason::Load));
    // The other says nothing of a load: the next one goes when both have rested.
    pair.tell(&[("t0", Carrying::Carries)]);
    assert_eq!(pair.run_until_given_up(9_000), None);
    assert_eq!(pair.carried(), ["t1", "t2"]);
    assert!(pair.run_until_given_up(8_000).is_some());
}

#[test]
fn what_has_not_arrived_in_time_stays_and_goes_on_where_it_stopped() {
    let mut pair = Pair::new(Some(0), [300, 200, 100]);
    pair.run_until_given_up(20_000).unwrap();
    pair.duties.clear();
    pair.run(380);
    assert_eq!((pair.duties.len(), pair.carried()), (0, vec!["t1", "t2"]));
    pair.run(40);
    assert_eq!(pair.duties, [(topic("t0"), Duty::Takes(Begin::At([7].into())))]);
    assert_eq!((pair.told("t0"), pair.carried()), (&Carrying::Carries, TOPICS.to_vec()));
    assert_eq!((pair.bench.core.moves().taken_back, pair.bench.core.moves().by_load), (1, 0));
    assert_eq!(pair.run_until_given_up(9_000), None, "it is not tried again at once");
    assert!(pair.run_until_given_up(8_000).is_some());
}

#[test]
fn one_that_dies_before_it_was_told_gets_nothing() {
    let mut pair = Pair::new(Some(0), [300, 200, 100]);
    pair.run_until_given_up(20_000).unwrap();
    pair.duties.clear();
    let goodbye = blaze_proto::link::link_control::Goodbye { epoch: 1 };
    pair.say(Body::Goodbye(goodbye));
    pair.run(100);
    assert_eq!(pair.duties, [(topic("t0"), Duty::Takes(Begin::At([7].into())))]);
    assert_eq!(pair.carried(), TOPICS);
}

#[test]
fn a_flow_that_goes_does_not_wait_for_what_is_on_its_way() {
    let mut pair = Pair::new(Some(0), [300, 200, 100]);
    pair.run_until_given_up(20_000).unwrap();
    let now = pair.bench.now;
    pair.bench.core.start_draining(now, 0);
    assert_eq!(pair.told("t0"), &handed_to(other()));
    pair.bench.collect();
    pair.serve();
    assert_eq!(pair.told("t1"), &Carrying::HandedOver([7].into()));
    assert_eq!(pair.bench.core.moves().by_load, 0, "that is no move");
}

#[test]
fn while_one_says_nothing_of_its_load_nothing_goes() {
    let mut pair = Pair::new(None, [300, 200, 100]);
    assert_eq!(pair.run_until_given_up(30_000), None);
    assert_eq!(pair.carried(), TOPICS, "and what weighs something is not moved by a hash");
}

#[test]
fn what_weighs_little_goes_to_whom_hashing_prefers() {
    let mut pair = Pair::new(None, [10, 10, 10]);
    let able = [other(), "fog/fog-1".parse().unwrap()];
    let prefers =
        |name: &&str| crate::plan::rendezvous::choose(name, able.iter()) == Some(&able[0]);
    let expected: Vec<&str> = TOPICS.into_iter().filter(prefers).collect();
    assert!(!expected.is_empty(), "the names are not well chosen");
    pair.arrives = true;
    pair.run(7_000);
    assert_eq!(pair.bench.core.moves().settled, expected.len() as u64);
    let gone: Vec<&str> =
        TOPICS.into_iter().filter(|name| !pair.carried().contains(name)).collect();
    assert_eq!(gone, expected);
}

#[test]
fn what_came_by_load_stays_a_minute_whatever_the_loads_are() {
    let mut pair = Pair::new(Some(1000), [300, 200, 100]);
    pair.may_move = &["t0"];
    pair.run(7_000);
    pair.bench.send(Scope::Layer, &lease("withdraw", "t0"));
    pair.run(800);
    pair.tell(&[("t0", Carrying::Carries)]);
    pair.run(100);
    assert_eq!(pair.carried(), ["t1", "t2"]);
    pair.bench.send(Scope::Layer, &lease("advertise", "t0"));
    pair.tell(&[("t0", handed_to("fog/fog-1".parse().unwrap()))]);
    pair.duties.clear();
    pair.run(400);
    assert_eq!(pair.duties, [(topic("t0"), Duty::Takes(Begin::At([7].into())))]);
    pair.load = Some(0);
    assert_eq!(pair.run_until_given_up(59_000), None);
    assert!(pair.run_until_given_up(10_000).is_some());
    assert_eq!(pair.bench.core.emptying(), [topic("t0")]);
}

#[test]
fn what_weighs_something_stays_after_an_outage_of_its_broker() {
    let mut pair = Pair::new(None, [300, 200, 100]);
    pair.run(7_000);
    let health = |pair: &mut Pair, health| {
        let now = pair.bench.now;
        pair.bench.core.set_scope_health(now, Scope::Layer, health);
    };
    health(&mut pair, ScopeHealth::Away);
    pair.weights = [0; 3];
    pair.run(4_000);
    health(&mut pair, ScopeHealth::Up);
    // The mean is still low.
    pair.run(4_000);
    pair.weights = [300, 200, 100];
    pair.run(10_000);
    assert_eq!(pair.bench.core.moves().settled, 0);
    assert_eq!(pair.carried(), TOPICS);
}
