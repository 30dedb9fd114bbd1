//! What a fleet costs one flow: how long it plans, and what it has to tell, with 10, 100 and 1,000 other nodes of 50 topics each.
//!
//! All of them announce themselves to one flow by the code of production, over a network that loses nothing and takes no time.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_domain::node_file::AccessRules;
use blaze_domain::{FlowId, Scope, TopicName};
use blaze_flow::plan::{PlanRules, Survey, plan_topic, plan_within};
use blaze_flow::registry::{LayerNames, Registry, RegistryConfig};
use blaze_flow::world::FlowState;
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Hello, Kind, LayerScope, State};
use prost::Message as _;
use serde_json::json;

const NODES: [usize; 3] = [10, 100, 1_000];
const TOPICS: usize = 50;
/// Hellos per second.
const HELLOS: f64 = 2.0;
/// IP, UDP and RTPS headers of a datagram.
const HEADERS: usize = 100;
/// Changes that are timed.
const CHANGES: usize = 500;
/// Rounds in which snapshots are pulled, a few at a time.
const ROUNDS: usize = 2_000;

/// Names of the topics of a node.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Names {
    /// All nodes have the same.
    Shared,
    /// Each has its own.
    Own,
}

impl Names {
    fn topic(self, node: usize, topic: usize) -> String {
        match self {
            Self::Shared => format!("topic-{topic}"),
            Self::Own => format!("node-{node}/topic-{topic}"),
        }
    }
}

fn registry(name: &str, now: Instant) -> anyhow::Result<Registry> {
    let me: FlowId = name.parse()?;
    let mut registry = Registry::new(RegistryConfig {
        kind: me.layer.as_str().parse()?,
        me,
        epoch: 1,
        node_scope: true,
        layer_scope: None,
        max_leases: 10_000,
        layer_answers_need_id: false,
        layer_names: LayerNames::Any,
        lease_stores: Default::default(),
        access: AccessRules::default(),
        started: now,
    });
    registry.set_state(FlowState::Ready);
    Ok(registry)
}

fn lease(registry: &mut Registry, now: Instant, op: &str, topic: &str, rate_hz: u32) -> anyhow::Result<()> {
    let mut message = json!({"op": op, "topic": topic, "service": "bench", "ttl_s": 0});
    if op == "advertise" {
        message["rate_hz"] = rate_hz.into();
    }
    let outcome = registry.control(now, Scope::Node, message.to_string().as_bytes());
    anyhow::ensure!(outcome.faults == 0, "{message} was refused");
    Ok(())
}

fn hello(registry: &Registry) -> anyhow::Result<Hello> {
    let (registry_version, registry_digest) = registry.announced();
    let own = registry.world().own().context("no own flow")?;
    let me = &registry.world().me;
    Ok(Hello {
        layer: me.layer.to_string(),
        node: me.node.to_string(),
        kind: Kind::Edge.into(),
        epoch: own.epoch,
        registry_version,
        registry_digest,
        state: State::Ready.into(),
        layer_scope: LayerScope::None.into(),
        ..Hello::default()
    })
}

/// One flow, and those that it hears.
struct Fleet {
    now: Instant,
    hub: Registry,
    nodes: Vec<Registry>,
    /// Bytes that the flow told others, by way of answers.
    told: usize,
}

impl Fleet {
    fn new(count: usize, names: Names) -> anyhow::Result<Self> {
        let now = Instant::now();
        let mut hub = registry("cloud/hub", now)?;
        let mut nodes = Vec::new();
        for number in 0..count {
            let mut node = registry(&format!("edge/node-{number}"), now)?;
            for topic in 0..TOPICS {
                lease(&mut node, now, "advertise", &names.topic(number, topic), 10)?;
            }
            nodes.push(node);
        }
        // A flow holds no more than 10,000 leases.
        let wanted = if names == Names::Shared { 1 } else { count.min(100) };
        for number in 0..wanted {
            for topic in 0..TOPICS {
                lease(&mut hub, now, "request", &names.topic(number, topic), 0)?;
            }
        }
        let mut fleet = Self {
            now,
            hub,
            nodes,
            told: 0,
        };
        fleet.meet()?;
        Ok(fleet)
    }

    /// Hellos and what follows, until the flow knows what all others announce.
    fn meet(&mut self) -> anyhow::Result<()> {
        for _ in 0..ROUNDS {
            self.now += Duration::from_millis(100);
            // What is announced becomes so with a poll.
            self.exchange();
            let to_nodes = hello(&self.hub)?;
            let hub = self.hub.world().me.clone();
            for node in &mut self.nodes {
                node.on_hello(self.now, &hub, &to_nodes);
                let (from, said) = (node.world().me.clone(), hello(node)?);
                self.hub.on_hello(self.now, &from, &said);
            }
            self.exchange();
            let flows: Vec<FlowId> = self.nodes.iter().map(|node| node.world().me.clone()).collect();
            if flows.iter().all(|flow| self.hub.is_in_step_with(flow)) {
                return Ok(());
            }
        }
        anyhow::bail!("the flow does not know all others after {ROUNDS} rounds")
    }

    fn exchange(&mut self) {
        let hub = self.hub.world().me.clone();
        for (to, body) in self.hub.poll(self.now) {
            self.told += LinkControl::from(body.clone()).encoded_len() + HEADERS;
            let node = to
                .node
                .as_str()
                .strip_prefix("node-")
                .and_then(|number| number.parse().ok());
            let Some(node) = node.and_then(|index: usize| self.nodes.get_mut(index)) else {
                continue;
            };
            node.on_control(self.now, &hub, body);
        }
        for node in &mut self.nodes {
            let from = node.world().me.clone();
            for (to, body) in node.poll(self.now) {
                if to == hub {
                    self.hub.on_control(self.now, &from, body);
                }
            }
        }
    }

    fn topics(&self) -> Vec<TopicName> {
        self.hub.all_topics().into_iter().collect()
    }

    /// The median time of a change at one node, from its announcement until the flow has planned what follows.
    fn change(&mut self, names: Names, rules: &PlanRules) -> anyhow::Result<Duration> {
        let hub = self.hub.world().me.clone();
        let mut times = Vec::new();
        for number in 0..CHANGES {
            let index = number % self.nodes.len();
            let topic = names.topic(index, number % TOPICS);
            let node = &mut self.nodes[index];
            lease(node, self.now, "advertise", &topic, 20 + u32::try_from(number)?)?;
            self.now += Duration::from_millis(100);
            let from = node.world().me.clone();
            let deltas: Vec<Body> = node
                .poll(self.now)
                .into_iter()
                .filter(|(to, _)| *to == hub)
                .map(|(_, body)| body)
                .collect();
            anyhow::ensure!(!deltas.is_empty(), "a change that nobody hears of");
            let begin = Instant::now();
            let mut changed = std::collections::BTreeSet::new();
            for delta in deltas {
                changed.extend(self.hub.on_control(self.now, &from, delta));
            }
            for topic in &changed {
                std::hint::black_box(plan_topic(self.hub.world(), topic, rules, None));
            }
            times.push(begin.elapsed());
            anyhow::ensure!(!changed.is_empty(), "a change without a consequence");
        }
        times.sort_unstable();
        Ok(times[times.len() / 2])
    }
}

/// Measures and prints a table.
pub(crate) fn run() -> anyhow::Result<()> {
    println!(
        "{:>6} {:<7} {:>9} {:>9} {:>14} {:>12} {:>16}",
        "NODES", "NAMES", "TOPICS", "BRIDGES", "FULL PLAN/ms", "CHANGE/us", "HELLO bytes/s"
    );
    for names in [Names::Shared, Names::Own] {
        for count in NODES {
            let mut fleet = Fleet::new(count, names)?;
            let rules = PlanRules::default();
            let topics = fleet.topics();
            let begin = Instant::now();
            let survey = Survey::of_all(fleet.hub.world());
            let plans: Vec<_> = topics
                .iter()
                .map(|topic| plan_within(&survey, topic, &rules, None))
                .collect();
            drop(survey);
            let full = begin.elapsed();
            let bridges: usize = plans.iter().map(|plan| plan.bridges.len()).sum();
            let change = fleet.change(names, &rules)?;
            let hello = LinkControl::from(Body::Hello(hello(&fleet.hub)?)).encoded_len() + HEADERS;
            println!(
                "{count:>6} {:<7} {:>9} {bridges:>9} {:>14.2} {:>12.1} {:>16.0}",
                format!("{names:?}").to_lowercase(),
                topics.len(),
                full.as_secs_f64() * 1e3,
                change.as_secs_f64() * 1e6,
                hello as f64 * HELLOS * count as f64
            );
        }
    }
    Ok(())
}
