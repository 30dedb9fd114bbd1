//! The registry and other flows: their Hellos, what they announce, and what they are told.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use blaze_domain::node_file::AutoBool;
use blaze_domain::{FlowId, Scope, TopicName};
use blaze_proto::link::link_control::{Body, Hello, RouteState, State};

use super::gateways::patience;
use super::remote::Remote;
use super::types::RemoteLease;
use super::{Registry, Way};
use crate::link::kind_from_wire;
use crate::world::{
    FlowState, FlowView, LayerScopeId, OriginFilter, Reach, Role, Ros2Network, Ros2NetworkId,
    TopicEntry,
};

/// Most other flows that are followed.
pub const MAX_FLOWS: usize = 1280;
/// How long after its last sign of life a flow may come back with the services that it had: they
/// are not gone because it is.
const RETURNS: Duration = Duration::from_secs(60);
/// Snapshots that are pulled at a time, so that their unfinished parts stay few.
const MAX_PULLS: usize = 8;
/// Messages to other flows that wait for [`Registry::poll`]; snapshot parts beyond it are asked for
/// again.
const MAX_OUTGOING: usize = 2048;

impl Registry {
    /// Version and digest of what flows of other groups are told, for the own Hello on the inter
    /// scope.
    #[must_use]
    pub fn announced(&self) -> (u64, u64) {
        self.announcer.announced()
    }

    /// Another flow said Hello on the inter scope. Returns the topics to plan anew.
    pub fn on_hello(&mut self, now: Instant, from: &FlowId, hello: &Hello) -> BTreeSet<TopicName> {
        let mut changed = self.hear(now, from, hello, Way::Link);
        if let Some(remote) = self.remotes.get_mut(from) {
            remote.ways.link.get_or_insert(Reach::Up);
        }
        changed.extend(self.update_reach(now, from));
        changed
    }

    /// Another flow said Hello somewhere. Returns the topics to plan anew.
    pub(super) fn hear(
        &mut self,
        now: Instant,
        from: &FlowId,
        hello: &Hello,
        way: Way,
    ) -> BTreeSet<TopicName> {
        let Some(kind) = kind_from_wire(hello.kind()).filter(|_| {
            *from != self.config.me
                && from.layer.as_str() == hello.layer
                && from.node.as_str() == hello.node
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
        let ros2 = ros2_network(hello);
        let mut changed = BTreeSet::new();
        // Of a flow that shares the layer broker counts what it says there: on the inter scope it
        // speaks to others, and under lives of their own.
        if way == Way::Link && self.is_heard_on_layer(from) {
            if !self.has_left_layer(from, layer_scope) {
                return changed;
            }
            // It has another layer broker now, or none: from now on the inter scope is the only way
            // to it.
            changed = self.forget(now, from);
        }
        let known = self.world.flows.get(from);
        // A newer one that does not speak any more may have been a mistake.
        let is_over = known.is_some_and(|view| view.reach == Reach::Down);
        match known.map(|view| view.epoch) {
            Some(epoch) if hello.epoch < epoch && !is_over => {
                self.faults.old_epochs += 1;
                return BTreeSet::new();
            }
            Some(epoch) if hello.epoch == epoch => {}
            Some(_) => {
                // Its life before this one is over.
                self.inherit(now, from);
                self.await_return(now, from);
                changed.extend(self.forget(now, from));
            }
            None => changed.extend(self.make_room(now)),
        }
        let is_new = !self.remotes.contains_key(from);
        if is_new && self.remotes.len() >= MAX_FLOWS {
            self.faults.too_many_flows += 1;
            return changed;
        }
        let (gateway, role) = match way {
            Way::Link => (AutoBool::Yes, Role::Gateway),
            Way::Layer => self.said_role(now, from, hello),
        };
        let others = self.remotes.len();
        let new = || FlowView::new(kind, hello.epoch);
        let view = self.world.flows.entry(from.clone()).or_insert_with(new);
        // One that is heard in two places may say of itself what it said before.
        let state = if is_new { state } else { state.max(view.state) };
        let said = (kind, state, layer_scope, gateway, role, hello.layer_away);
        let (scope, away) = (view.layer_scope, view.layer_away);
        let same = (view.kind, view.state, scope, view.gateway, view.role, away) == said;
        let same = !is_new && same && view.ros2 == ros2;
        (view.kind, view.state, view.layer_scope, view.gateway, view.role, view.layer_away) = said;
        view.ros2 = ros2;
        let remote = self.remotes.entry(from.clone()).or_default();
        if way == Way::Layer {
            remote.link_peers = hello.link_peers;
        }
        let wait = || match way {
            Way::Link => Duration::ZERO,
            Way::Layer => patience(&self.config.me, others, from),
        };
        remote.on_hello(now, hello.registry_version, hello.registry_digest, wait);
        if !same {
            self.tell_of(now, from);
            // Which flow receives, reads or answers hangs on all live flows, whatever their own
            // topics are.
            changed.extend(self.all_topics());
        }
        changed
    }

    /// Where there is no room for another flow, one that is down gives way.
    fn make_room(&mut self, now: Instant) -> BTreeSet<TopicName> {
        if self.remotes.len() < MAX_FLOWS {
            return BTreeSet::new();
        }
        let down = |(flow, view): (&FlowId, &FlowView)| {
            (view.reach == Reach::Down && *flow != self.config.me).then(|| flow.clone())
        };
        match self.world.flows.iter().find_map(down) {
            Some(flow) => self.forget(now, &flow),
            None => BTreeSet::new(),
        }
    }

    /// Another flow sent a Delta, a SnapshotRequest or a Snapshot; other bodies are not the
    /// registry's. Returns the topics to plan anew.
    pub fn on_control(&mut self, now: Instant, from: &FlowId, body: Body) -> BTreeSet<TopicName> {
        let answers = matches!(body, Body::SnapshotRequest(_));
        if !answers && self.is_heard_on_layer(from) {
            return BTreeSet::new();
        }
        self.take(now, from, body, Way::Link)
    }

    /// The same, wherever it was heard.
    pub(super) fn take(
        &mut self,
        now: Instant,
        from: &FlowId,
        body: Body,
        way: Way,
    ) -> BTreeSet<TopicName> {
        let (Some(remote), Some(view)) =
            (self.remotes.get_mut(from), self.world.flows.get_mut(from))
        else {
            self.faults.unknown_flows += 1;
            return BTreeSet::new();
        };
        let changed = match body {
            Body::Delta(delta) => remote.on_delta(now, delta, &mut view.topics, &mut self.faults),
            Body::Snapshot(snapshot) => {
                remote.on_snapshot(now, snapshot, &mut view.topics, &mut self.faults)
            }
            Body::SnapshotRequest(request) => {
                // On the channel of the layer broker all hear the answer.
                let (to, mut parts) = match way {
                    Way::Link => (Some(from.clone()), self.announcer.request(now, &request)),
                    Way::Layer => (None, self.layer_announcer.request(now, &request)),
                };
                parts.retain(|part| to.is_some() || self.say_part(now, part.version, part.part));
                for part in parts {
                    if self.outgoing.len() >= MAX_OUTGOING {
                        self.faults.dropped_replies += 1;
                    } else {
                        self.outgoing.push_back((to.clone(), Body::Snapshot(part)));
                    }
                }
                return BTreeSet::new();
            }
            Body::Hello(_)
            | Body::Feedback(_)
            | Body::Goodbye(_)
            | Body::WrittenRequest(_)
            | Body::Written(_)
            | Body::TypeRequest(_)
            | Body::TypeDefinition(_) => {
                return BTreeSet::new();
            }
        };
        // A Hello does not say whether there is a node scope: whoever has services on one has it.
        view.node_scope = view
            .topics
            .values()
            .any(|entry| entry.node.advertise.is_some() || entry.node.request.is_some());
        self.note_parts(now, from, &changed);
        self.tell_anew(now, &changed);
        changed
    }

    /// Whether another flow can be reached over the inter scope. Returns the topics to plan anew.
    pub fn set_reach(&mut self, now: Instant, flow: &FlowId, reach: Reach) -> BTreeSet<TopicName> {
        let Some(remote) = self.remotes.get_mut(flow) else {
            return BTreeSet::new();
        };
        remote.ways.link = Some(reach);
        self.update_reach(now, flow)
    }

    /// The link does not wait for another flow any more. One that is heard on the layer broker
    /// stays. Returns the topics to plan anew.
    pub fn forget_link(&mut self, now: Instant, flow: &FlowId) -> BTreeSet<TopicName> {
        let ways = self.remotes.get(flow).map(|remote| remote.ways);
        if ways.is_some_and(|ways| ways.over_layer()) {
            return self.set_reach(now, flow, Reach::Down);
        }
        self.await_return(now, flow);
        self.forget(now, flow)
    }

    /// A life of a flow is over. Its services may live, and be named by the next.
    fn await_return(&mut self, now: Instant, flow: &FlowId) {
        let Some(remote) = self.remotes.get(flow) else { return };
        let until = remote.down_since.unwrap_or(now) + RETURNS;
        self.departed.retain(|_, until| *until > now);
        if until > now && self.departed.len() < MAX_FLOWS {
            self.departed.insert(flow.clone(), until);
        }
    }

    /// The round trip to another flow, which decides when it is asked again.
    pub fn set_round_trip(&mut self, flow: &FlowId, round_trip: Duration) {
        if let Some(remote) = self.remotes.get_mut(flow) {
            remote.set_round_trip(round_trip);
        }
    }

    /// Another flow is gone for good. Returns the topics to plan anew.
    pub fn forget(&mut self, now: Instant, flow: &FlowId) -> BTreeSet<TopicName> {
        if !self.remotes.contains_key(flow) {
            return BTreeSet::new();
        }
        self.tell_of(now, flow);
        let topics = self.all_topics();
        self.remotes.remove(flow);
        self.world.flows.remove(flow);
        self.outgoing.retain(|(to, _)| to.as_ref() != Some(flow));
        topics
    }

    /// Whether a service that nobody names may be named again in a moment: the flow of its node has
    /// ended, or that of a layer in which no other could name it, and has not been there again for
    /// long enough to have told of its services.
    pub(crate) fn may_return(&self, now: Instant, of: &OriginFilter) -> bool {
        let settled = |flow: &FlowId| self.world.flows.get(flow).is_some_and(|view| view.settled);
        self.departed.iter().any(|(flow, until)| {
            let same_layer = of.layer.as_deref().is_none_or(|layer| flow.layer.as_str() == layer);
            let same_node = of.node.as_deref().is_none_or(|node| flow.node.as_str() == node);
            let is_alone = || {
                let others = self.world.flows.keys().filter(|other| other.layer == flow.layer);
                !others.into_iter().any(settled)
            };
            *until > now && same_layer && !settled(flow) && (same_node || is_alone())
        })
    }

    /// What is to be sent to other flows now; each encodes to at most
    /// [`MAX_LINK_CONTROL_BYTES`](super::MAX_LINK_CONTROL_BYTES).
    pub fn poll(&mut self, now: Instant) -> Vec<(FlowId, Body)> {
        let mut messages = Vec::new();
        let mut layer = Vec::new();
        for (to, body) in self.outgoing.drain(..) {
            match to {
                Some(to) => messages.push((to, body)),
                None => layer.push((None, body)),
            }
        }
        self.see_whom_it_speaks_for(now);
        let (deltas, layer_deltas) = self.announce(now);
        // Those who share the layer broker hear of it there whatever becomes of the link: what is
        // handed over must arrive.
        let over_link = |remote: &Remote| remote.ways.over_link() && !remote.ways.over_layer();
        for (flow, _) in self.remotes.iter().filter(|(_, remote)| over_link(remote)) {
            messages.extend(deltas.iter().map(|delta| (flow.clone(), Body::Delta(delta.clone()))));
        }
        if self.remotes.values().any(|remote| remote.ways.over_layer()) {
            layer.extend(layer_deltas.into_iter().map(|delta| (None, Body::Delta(delta))));
        }
        // First the pulls that go on: one that is given up makes room for another. Then those that
        // waited longest.
        let mut order: Vec<(bool, Instant, FlowId)> = self
            .remotes
            .iter()
            .filter(|(_, remote)| is_reachable(remote))
            .filter_map(|(flow, remote)| {
                let due = remote.next_poll().filter(|at| *at <= now)?;
                Some((!remote.is_pulling(), due, flow.clone()))
            })
            .collect();
        order.sort_unstable();
        for (_, _, flow) in order {
            let may_start = self.pulls() < MAX_PULLS;
            let request =
                self.remotes.get_mut(&flow).and_then(|remote| remote.poll(now, may_start));
            let Some(request) = request.map(Body::SnapshotRequest) else {
                continue;
            };
            if self.is_heard_on_layer(&flow) {
                layer.push((Some(flow), request));
            } else {
                messages.push((flow, request));
            }
        }
        self.layer_outgoing = layer;
        messages
    }

    fn pulls(&self) -> usize {
        self.remotes.values().filter(|remote| remote.is_pulling()).count()
    }

    /// When [`Registry::poll`] has something to send; an instant that has passed means at once.
    #[must_use]
    pub fn next_poll(&self) -> Option<Instant> {
        if !self.outgoing.is_empty() {
            return Some(self.config.started);
        }
        // What waits for a free pull or for its flow to come back is no reason to poll.
        let may_start = self.pulls() < MAX_PULLS;
        let requests = self
            .remotes
            .iter()
            .filter(|(_, remote)| is_reachable(remote) && (may_start || remote.is_pulling()));
        requests
            .filter_map(|(_, remote)| remote.next_poll())
            .chain(self.announcer.due())
            .chain(self.layer_announcer.due())
            .min()
    }

    /// What other flows told of a topic, by flow and scope. The layer scope of a flow that shares
    /// the own layer broker is left out: those services hold leases here. What a gateway tells of
    /// flows of other groups is of its inter scope.
    pub fn remote_leases<'a>(
        &'a self,
        topic: &'a TopicName,
    ) -> impl Iterator<Item = RemoteLease<'a>> {
        let shares = |flow: &FlowId, view: &FlowView| {
            flow.layer == self.config.me.layer
                && self.config.layer_scope.is_some()
                && view.layer_scope == self.config.layer_scope
        };
        self.world.flows.iter().filter(|(flow, _)| **flow != self.config.me).flat_map(
            move |(flow, view)| {
                let scopes = view.topics.get(topic).map(TopicEntry::scopes);
                let told = move |scope: Scope| scope != Scope::Layer || !shares(flow, view);
                let scopes = scopes.into_iter().flatten().filter(move |(scope, _)| told(*scope));
                scopes.filter_map(move |(scope, entry)| {
                    (entry.advertise.is_some() || entry.request.is_some()).then_some(RemoteLease {
                        flow,
                        scope,
                        advertise: entry.advertise.as_ref(),
                        request: entry.request.as_ref(),
                    })
                })
            },
        )
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

/// The ROS 2 network that a flow says it is on; without an address there it is on none.
fn ros2_network(hello: &Hello) -> Option<Ros2Network> {
    let address = hello.ros2_address.parse().ok()?;
    let id = Ros2NetworkId(hello.ros2_network);
    (hello.ros2_network != 0).then_some(Ros2Network { id, address })
}

fn is_reachable(remote: &Remote) -> bool {
    match remote.ways.layer {
        Some(sign) => !sign.over,
        None => remote.ways.over_link(),
    }
}
