use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::{DropReason, Durability, Reliability};
use serde_json::json;

use super::*;
use crate::link::NameConflict;
use crate::plan::tests::generate::System;
use crate::plan::tests::worlds::{ask, entry, filter, id, offer, rules, topic, world};
use crate::plan::{PlanRules, TopicPlan, plan_topic};
use crate::testing::Random;
use crate::world::World;

/// A question, with everything well: each planned bridge is up and carried ten messages.
struct Setup {
    world: World,
    to: Option<&'static str>,
    plan: TopicPlan,
    bridges: Vec<BridgeFacts>,
    node_broker: BrokerFacts,
    layer_broker: BrokerFacts,
    routes: Vec<RouteFacts>,
    leases: Vec<LeaseHint>,
    conflicts: Vec<NameConflict>,
}

impl Setup {
    fn new(world: World) -> Self {
        let broker = |name: &str, at_most_once| BrokerFacts {
            name: name.to_owned(),
            health: BrokerHealth::Up,
            detail: String::new(),
            at_most_once,
        };
        let mut setup = Self {
            world,
            to: None,
            plan: TopicPlan::default(),
            bridges: Vec::new(),
            node_broker: broker("redis 7.0.15", true),
            layer_broker: broker("kafka", false),
            routes: Vec::new(),
            leases: Vec::new(),
            conflicts: Vec::new(),
        };
        setup.replan();
        setup
    }

    /// After a change of the world: plan and bridges follow.
    fn replan(&mut self) {
        self.plan = plan_topic(&self.world, &topic(), &PlanRules::default(), None);
        let up = |bridge: &crate::plan::Bridge| BridgeFacts {
            from: bridge.from,
            to: bridge.to.clone(),
            state: BridgeState::Up,
            received: 10,
            sent: 10,
            dropped: BTreeMap::new(),
            exceeds_advertised: false,
            denied: 0,
            unconverted: None,
        };
        self.bridges = self.plan.bridges.iter().map(up).collect();
    }

    fn drops(&mut self, reason: DropReason, sent: u64) {
        self.bridges[0].sent = sent;
        self.bridges[0].dropped.insert(reason, 10 - sent);
    }

    /// Messages that the rules keep from the first bridge.
    fn denies(&mut self, sent: u64) {
        self.bridges[0].sent = sent;
        self.bridges[0].denied = 10 - sent;
    }

    /// The rules of the flow that is asked.
    fn ruled(&mut self, rule: serde_json::Value) {
        self.world.access = rules(rule);
        self.replan();
    }

    fn route(&mut self, flow: &str, receiver: Option<&str>, step: StepKind, code: WhyCode) {
        let to = receiver.unwrap_or(flow);
        self.routes.push(RouteFacts {
            flow: id(flow),
            to_layer: id(to).layer,
            receiver: receiver.map(id),
            step,
            ok: code == WhyCode::Ok,
            code,
        });
    }

    /// What a flow says whose rules refuse the services of the layer of another flow.
    fn denied_layer(&mut self, flow: &str, of: &str) {
        self.route(flow, Some(of), StepKind::Plan, WhyCode::AccessDenied);
        self.routes.iter_mut().for_each(|route| route.receiver = None);
    }

    fn block_layer(&mut self, code: WhyCode) {
        self.plan.block_layer(&self.world.me, code, "it is another's");
        let plan = &self.plan;
        self.bridges.retain(|facts| {
            plan.bridges.iter().any(|bridge| (bridge.from, &bridge.to) == (facts.from, &facts.to))
        });
    }

    fn hint(&mut self, kind: StepKind, code: WhyCode) {
        self.leases.push(LeaseHint {
            flow: self.world.me.clone(),
            kind,
            service: "driver".to_owned(),
            code,
            detail: String::new(),
        });
    }

    /// Another program has the name of a flow, too.
    fn conflict(&mut self, flow: &str) {
        let detail = format!("2 programs run under the name {flow}");
        self.conflicts.push(NameConflict { flow: id(flow), is_refused: false, detail });
    }

    fn why(&self) -> Why {
        explain(&WhyInput {
            world: &self.world,
            topic: &topic(),
            to: self.to.map(|to| to.parse().unwrap()),
            plan: &self.plan,
            bridges: self.bridges.clone(),
            node_broker: Some(self.node_broker.clone()),
            layer_broker: Some(self.layer_broker.clone()),
            routes: self.routes.clone(),
            leases: self.leases.clone(),
            conflicts: self.conflicts.clone(),
        })
    }
}

struct Row {
    name: &'static str,
    flows: &'static [&'static str],
    change: fn(&mut Setup),
    verdict: Verdict,
    code: WhyCode,
    /// The step that carries the code.
    step: Option<StepKind>,
}

/// An edge node publishes, a cloud node asks; the edge node is asked why.
const PAIR: &[&str] = &["e/a@1 node+", "c/b@1 node-"];
/// The same, seen from the cloud.
const FROM_CLOUD: &[&str] = &["c/b@1 node-", "e/a@1 node+"];

macro_rules! rows {
    ($($name:literal: $flows:expr, $change:expr => $verdict:ident $code:ident $($step:ident)?;)+) => {
        vec![$(Row { name: $name, flows: $flows, change: $change, verdict: Verdict::$verdict,
            code: WhyCode::$code,
            step: rows!(@step $($step)?) }),+]
    };
    (@step) => { None };
    (@step $step:ident) => { Some(StepKind::$step) };
}

#[rustfmt::skip]
fn rows() -> Vec<Row> {
    rows! {
        "all is well": PAIR, |_| {} => Flowing Ok;
        "seen from the receiver": FROM_CLOUD, |_| {} => Flowing Ok;
        "one scope, no bridge": &["e/a node+ node-"], |_| {} => Flowing Ok;
        "over the layer": &["e/a@1 node+", "e/b@1 node-"], |_| {} => Flowing Ok;
        "two other flows": &["f/x@1", "e/a@1 node+", "c/b node-"], |_| {} => Flowing Ok;
        "nobody knows it": &["e/a"], |_| {} => NotFlowing NoAdvertise Advertise;
        "nobody advertises": &["e/a node-"], |_| {} => NotFlowing NoAdvertise Advertise;
        "nobody requests": &["e/a node+"], |_| {} => NotFlowing NoRequest Request;
        "nobody there requests": PAIR, |s| s.to = Some("f") => NotFlowing NoRequest Request;
        "nobody on that node requests": PAIR,
        |s| s.to = Some("c/x") => NotFlowing NoRequest Request;
        "that node requests": PAIR, |s| s.to = Some("c/b/logger") => Flowing Ok;
        "a service of that node on the layer": &["e/a node+", "c/b@1 layer-"],
        |s| s.to = Some("c/b") => Flowing Ok;
        "the advertise lapsed": &["e/a node-"], |s| s.hint(
            StepKind::Advertise,
            WhyCode::LeaseExpired,
        ) => NotFlowing LeaseExpired Advertise;
        "the request lapsed": &["e/a node+"], |s| s.hint(
            StepKind::Request,
            WhyCode::LeaseExpired,
        ) => NotFlowing LeaseExpired Request;
        "a lapsed request is no lapsed advertise": &["e/a"], |s| s.hint(
            StepKind::Request,
            WhyCode::LeaseExpired,
        ) => NotFlowing NoAdvertise Advertise;
        "a lease from elsewhere": &["e/a node-"], |s| s.hint(
            StepKind::Advertise,
            WhyCode::SourceMismatch,
        ) => NotFlowing SourceMismatch Advertise;
        "a name that the broker cannot express": &["e/a node-"], |s| s.hint(
            StepKind::Advertise,
            WhyCode::NameNotExpressible,
        ) => NotFlowing NameNotExpressible Advertise;
        "two names that are one on the broker": &["e/a node+"], |s| s.hint(
            StepKind::Request,
            WhyCode::NameCollision,
        ) => NotFlowing NameCollision Request;
        "not allowed": &["e/a node-"], |s| s.hint(
            StepKind::Advertise,
            WhyCode::AccessDenied,
        ) => NotFlowing AccessDenied Advertise;
        "a requester that the rules refuse": PAIR,
        |s| s.ruled(json!({"request": {"deny": ["c"]}})) => NotFlowing AccessDenied Plan;
        "one of two that the rules refuse": &[
            "e/a node+",
            "c/b node-",
            "f/d node-",
        ], |s| s.ruled(json!({"request": {"deny": ["c"]}})) => Degraded AccessDenied Plan;
        "the other one is allowed": &["e/a node+", "c/b node-", "f/d node-"], |s| {
            s.ruled(json!({"request": {"deny": ["c"]}}));
            s.to = Some("f");
        } => Flowing Ok;
        "a refused one that gets what another node of its layer is sent": &["e/a node+",
            "c/b@1 node-", "c/d@1 node-"], |s| {
            s.ruled(json!({"request": {"deny": ["c/b"]}}));
            s.to = Some("c/b");
        } => Flowing Ok;
        "the rules are no matter of others": &["f/x", "e/a node+", "c/b node-"],
        |s| s.ruled(json!({"request": {"deny": ["c"]}})) => Flowing Ok;
        "the sender says that its rules refuse a node": FROM_CLOUD, |s| s.route(
            "e/a",
            Some("c/b"),
            StepKind::Plan,
            WhyCode::AccessDenied,
        ) => NotFlowing AccessDenied Plan;
        "the sender says that its rules refuse a layer": &["c/b@1 layer-", "e/a@1 node+"],
        |s| s.denied_layer("e/a", "c/b") => NotFlowing AccessDenied Plan;
        "a layer that is refused is not its nodes": FROM_CLOUD,
        |s| s.denied_layer("e/a", "c/b") => Flowing Ok;
        "a publisher that the rules refuse": FROM_CLOUD,
        |s| s.ruled(json!({"advertise": {"deny": ["e"]}})) => NotFlowing AccessDenied Plan;
        "the receiver says that its rules refuse who publishes": PAIR, |s| s.route(
            "c/b",
            Some("c/b"),
            StepKind::Plan,
            WhyCode::AccessDenied,
        ) => NotFlowing AccessDenied Plan;
        "all messages are refused by the rules": FROM_CLOUD,
        |s| s.denies(0) => NotFlowing AccessDenied Admit;
        "some messages are refused by the rules": PAIR,
        |s| s.denies(4) => Degraded AccessDenied Admit;
        "no room for another lease": &["e/a node-"], |s| s.hint(
            StepKind::Advertise,
            WhyCode::TooManyLeases,
        ) => NotFlowing TooManyLeases Advertise;
        "no such origin": PAIR,
        |s| { ask(&mut s.world, "c/b", "node").from = vec![filter("x/*/*")]; s.replan(); } =>
        NotFlowing NoMatchingOrigin Plan;
        "other types": PAIR, |s| {
            offer(&mut s.world, "e/a", "node").type_name = "a/A".to_owned();
            ask(&mut s.world, "c/b", "node").type_name = "b/B".to_owned();
            s.replan();
        } => NotFlowing TypeMismatch Plan;
        "more asked than offered": PAIR,
        |s| { ask(&mut s.world, "c/b", "node").reliability = Reliability::Reliable; s.replan(); } =>
        Degraded QosMismatch Plan;
        "late joiners ask for more": PAIR,
        |s| { ask(&mut s.world, "c/b", "node").durability = Durability::TransientLocal; s
        .replan(); } => Degraded QosMismatch Plan;
        "the requester is down": &["e/a node+", "c/b down node-"],
        |_| {} => NotFlowing PeerDown Link;
        "another program has the requester's name": &["e/a node+", "c/b down node-"],
        |s| s.conflict("c/b") => NotFlowing NameInUse Link;
        "another program has the name of this flow": &["e/a node+"],
        |s| s.conflict("e/a") => NotFlowing NameInUse Link;
        "another program has a name, and it flows": PAIR, |s| s.conflict("c/b") => Flowing Ok;
        "another program has the name of a third": &["e/a node+", "c/b down node-", "x/y"],
        |s| s.conflict("x/y") => NotFlowing PeerDown Link;
        "a lost flow's word of a layer where others live": &[
            "e/a node+",
            "c/b@1",
            "c/d@1 down layer-",
        ], |_| {} => NotFlowing NoRequest Request;
        "a lost flow's word of a layer of its own": &[
            "e/a node+",
            "c/d@1 down layer-",
        ], |_| {} => NotFlowing PeerDown Link;
        "the requester goes away": &[
            "e/a node+",
            "c/b draining node-",
        ], |_| {} => NotFlowing PeerDown Link;
        "the requester starts": &[
            "e/a node+",
            "c/b starting node-",
        ], |_| {} => NotFlowing BridgeStarting Plan;
        "the publisher is down": &["c/b node-", "e/a down node+"],
        |_| {} => NotFlowing PeerDown Advertise;
        "the publisher starts": &[
            "e/a starting node+",
            "c/b node-",
        ], |_| {} => NotFlowing BridgeStarting Advertise;
        "the receiver does not answer": &[
            "e/a node+",
            "c/b suspect node-",
        ], |_| {} => NotFlowing PeerSuspect Link;
        "the sender does not answer": &[
            "c/b node-",
            "e/a suspect node+",
        ], |_| {} => NotFlowing PeerSuspect Link;
        "one of two is down": &[
            "e/a node+",
            "c/b node-",
            "c/d down node-",
        ], |_| {} => Degraded PeerDown Link;
        "the one that is meant is down": &[
            "e/a node+",
            "c/b node-",
            "c/d down node-",
        ], |s| s.to = Some("c/d") => NotFlowing PeerDown Link;
        "the other one is meant": &[
            "e/a node+",
            "c/b node-",
            "c/d down node-",
        ], |s| s.to = Some("c/b") => Flowing Ok;
        "the worst in the layer that is meant": &[
            "e/a node+",
            "c/b node-",
            "c/d down node-",
        ], |s| s.to = Some("c") => NotFlowing PeerDown Link;
        "not planned yet": PAIR,
        |s| { s.plan = TopicPlan::default(); s.bridges.clear(); } =>
        NotFlowing BridgeStarting Bridge;
        "planned, not made": PAIR, |s| s.bridges.clear() => NotFlowing BridgeStarting Bridge;
        "being made": PAIR,
        |s| s.bridges[0].state = BridgeState::Starting => NotFlowing BridgeStarting Bridge;
        "not made": PAIR,
        |s| s.bridges[0].state = BridgeState::Failed("refused".to_owned()) =>
        NotFlowing BridgeFailed Bridge;
        "the intake is not made": FROM_CLOUD,
        |s| s.bridges[0].state = BridgeState::Failed("refused".to_owned()) =>
        NotFlowing BridgeFailed Bridge;
        "an intake that no plan expected delivers": FROM_CLOUD,
        |s| { s.plan = TopicPlan::default(); s.bridges.clear(); } => Flowing Ok;
        "the source broker is away": PAIR,
        |s| s.node_broker.health = BrokerHealth::Down => NotFlowing BrokerDown Bridge;
        "the target broker is away": FROM_CLOUD,
        |s| s.node_broker.health = BrokerHealth::Down => NotFlowing BrokerDown Deliver;
        "another broker is away": PAIR,
        |s| s.layer_broker.health = BrokerHealth::Down => Flowing Ok;
        "another flow uses the source": PAIR,
        |s| s.node_broker.health = BrokerHealth::InUse => NotFlowing ScopeInUse Bridge;
        "another flow uses the target": &["e/a@1 node+ layer-"],
        |s| s.layer_broker.health = BrokerHealth::InUse => NotFlowing ScopeInUse Deliver;
        "another flow uses the scope where it would be advertised": &["e/a@1 layer-"],
        |s| s.node_broker.health = BrokerHealth::InUse => NotFlowing ScopeInUse Advertise;
        "another flow uses the scope where it would be requested": &["e/a@1 node+"],
        |s| s.layer_broker.health = BrokerHealth::InUse => NotFlowing ScopeInUse Request;
        "what a scope that is in use has to do with another layer": &["e/a@1 node+"],
        |s| { s.layer_broker.health = BrokerHealth::InUse; s.to = Some("c"); } =>
        NotFlowing NoRequest Request;
        "a lease that lapsed because the scope is another's": &["e/a@1 layer-"], |s| {
            s.node_broker.health = BrokerHealth::InUse;
            s.hint(StepKind::Advertise, WhyCode::LeaseExpired);
        } => NotFlowing ScopeInUse Advertise;
        "the target broker is away and its queue is full": FROM_CLOUD, |s| {
            s.node_broker.health = BrokerHealth::Down;
            s.drops(DropReason::QueueFull, 0);
        } => NotFlowing BrokerDown Deliver;
        "the broker is slower than the publisher": FROM_CLOUD,
        |s| s.drops(DropReason::QueueFull, 4) => Degraded RateLimited Deliver;
        "larger than the topic of the broker carries": FROM_CLOUD,
        |s| s.drops(DropReason::TooLarge, 0) => NotFlowing TooLarge Admit;
        "a name that is another's on the layer broker": &["e/a@1 node+", "e/b@1 node-"],
        |s| s.block_layer(WhyCode::NameCollision) => NotFlowing NameCollision Plan;
        "a name that the layer broker cannot have": &["e/a@1 node+ layer-"],
        |s| s.block_layer(WhyCode::NameNotExpressible) => NotFlowing NameNotExpressible Plan;
        "a way from the layer that it cannot have": &["e/b@1 node-", "e/a@1 node+"],
        |s| s.block_layer(WhyCode::NameCollision) => NotFlowing NameCollision Plan;
        "a way past the layer that cannot have it": PAIR,
        |s| s.block_layer(WhyCode::NameCollision) => Flowing Ok;
        "the writer's flow says that its layer broker cannot have it": &["e/b@1 node-",
            "e/a@1 node+"], |s| s.route(
            "e/a",
            None,
            StepKind::Plan,
            WhyCode::NameCollision,
        ) => NotFlowing NameCollision Plan;
        "the receiver says that its broker is away": PAIR, |s| s.route(
            "c/b",
            Some("c/b"),
            StepKind::Deliver,
            WhyCode::BrokerDown,
        ) => NotFlowing BrokerDown Deliver;
        "the receiver delivers in one way and not in the other": PAIR, |s| {
            s.route("c/b", Some("c/b"), StepKind::Deliver, WhyCode::Ok);
            s.route("c/b", Some("c/b"), StepKind::Deliver, WhyCode::ScopeInUse);
        } => NotFlowing ScopeInUse Deliver;
        "no budget at all": PAIR,
        |s| s.drops(DropReason::RateLimit, 0) => NotFlowing BudgetStarved Admit;
        "less budget than rate": PAIR,
        |s| s.drops(DropReason::RateLimit, 4) => Degraded RateLimited Admit;
        "thinned as asked": PAIR, |s| s.drops(DropReason::MaxRate, 4) => Flowing Ok;
        "the queue overflows": PAIR,
        |s| s.drops(DropReason::QueueFull, 4) => Degraded RateLimited Link;
        "all too large": PAIR, |s| s.drops(DropReason::TooLarge, 0) => NotFlowing TooLarge Admit;
        "some too large": PAIR, |s| s.drops(DropReason::TooLarge, 9) => Degraded TooLarge Admit;
        "too old on the link": PAIR,
        |s| s.drops(DropReason::Lifespan, 0) => NotFlowing Lifespan Link;
        "too old on arrival": FROM_CLOUD,
        |s| s.drops(DropReason::Lifespan, 0) => NotFlowing Lifespan Deliver;
        "the link went down": PAIR, |s| s.drops(DropReason::LinkDown, 5) => Degraded PeerDown Link;
        "the broker refuses": FROM_CLOUD,
        |s| s.drops(DropReason::BrokerError, 0) => NotFlowing BrokerDown Deliver;
        "messages of another type": PAIR,
        |s| s.drops(DropReason::TypeMismatch, 0) => NotFlowing TypeMismatch Admit;
        "messages from elsewhere": PAIR,
        |s| s.drops(DropReason::ForeignOrigin, 0) => NotFlowing SourceMismatch Admit;
        "repeats are no fault": PAIR, |s| s.drops(DropReason::Duplicate, 5) => Flowing Ok;
        "the sender says why": FROM_CLOUD, |s| s.route(
            "e/a",
            Some("c/b"),
            StepKind::Admit,
            WhyCode::BudgetStarved,
        ) => NotFlowing BudgetStarved Admit;
        "the sender says that all is well": FROM_CLOUD, |s| s.route(
            "e/a",
            Some("c/b"),
            StepKind::Deliver,
            WhyCode::Ok,
        ) => Flowing Ok;
        "the receiver says why": PAIR, |s| s.route(
            "c/b",
            None,
            StepKind::Deliver,
            WhyCode::BrokerDown,
        ) => NotFlowing BrokerDown Deliver;
        "a route to somewhere else says nothing": FROM_CLOUD, |s| s.route(
            "e/a",
            Some("f/x"),
            StepKind::Admit,
            WhyCode::BudgetStarved,
        ) => Flowing Ok;
        "a type without a definition": PAIR,
            |s| s.route("c/b", None, StepKind::Deliver, WhyCode::TypeUnknown)
            => NotFlowing TypeUnknown Deliver;
        "the receiver cannot convert it": PAIR,
            |s| s.route("c/b", None, StepKind::Deliver, WhyCode::ConvertError)
            => NotFlowing ConvertError Deliver;
        "a conversion that fails": PAIR, |s| s.drops(DropReason::ConvertError, 0)
            => NotFlowing ConvertError Deliver;
        "no message is converted": PAIR, |s| {
            s.drops(DropReason::ConvertError, 0);
            s.bridges[0].unconverted = Some((WhyCode::TypeUnknown, "no definition".to_owned()));
        } => NotFlowing TypeUnknown Deliver;
        "the last message was not converted": PAIR,
            |s| s.bridges[0].unconverted = Some((WhyCode::ConvertError, "/x: no".to_owned()))
            => Degraded ConvertError Deliver;
        "an endpoint without an address": PAIR,
            |s| s.route("c/b", None, StepKind::Deliver, WhyCode::Unreachable)
            => NotFlowing Unreachable Deliver;
        "two ROS 2 nodes on one network": &["e/a net1 ros2+ ros2-"], |_| {}
            => Flowing NativePath Plan;
        "of two flows on it": &["e/a@1 net1 ros2+ ros2-", "e/b@1 net1 ros2-"], |_| {}
            => Flowing NativePath Plan;
        "a ROS 2 writer for another layer": &["e/a net1 ros2+", "c/b net1 ros2-"], |_| {}
            => Flowing Ok;
        "no bridge from ROS 2 yet": &["e/a net1 ros2+", "c/b net1 ros2-"], |s| s.bridges.clear()
            => NotFlowing BridgeStarting Bridge;
        "JSON that is not converted": &["e/a@1 node+ layer-j"],
            |s| s.drops(DropReason::ConvertError, 0) => NotFlowing ConvertError Deliver;
        "a route that is native, as another flow says": PAIR, |s| s.routes.push(RouteFacts {
            flow: id("c/b"), to_layer: id("c/b").layer, receiver: None, step: StepKind::Deliver,
            ok: true, code: WhyCode::NativePath,
        }) => Flowing NativePath Deliver;
    }
}

/// More budget would not help where more is published than was advertised.
#[test]
fn whoever_publishes_more_than_it_says_is_told_so() {
    let mut setup = Setup::new(world(PAIR));
    setup.drops(DropReason::RateLimit, 4);
    assert!(setup.why().remedy.contains("limit_mbps"));
    setup.bridges[0].exceeds_advertised = true;
    let why = setup.why();
    assert_eq!((why.code, why.remedy), (WhyCode::RateLimited, remedy::OF_AN_EXCESS));
    let admit = why.steps.iter().find(|step| step.code == WhyCode::RateLimited).unwrap();
    assert!(admit.detail.ends_with("more is published than was advertised"), "{admit:?}");
    // Skipped for nothing of the kind.
    setup.bridges[0].dropped.clear();
    setup.drops(DropReason::QueueFull, 4);
    assert!(setup.why().remedy.contains("limit_mbps"));
}

#[test]
fn verdict_and_cause_of_each_case() {
    let mut seen = BTreeSet::new();
    for row in rows() {
        let mut setup = Setup::new(world(row.flows));
        (row.change)(&mut setup);
        let why = setup.why();
        assert_eq!((why.verdict, why.code), (row.verdict, row.code), "{}: {why:#?}", row.name);
        let naming = why.steps.iter().find(|step| step.code == row.code && row.code != WhyCode::Ok);
        assert_eq!(naming.map(|step| step.step), row.step, "{}: {why:#?}", row.name);
        let failing = why.steps.iter().find(|step| !step.ok);
        assert!(
            failing.is_none_or(|step| step.code == why.code),
            "{}: the first failing step names the code",
            row.name
        );
        assert!(why.steps.iter().all(|step| step.ok || step.code != WhyCode::Ok), "{}", row.name);
        assert!(!why.remedy.is_empty());
        seen.extend(why.steps.iter().map(|step| step.code).chain([why.code]));
    }
    // The two that are left have tests of their own below.
    let missing: Vec<_> = WhyCode::ALL.iter().filter(|code| !seen.contains(code)).collect();
    assert_eq!(missing, [&WhyCode::NotOwner]);
}

/// The flow of `f/a` and `f/b` that does not carry the topic, and the one that does.
fn replicas() -> (World, FlowId) {
    let mut world = world(&["f/a@1 layer+", "f/b@1 layer+", "c/x@1 layer-"]);
    let owner = crate::plan::owner(&world, &topic()).unwrap();
    world.me = if owner == id("f/a") { id("f/b") } else { id("f/a") };
    (world, owner)
}

#[test]
fn a_replica_names_the_one_that_carries_the_topic() {
    let (world, owner) = replicas();
    let mut setup = Setup::new(world);
    let why = setup.why();
    assert_eq!((why.verdict, why.code), (Verdict::NotFlowing, WhyCode::NotOwner));
    let step = why.steps.iter().find(|step| !step.ok).unwrap();
    assert!(step.step == StepKind::Plan && step.detail.contains(&owner.to_string()), "{step:?}");
    setup.route(&owner.to_string(), Some("c/x"), StepKind::Deliver, WhyCode::Ok);
    let why = setup.why();
    assert_eq!((why.verdict, why.code), (Verdict::Flowing, WhyCode::Ok), "it says that it flows");
    let named = why.steps.iter().find(|step| step.code == WhyCode::NotOwner).unwrap();
    assert!(named.ok && named.detail.contains(&owner.to_string()), "{named:?}");
}

#[test]
fn the_answer_has_the_keys_of_the_contract_in_their_order() {
    let mut setup = Setup::new(world(PAIR));
    setup.to = Some("c/b");
    setup.bridges[0].state = BridgeState::Failed("topic refused".to_owned());
    let text = serde_json::to_string(&setup.why()).unwrap();
    let expected = concat!(
        r#"{"topic":"imu/data","to":"c/b","verdict":"not_flowing","code":"bridge_failed","remedy":"Read the step's "#,
        r#"detail: the broker refused what the bridge needs; it is tried again every 5 s.","steps":["#,
        r#"{"flow":"e/a","step":"advertise","ok":true,"code":"ok","detail":"driver on node scope"},"#,
        r#"{"flow":"c/b","step":"request","ok":true,"code":"ok","detail":"dashboard on node scope"},"#,
        r#"{"flow":"e/a","step":"plan","ok":true,"code":"ok","detail":"they match"},"#,
        r#"{"flow":"e/a","step":"bridge","ok":false,"code":"bridge_failed","detail":"node to inter, c/b: topic refused"}]}"#,
    );
    assert_eq!(text, expected);
    setup.to = None;
    assert!(serde_json::to_string(&setup.why()).unwrap().contains(r#""to":null"#));
}

#[test]
fn a_broker_that_is_another_s_or_away_is_described() {
    let mut setup = Setup::new(world(PAIR));
    setup.node_broker = BrokerFacts {
        name: "redis".to_owned(),
        health: BrokerHealth::InUse,
        detail: "edge/robot-7 holds it".to_owned(),
        at_most_once: true,
    };
    let detail =
        |setup: &Setup| setup.why().steps.iter().find(|step| !step.ok).unwrap().detail.clone();
    assert_eq!(detail(&setup), "another flow uses this redis: edge/robot-7 holds it");
    assert!(setup.why().remedy.contains("`prefix`"));
    setup.node_broker.health = BrokerHealth::Down;
    setup.node_broker.detail = "connection refused".to_owned();
    assert_eq!(detail(&setup), "redis does not answer: connection refused");
}

#[test]
fn a_refused_lease_is_named_with_the_facts() {
    let mut setup = Setup::new(world(&["e/a node-"]));
    setup.hint(StepKind::Advertise, WhyCode::NameCollision);
    setup.leases[0].detail = "is one name with imu_data".to_owned();
    setup.hint(StepKind::Advertise, WhyCode::LeaseExpired);
    let step = setup.why().steps.remove(0);
    assert_eq!(step.code, WhyCode::NameCollision, "the first is the newest");
    assert_eq!(step.detail, "name_collision of driver: is one name with imu_data");
}

#[test]
fn redis_says_that_it_is_at_most_once() {
    let mut setup = Setup::new(world(PAIR));
    offer(&mut setup.world, "e/a", "node").reliability = Reliability::Reliable;
    ask(&mut setup.world, "c/b", "node").reliability = Reliability::Reliable;
    setup.replan();
    let why = setup.why();
    assert_eq!(why.verdict, Verdict::Flowing);
    assert!(
        why.steps.iter().any(|step| step.detail.contains("redis 7.0.15 delivers at most once")),
        "{why:#?}"
    );
}

#[test]
fn an_answer_is_bounded_and_the_cause_comes_first() {
    let mut lines = vec!["e/a node+".to_owned()];
    lines.extend((0..500).map(|n| format!("c/n{n} node-")));
    lines.push("f/z down node-".to_owned());
    let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
    let mut setup = Setup::new(world(&lines));
    entry(&mut setup.world, "c/n0", "node").request.as_mut().unwrap().type_name = "b/B".to_owned();
    offer(&mut setup.world, "e/a", "node").type_name = "a/A".to_owned();
    setup.replan();
    let why = setup.why();
    assert_eq!((why.verdict, why.code), (Verdict::Degraded, WhyCode::TypeMismatch));
    assert_eq!(why.steps.len(), MAX_STEPS);
}

#[test]
fn a_target_is_a_layer_a_node_or_a_service() {
    for text in ["c", "c/b", "c/b/logger"] {
        assert_eq!(text.parse::<WhyTarget>().unwrap().to_string(), text);
    }
    for text in ["", "/b", "c/", "c/b/", "c/b/l/0", "C"] {
        assert!(text.parse::<WhyTarget>().is_err(), "{text}");
    }
}

/// The bridges that `why` looks for are those that the planner makes, no more and no less.
#[test]
fn why_and_the_planner_agree_in_random_systems() {
    let mut compared = 0;
    for seed in 0..300 {
        let mut system = System::random(&mut Random(seed));
        for view in system.world.flows.values_mut() {
            (view.state, view.reach) = (FlowState::Ready, Reach::Up);
        }
        for me in system.ids() {
            system.world.me = me.clone();
            let setup = Setup::new(system.world.clone());
            let why = setup.why();
            if why.steps.len() == MAX_STEPS {
                continue;
            }
            let own =
                why.steps.iter().filter(|step| step.step == StepKind::Bridge && step.flow == me);
            let looked_for: BTreeSet<String> = own.map(|step| step.detail.clone()).collect();
            let way = |bridge: &crate::plan::Bridge| {
                format!("{} to {}", bridge.from, trace::describe(&bridge.to))
            };
            let planned: BTreeSet<String> = setup.plan.bridges.iter().map(way).collect();
            let missing: Vec<_> = looked_for.difference(&planned).collect();
            assert!(missing.is_empty(), "seed {seed} {me}: {missing:?}\n{:#?}", setup.plan);
            // Beside an intake to the node there may be a bridge from the layer that only waits.
            let unexplained = planned.difference(&looked_for).filter(|way| {
                let intake = way.replace("layer to", "inter to");
                let waits = way.starts_with("layer to node") || *way == "layer to ros2";
                !(waits && looked_for.contains(&intake))
            });
            let unexplained: Vec<_> = unexplained.collect();
            assert!(unexplained.is_empty(), "seed {seed} {me}: {unexplained:?}\n{why:#?}");
            compared += planned.len();
        }
    }
    assert!(compared > 1000, "{compared}");
}
