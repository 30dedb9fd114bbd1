//! What one flow knows of all flows: the input of the planner.
//!
//! The registry builds it from local leases and from what other flows announced; the planner only
//! reads it.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::node_file::{AccessRules, AutoBool};
use blaze_domain::{
    Durability, FlowId, LayerKind, LayerName, Priority, Reliability, Scope, TopicName,
};
use blaze_proto::link::link_control::State;
use serde::Serialize;
use sha2::{Digest, Sha256};

/// All flows that one flow knows, itself included.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// The flow whose view this is; it has an entry in `flows`.
    pub me: FlowId,
    /// Every known flow, dead ones until they are forgotten.
    pub flows: BTreeMap<FlowId, FlowView>,
    /// Who may advertise and request what, as the node file of `me` says.
    pub access: AccessRules,
}

/// One flow as another sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowView {
    /// Kind of its layer.
    pub kind: LayerKind,
    /// Its life: larger is newer.
    pub epoch: u64,
    /// What it says of itself.
    pub state: FlowState,
    /// Whether it can be reached.
    pub reach: Reach,
    /// Whether it has a node scope.
    pub node_scope: bool,
    /// The layer broker that it uses: flows of one layer with equal values share it. `None`: it has
    /// none.
    pub layer_scope: Option<LayerScopeId>,
    /// The ROS 2 network that it is on, if any.
    pub ros2: Option<Ros2Network>,
    /// What its local services advertise and request.
    pub topics: BTreeMap<TopicName, TopicEntry>,
    /// It has been ready for as long as it takes to be given what others carry ([`SETTLED_AFTER`]).
    pub settled: bool,
    /// What it does for topics, as far as plans of other flows hang on it.
    pub parts: BTreeMap<TopicName, Part>,
    /// What its node file says of it as a gateway.
    pub gateway: AutoBool,
    /// Whether it is on the inter scope for its group.
    pub role: Role,
    /// The broker of its layer has not answered it for some seconds: another flow of its group
    /// serves that better.
    pub layer_away: bool,
}

impl FlowView {
    /// A flow that has said nothing but which kind and life it is.
    pub(crate) fn new(kind: LayerKind, epoch: u64) -> Self {
        Self {
            kind,
            epoch,
            state: FlowState::Starting,
            reach: Reach::Up,
            node_scope: false,
            layer_scope: None,
            ros2: None,
            topics: BTreeMap::new(),
            settled: false,
            parts: BTreeMap::new(),
            gateway: AutoBool::Auto,
            role: Role::Gateway,
            layer_away: false,
        }
    }
}

/// Whether a flow is on the inter scope for the flows that share its layer broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Role {
    /// It is: flows of other groups reach it.
    #[default]
    Gateway,
    /// It has been since a moment: what it wrote to the layer scope before is still carried out for
    /// it, and what it writes until it sends itself.
    NewGateway,
    /// It is still, for what is on its way, but has said that it will not be. Of the own flow only.
    Leaving,
    /// It is not: it reaches flows of other groups over the layer scope and a gateway.
    Member,
}

impl Role {
    /// Whether a flow with this role carries topics between its layer scope and other groups.
    #[must_use]
    pub fn is_gateway(self) -> bool {
        matches!(self, Self::Gateway | Self::NewGateway)
    }

    /// Whether it sends and receives on the inter scope.
    #[must_use]
    pub fn is_inside(self) -> bool {
        self != Self::Member
    }
}

/// A flow that has been ready for this long is given topics that a live one carries.
pub const SETTLED_AFTER: Duration = Duration::from_secs(5);

/// The part of a flow in one topic.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Part {
    /// Whether it carries what is published on its layer scope to other groups.
    pub carrying: Carrying,
    /// The flows that it sends the topic to over the inter scope, sorted.
    pub receivers: Vec<FlowId>,
    /// It sends to more flows than it can name.
    pub more_receivers: bool,
    /// Of the own flow, while it carries the topic: whether it keeps it.
    pub hold: Hold,
}

/// Whether a flow carries what services of its layer scope publish to other groups.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Carrying {
    /// It does not.
    #[default]
    No,
    /// It does.
    Carries,
    /// It did, and another one goes on.
    HandedOver(Handover),
}

/// Where a flow stopped that carried a topic out of its layer, and who goes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Handover {
    /// Offsets that the next one begins at, by partition.
    pub offsets: Arc<[i64]>,
    /// The flow that it is given to; `None`, and when that one is gone: whoever hashing chooses.
    pub to: Option<FlowId>,
}

#[cfg(test)]
impl<const N: usize> From<[i64; N]> for Handover {
    fn from(offsets: [i64; N]) -> Self {
        Self { offsets: offsets.into(), to: None }
    }
}

/// Whether a flow keeps what it carries out of its layer.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Hold {
    /// Until one that hashing prefers has settled.
    #[default]
    Hashing,
    /// It does: the topic was placed by load, or weighs too much to be moved by a hash.
    Stays,
    /// It gives it to this flow.
    GivesTo(FlowId),
}

/// Identity of a layer broker; two flows of one layer with the same value reach each other over it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LayerScopeId(pub u64);

impl LayerScopeId {
    /// Identity of a broker that only this process sees.
    #[must_use]
    pub fn private() -> Self {
        Self(rand::random::<u64>().max(1))
    }

    /// Identity of the Kafka broker of a layer: the same for all flows of the layer that give their
    /// names this prefix.
    #[must_use]
    pub fn kafka(prefix: &str) -> Self {
        Self::of(&format!("kafka|{prefix}"))
    }

    /// Identity of the DDS domain of a layer: the same for all flows of the layer that use it on
    /// its network. A domain on loopback is one of this host only, which `host` tells apart from
    /// others.
    #[must_use]
    pub fn dds(domain: u16, host: Option<&str>) -> Self {
        match host {
            None => Self::of(&format!("dds|{domain}")),
            Some(host) => Self::of(&format!("dds|{domain}|{host}")),
        }
    }

    fn of(text: &str) -> Self {
        Self(stable_id(text))
    }
}

/// The same for a text in every flow and version, and never 0.
fn stable_id(text: &str) -> u64 {
    let digest = Sha256::digest(text);
    let mut id = [0; 8];
    id.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(id).max(1)
}

/// Identity of a ROS 2 network: flows of one layer with the same value share it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ros2NetworkId(pub u64);

impl Ros2NetworkId {
    /// Identity of the network of a layer in this DDS domain.
    #[must_use]
    pub fn of_layer(domain: u16, layer: &LayerName) -> Self {
        Self(stable_id(&format!("ros2|{domain}|layer {layer}")))
    }

    /// The same on loopback, where all flows of a host share it, whatever their layers are.
    #[must_use]
    pub fn of_host(domain: u16, host: &str) -> Self {
        Self(stable_id(&format!("ros2|{domain}|host {host}")))
    }
}

/// Where a flow is on a ROS 2 network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ros2Network {
    /// Which network.
    pub id: Ros2NetworkId,
    /// Address of its interface there: it owns the writers that have it among their locators.
    pub address: Ipv4Addr,
}

/// What a flow says of itself: it begins, is ready, and goes, never the other way round in one
/// life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FlowState {
    /// It has not yet read its leases and listened for peers.
    #[default]
    Starting,
    /// It carries topics.
    Ready,
    /// It is going away: it takes in nothing more.
    Draining,
}

impl From<FlowState> for State {
    fn from(state: FlowState) -> Self {
        match state {
            FlowState::Starting => Self::Starting,
            FlowState::Ready => Self::Ready,
            FlowState::Draining => Self::Draining,
        }
    }
}

/// Whether a flow can be reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Reach {
    /// It says Hello and answers.
    Up,
    /// It has not answered for a moment: keep its routes, write nothing.
    Suspect,
    /// No sign of life: routes end.
    Down,
}

/// One topic of one flow, its services merged per scope.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TopicEntry {
    /// Services on the flow's node scope.
    pub node: ScopeEntry,
    /// Services on the layer scope (every flow that shares the layer broker has the same).
    pub layer: ScopeEntry,
    /// Writers of the ROS 2 network that the flow owns, and readers of the network (every flow on
    /// it has the same).
    pub ros2: ScopeEntry,
    /// What a gateway says that flows of other groups advertise and request, merged; for flows that
    /// are none.
    pub outside: ScopeEntry,
}

impl TopicEntry {
    /// Whether anybody asks for it.
    pub(crate) fn is_requested(&self) -> bool {
        self.scopes().iter().any(|(_, scope)| scope.request.is_some())
    }

    /// What is said of each scope; what a gateway tells of flows outside is of its inter scope.
    #[must_use]
    pub fn scopes(&self) -> [(Scope, &ScopeEntry); 4] {
        [
            (Scope::Node, &self.node),
            (Scope::Layer, &self.layer),
            (Scope::Ros2, &self.ros2),
            (Scope::Inter, &self.outside),
        ]
    }
}

/// What the services of one scope advertise and request of one topic.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ScopeEntry {
    /// Merged advertisements, if any.
    pub advertise: Option<Advertise>,
    /// Merged requests, if any.
    pub request: Option<Request>,
}

/// Advertisements of one topic in one scope, merged: sum of rates, largest size, strongest quality
/// of service.
#[derive(Debug, Clone, PartialEq)]
pub struct Advertise {
    /// Sum of the writers' rates; `None` where one of them gives none.
    pub rate_hz: Option<f64>,
    /// Largest payload in bytes, if all give it.
    pub max_bytes: Option<u64>,
    /// Media type of the payload, `application/octet-stream` unless given.
    pub encoding: String,
    /// ROS type, or empty.
    pub type_name: String,
    /// RIHS01 hash of the type, or empty.
    pub type_hash: String,
    /// Reliable if any is.
    pub reliability: Reliability,
    /// Transient local if any is.
    pub durability: Durability,
    /// Samples kept per writer.
    pub depth: u32,
    /// Highest class given; `None` = not said.
    pub priority: Option<Priority>,
    /// Longest lifespan in milliseconds; 0 = none.
    pub lifespan_ms: u32,
    /// Services behind it, for `from` filters; sorted.
    pub sources: Vec<Source>,
    /// `sources` leaves some out, so a filter by service may match one that is not listed.
    pub more_sources: bool,
}

/// Services that ask for a topic, of which so many are named.
pub const MAX_REQUESTERS: usize = 4;

/// A service that advertises or requests.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Source {
    /// Its node; empty where a service of the layer names none.
    pub node: String,
    /// Its name.
    pub service: String,
}

/// Requests of one topic in one scope, merged: highest rate, longest lifespan, highest class.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Highest `max_rate_hz`; `None` where one of them sets no limit.
    pub max_rate_hz: Option<f64>,
    /// Longest lifespan in milliseconds; 0 = none.
    pub lifespan_ms: u32,
    /// Reliable if any is.
    pub reliability: Reliability,
    /// Transient local if any is.
    pub durability: Durability,
    /// Samples kept per writer.
    pub depth: u32,
    /// Highest class that is asked for; `None` = as published.
    pub priority: Option<Priority>,
    /// Origins that are asked for, sorted; empty = any.
    pub from: Vec<OriginFilter>,
    /// ROS type that is expected, or empty.
    pub type_name: String,
    /// RIHS01 hash that is expected, or empty.
    pub type_hash: String,
    /// Services that ask, sorted, at most [`MAX_REQUESTERS`]: for people.
    pub services: Vec<Source>,
    /// How many more there are.
    pub more_services: u32,
    /// A service of this scope wants payloads with a header.
    pub framed: bool,
    /// A service of this scope wants bare payloads.
    pub bare: bool,
    /// A service of this scope wants payloads as JSON.
    pub json: bool,
}

/// Only messages of that origin; an absent part matches everything.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct OriginFilter {
    /// Layer of the publisher.
    pub layer: Option<String>,
    /// Node of the publisher.
    pub node: Option<String>,
    /// Service of the publisher.
    pub service: Option<String>,
}

impl OriginFilter {
    /// Whether an origin passes.
    #[must_use]
    pub fn matches(&self, layer: &str, node: &str, service: &str) -> bool {
        let part = |wanted: &Option<String>, found: &str| {
            wanted.as_deref().is_none_or(|wanted| wanted == found)
        };
        part(&self.layer, layer) && part(&self.node, node) && part(&self.service, service)
    }
}

impl TopicEntry {
    /// Whether nobody advertises or requests the topic here.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

impl World {
    /// The own flow.
    #[must_use]
    pub fn own(&self) -> Option<&FlowView> {
        self.flows.get(&self.me)
    }

    /// Whether a flow carries topics, as far as the own flow knows. Of itself it knows that it
    /// lives.
    pub(crate) fn carries(&self, id: &FlowId) -> bool {
        let flow = self.flows.get(id);
        flow.is_some_and(|flow| {
            flow.state == FlowState::Ready && (flow.reach != Reach::Down || *id == self.me)
        })
    }

    /// The flows of one layer, by node.
    pub fn flows_of<'a>(
        &'a self,
        layer: &'a LayerName,
    ) -> impl Iterator<Item = (&'a FlowId, &'a FlowView)> {
        self.flows.iter().filter(move |(id, _)| id.layer == *layer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_identity_of_a_kafka_broker_is_the_same_on_every_machine_and_in_every_version() {
        assert_eq!(LayerScopeId::kafka("").0, 0x7EA7_172E_AAB7_C9FB);
        assert_ne!(LayerScopeId::kafka(""), LayerScopeId::kafka("a."));
        let domains = [
            LayerScopeId::dds(1, None),
            LayerScopeId::dds(2, None),
            LayerScopeId::dds(1, Some("a")),
        ];
        assert!(domains[0] != domains[1] && domains[0] != domains[2]);
        assert_eq!(LayerScopeId::dds(1, Some("a")), domains[2]);
    }
}
