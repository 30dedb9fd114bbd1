//! Endpoints of the own ROS 2 network, as its adapter finds them: beside leases the second source
//! of what is announced.
//!
//! ```text
//! set_found ─► owner of each endpoint ─► merged per topic ─► own topics in the World, scope ros2
//!              (again whenever flows of the network come and go)
//! ```
//!
//! They live as long as the adapter reports them: they have no time to live and are not stored. A
//! writer is announced by its owner alone, a reader by every flow of the network.

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use blaze_domain::control::LeaseKind;
use blaze_domain::node_file::TopicAccess;
use blaze_domain::{Durability, FlowId, Reliability, Scope, ServiceName, TopicName, WriterId};

use super::Registry;
use crate::plan::network::{Candidate, candidates, claimant, heir, is_of_service};
use crate::plan::told::{merge_offers, merge_requests};
use crate::world::{Advertise, Request, Ros2Network, ScopeEntry, Source};

/// A writer that no flow of the network has claimed for this long goes to the one that hashing
/// chooses.
const CLAIM_WITHIN: Duration = Duration::from_secs(2);
/// Samples kept per writer of a durable topic: discovery does not tell how many there are.
const KEPT_SAMPLES: u32 = 10;
/// Media type of what ROS 2 publishes.
const ENCODING: &str = "application/cdr";

/// A writer or a reader of a ROS 2 node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundEndpoint {
    /// Its GUID.
    pub guid: WriterId,
    /// Whether it publishes or wants the topic.
    pub kind: LeaseKind,
    /// ROS type, such as `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// RIHS01 hash of the type, or empty.
    pub type_hash: String,
    /// As it says.
    pub reliability: Reliability,
    /// As it says.
    pub durability: Durability,
    /// Finite lifespan in milliseconds; 0 = none.
    pub lifespan_ms: u32,
    /// Full name of its node, such as `/arm/Talker_1`; empty while it is not known.
    pub node: String,
    /// Its unicast addresses.
    pub locators: Vec<Ipv4Addr>,
}

/// A found endpoint and the flow that it belongs to.
#[derive(Debug, Clone)]
struct Held {
    endpoint: FoundEndpoint,
    owner: Option<FlowId>,
    /// Since when no flow has one of its addresses.
    unclaimed: Option<Instant>,
}

impl Held {
    fn new(endpoint: FoundEndpoint) -> Self {
        Self { endpoint, owner: None, unclaimed: None }
    }
}

/// All found endpoints; the adapter bounds them.
#[derive(Default)]
pub(super) struct Found {
    /// Where this flow is, whether or not it may use the network.
    pub(super) network: Option<Ros2Network>,
    topics: BTreeMap<TopicName, Vec<Held>>,
    /// Writers have other owners than when that was last asked for.
    owners_changed: bool,
    /// The flows that could own an endpoint, when that was last looked at.
    candidates: Vec<Candidate>,
    /// When an unclaimed endpoint goes to the next one.
    due: Option<Instant>,
}

impl Found {
    /// Replaces what was found. Returns the topics of which something has changed.
    fn set(&mut self, mut found: BTreeMap<TopicName, Vec<FoundEndpoint>>) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        self.topics.retain(|topic, held| {
            let endpoints = found.remove(topic).unwrap_or_default();
            if held.iter().map(|held| &held.endpoint).eq(&endpoints) {
                return true;
            }
            changed.insert(topic.clone());
            let mut known: BTreeMap<WriterId, Held> =
                held.drain(..).map(|held| (held.endpoint.guid, held)).collect();
            let hold = |endpoint: FoundEndpoint| match known.remove(&endpoint.guid) {
                Some(before) => Held { endpoint, ..before },
                None => Held::new(endpoint),
            };
            held.extend(endpoints.into_iter().map(hold));
            !held.is_empty()
        });
        for (topic, endpoints) in found.into_iter().filter(|(_, found)| !found.is_empty()) {
            changed.insert(topic.clone());
            self.topics.insert(topic, endpoints.into_iter().map(Held::new).collect());
        }
        self.owners_changed |= !changed.is_empty();
        changed
    }

    /// Finds the owners of a topic's endpoints.
    fn assign(&mut self, now: Instant, topic: &TopicName) {
        for held in self.topics.get_mut(topic).into_iter().flatten() {
            let (guid, locators) = (held.endpoint.guid, &held.endpoint.locators);
            let owner = if let Some(owner) = claimant(&self.candidates, locators, guid) {
                held.unclaimed = None;
                Some(owner)
            } else {
                let at = *held.unclaimed.get_or_insert(now) + CLAIM_WITHIN;
                if at > now {
                    self.due = Some(self.due.map_or(at, |due| due.min(at)));
                }
                heir(&self.candidates, guid).filter(|_| at <= now)
            };
            if held.owner.as_ref() != owner {
                held.owner = owner.cloned();
                self.owners_changed = true;
            }
        }
    }

    /// What this flow announces of a topic.
    pub(super) fn merged(
        &self,
        me: &FlowId,
        topic: &TopicName,
        access: &TopicAccess,
    ) -> ScopeEntry {
        let allowed = |held: &&Held| {
            let service = ServiceName::of_ros2_node(&held.endpoint.node);
            let (layer, node) = (me.layer.as_str(), me.node.as_str());
            access.allows(held.endpoint.kind, layer, node, service.as_str())
        };
        let all = || self.topics.get(topic).into_iter().flatten().filter(allowed);
        let own = |held: &&Held| held.owner.as_ref() == Some(me);
        let writers = all().filter(own).filter(|held| held.endpoint.kind == LeaseKind::Advertise);
        let offers: Vec<Advertise> = writers.map(|held| advertise(me, &held.endpoint)).collect();
        // Requests and replies of services go to the flow of the endpoint that they are for.
        let readers = all().filter(|held| own(held) || !is_of_service(topic));
        let readers = readers.filter(|held| held.endpoint.kind == LeaseKind::Request);
        let requests: Vec<Request> = readers.map(|held| request(me, &held.endpoint)).collect();
        ScopeEntry { advertise: merge_offers(&offers), request: merge_requests(&requests) }
    }

    pub(super) fn topics(&self) -> impl Iterator<Item = &TopicName> {
        self.topics.keys()
    }
}

impl Registry {
    /// This flow is on a ROS 2 network, or no longer. Returns the topics to plan anew.
    pub fn set_ros2_network(
        &mut self,
        now: Instant,
        network: Option<Ros2Network>,
    ) -> BTreeSet<TopicName> {
        if self.found.network == network {
            return BTreeSet::new();
        }
        self.found.network = network;
        self.show_ros2();
        let mut changed = self.all_topics();
        let topics = self.found.topics().cloned().collect();
        changed.extend(self.refresh(now, topics));
        changed.extend(self.update_found(now));
        changed
    }

    /// The own network in the world: none while it belongs to another layer.
    pub(super) fn show_ros2(&mut self) {
        let network = self.found.network.filter(|_| !self.off.contains(&Scope::Ros2));
        if let Some(own) = self.own_view() {
            own.ros2 = network;
        }
    }

    /// Replaces what was found on the ROS 2 network, by topic. Returns the topics to plan anew.
    pub fn set_found(
        &mut self,
        now: Instant,
        found: BTreeMap<TopicName, Vec<FoundEndpoint>>,
    ) -> BTreeSet<TopicName> {
        let changed = self.found.set(found);
        for topic in &changed {
            self.found.assign(now, topic);
        }
        self.refresh(now, changed)
    }

    /// Whether this flow owns each writer that has an owner, if that is not the same as when it was
    /// last taken.
    pub fn take_owned(&mut self) -> Option<BTreeMap<WriterId, bool>> {
        if !std::mem::take(&mut self.found.owners_changed) {
            return None;
        }
        let writers = self.found.topics.values().flatten();
        let writers = writers.filter(|held| held.endpoint.kind == LeaseKind::Advertise);
        let owned = writers
            .filter_map(|held| Some((held.endpoint.guid, *held.owner.as_ref()? == self.config.me)));
        Some(owned.collect())
    }

    /// Gives endpoints to other flows where flows of the network have come or gone, and those that
    /// nobody has claimed. Returns the topics to plan anew.
    pub fn update_found(&mut self, now: Instant) -> BTreeSet<TopicName> {
        if self.found.topics.is_empty() && self.found.network.is_none() {
            return BTreeSet::new();
        }
        let candidates = candidates(&self.world);
        let is_due = self.found.due.is_some_and(|due| due <= now);
        if candidates == self.found.candidates && !is_due {
            return BTreeSet::new();
        }
        (self.found.candidates, self.found.due) = (candidates, None);
        let topics: BTreeSet<TopicName> = self.found.topics.keys().cloned().collect();
        for topic in &topics {
            self.found.assign(now, topic);
        }
        self.refresh(now, topics)
    }

    /// What was found of a topic, each endpoint with its owner, if it has one yet.
    pub fn found<'a>(
        &'a self,
        topic: &TopicName,
    ) -> impl Iterator<Item = (&'a FoundEndpoint, Option<&'a FlowId>)> + use<'a> {
        let held = self.found.topics.get(topic).into_iter().flatten();
        held.map(|held| (&held.endpoint, held.owner.as_ref()))
    }
}

fn advertise(me: &FlowId, endpoint: &FoundEndpoint) -> Advertise {
    Advertise {
        rate_hz: None,
        max_bytes: None,
        encoding: ENCODING.to_owned(),
        type_name: endpoint.type_name.clone(),
        type_hash: endpoint.type_hash.clone(),
        reliability: endpoint.reliability,
        durability: endpoint.durability,
        depth: samples(endpoint.durability),
        priority: None,
        lifespan_ms: endpoint.lifespan_ms,
        sources: vec![source(me, endpoint)],
        more_sources: false,
    }
}

fn request(me: &FlowId, endpoint: &FoundEndpoint) -> Request {
    Request {
        max_rate_hz: None,
        lifespan_ms: endpoint.lifespan_ms,
        reliability: endpoint.reliability,
        durability: endpoint.durability,
        depth: samples(endpoint.durability),
        priority: None,
        from: Vec::new(),
        type_name: endpoint.type_name.clone(),
        type_hash: endpoint.type_hash.clone(),
        services: vec![source(me, endpoint)],
        more_services: 0,
        framed: true,
        bare: false,
        json: false,
    }
}

fn samples(durability: Durability) -> u32 {
    if durability == Durability::TransientLocal { KEPT_SAMPLES } else { 1 }
}

fn source(me: &FlowId, endpoint: &FoundEndpoint) -> Source {
    let service = ServiceName::of_ros2_node(&endpoint.node);
    Source { node: me.node.to_string(), service: service.to_string() }
}
