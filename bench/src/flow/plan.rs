//! What a fleet costs one flow: how long it plans, and what it has to tell, with 10, 100 and 1,000
//! other nodes of 50 topics each.
//!
//! All of them announce themselves to one flow by the code of production, over a network that loses
//! nothing and takes no time. That flow plans for itself, or as a gateway that speaks for a flow of
//! its layer as well: then it tells that one of all the others.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_domain::node_file::AccessRules;
use blaze_domain::{FlowId, Scope, TopicName};
use blaze_flow::plan::{PlanRules, Survey, plan_topic, plan_within};
use blaze_flow::registry::{LayerNames, Registry, RegistryConfig};
use blaze_flow::world::{FlowState, LayerScopeId};
use blaze_proto::link::LinkControl;
use blaze_proto::link::link_control::{Body, Gateway, Goodbye, Hello, Kind, LayerScope, State};
use prost::Message as _;
use serde_json::json;

const NODES: [usize; 3] = [10, 100, 1_000];
const TOPICS: usize = 50;
/// Rows of a gateway.
const GATEWAY_NODES: [usize; 1] = [1_000];
/// The layer broker of the gateway and the flow that it speaks for.
const LAYER: LayerScopeId = LayerScopeId(1);
/// Hellos per second.
const HELLOS: f64 = 2.0;
/// IP, UDP and RTPS headers of a datagram.
const HEADERS: usize = 100;
/// Full plans that are timed.
const REPEATS: usize = 5;
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

fn registry(
    name: &str,
    layer_scope: Option<LayerScopeId>,
    now: Instant,
) -> anyhow::Result<Registry> {
    let me: FlowId = name.parse()?;
    let mut registry = Registry::new(RegistryConfig {
        kind: me.layer.as_str().parse()?,
        me,
        epoch: 1,
        node_scope: true,
        layer_scope,
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

fn lease(
    registry: &mut Registry,
    now: Instant,
    op: &str,
    topic: &str,
    rate_hz: u32,
) -> anyhow::Result<()> {
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

/// The Hello of a flow of the gateway's layer, on their channel.
fn layer_hello(registry: &Registry, is_gateway: bool) -> anyhow::Result<Hello> {
    let (registry_version, registry_digest) = registry.announced_on_layer();
    Ok(Hello {
        kind: Kind::Cloud.into(),
        layer_scope_id: LAYER.0,
        gateway: Gateway::Auto.into(),
        is_gateway,
        registry_version,
        registry_digest,
        ..hello(registry)?
    })
}

/// One flow, and those that it hears.
struct Fleet {
    now: Instant,
    hub: Registry,
    nodes: Vec<Registry>,
    /// A flow of its layer that it speaks for.
    member: Option<Registry>,
    /// Bytes that the flow told others, by way of answers.
    told: usize,
}

/// What it costs to plan and, for a gateway, to tell.
struct Cost {
    plan: Duration,
    tell: Duration,
    bridges: usize,
}

fn goodbye() -> Body {
    Body::Goodbye(Goodbye { epoch: 1 })
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort_unstable();
    times.get(times.len() / 2).copied().unwrap_or_default()
}

impl Fleet {
    fn new(count: usize, names: Names, is_gateway: bool) -> anyhow::Result<Self> {
        let now = Instant::now();
        let layer = is_gateway.then_some(LAYER);
        let mut hub = registry("cloud/hub", layer, now)?;
        let mut member = layer.map(|_| registry("cloud/member", layer, now)).transpose()?;
        let mut nodes = Vec::new();
        for number in 0..count {
            let mut node = registry(&format!("edge/node-{number}"), None, now)?;
            for topic in 0..TOPICS {
                lease(&mut node, now, "advertise", &names.topic(number, topic), 10)?;
            }
            nodes.push(node);
        }
        // A flow holds no more than 10,000 leases.
        let wanted = if names == Names::Shared { 1 } else { count.min(100) };
        for number in 0..wanted {
            for topic in 0..TOPICS {
                let topic = names.topic(number, topic);
                for flow in [&mut hub].into_iter().chain(&mut member) {
                    lease(flow, now, "request", &topic, 0)?;
                }
            }
        }
        let mut fleet = Self { now, hub, nodes, member, told: 0 };
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
            let flows: Vec<FlowId> =
                self.nodes.iter().map(|node| node.world().me.clone()).collect();
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
            let node =
                to.node.as_str().strip_prefix("node-").and_then(|number| number.parse().ok());
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

    /// A gateway gets to know the flow of its layer that it speaks for. Returns what that one says
    /// of itself.
    fn meet_member(&mut self, member: &mut Registry) -> anyhow::Result<Hello> {
        let (hub, from) = (self.hub.world().me.clone(), member.world().me.clone());
        member.poll(self.now);
        let hello = layer_hello(member, false)?;
        self.hub.on_layer_hello(self.now, &from, &hello, 1, None);
        member.on_layer_hello(self.now, &hub, &layer_hello(&self.hub, true)?, 1, None);
        for _ in 0..ROUNDS {
            if self.hub.is_in_step_with(&from) {
                self.settle();
                return Ok(hello);
            }
            self.now += Duration::from_millis(10);
            self.hub.poll(self.now);
            for (_, body) in self.hub.poll_layer() {
                member.on_layer_control(self.now, &hub, 1, body);
            }
            member.poll(self.now);
            for (_, body) in member.poll_layer() {
                self.hub.on_layer_control(self.now, &from, 1, body);
            }
        }
        anyhow::bail!("the gateway does not know its member after {ROUNDS} rounds")
    }

    /// The median times of a full plan, and of telling all topics when a gateway begins to speak
    /// for the other flow of its layer.
    fn cost(&mut self, topics: &[TopicName], rules: &PlanRules) -> anyhow::Result<Cost> {
        let comes_back = match self.member.take() {
            Some(mut member) => {
                let hello = self.meet_member(&mut member)?;
                Some((self.member.insert(member).world().me.clone(), hello))
            }
            None => None,
        };
        let (mut plans, mut tells, mut bridges) = (Vec::new(), Vec::new(), 0);
        for _ in 0..REPEATS {
            if let Some((member, hello)) = &comes_back {
                self.hub.on_layer_control(self.now, member, 1, goodbye());
                self.settle();
                self.hub.on_layer_hello(self.now, member, hello, 1, None);
            }
            let begin = Instant::now();
            let survey = Survey::of_all(self.hub.world());
            let planned = topics.iter().map(|topic| plan_within(&survey, topic, rules, None));
            let planned: Vec<_> = planned.collect();
            drop(survey);
            plans.push(begin.elapsed());
            bridges = planned.iter().map(|plan| plan.bridges.len()).sum();
            let before = self.hub.announced_on_layer();
            let begin = Instant::now();
            self.settle();
            tells.push(begin.elapsed());
            let told = before != self.hub.announced_on_layer();
            anyhow::ensure!(comes_back.is_none() || told, "nothing was told");
        }
        Ok(Cost { plan: median(plans), tell: median(tells), bridges })
    }

    /// What is marked is told.
    fn settle(&mut self) {
        for _ in 0..2 {
            self.hub.poll(self.now);
            self.hub.poll_layer();
            self.now += Duration::from_millis(20);
        }
        self.hub.poll(self.now);
    }

    fn topics(&self) -> Vec<TopicName> {
        self.hub.all_topics().into_iter().collect()
    }

    /// The median time of a change at one node, from its announcement until the flow has planned
    /// what follows.
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
            if self.member.is_some() {
                self.now += Duration::from_millis(20);
                self.hub.poll(self.now);
                anyhow::ensure!(!self.hub.has_unannounced(), "a change that is not told");
            }
            times.push(begin.elapsed());
            anyhow::ensure!(!changed.is_empty(), "a change without a consequence");
        }
        Ok(median(times))
    }
}

/// Measures and prints a table.
pub(crate) fn run() -> anyhow::Result<()> {
    println!(
        "{:>6} {:<7} {:<7} {:>9} {:>9} {:>14} {:>12} {:>12} {:>16}",
        "NODES",
        "NAMES",
        "GATEWAY",
        "TOPICS",
        "BRIDGES",
        "FULL PLAN/ms",
        "TELL ALL/ms",
        "CHANGE/us",
        "HELLO bytes/s"
    );
    for names in [Names::Shared, Names::Own] {
        for count in NODES {
            row(count, names, false)?;
        }
        for count in GATEWAY_NODES {
            row(count, names, true)?;
        }
    }
    Ok(())
}

fn row(count: usize, names: Names, is_gateway: bool) -> anyhow::Result<()> {
    let mut fleet = Fleet::new(count, names, is_gateway)?;
    let rules = PlanRules::default();
    let topics = fleet.topics();
    let cost = fleet.cost(&topics, &rules)?;
    let change = fleet.change(names, &rules)?;
    let hello = LinkControl::from(Body::Hello(hello(&fleet.hub)?)).encoded_len() + HEADERS;
    let told = is_gateway.then(|| format!("{:.2}", cost.tell.as_secs_f64() * 1e3));
    println!(
        "{count:>6} {:<7} {:<7} {:>9} {:>9} {:>14.2} {:>12} {:>12.1} {:>16.0}",
        format!("{names:?}").to_lowercase(),
        if is_gateway { "yes" } else { "-" },
        topics.len(),
        cost.bridges,
        cost.plan.as_secs_f64() * 1e3,
        told.as_deref().unwrap_or("-"),
        change.as_secs_f64() * 1e6,
        hello as f64 * HELLOS * count as f64
    );
    Ok(())
}
