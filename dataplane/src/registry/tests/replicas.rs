//! Flows that hear each other on the channel of their layer broker.

use blaze_brokers::Begin;
use blaze_proto::link::link_control::{Goodbye, Kind};

use super::*;
use crate::registry::{Load, REST};
use crate::testing::{delta, hello_of};
use crate::world::{Carrying, Handover, SETTLED_AFTER};

const MS: Duration = Duration::from_millis(1);

fn id(text: &str) -> FlowId {
    text.parse().unwrap()
}

/// Two flows of a layer without an inter scope between them, and a channel that loses.
struct Pair {
    now: Instant,
    start: Instant,
    flows: [Registry; 2],
    steps: u64,
    messages: u64,
    /// Of ten messages so many are lost.
    loss: u64,
}

impl Pair {
    fn new(loss: u64) -> Self {
        let now = Instant::now();
        let flows = ["cloud/a", "cloud/b"].map(|flow| Registry::new(config(flow, 1, now)));
        let mut pair = Self { now, start: now, flows, steps: 0, messages: 0, loss };
        for flow in &mut pair.flows {
            flow.set_state(FlowState::Ready);
        }
        pair
    }

    fn names(&self) -> [FlowId; 2] {
        [0, 1].map(|at| self.flows[at].world().me.clone())
    }

    /// Milliseconds since 1970 on the server, which began with the test.
    fn server_ms(&self) -> i64 {
        i64::try_from((self.now - self.start).as_millis()).unwrap()
    }

    fn hello(&mut self, from: usize) {
        let said = Hello {
            state: State::from(self.flows[from].world().own().unwrap().state).into(),
            ..hello(&self.flows[from])
        };
        let (name, ms) = (self.names()[from].clone(), self.server_ms());
        self.flows[1 - from].on_layer_hello(self.now, &name, &said, said.epoch, Some(ms));
    }

    fn run(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.now += 10 * MS;
            self.steps += 1;
            for from in 0..2 {
                if self.steps.is_multiple_of(50) {
                    self.hello(from);
                }
                let over_link = self.flows[from].poll(self.now);
                assert!(
                    over_link.iter().all(|(to, _)| to.layer.as_str() == "edge"),
                    "there is no link between them: {over_link:?}"
                );
                for (to, body) in self.flows[from].poll_layer() {
                    let names = self.names();
                    assert!(to.is_none_or(|to| to == names[1 - from]));
                    self.messages += 1;
                    if self.messages * 7 % 10 >= self.loss {
                        self.flows[1 - from].on_layer_control(self.now, &names[from], 1, body);
                    }
                }
                let now = self.now;
                self.flows[from].watch_flows(now);
            }
        }
    }

    fn say(&mut self, at: usize, scope: Scope, message: &Value) {
        say(&mut self.flows[at], self.now, scope, message);
    }

    fn carries(&mut self, at: usize, carrying: &Carrying) {
        let me = self.names()[at].clone();
        self.flows[at].set_route_state(self.now, &topic("t"), carrying_states(&me, carrying));
    }

    fn sees(&self, at: usize) -> &FlowView {
        &self.flows[at].world().flows[&self.names()[1 - at]]
    }
}

#[test]
fn without_a_link_they_know_each_other_over_a_channel_that_loses() {
    for loss in [0, 3, 6] {
        let mut pair = Pair::new(loss);
        pair.run(1000 * MS);
        for number in 0..120 {
            pair.say(number % 2, Scope::Node, &lease("request", &format!("t{number}"), "s"));
            pair.run(20 * MS);
        }
        pair.run(8000 * MS);
        for at in 0..2 {
            let own = &pair.flows[1 - at].world().own().unwrap().topics;
            let told: BTreeSet<&TopicName> = pair.sees(at).topics.keys().collect();
            assert_eq!(told, own.keys().collect(), "loss {loss}");
            assert!(pair.flows[at].knows_replicas() && pair.sees(at).reach == Reach::Up);
        }
    }
}

#[test]
fn one_that_is_silent_is_gone_and_what_it_carried_begins_a_second_before_its_last_sign() {
    let mut pair = Pair::new(0);
    pair.carries(0, &Carrying::Carries);
    pair.run(1000 * MS);
    assert!(pair.flows[1].is_carried_elsewhere(&topic("t")));
    let last = pair.now;
    pair.hello(0);
    let last_ms = pair.server_ms();
    let mut watch = |after: Duration| pair.flows[1].watch_flows(last + after);
    assert!(!watch(2499 * MS).contains(&topic("t")));
    assert!(watch(2500 * MS).contains(&topic("t")), "what it carried is planned anew");
    let (flow, now) = (&mut pair.flows[1], last + 2500 * MS);
    assert!(flow.take_urgent().contains(&topic("t")));
    assert_eq!(flow.world().flows[&id("cloud/a")].reach, Reach::Down);
    let since = Begin::Since { appended_ms: last_ms - 1000, latest: [].into() };
    assert_eq!(flow.begin_carrying(now, &topic("t"), true), since);
    assert_eq!(flow.begin_carrying(now, &topic("t"), true), Begin::Now, "it is taken up once");
}

#[test]
fn after_a_crash_best_effort_topics_begin_at_the_end_and_old_places_are_forgotten() {
    for (reliable, wait) in [(false, Duration::ZERO), (true, LEGACY)] {
        let mut pair = Pair::new(0);
        pair.carries(0, &Carrying::Carries);
        pair.run(1000 * MS);
        let gone = pair.now + SILENT;
        pair.flows[1].watch_flows(gone);
        let begin = pair.flows[1].begin_carrying(gone + wait, &topic("t"), reliable);
        assert_eq!(begin, Begin::Now, "reliable {reliable}, {wait:?} later");
    }
}

#[test]
fn an_older_life_is_heard_again_when_the_newer_one_has_ended() {
    for says_goodbye in [true, false] {
        let mut pair = Pair::new(0);
        pair.run(1000 * MS);
        let name = pair.names()[0].clone();
        // Another program under its name, as a failed update starts.
        let double = Registry::new(config("cloud/a", 9, pair.now));
        let said = Hello { state: State::Ready.into(), ..hello(&double) };
        pair.flows[1].on_layer_hello(pair.now, &name, &said, 9, None);
        assert_eq!(pair.sees(1).epoch, 9);
        pair.hello(0);
        assert_eq!((pair.sees(1).epoch, pair.flows[1].faults().old_epochs), (9, 1));
        if says_goodbye {
            let body = Body::Goodbye(Goodbye { epoch: 9 });
            pair.flows[1].on_layer_control(pair.now, &name, 9, body);
        } else {
            let silent = pair.now + SILENT;
            pair.flows[1].watch_flows(silent);
        }
        pair.hello(0);
        assert_eq!((pair.sees(1).epoch, pair.sees(1).reach), (1, Reach::Up), "{says_goodbye}");
    }
}

#[test]
fn what_is_handed_over_outlives_the_good_bye() {
    let mut pair = Pair::new(0);
    pair.carries(0, &Carrying::Carries);
    pair.run(1000 * MS);
    pair.carries(0, &Carrying::HandedOver([42].into()));
    pair.flows[0].set_state(FlowState::Draining);
    pair.hello(0);
    pair.run(100 * MS);
    assert_eq!(pair.sees(1).state, FlowState::Draining);
    let now = pair.now;
    let goodbye = Body::Goodbye(Goodbye { epoch: 1 });
    pair.flows[1].on_layer_control(now, &id("cloud/a"), 1, goodbye);
    assert_eq!(pair.sees(1).reach, Reach::Down);
    assert_eq!(pair.flows[1].begin_carrying(now, &topic("t"), false), Begin::At([42].into()));
}

#[test]
fn a_new_life_ends_the_one_before_and_late_words_of_that_count_no_more() {
    let mut pair = Pair::new(0);
    pair.carries(0, &Carrying::Carries);
    pair.run(1000 * MS);
    let (now, ms) = (pair.now, pair.server_ms());
    let mut again = Registry::new(config("cloud/a", 2, now));
    let said = Hello { state: State::Starting.into(), ..hello(&again) };
    pair.flows[1].on_layer_hello(now, &id("cloud/a"), &said, said.epoch, Some(ms));
    assert!(!pair.flows[1].is_carried_elsewhere(&topic("t")));
    assert!(matches!(pair.flows[1].begin_carrying(now, &topic("t"), true), Begin::Since { .. }));
    let before = pair.flows[1].faults().unknown_flows;
    let goodbye = Body::Goodbye(Goodbye { epoch: 1 });
    pair.flows[1].on_layer_control(now, &id("cloud/a"), 1, goodbye);
    pair.hello(0);
    assert_eq!(pair.flows[1].faults().unknown_flows, before + 1);
    assert_eq!((pair.sees(1).reach, pair.sees(1).epoch), (Reach::Up, 2));
    again.set_state(FlowState::Ready);
}

#[test]
fn a_flow_does_not_go_back_to_what_it_was_and_settles_after_five_seconds() {
    let mut pair = Pair::new(0);
    pair.run(1000 * MS);
    pair.run(SETTLED_AFTER - 1000 * MS);
    assert!(!pair.sees(1).settled);
    pair.run(1000 * MS);
    assert!(pair.sees(1).settled);
    let late = hello(&pair.flows[0]);
    pair.flows[0].set_state(FlowState::Draining);
    pair.hello(0);
    let (now, ms) = (pair.now, pair.server_ms());
    pair.flows[1].on_layer_hello(now, &id("cloud/a"), &late, late.epoch, Some(ms));
    pair.flows[1].watch_flows(now);
    assert_eq!((pair.sees(1).state, pair.sees(1).settled), (FlowState::Draining, false));
}

#[test]
fn the_link_does_not_decide_about_flows_that_share_the_layer_broker() {
    let mut pair = Pair::new(0);
    pair.run(1000 * MS);
    let (a, now) = (id("cloud/a"), pair.now);
    let said = hello(&pair.flows[0]);
    pair.flows[1].on_hello(now, &a, &said);
    for reach in [Reach::Suspect, Reach::Down] {
        pair.flows[1].set_reach(now, &a, reach);
        assert_eq!(pair.sees(1).reach, Reach::Up, "it lives on the layer broker");
    }
    pair.flows[1].forget_link(now, &a);
    assert_eq!(pair.sees(1).reach, Reach::Up);
    pair.flows[1].set_reach(now, &a, Reach::Up);
    pair.flows[1].watch_flows(now + SILENT);
    assert_eq!(pair.sees(1).reach, Reach::Down, "it has lost the broker, though it is there");
    pair.flows[1].forget_link(now, &a);
    assert!(!pair.flows[1].world().flows.contains_key(&a));
}

#[test]
fn who_shares_nothing_is_not_heard_there() {
    let mut pair = Pair::new(0);
    let (now, said) = (pair.now, hello(&pair.flows[0]));
    let other_broker = Hello { layer_scope_id: 77, ..said.clone() };
    assert!(
        pair.flows[1]
            .on_layer_hello(now, &id("cloud/a"), &other_broker, other_broker.epoch, None)
            .is_empty()
    );
    pair.flows[1].on_layer_hello(now, &id("fog/a"), &said, said.epoch, None);
    assert_eq!(pair.flows[1].world().flows.len(), 1);
}

#[test]
fn loads_are_told_with_each_hello_and_change_nothing_that_is_announced() {
    let mut pair = Pair::new(0);
    pair.run(1000 * MS);
    let a = id("cloud/a");
    assert_eq!(pair.flows[1].load_of(&a), None, "an earlier version says nothing");
    let announced = pair.flows[0].announced();
    let said = Hello {
        state: State::Ready.into(),
        egress: Some(blaze_proto::link::link_control::Egress {
            demand_bytes_per_s: 700,
            limit_bytes_per_s: 9000,
        }),
        ingress_bytes_per_s: Some(30),
        ..hello(&pair.flows[0])
    };
    let now = pair.now;
    let changed = pair.flows[1].on_layer_hello(now, &a, &said, said.epoch, None);
    assert!(changed.is_empty(), "no topic is planned because of a load: {changed:?}");
    let load = pair.flows[1].load_of(&a).unwrap();
    let expected = Load { out_bytes_per_s: 700, in_bytes_per_s: 30, limit_bytes_per_s: 9000 };
    assert_eq!((load, load.total()), (expected, 730));
    assert_eq!(pair.flows[0].announced(), announced);
    let absurd = Hello { ingress_bytes_per_s: Some(u64::MAX), ..said };
    pair.flows[1].on_layer_hello(now, &a, &absurd, absurd.epoch, None);
    assert_eq!(pair.flows[1].load_of(&a).unwrap().total(), u64::MAX);
}

#[test]
fn one_that_gave_or_got_a_topic_by_name_rests_for_ten_seconds() {
    let mut pair = Pair::new(0);
    pair.carries(0, &Carrying::Carries);
    pair.run(1000 * MS);
    pair.carries(0, &Carrying::HandedOver([7].into()));
    pair.run(100 * MS);
    let [a, b] = pair.names();
    assert!(
        !pair.flows[1].rests(pair.now, &a),
        "a topic that is handed to nobody by name says nothing"
    );
    pair.carries(0, &Carrying::Carries);
    pair.run(100 * MS);
    pair.carries(0, &Carrying::HandedOver(Handover { to: Some(b.clone()), ..[7].into() }));
    pair.run(100 * MS);
    assert!(pair.flows[1].was_given(&topic("t")) && !pair.flows[0].was_given(&topic("t")));
    for flow in &pair.flows {
        assert!(flow.rests(pair.now, &a) && flow.rests(pair.now, &b));
        assert!(!flow.rests(pair.now + REST, &a) && !flow.rests(pair.now + REST, &b));
    }
}

/// A robot that one of them reaches asks for the topic, or does so no more.
fn robot_asks(pair: &mut Pair, version: u64, asks: bool) {
    use blaze_proto::link::link_control::{Entry, Request};
    let robot = id("edge/robot-1");
    let entry =
        Entry { topic: "t".into(), node_request: asks.then(Request::default), ..Entry::default() };
    let now = pair.now;
    pair.flows[1].on_hello(now, &robot, &hello_of(&robot, Kind::Edge));
    pair.flows[1].on_control(now, &robot, Body::Delta(delta(version, vec![entry])));
}

#[test]
fn what_a_flow_carried_that_has_lost_its_way_out_begins_a_while_back() {
    let mut pair = Pair::new(0);
    pair.run(1000 * MS);
    let stops = |pair: &mut Pair| {
        pair.carries(0, &Carrying::Carries);
        pair.run(1000 * MS);
        pair.carries(0, &Carrying::No);
        pair.run(100 * MS);
    };
    stops(&mut pair);
    let now = pair.now;
    assert_eq!(pair.flows[1].begin_carrying(now, &topic("t"), true), Begin::Now, "nobody asks");
    robot_asks(&mut pair, 1, true);
    stops(&mut pair);
    let (now, ms) = (pair.now, pair.server_ms());
    match pair.flows[1].begin_carrying(now, &topic("t"), true) {
        Begin::Since { appended_ms, .. } => {
            assert!((3500..4500).contains(&(ms - appended_ms)), "{ms} {appended_ms}");
        }
        other => panic!("{other:?}"),
    }
    stops(&mut pair);
    robot_asks(&mut pair, 2, false);
    robot_asks(&mut pair, 3, true);
    let now = pair.now;
    let begin = pair.flows[1].begin_carrying(now, &topic("t"), true);
    assert_eq!(begin, Begin::Now, "whoever asks anew gets what is published from now on");
}

#[test]
fn who_hears_nothing_believes_no_silence() {
    let mut pair = Pair::new(0);
    pair.run(1000 * MS);
    let mut now = pair.now;
    let b = &mut pair.flows[1];
    b.on_own_hello(now, Some(0));
    let reach = |b: &Registry| b.world().flows[&id("cloud/a")].reach;
    // The own Hellos stay away, too.
    b.watch_flows(now + 2 * SILENT);
    assert_eq!(reach(b), Reach::Up);
    now += 2 * SILENT;
    // They are back, and the other's have as long as ever to follow.
    for after in 0..5 {
        b.on_own_hello(now + 500 * MS * after, Some(0));
        b.watch_flows(now + 500 * MS * after);
        assert_eq!(reach(b), Reach::Up, "{after}");
    }
    b.watch_flows(now + SILENT);
    assert_eq!(reach(b), Reach::Down);
}

#[test]
fn what_a_flow_had_not_read_before_it_fell_silent_is_taken_up() {
    let mut pair = Pair::new(0);
    pair.carries(0, &Carrying::Carries);
    pair.run(8000 * MS);
    let a = id("cloud/a");
    // A server's clock is far from 0, which says nothing.
    let (now, ms) = (pair.now, pair.server_ms() + 100_000);
    for (heard_ms, begins) in
        [(0, ms), (ms - 6000, ms - 6000), (ms + 5, ms), (ms - 90_000, ms - 30_000)]
    {
        let said = Hello { heard_ms, ..hello(&pair.flows[0]) };
        let b = &mut pair.flows[1];
        b.on_layer_hello(now, &a, &said, said.epoch, Some(ms));
        b.watch_flows(now + SILENT);
        let since = Begin::Since { appended_ms: begins - 1000, latest: [].into() };
        assert_eq!(b.begin_carrying(now + SILENT, &topic("t"), true), since, "{heard_ms}");
    }
}
