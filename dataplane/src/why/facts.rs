//! What a verdict rests on.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use blaze_domain::{
    DropReason, FlowId, LayerName, NameError, NodeName, Scope, ServiceName, TopicName, WhyCode,
};
use serde::{Serialize, Serializer};

use super::StepKind;
use crate::link::NameConflict;
use crate::plan::{Target, TopicPlan};
use crate::world::World;

/// All that a verdict rests on.
#[derive(Debug, Clone)]
pub struct WhyInput<'a> {
    /// What the flow knows of all flows.
    pub world: &'a World,
    /// The topic that is asked about.
    pub topic: &'a TopicName,
    /// Whom it should reach; `None` = everybody who requests it.
    pub to: Option<WhyTarget>,
    /// The plan in effect.
    pub plan: &'a TopicPlan,
    /// The bridges that exist, with what went through them in the last seconds.
    pub bridges: Vec<BridgeFacts>,
    /// The broker of the node scope, if one is configured.
    pub node_broker: Option<BrokerFacts>,
    /// The broker of the layer scope, if one is configured.
    pub layer_broker: Option<BrokerFacts>,
    /// What other flows say of their routes of this topic.
    pub routes: Vec<RouteFacts>,
    /// Leases of this topic that lapsed lately or were refused, newest first.
    pub leases: Vec<LeaseHint>,
    /// Flows whose name several programs have.
    pub conflicts: Vec<NameConflict>,
}

/// `layer[/node[/service]]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WhyTarget {
    /// Layer of the requester.
    pub layer: LayerName,
    /// Its node.
    pub node: Option<NodeName>,
    /// Its service. Flows tell each other scopes, not services, so this does not narrow the answer.
    pub service: Option<ServiceName>,
}

/// A bridge that exists.
#[derive(Debug, Clone)]
pub struct BridgeFacts {
    /// Scope that it reads.
    pub from: Scope,
    /// Where it writes.
    pub to: Target,
    /// Whether it works.
    pub state: BridgeState,
    /// Messages that it took in during the last seconds.
    pub received: u64,
    /// Messages that it wrote during the same time.
    pub sent: u64,
    /// Messages that it, or the way to it, dropped during the same time.
    pub dropped: BTreeMap<DropReason, u64>,
    /// It is held to the rate that was advertised, because more is published.
    pub exceeds_advertised: bool,
    /// Messages that the rules of `flow.access` kept from it during the same time; not among those
    /// of `dropped`.
    pub denied: u64,
    /// Why the last message that could not be converted for it could not, if that was lately.
    pub unconverted: Option<(WhyCode, String)>,
}

/// Whether a bridge works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BridgeState {
    /// It is being made.
    Starting,
    /// It carries messages.
    Up,
    /// It could not be made, for this reason.
    Failed(String),
}

/// The broker of a scope.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrokerFacts {
    /// What it is, such as `redis 7.0.15`.
    pub name: String,
    /// Whether it works.
    pub health: BrokerHealth,
    /// Where it does not: the last error, or whose the scope is.
    pub detail: String,
    /// It loses messages of reliable topics (Redis Pub/Sub).
    pub at_most_once: bool,
}

/// Whether a broker works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrokerHealth {
    /// It answers.
    Up,
    /// It does not.
    Down,
    /// Another flow or another layer uses this scope.
    InUse,
}

/// What another flow says of one of its routes of the topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RouteFacts {
    /// The flow that says it.
    pub flow: FlowId,
    /// Layer that the route ends in.
    pub to_layer: LayerName,
    /// The flow that it sends to, if it ends in another flow.
    pub receiver: Option<FlowId>,
    /// The step it is at.
    pub step: StepKind,
    /// Whether it works.
    pub ok: bool,
    /// Why not, or what is not as asked for.
    pub code: WhyCode,
}

/// A lease that is missing, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeaseHint {
    /// The flow that had it or refused it.
    pub flow: FlowId,
    /// `Advertise` or `Request`.
    pub kind: StepKind,
    /// The service.
    pub service: String,
    /// `lease_expired`, `source_mismatch`, `access_denied`, `name_not_expressible`,
    /// `name_collision`, …
    pub code: WhyCode,
    /// The facts, for people; empty where the code says all.
    pub detail: String,
}

impl FromStr for WhyTarget {
    type Err = NameError;
    fn from_str(text: &str) -> Result<Self, NameError> {
        let mut parts = text.splitn(3, '/');
        Ok(Self {
            layer: parts.next().unwrap_or_default().parse()?,
            node: parts.next().map(str::parse).transpose()?,
            service: parts.next().map(str::parse).transpose()?,
        })
    }
}

impl fmt::Display for WhyTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.layer)?;
        self.node.iter().try_for_each(|node| write!(f, "/{node}"))?;
        self.service.iter().try_for_each(|service| write!(f, "/{service}"))
    }
}

impl Serialize for WhyTarget {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}
