//! Who advertises and requests what: leases of the local services, and what other flows announce of
//! theirs.
//!
//! ```text
//! control payload ─► LeaseTable ─merge─► own topics in the World ─► Announcer ─► Delta, Snapshot to other flows
//! Hello, Delta, Snapshot of other flows ─► Remote ─► their topics in the World ─► planner
//! ```
//!
//! No input or output and no clock: its owner passes the time, sends what [`Registry::poll`] gives,
//! and plans the topics that each call reports as changed. Poll after every message and at
//! [`Registry::next_poll`].

mod access;
mod announce;
mod callers;
mod found;
mod gateways;
mod holder;
mod kept;
mod leases;
mod loads;
mod merge;
mod names;
mod parts;
mod peers;
mod pieces;
mod pull;
mod remote;
mod replicas;
mod stored;
mod types;
mod wire;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

use blaze_domain::control::{
    AdvertiseMessage, Answer, CallMessage, Common, ControlError, ControlMessage, ErrorCode,
    EventKind, LeaseKind, ParsedObject, parse_payload,
};
use blaze_domain::names::ChannelName;
use blaze_domain::{Durability, FlowId, Scope, TopicName};
use blaze_proto::link::link_control::{Body, RouteState};

use announce::{Announcer, MAX_LEASED_ENTRIES};
use callers::Callers;
use found::Found;
pub use found::FoundEndpoint;
use leases::LeaseTable;
pub use leases::{LapseReason, LapsedLease, LeaseKey, LeaseView, Terms};
pub use loads::{Load, REST};
pub(crate) use merge::requesters;
use names::NameBook;
pub use names::{LayerNames, NameFault, peers_channel};
pub use parts::LEGACY;
use parts::Legacies;
pub(crate) use parts::{MAX_PARTITIONS, carrying_states};
pub use peers::MAX_FLOWS;
pub use pieces::MAX_LINK_CONTROL_BYTES;
#[cfg(test)]
pub(crate) use pieces::entry_hash;
use remote::Remote;
use replicas::Hearing;
pub use replicas::SILENT;
pub use stored::{Restored, UnsavedLease};
pub use types::{
    AnswerOut, CallIn, CalledTopics, Changes, ControlOutcome, EventDraft, RegistryConfig,
    RemoteLease, SyncFaults,
};
pub(crate) use wire::MAX_ROUTES;

use crate::world::{FlowState, FlowView, Reach, ScopeEntry, World};

/// A message to another flow; `None`: to everybody on the channel of the layer broker.
type Outgoing = (Option<FlowId>, Body);

/// Where flows hear each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// On the inter scope.
    Link,
    /// On the channel of the layer broker.
    Layer,
}

/// All that a flow knows of who publishes and who wants which topic.
pub struct Registry {
    config: RegistryConfig,
    leases: LeaseTable,
    routes: BTreeMap<TopicName, Vec<RouteState>>,
    /// What flows of other groups are told.
    announcer: Announcer,
    /// What flows are told that share the layer broker, on its channel.
    layer_announcer: Announcer,
    /// Parts of snapshots that were said on that channel lately: version and part.
    said_parts: BTreeMap<(u64, u32), Instant>,
    /// This flow is a gateway and, when it was last looked at, spoke for flows of its group.
    speaks_for_others: bool,
    remotes: BTreeMap<FlowId, Remote>,
    /// What this flow hears of itself on the layer broker.
    hearing: Option<Hearing>,
    /// Flows whose last life is over, and until when they may come back with the services that they
    /// had.
    departed: BTreeMap<FlowId, Instant>,
    world: World,
    /// What waits for [`Registry::poll`].
    outgoing: VecDeque<Outgoing>,
    /// For the channel of the layer broker.
    layer_outgoing: Vec<Outgoing>,
    /// Where flows stopped that carried a topic out of the layer.
    legacies: Legacies,
    /// Topics whose carrier has changed.
    urgent: BTreeSet<TopicName>,
    /// When flows of the group last gave or got a topic by load.
    moves: BTreeMap<FlowId, Instant>,
    faults: SyncFaults,
    names: NameBook,
    /// Topics that a bridge of this flow reads from or writes to the layer scope.
    on_layer: BTreeSet<TopicName>,
    /// Scopes that belong to another flow: for the world they are not there.
    off: BTreeSet<Scope>,
    /// What the adapter of the ROS 2 network has found.
    found: Found,
    /// Who calls ROS 2 services through this flow.
    callers: Callers,
}

impl Registry {
    /// A registry without leases that knows no other flow; the own flow is starting.
    #[must_use]
    pub fn new(mut config: RegistryConfig) -> Self {
        let own = FlowView {
            node_scope: config.node_scope,
            layer_scope: config.layer_scope,
            ..FlowView::new(config.kind, config.epoch)
        };
        Self {
            leases: LeaseTable::new(
                config.max_leases.min(MAX_LEASED_ENTRIES),
                config.lease_stores.clone(),
            ),
            names: NameBook::new(config.layer_names.clone()),
            on_layer: BTreeSet::new(),
            off: BTreeSet::new(),
            found: Found::default(),
            callers: Callers::default(),
            routes: BTreeMap::new(),
            announcer: Announcer::default(),
            layer_announcer: Announcer::default(),
            said_parts: BTreeMap::new(),
            hearing: None,
            speaks_for_others: false,
            remotes: BTreeMap::new(),
            departed: BTreeMap::new(),
            world: World {
                me: config.me.clone(),
                flows: BTreeMap::from([(config.me.clone(), own)]),
                access: std::mem::take(&mut config.access),
            },
            outgoing: VecDeque::new(),
            layer_outgoing: Vec::new(),
            legacies: Legacies::new(),
            urgent: BTreeSet::new(),
            moves: BTreeMap::new(),
            faults: SyncFaults::default(),
            config,
        }
    }

    /// All flows and their topics.
    #[must_use]
    pub fn world(&self) -> &World {
        &self.world
    }

    /// What was ignored of other flows' announcements.
    #[must_use]
    pub fn faults(&self) -> SyncFaults {
        let left_out = [self.announcer.left_out(), self.layer_announcer.left_out()];
        SyncFaults {
            left_out_routes: left_out.iter().map(|left_out| left_out.routes).max().unwrap_or(0),
            left_out_topics: left_out.iter().map(|left_out| left_out.topics).max().unwrap_or(0),
            ..self.faults
        }
    }

    fn own_view(&mut self) -> Option<&mut FlowView> {
        self.world.flows.get_mut(&self.config.me)
    }

    /// The own flow's state has changed. Returns the topics to plan anew.
    pub fn set_state(&mut self, state: FlowState) -> BTreeSet<TopicName> {
        match self.own_view() {
            Some(own) if own.state != state => own.state = state,
            _ => return BTreeSet::new(),
        }
        self.all_topics()
    }

    /// The own flow has a new life on the link; its leases stay.
    pub fn set_epoch(&mut self, epoch: u64) {
        if let Some(own) = self.own_view() {
            own.epoch = epoch;
        }
    }

    /// Every topic that any flow has an entry for.
    #[must_use]
    pub fn all_topics(&self) -> BTreeSet<TopicName> {
        // Most flows have to do with the same ones: each is copied once.
        let mut topics: BTreeSet<&TopicName> = self.routes.keys().collect();
        for view in self.world.flows.values() {
            topics.extend(view.topics.keys());
        }
        for remote in self.remotes.values() {
            topics.extend(remote.topics_with_routes());
        }
        topics.into_iter().cloned().collect()
    }

    /// Takes a control payload that was received on a scope.
    pub fn control(&mut self, now: Instant, scope: Scope, payload: &[u8]) -> ControlOutcome {
        let mut outcome = ControlOutcome::default();
        let parsed = match parse_payload(payload) {
            Ok(objects) if scope != Scope::Inter => objects,
            Ok(_) => return outcome,
            Err(error) => {
                outcome.refuse(None, &error);
                return outcome;
            }
        };
        let mut dirty = BTreeSet::new();
        for object in parsed {
            if let Ok(ControlMessage::Call(call)) = &object.message {
                let fault = self.check_call(now, scope, call, &object.pointer).err();
                if let Some(fault) = &fault {
                    outcome.refuse(object.topic, fault);
                }
                let Common { id, reply_to, .. } = &call.common;
                let answers = |to| self.is_designated(scope, to, id.as_deref());
                if reply_to.as_ref().is_some_and(answers) {
                    let (call, pointer) = (call.clone(), object.pointer);
                    outcome.calls.push(CallIn { scope, pointer, call, fault });
                }
                continue;
            }
            let result = self.apply(now, scope, &object, &mut dirty, &mut outcome.touched);
            if let Err(error) = &result {
                outcome.refuse(object.topic, error);
            }
            let Some(reply_to) = object.reply_to else {
                continue;
            };
            let answer = match result {
                Ok(lease_s) => Answer::granted(object.id.clone(), &self.config.me, lease_s),
                Err(error) => Answer::refused(object.id.clone(), error),
            };
            outcome.answers.push(AnswerOut {
                designated: self.is_designated(scope, &reply_to, object.id.as_deref()),
                reply_to,
                id: object.id,
                body: answer.to_json(),
            });
        }
        outcome.changed = self.refresh(now, dirty);
        outcome
    }

    fn apply(
        &mut self,
        now: Instant,
        scope: Scope,
        object: &ParsedObject,
        dirty: &mut BTreeSet<TopicName>,
        touched: &mut BTreeSet<TopicName>,
    ) -> Result<u32, ControlError> {
        let message = object.message.as_ref().map_err(Clone::clone)?;
        let common = message.common();
        self.check_access(now, scope, message, &object.pointer)?;
        if scope == Scope::Layer
            && self.config.layer_answers_need_id
            && common.reply_to.is_some()
            && common.id.as_ref().is_none_or(String::is_empty)
        {
            return Err(ControlError::new(
                ErrorCode::InvalidValue,
                format!("{}/id", object.pointer),
                "is required here with reply_to, because answers share one channel",
            ));
        }
        self.check_name(now, scope, message, &object.pointer)?;
        let applied = self.leases.apply(now, scope, &self.config.me, message, &object.pointer)?;
        if applied.changed {
            dirty.insert(common.topic.clone());
        }
        touched.insert(common.topic.clone());
        Ok(applied.lease_s)
    }

    /// Whether a service may call another one: it advertises the requests.
    fn check_call(
        &mut self,
        now: Instant,
        scope: Scope,
        call: &CallMessage,
        pointer: &str,
    ) -> Result<(), ControlError> {
        let CalledTopics { request, .. } = CalledTopics::of(&call.common.topic, pointer)?;
        let common = Common { topic: request, ..call.common.clone() };
        let advertise = AdvertiseMessage {
            common: common.clone(),
            ..AdvertiseMessage::new(common.topic, common.service)
        };
        self.check_access(now, scope, &ControlMessage::Advertise(advertise), pointer)
    }

    /// Takes a topic's name on the layer broker, where the topic is to be on it.
    fn claim_name(&mut self, scope: Scope, topic: &TopicName) -> Result<(), NameFault> {
        if scope != Scope::Layer {
            return Ok(());
        }
        let (leases, on_layer) = (&self.leases, &self.on_layer);
        self.names.claim(topic, |other| on_layer.contains(other) || leases.has(other, Scope::Layer))
    }

    /// A bridge of this flow is to read or write a topic on the layer scope, whether or not anybody
    /// leases it there.
    ///
    /// # Errors
    /// [`NameFault`] where the layer broker cannot have it.
    pub fn put_on_layer(&mut self, topic: &TopicName) -> Result<(), NameFault> {
        self.claim_name(Scope::Layer, topic)?;
        self.on_layer.insert(topic.clone());
        Ok(())
    }

    /// The layer broker has a topic of somebody else's that it would not tell apart from this one.
    pub fn note_foreign_name(&mut self, topic: &TopicName, other: String) {
        self.names.note_foreign(topic, other);
    }

    /// Nobody uses the topic on the layer broker any more.
    pub fn forget_foreign_name(&mut self, topic: &TopicName) {
        self.names.forget_foreign(topic);
    }

    /// No bridge of this flow uses the topic on the layer scope any more.
    pub fn take_off_layer(&mut self, topic: &TopicName) {
        self.on_layer.remove(topic);
    }

    /// A scope belongs to another flow, or no longer does. While it does it is as if it were not
    /// there, and its leases are the other's; then they are to be read anew. Returns the topics to
    /// plan anew.
    pub fn set_in_use(&mut self, now: Instant, scope: Scope, in_use: bool) -> BTreeSet<TopicName> {
        let changes = if in_use { self.off.insert(scope) } else { self.off.remove(&scope) };
        if !changes {
            return BTreeSet::new();
        }
        let leased: BTreeSet<TopicName> =
            self.leases.topics().chain(self.found.topics()).cloned().collect();
        // On a ROS 2 network there are no leases.
        if in_use && scope != Scope::Ros2 {
            self.leases.give_up(scope);
        }
        let layer_scope = self.config.layer_scope.filter(|_| !self.off.contains(&Scope::Layer));
        if let Some(own) = self.own_view() {
            own.layer_scope = layer_scope;
        }
        self.show_node();
        self.show_ros2();
        let mut changed = self.all_topics();
        changed.extend(self.refresh(now, leased));
        changed
    }

    /// The own node scope in the world: calls come from it also where there is no broker.
    fn show_node(&mut self) {
        let has_broker = self.config.node_scope && !self.off.contains(&Scope::Node);
        let calls = !self.callers.is_empty();
        if let Some(own) = self.own_view() {
            own.node_scope = has_broker || calls;
        }
    }

    /// Whether the kept leases of a scope are still to be read.
    #[must_use]
    pub fn is_reading(&self, scope: Scope) -> bool {
        self.leases.is_reading(scope)
    }

    /// Whether this flow answers, of all that share the layer broker: the same one in every flow
    /// with the same view.
    fn is_designated(&self, scope: Scope, reply_to: &ChannelName, id: Option<&str>) -> bool {
        if scope == Scope::Node || self.config.layer_scope.is_none() {
            return true;
        }
        let weight = |flow: &FlowId| {
            let text = format!("{flow}|{reply_to}|{}", id.unwrap_or_default());
            pieces::text_hash(text.as_bytes())
        };
        let able = |flow: &FlowId, view: &FlowView| {
            (flow == &self.config.me || view.layer_scope == self.config.layer_scope)
                && view.state == FlowState::Ready
                && view.reach == Reach::Up
        };
        self.world
            .flows_of(&self.config.me.layer)
            .filter(|(flow, view)| able(flow, view))
            .max_by_key(|(flow, _)| (weight(flow), *flow))
            .is_none_or(|(flow, _)| *flow == self.config.me)
    }

    /// Merges the leases of these topics anew. Returns those that changed.
    fn refresh(&mut self, now: Instant, dirty: BTreeSet<TopicName>) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        for topic in dirty {
            let mut merged = merge::merge(&self.leases.of_topic(&topic));
            if self.found.network.is_some() {
                let access = self.access_of(&topic);
                merged.ros2 = self.found.merged(&self.config.me, &topic, &access);
            }
            let scopes = [
                (Scope::Node, &mut merged.node),
                (Scope::Layer, &mut merged.layer),
                (Scope::Ros2, &mut merged.ros2),
            ];
            for (scope, entry) in scopes {
                if self.off.contains(&scope) {
                    *entry = ScopeEntry::default();
                }
            }
            self.callers.add(&self.config.me, &topic, &mut merged.node);
            let Some(own) = self.world.flows.get_mut(&self.config.me) else {
                continue;
            };
            if own.topics.get(&topic).map_or(merged.is_empty(), |held| *held == merged) {
                continue;
            }
            if merged.is_empty() {
                own.topics.remove(&topic);
            } else {
                own.topics.insert(topic.clone(), merged);
            }
            self.mark(now, &topic);
            changed.insert(topic);
        }
        changed
    }

    /// Ends the leases whose time has come.
    pub fn expire(&mut self, now: Instant) -> Changes {
        let lapsed = self.leases.expire(now);
        let events = lapsed
            .iter()
            .map(|lease| EventDraft {
                event: EventKind::LeaseExpired,
                topic: Some(lease.topic.clone()),
                code: "lease_expired",
                detail: format!("{} of {} was not renewed", lease.key.kind, lease.key.service),
            })
            .collect();
        let changed = self.refresh(now, lapsed.iter().map(|lease| lease.topic.clone()).collect());
        Changes { events, changed, lapsed }
    }

    /// When the next lease lapses.
    #[must_use]
    pub fn next_expiry(&self) -> Option<Instant> {
        self.leases.next_expiry()
    }

    /// The most samples that an advertisement of the topic on that scope keeps per writer for late
    /// joiners, 0 = none; `None` where nobody leases the topic there.
    #[must_use]
    pub fn channel_depth(&self, topic: &TopicName, scope: Scope) -> Option<u32> {
        let of_scope = self.leases.of_topic(topic).filter(|lease| lease.key.scope == scope);
        let depth = |lease: LeaseView<'_>| match (lease.key.kind, lease.quality().durability) {
            (LeaseKind::Advertise, Durability::TransientLocal) => lease.quality().depth,
            _ => 0,
        };
        of_scope.map(depth).max()
    }

    /// Whether a service of that scope asks for the topic as JSON.
    #[must_use]
    pub fn wants_json(&self, topic: &TopicName, scope: Scope) -> bool {
        let mut of_scope = self.leases.of_topic(topic).filter(|lease| lease.key.scope == scope);
        of_scope.any(|lease| matches!(lease.terms, Terms::Request { json: true, .. }))
    }

    /// All leases, by topic.
    pub fn leases(&self) -> impl Iterator<Item = LeaseView<'_>> {
        self.leases.all()
    }

    /// How many leases there are.
    #[must_use]
    pub fn lease_count(&self) -> usize {
        self.leases.len()
    }

    /// The leases of a topic.
    pub fn leases_of(&self, topic: &TopicName) -> impl Iterator<Item = LeaseView<'_>> + Clone {
        self.leases.of_topic(topic)
    }

    /// The local services that advertise a topic.
    pub fn local_advertisers(&self, topic: &TopicName) -> impl Iterator<Item = LeaseView<'_>> {
        self.leases.of_topic(topic).filter(|lease| lease.key.kind == LeaseKind::Advertise)
    }

    /// Leases of a topic that lapsed or were refused and were not made anew, newest first, as far
    /// as remembered.
    pub fn lapsed(&self, topic: &TopicName) -> impl Iterator<Item = &LapsedLease> {
        self.leases.lapsed(topic)
    }

    /// Whether something is told of the own flow's routes of a topic.
    #[must_use]
    pub fn has_route_state(&self, topic: &TopicName) -> bool {
        self.routes.contains_key(topic)
    }

    /// What the own flow's routes of a topic do; told to others with its entry.
    pub fn set_route_state(&mut self, now: Instant, topic: &TopicName, routes: Vec<RouteState>) {
        let same = match self.routes.get(topic) {
            Some(held) => *held == routes,
            None => routes.is_empty(),
        };
        if same {
            return;
        }
        self.note_own_part(now, topic, &routes);
        if routes.is_empty() {
            self.routes.remove(topic);
        } else {
            self.routes.insert(topic.clone(), routes);
        }
        self.mark(now, topic);
    }
}

#[cfg(test)]
mod tests;
