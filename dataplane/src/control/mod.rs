//! The control side of one flow: leases in, plans out.
//!
//! ```text
//! control messages of services ─┐
//! Hello, Delta, Snapshot of flows ─┼─► registry ─► changed topics ─► (50 ms of quiet, 250 ms at most) ─► planner ─► plans
//! peers up, suspect, down ─────────┘                                                             └─► events, answers
//! ```
//!
//! Without input or output: what it wants done comes out of [`ControlCore::poll`]. Production
//! carries it out with tasks and brokers, the simulated network with plain calls.

mod balance;
mod calls;
mod carrying;
mod gateways;
mod info;
mod output;
mod planning;
mod replicas;
mod ros2;
mod routes;
mod scopes;
mod topic_states;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use blaze_domain::control::EventKind;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::AccessRules;
use blaze_domain::{FlowId, Scope, TopicName};
use blaze_proto::link::link_control::Body;
use bytes::Bytes;

use crate::link::LinkEvent;
use crate::link::transport::Endpoint;
use crate::plan::{PlanRules, TopicPlan};
use crate::registry::{EventDraft, Registry, RegistryConfig};
use crate::types::ConvertFailure;
use crate::world::{FlowState, OriginFilter, Reach, World};
use balance::Balance;
pub use balance::{LastMove, MoveReason, Moves, STAY};
use calls::Calls;
use carrying::Carriers;
pub use carrying::Duty;
use gateways::Gateways;
pub use gateways::Stage;
pub use output::{ControlConfig, Output};
use planning::Dirty;
use replicas::Replicas;
pub use replicas::read_replica_message;
use ros2::Ros2;
pub use scopes::ScopeHealth;
use scopes::Scopes;
pub use topic_states::TopicState;
use topic_states::TopicStates;

/// A changed topic is planned after this much quiet …
pub const QUIET: Duration = Duration::from_millis(50);
/// … and at the latest this long after its first change.
pub const LATEST: Duration = Duration::from_millis(250);
/// A flow listens for peers this long before it is ready.
pub const LISTEN: Duration = Duration::from_millis(1500);
/// A message about a definition is of no use later: it is asked for again.
const TYPES_WITHIN: Duration = Duration::from_secs(2);
/// All topics are planned anew that often, changed or not.
pub const RECONCILE: Duration = Duration::from_secs(5);

/// Leases, other flows, plans.
pub struct ControlCore {
    config: ControlConfig,
    registry: Registry,
    plans: BTreeMap<TopicName, TopicPlan>,
    topic_states: TopicStates,
    dirty: BTreeMap<TopicName, Dirty>,
    outputs: VecDeque<Output>,
    state: FlowState,
    started: Instant,
    reconciled: Instant,
    announced: (u64, u64),
    scopes: Scopes,
    /// Who advertises which topic as transient_local, in any flow.
    durable: BTreeMap<TopicName, BTreeSet<OriginFilter>>,
    replicas: Replicas,
    ros2: Ros2,
    calls: Calls,
    gateways: Gateways,
    carriers: Carriers,
    balance: Balance,
    /// Where other flows say that they are found.
    addresses: BTreeMap<FlowId, String>,
    /// Control payloads or parts of them that were refused.
    pub refused: u64,
    /// Control payloads that came faster than they could be read.
    pub overrun: u64,
    /// Kept leases that could not be taken.
    pub skipped_leases: u64,
}

impl ControlCore {
    /// A control core in state `starting`.
    #[must_use]
    pub fn new(config: ControlConfig, now: Instant) -> Self {
        let mut registry = Registry::new(RegistryConfig {
            me: config.me.clone(),
            kind: config.kind,
            epoch: config.epoch,
            node_scope: config.node_scope,
            layer_scope: config.layer_scope,
            max_leases: 10_000,
            layer_answers_need_id: config.layer_answers_need_id,
            layer_names: config.layer_names.clone(),
            lease_stores: config.lease_stores.clone(),
            access: config.access.clone(),
            started: now,
        });
        let gateways = Gateways::new(&config);
        registry.set_role(gateways.setting(&config), gateways.role());
        Self {
            replicas: Replicas::new(config.epoch),
            gateways,
            carriers: Carriers::default(),
            balance: Balance::default(),
            ros2: Ros2::default(),
            calls: Calls::default(),
            config,
            registry,
            plans: BTreeMap::new(),
            topic_states: TopicStates::default(),
            dirty: BTreeMap::new(),
            outputs: VecDeque::new(),
            state: FlowState::Starting,
            started: now,
            reconciled: now,
            announced: (0, 0),
            scopes: Scopes::default(),
            durable: BTreeMap::new(),
            addresses: BTreeMap::new(),
            refused: 0,
            overrun: 0,
            skipped_leases: 0,
        }
    }

    /// Leases and what other flows announced.
    #[must_use]
    pub fn registry(&self) -> &Registry {
        &self.registry
    }

    /// What this flow knows of all flows.
    #[must_use]
    pub fn world(&self) -> &World {
        self.registry.world()
    }

    /// Where another flow says that it is found.
    #[must_use]
    pub fn address_of(&self, flow: &FlowId) -> Option<&str> {
        self.addresses.get(flow).map(String::as_str)
    }

    /// The flow has a new life on the link; leases and plans stay.
    pub fn set_epoch(&mut self, epoch: u64) {
        self.registry.set_epoch(epoch);
    }

    /// The plans in force, by topic.
    #[must_use]
    pub fn plans(&self) -> &BTreeMap<TopicName, TopicPlan> {
        &self.plans
    }

    /// Topics that the flow knows, by state.
    pub fn topic_states(&self) -> impl Iterator<Item = (TopicState, u64)> {
        self.topic_states.counts()
    }

    /// Topics that are in a state, by its name in answers.
    pub fn topics_in_state(&self, state: &str) -> impl Iterator<Item = &TopicName> {
        self.topic_states.in_state(state)
    }

    /// What the flow says of itself.
    #[must_use]
    pub fn state(&self) -> FlowState {
        self.state
    }

    /// Tells all services that the flow has started, so that they send their leases again.
    pub fn announce_start(&mut self, wall_ms: u64) {
        self.tell(&event(EventKind::FlowStarted, None), wall_ms);
    }

    /// Changes the rules; every topic is planned anew.
    pub fn set_rules(&mut self, now: Instant, rules: PlanRules) {
        self.config.rules = rules;
        self.touch_all(now);
    }

    /// The layer broker has a topic of somebody else's with the name that this one would have: it
    /// is blocked there.
    pub fn refuse_name(&mut self, now: Instant, topic: TopicName, other: String) {
        self.registry.note_foreign_name(&topic, other);
        self.touch(now, BTreeSet::from([topic]));
    }

    /// Changes who may advertise and request what. Leases that are no longer allowed end; every
    /// topic is planned anew, because the rules hold for requesters of other flows, too.
    pub fn set_access(&mut self, now: Instant, wall_ms: u64, access: AccessRules) {
        let ended = self.registry.set_access(now, access);
        for event in &ended.events {
            self.tell(event, wall_ms);
        }
        for topic in &ended.changed {
            self.update_channels(topic);
        }
        self.save_leases();
        self.touch(now, ended.changed);
        self.touch_all(now);
    }

    /// Takes in nothing more: every bridge drains.
    pub fn start_draining(&mut self, now: Instant, wall_ms: u64) {
        self.set_state(now, FlowState::Draining);
        self.plan_changed(now, wall_ms);
        self.hand_over_all(now, wall_ms);
    }

    /// Takes a payload of the control channel of a scope.
    pub fn control(&mut self, now: Instant, wall_ms: u64, scope: Scope, payload: &[u8]) {
        let outcome = self.registry.control(now, scope, payload);
        self.refused += outcome.faults;
        // A channel is asked for before anybody is told that it may be used.
        self.update_channels_of(&outcome.touched);
        self.save_leases();
        let shared = scope == Scope::Layer && self.config.layer_answers_need_id;
        for answer in outcome.answers.into_iter().filter(|answer| answer.designated) {
            let body = Bytes::from(answer.body.to_string());
            let channel = if shared { ChannelName::shared_reply() } else { answer.reply_to };
            self.outputs.push_back(Output::Publish { scope, channel, body });
        }
        for event in &outcome.events {
            self.tell(event, wall_ms);
        }
        self.touch(now, outcome.changed);
        for call in outcome.calls {
            self.call(now, call);
        }
    }

    /// Takes what the link says of other flows.
    pub fn link_event(&mut self, now: Instant, event: LinkEvent) {
        if self.config.inter_scope
            && !self.gateways.is_inside()
            && matches!(event, LinkEvent::Hello { .. } | LinkEvent::Control { .. })
        {
            // Said before this flow left the inter scope.
            return;
        }
        let changed = match event {
            LinkEvent::Hello { from, hello } => {
                // The own address comes first.
                if let Some(address) = hello.addresses.first() {
                    self.addresses.insert(from.clone(), address.clone());
                }
                self.registry.on_hello(now, &from, &hello)
            }
            LinkEvent::Control { from, body } => match self.of_types(&from, body) {
                Some(body) => self.registry.on_control(now, &from, body),
                None => BTreeSet::new(),
            },
            LinkEvent::PeerUp(Endpoint { flow, .. }) | LinkEvent::PeerRecovered { flow } => {
                self.registry.set_reach(now, &flow, Reach::Up)
            }
            LinkEvent::PeerSuspect { flow } => self.registry.set_reach(now, &flow, Reach::Suspect),
            LinkEvent::PeerDown { endpoint, .. } => {
                self.registry.set_reach(now, &endpoint.flow, Reach::Down)
            }
            LinkEvent::PeerForgotten(Endpoint { flow, .. }) => {
                self.addresses.remove(&flow);
                self.registry.forget_link(now, &flow)
            }
            _ => BTreeSet::new(),
        };
        self.touch(now, changed);
        self.hurry(now);
    }

    /// Takes out what is about definitions of types.
    fn of_types(&mut self, from: &FlowId, body: Body) -> Option<Body> {
        if matches!(body, Body::TypeRequest(_) | Body::TypeDefinition(_)) {
            self.outputs.push_back(Output::Types { from: from.clone(), body: Box::new(body) });
            return None;
        }
        Some(body)
    }

    /// Sends a TypeRequest or TypeDefinition to another flow: over the link, or where that does not
    /// reach it over the layer broker.
    pub fn send_types(&mut self, now: Instant, to: &FlowId, body: Body) {
        if self.registry.is_on_layer_alone(to) {
            self.say(Some(to), body, Some(now + TYPES_WITHIN));
        } else {
            self.outputs.push_back(Output::Link { to: to.clone(), body: Box::new(body) });
        }
    }

    /// A message could not be converted.
    pub fn convert_failed(&mut self, wall_ms: u64, topic: TopicName, failure: &ConvertFailure) {
        let draft = EventDraft {
            event: EventKind::ConvertFailed,
            topic: Some(topic),
            code: failure.code.as_str(),
            detail: failure.to_string(),
        };
        self.tell(&draft, wall_ms);
    }

    /// Does what is due. To be called every few ten milliseconds.
    pub fn tick(&mut self, now: Instant, wall_ms: u64) {
        self.follow_choice(now);
        self.tell_layer_away(now);
        let listened = self.has_listened(now);
        let knows_leases = !Scope::LOCAL.iter().any(|scope| self.is_reading_leases(*scope));
        if self.state == FlowState::Starting && listened && knows_leases && self.knows_replicas(now)
        {
            self.set_state(now, FlowState::Ready);
        }
        let expired = self.registry.expire(now);
        for event in &expired.events {
            self.tell(event, wall_ms);
        }
        for lapsed in &expired.lapsed {
            self.update_channels(&lapsed.topic);
        }
        self.touch(now, expired.changed);
        self.save_leases();
        let changed = self.registry.watch_flows(now);
        self.touch(now, changed);
        self.follow_ros2(now);
        self.tell_owned();
        self.hurry(now);
        if now.saturating_duration_since(self.reconciled) >= RECONCILE {
            self.reconciled = now;
            self.touch_all(now);
        }
        self.take_back_late(now, wall_ms);
        self.follow_calls(now);
        self.plan_due(now, wall_ms);
        for (to, body) in self.registry.poll(now) {
            self.outputs.push_back(Output::Link { to, body: Box::new(body) });
        }
        self.tell_replicas(now);
        let announced = self.registry.announced();
        if announced != self.announced {
            self.announced = announced;
            self.outputs.push_back(Output::Announce { version: announced.0, digest: announced.1 });
        }
    }

    /// The next thing to do.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    fn set_state(&mut self, now: Instant, state: FlowState) {
        self.state = state;
        let changed = self.registry.set_state(state);
        self.show_on_link(now);
        self.hello_now();
        self.touch(now, changed);
        self.touch_all(now);
    }

    fn tell(&mut self, event: &EventDraft, wall_ms: u64) {
        if !event.detail.is_empty() {
            tracing::info!(
                event = event.event.as_str(),
                topic = event.topic.as_ref().map(TopicName::as_str),
                code = event.code,
                "{}",
                event.detail,
            );
        }
        let body = Bytes::from(event.stamp(&self.config.me, wall_ms).to_json().to_string());
        let scopes = [
            (Scope::Node, self.config.node_scope),
            (Scope::Layer, self.config.layer_scope.is_some()),
        ];
        for (scope, _) in scopes.into_iter().filter(|(_, there)| *there) {
            self.outputs.push_back(Output::Publish {
                scope,
                channel: ChannelName::events(),
                body: body.clone(),
            });
        }
    }
}

fn event(event: EventKind, topic: Option<TopicName>) -> EventDraft {
    EventDraft { event, topic, code: "", detail: String::new() }
}

#[cfg(test)]
mod tests;
