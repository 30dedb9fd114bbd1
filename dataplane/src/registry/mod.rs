//! Who advertises and requests what: leases of the local services, and what other flows announce of theirs.
//!
//! ```text
//! control payload ─► LeaseTable ─merge─► own topics in the World ─► Announcer ─► Delta, Snapshot to other flows
//! Hello, Delta, Snapshot of other flows ─► Remote ─► their topics in the World ─► planner
//! ```
//!
//! No input or output and no clock: its owner passes the time, sends what [`Registry::poll`] gives, and plans the topics
//! that each call reports as changed. Poll after every message and at [`Registry::next_poll`].

mod announce;
mod leases;
mod merge;
mod remote;
mod wire;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::control::{
    Answer, ControlError, ErrorCode, Event, EventKind, LeaseKind, ParsedObject, parse_payload,
};
use blaze_domain::names::ChannelName;
use blaze_domain::{FlowId, LayerKind, Scope, TopicName};
use blaze_proto::link::link_control::{Body, Hello, Kind, RouteState, State};
use serde_json::Value;

use announce::{Announcer, MAX_LEASED_ENTRIES};
use leases::LeaseTable;
pub use leases::{LapsedLease, LeaseKey, LeaseView, Terms};
use remote::Remote;
pub use remote::SyncFaults;
pub use wire::MAX_LINK_CONTROL_BYTES;

use crate::world::{Advertise, FlowState, FlowView, LayerScopeId, Reach, Request, World};

/// Most other flows that are followed.
pub const MAX_FLOWS: usize = 256;
/// Snapshots that are pulled at a time, so that their unfinished parts stay few.
const MAX_PULLS: usize = 8;
/// Messages to other flows that wait for [`Registry::poll`]; snapshot parts beyond it are asked for again.
const MAX_OUTGOING: usize = 2048;

/// What a registry is told once.
#[derive(Debug, Clone)]
pub struct RegistryConfig {
    /// The own flow.
    pub me: FlowId,
    /// Kind of its layer.
    pub kind: LayerKind,
    /// Its life.
    pub epoch: u64,
    /// Whether it has a node scope.
    pub node_scope: bool,
    /// The layer broker that it uses, if any.
    pub layer_scope: Option<LayerScopeId>,
    /// Most leases, at most 10,000.
    pub max_leases: usize,
    /// Answers on the layer scope share one channel (Kafka, DDS): a message that wants one must have an `id`.
    pub layer_answers_need_id: bool,
    /// When the flow started.
    pub started: Instant,
}

/// An event without its flow and time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventDraft {
    /// What happened.
    pub event: EventKind,
    /// The topic, if one is meant.
    pub topic: Option<TopicName>,
    /// Error code or verdict; empty where there is none.
    pub code: &'static str,
    /// For the log.
    pub detail: String,
}

impl EventDraft {
    /// The event as it is published, at a wall-clock time in milliseconds since 1970.
    #[must_use]
    pub fn stamp(&self, flow: &FlowId, unix_ms: u64) -> Event {
        Event::new(self.event, flow, self.topic.as_ref(), self.code, unix_ms)
    }
}

/// An answer to a control message that named a `reply_to`.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerOut {
    /// Where it goes, as the message said; brokers where answers share a channel send it there.
    pub reply_to: ChannelName,
    /// The `id` of the message.
    pub id: Option<String>,
    /// The answer.
    pub body: Value,
    /// Of several flows that received the message, this one is to answer.
    pub designated: bool,
}

/// What a control payload did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ControlOutcome {
    /// One for each object that wants one.
    pub answers: Vec<AnswerOut>,
    /// Refusals.
    pub events: Vec<EventDraft>,
    /// Topics whose own entry in the world changed.
    pub changed: BTreeSet<TopicName>,
    /// Topics with a lease that was granted, renewed or withdrawn: what is persisted is to be written again.
    pub touched: BTreeSet<TopicName>,
    /// Objects that were refused; 1 for a payload that is none.
    pub faults: u64,
}

/// What the passing of time did.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Changes {
    /// What happened.
    pub events: Vec<EventDraft>,
    /// Topics whose own entry in the world changed.
    pub changed: BTreeSet<TopicName>,
    /// The leases that lapsed.
    pub lapsed: Vec<LapsedLease>,
}

/// What another flow told of the services of one of its scopes.
#[derive(Debug, Clone, Copy)]
pub struct RemoteLease<'a> {
    /// The flow.
    pub flow: &'a FlowId,
    /// Its scope.
    pub scope: Scope,
    /// Merged advertisements, if any.
    pub advertise: Option<&'a Advertise>,
    /// Merged requests, if any.
    pub request: Option<&'a Request>,
}

/// All that a flow knows of who publishes and who wants which topic.
pub struct Registry {
    config: RegistryConfig,
    leases: LeaseTable,
    routes: BTreeMap<TopicName, Vec<RouteState>>,
    announcer: Announcer,
    remotes: BTreeMap<FlowId, Remote>,
    world: World,
    outgoing: VecDeque<(FlowId, Body)>,
    faults: SyncFaults,
}

impl Registry {
    /// A registry without leases that knows no other flow; the own flow is starting.
    #[must_use]
    pub fn new(config: RegistryConfig) -> Self {
        let own = FlowView {
            kind: config.kind,
            epoch: config.epoch,
            state: FlowState::Starting,
            reach: Reach::Up,
            node_scope: config.node_scope,
            layer_scope: config.layer_scope,
            topics: BTreeMap::new(),
        };
        Self {
            leases: LeaseTable::new(config.max_leases.min(MAX_LEASED_ENTRIES)),
            routes: BTreeMap::new(),
            announcer: Announcer::default(),
            remotes: BTreeMap::new(),
            world: World {
                me: config.me.clone(),
                flows: BTreeMap::from([(config.me.clone(), own)]),
            },
            outgoing: VecDeque::new(),
            faults: SyncFaults::default(),
            config,
        }
    }

    /// All flows and their topics.
    #[must_use]
    pub fn world(&self) -> &World {
        &self.world
    }

    /// When the flow started.
    #[must_use]
    pub fn started(&self) -> Instant {
        self.config.started
    }

    /// What was ignored of other flows' announcements.
    #[must_use]
    pub fn faults(&self) -> SyncFaults {
        SyncFaults {
            left_out_routes: self.announcer.left_out,
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
        let mut topics: BTreeSet<TopicName> = self.routes.keys().cloned().collect();
        for view in self.world.flows.values() {
            topics.extend(view.topics.keys().cloned());
        }
        for remote in self.remotes.values() {
            topics.extend(remote.topics_with_routes().cloned());
        }
        topics
    }

    // ---- leases of the local services

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
        let applied = self
            .leases
            .apply(now, scope, &self.config.me, message, &object.pointer)?;
        if applied.changed {
            dirty.insert(common.topic.clone());
        }
        touched.insert(common.topic.clone());
        Ok(applied.lease_s)
    }

    /// Whether this flow answers, of all that share the layer broker: the same one in every flow with the same view.
    fn is_designated(&self, scope: Scope, reply_to: &ChannelName, id: Option<&str>) -> bool {
        if scope == Scope::Node || self.config.layer_scope.is_none() {
            return true;
        }
        let weight = |flow: &FlowId| {
            let text = format!("{flow}|{reply_to}|{}", id.unwrap_or_default());
            wire::text_hash(text.as_bytes())
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
            let merged = merge::merge(&self.leases.of_topic(&topic));
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
            self.announcer.mark(now, topic.clone());
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
        Changes {
            events,
            changed,
            lapsed,
        }
    }

    /// When the next lease lapses.
    #[must_use]
    pub fn next_expiry(&self) -> Option<Instant> {
        self.leases.next_expiry()
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
        self.leases
            .of_topic(topic)
            .filter(|lease| lease.key.kind == LeaseKind::Advertise)
    }

    /// Leases of a topic that lapsed and were not made anew, oldest first, as far as remembered.
    pub fn lapsed(&self, topic: &TopicName) -> impl Iterator<Item = &LapsedLease> {
        self.leases.lapsed(topic)
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
        if routes.is_empty() {
            self.routes.remove(topic);
        } else {
            self.routes.insert(topic.clone(), routes);
        }
        self.announcer.mark(now, topic.clone());
    }

    // ---- other flows

    /// Version and digest of the announced state, for the own Hello.
    #[must_use]
    pub fn announced(&self) -> (u64, u64) {
        self.announcer.announced()
    }

    /// Another flow said Hello. Returns the topics to plan anew.
    pub fn on_hello(&mut self, now: Instant, from: &FlowId, hello: &Hello) -> BTreeSet<TopicName> {
        let Some(kind) = kind_of(hello).filter(|_| {
            *from != self.config.me && from.layer.as_str() == hello.layer && from.node.as_str() == hello.node
        }) else {
            self.faults.bad_hellos += 1;
            return BTreeSet::new();
        };
        let state = match hello.state() {
            State::Ready => FlowState::Ready,
            State::Draining => FlowState::Draining,
            State::Starting | State::Unspecified => FlowState::Starting,
        };
        let layer_scope = (hello.layer_scope_id != 0).then_some(LayerScopeId(hello.layer_scope_id));
        let mut changed = BTreeSet::new();
        match self.world.flows.get(from).map(|view| view.epoch) {
            Some(epoch) if hello.epoch < epoch => {
                self.faults.old_epochs += 1;
                return BTreeSet::new();
            }
            Some(epoch) if hello.epoch == epoch => {}
            Some(_) => changed = self.forget(from),
            None => changed = self.make_room(),
        }
        let is_new = !self.remotes.contains_key(from);
        if is_new && self.remotes.len() >= MAX_FLOWS {
            self.faults.too_many_flows += 1;
            return changed;
        }
        let view = self.world.flows.entry(from.clone()).or_insert_with(|| FlowView {
            kind,
            epoch: hello.epoch,
            state,
            reach: Reach::Up,
            node_scope: false,
            layer_scope,
            topics: BTreeMap::new(),
        });
        let same = !is_new && (view.kind, view.state, view.layer_scope) == (kind, state, layer_scope);
        (view.kind, view.state, view.layer_scope) = (kind, state, layer_scope);
        let remote = self.remotes.entry(from.clone()).or_insert_with(Remote::new);
        remote.on_hello(now, hello.registry_version, hello.registry_digest);
        if !same {
            // Which flow receives, reads or answers hangs on all live flows, whatever their own topics are.
            changed.extend(self.all_topics());
        }
        changed
    }

    /// Where there is no room for another flow, one that is down gives way.
    fn make_room(&mut self) -> BTreeSet<TopicName> {
        if self.remotes.len() < MAX_FLOWS {
            return BTreeSet::new();
        }
        let down = |(flow, view): (&FlowId, &FlowView)| {
            (view.reach == Reach::Down && *flow != self.config.me).then(|| flow.clone())
        };
        match self.world.flows.iter().find_map(down) {
            Some(flow) => self.forget(&flow),
            None => BTreeSet::new(),
        }
    }

    /// Another flow sent a Delta, a SnapshotRequest or a Snapshot; other bodies are not the registry's. Returns the
    /// topics to plan anew.
    pub fn on_control(&mut self, now: Instant, from: &FlowId, body: Body) -> BTreeSet<TopicName> {
        let (Some(remote), Some(view)) = (self.remotes.get_mut(from), self.world.flows.get_mut(from)) else {
            self.faults.unknown_flows += 1;
            return BTreeSet::new();
        };
        let changed = match body {
            Body::Delta(delta) => remote.on_delta(now, delta, &mut view.topics, &mut self.faults),
            Body::Snapshot(snapshot) => remote.on_snapshot(now, snapshot, &mut view.topics, &mut self.faults),
            Body::SnapshotRequest(request) => {
                for part in self.announcer.request(now, &request) {
                    if self.outgoing.len() >= MAX_OUTGOING {
                        self.faults.dropped_replies += 1;
                    } else {
                        self.outgoing.push_back((from.clone(), Body::Snapshot(part)));
                    }
                }
                return BTreeSet::new();
            }
            Body::Hello(_) | Body::Feedback(_) | Body::Goodbye(_) => return BTreeSet::new(),
        };
        // A Hello does not say whether there is a node scope: whoever has services on one has it.
        view.node_scope = view
            .topics
            .values()
            .any(|entry| entry.node.advertise.is_some() || entry.node.request.is_some());
        changed
    }

    /// Whether another flow can be reached. Returns the topics to plan anew.
    pub fn set_reach(&mut self, _now: Instant, flow: &FlowId, reach: Reach) -> BTreeSet<TopicName> {
        let Some(remote) = self.remotes.get_mut(flow) else {
            return BTreeSet::new();
        };
        match self.world.flows.get_mut(flow) {
            Some(view) if view.reach != reach => view.reach = reach,
            _ => return BTreeSet::new(),
        }
        if reach == Reach::Down {
            remote.stop();
        }
        self.all_topics()
    }

    /// The round trip to another flow, which decides when it is asked again.
    pub fn set_round_trip(&mut self, flow: &FlowId, round_trip: Duration) {
        if let Some(remote) = self.remotes.get_mut(flow) {
            remote.set_round_trip(round_trip);
        }
    }

    /// Another flow is gone for good. Returns the topics to plan anew.
    pub fn forget(&mut self, flow: &FlowId) -> BTreeSet<TopicName> {
        if !self.remotes.contains_key(flow) {
            return BTreeSet::new();
        }
        let topics = self.all_topics();
        self.remotes.remove(flow);
        self.world.flows.remove(flow);
        self.outgoing.retain(|(to, _)| to != flow);
        topics
    }

    /// What is to be sent to other flows now; each encodes to at most [`MAX_LINK_CONTROL_BYTES`].
    pub fn poll(&mut self, now: Instant) -> Vec<(FlowId, Body)> {
        let mut messages: Vec<(FlowId, Body)> = self.outgoing.drain(..).collect();
        self.announcer.tidy(now);
        let own = self.world.flows.get(&self.config.me);
        let routes = &self.routes;
        let deltas = self.announcer.announce(now, |topic| {
            let entry = own.and_then(|own| own.topics.get(topic));
            let routes = routes.get(topic).map(Vec::as_slice);
            (entry.is_some() || routes.is_some())
                .then(|| wire::to_wire(topic, &entry.cloned().unwrap_or_default(), routes.unwrap_or_default()))
        });
        let mut pulls = self.remotes.values().filter(|remote| remote.is_pulling()).count();
        for (flow, remote) in &mut self.remotes {
            if self.world.flows.get(flow).is_none_or(|view| view.reach == Reach::Down) {
                continue;
            }
            messages.extend(deltas.iter().map(|delta| (flow.clone(), Body::Delta(delta.clone()))));
            let was_pulling = remote.is_pulling();
            if let Some(request) = remote.poll(now, pulls < MAX_PULLS) {
                messages.push((flow.clone(), Body::SnapshotRequest(request)));
            }
            pulls = pulls + usize::from(remote.is_pulling()) - usize::from(was_pulling);
        }
        messages
    }

    /// When [`Registry::poll`] has something to send; an instant that has passed means at once.
    #[must_use]
    pub fn next_poll(&self) -> Option<Instant> {
        if !self.outgoing.is_empty() {
            return Some(self.config.started);
        }
        let requests = self.remotes.values().filter_map(Remote::next_poll);
        requests.chain(self.announcer.due()).min()
    }

    /// What other flows told of a topic, by flow and scope. The layer scope of a flow that shares the own layer broker
    /// is left out: those services hold leases here.
    pub fn remote_leases<'a>(&'a self, topic: &'a TopicName) -> impl Iterator<Item = RemoteLease<'a>> {
        let shares = |flow: &FlowId, view: &FlowView| {
            flow.layer == self.config.me.layer
                && self.config.layer_scope.is_some()
                && view.layer_scope == self.config.layer_scope
        };
        self.world
            .flows
            .iter()
            .filter(|(flow, _)| **flow != self.config.me)
            .flat_map(move |(flow, view)| {
                let entry = view.topics.get(topic);
                let node = entry.map(|entry| (Scope::Node, &entry.node));
                let layer = entry
                    .filter(|_| !shares(flow, view))
                    .map(|entry| (Scope::Layer, &entry.layer));
                node.into_iter().chain(layer).filter_map(move |(scope, entry)| {
                    (entry.advertise.is_some() || entry.request.is_some()).then_some(RemoteLease {
                        flow,
                        scope,
                        advertise: entry.advertise.as_ref(),
                        request: entry.request.as_ref(),
                    })
                })
            })
    }

    /// What another flow's routes of a topic do, as it told.
    #[must_use]
    pub fn remote_routes(&self, flow: &FlowId, topic: &TopicName) -> &[RouteState] {
        self.remotes.get(flow).map_or(&[], |remote| remote.routes(topic))
    }

    /// Whether all that another flow has announced is known.
    #[must_use]
    pub fn is_in_step_with(&self, flow: &FlowId) -> bool {
        self.remotes.get(flow).is_some_and(Remote::is_in_step)
    }
}

impl ControlOutcome {
    fn refuse(&mut self, topic: Option<TopicName>, error: &ControlError) {
        self.faults += 1;
        self.events.push(EventDraft {
            event: EventKind::LeaseRefused,
            topic,
            code: error.code.as_str(),
            detail: error.to_string(),
        });
    }
}

fn kind_of(hello: &Hello) -> Option<LayerKind> {
    match hello.kind() {
        Kind::Edge => Some(LayerKind::Edge),
        Kind::Fog => Some(LayerKind::Fog),
        Kind::Cloud => Some(LayerKind::Cloud),
        Kind::Unspecified => None,
    }
}

#[cfg(test)]
mod tests;
