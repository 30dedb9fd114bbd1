//! Flows of the own group that are on the inter scope for the others, and those that are not: who
//! is which, and what each side is told of the other.
//!
//! ```text
//! own entry ─────────────────────────┬─► announced on the channel of the layer broker
//! flows of other groups ─ merged ────┘    (`outside`, while somebody there is not on the inter scope)
//! own entry ─────────────────────────┬─► announced on the inter scope
//! flows of the group that are not on it ─ merged ─┘    (as of the layer scope)
//! ```

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use blaze_domain::node_file::AutoBool;
use blaze_domain::{FlowId, TopicName};
use blaze_proto::link::link_control::{Delta, Gateway, Hello};

use super::announce::{Rank, Told};
use super::pieces::text_hash;
use super::remote::Remote;
use super::{Registry, wire};
use crate::plan::gateway::speaks_for_others;
use crate::plan::{Survey, told};
use crate::world::{FlowState, Role, TopicEntry};

/// Of so many milliseconds per flow that is known a flow waits a part before it asks …
const PATIENCE_MS: u64 = 10;
/// … and at most this long.
const MAX_PATIENCE_MS: u64 = 5000;
/// What was said on the channel of the layer broker is not said again for this long.
const SAID: Duration = Duration::from_millis(100);

/// What a flow wrote to its layer scope before it became a gateway is carried out for it this long.
pub(crate) const GRACE: Duration = Duration::from_secs(2);

/// How long a flow waits before it asks for what one of so many others has announced on the channel
/// of the layer broker: of many that miss the same, one asks, and all hear the answer.
pub(super) fn patience(me: &FlowId, others: usize, with: &FlowId) -> Duration {
    let others = u64::try_from(others).unwrap_or(u64::MAX);
    let longest = others.saturating_mul(PATIENCE_MS).min(MAX_PATIENCE_MS);
    let hash = text_hash(format!("{me}|{with}").as_bytes());
    Duration::from_millis(hash % (longest + 1))
}

impl Registry {
    /// What the node file says of this flow as a gateway, and what it is. Returns the topics to
    /// plan anew.
    pub fn set_role(&mut self, gateway: AutoBool, role: Role) -> BTreeSet<TopicName> {
        match self.own_view() {
            Some(own) if (own.gateway, own.role) != (gateway, role) => {
                (own.gateway, own.role) = (gateway, role);
            }
            _ => return BTreeSet::new(),
        }
        self.all_topics()
    }

    /// This flow is not on the inter scope any more: whom it knew over that alone is forgotten.
    /// Returns the topics to plan anew.
    pub fn leave_link(&mut self, now: Instant) -> BTreeSet<TopicName> {
        let mut changed = BTreeSet::new();
        let (here, gone): (Vec<FlowId>, Vec<FlowId>) =
            self.remotes.keys().cloned().partition(|flow| self.is_heard_on_layer(flow));
        for flow in gone {
            changed.extend(self.forget(now, &flow));
        }
        for flow in here {
            if let Some(remote) = self.remotes.get_mut(&flow) {
                remote.ways.link = None;
            }
            changed.extend(self.update_reach(now, &flow));
        }
        changed
    }

    /// Version and digest of what is told on the channel of the layer broker.
    #[must_use]
    pub fn announced_on_layer(&self) -> (u64, u64) {
        self.layer_announcer.announced()
    }

    /// Another flow said something else of these topics: what a gateway tells of them may be
    /// different, too.
    pub(super) fn tell_anew(&mut self, now: Instant, topics: &BTreeSet<TopicName>) {
        if self.speaks_for_others {
            topics.iter().for_each(|topic| self.mark(now, topic));
        }
    }

    /// Another flow has come, changed, or is about to be forgotten: the same of all that it
    /// announced.
    pub(super) fn tell_of(&mut self, now: Instant, flow: &FlowId) {
        if self.speaks_for_others
            && let Some(view) = self.world.flows.get(flow)
        {
            let topics = view.topics.keys().cloned().collect();
            self.tell_anew(now, &topics);
        }
    }

    /// Where this flow begins or ends to speak for others, all topics are to be told anew.
    pub(super) fn see_whom_it_speaks_for(&mut self, now: Instant) {
        let speaks = speaks_for_others(&self.world);
        if speaks != self.speaks_for_others {
            self.speaks_for_others = speaks;
            for topic in self.all_topics() {
                self.mark(now, &topic);
            }
        }
    }

    /// A topic is to be announced anew, should what is told of it have changed.
    pub(super) fn mark(&mut self, now: Instant, topic: &TopicName) {
        self.announcer.mark(now, topic.clone());
        if self.config.layer_scope.is_some() {
            self.layer_announcer.mark(now, topic.clone());
        }
    }

    /// What is due to be told on the inter scope, and on the channel of the layer broker.
    pub(super) fn announce(&mut self, now: Instant) -> (Vec<Delta>, Vec<Delta>) {
        self.announcer.tidy(now);
        self.layer_announcer.tidy(now);
        let topics = self.announcer.count_due(now).max(self.layer_announcer.count_due(now));
        if topics == 0 {
            return (Vec::new(), Vec::new());
        }
        // Of others it is only asked where this flow speaks for them.
        let asked = if self.speaks_for_others { topics } else { 0 };
        let (survey, routes) = (Survey::of(&self.world, asked), &self.routes);
        let own = |topic: &TopicName| self.world.own().and_then(|own| own.topics.get(topic));
        let told_of = |topic: &TopicName, entry: Option<TopicEntry>| {
            let routes = routes.get(topic).map(Vec::as_slice);
            let rank = match (own(topic), routes, &entry) {
                (Some(_), ..) => Rank::Leased,
                (None, Some(_), _) => Rank::Carried,
                (None, None, Some(_)) => Rank::Merged,
                (None, None, None) => return None,
            };
            let entry =
                wire::to_wire(topic, &entry.unwrap_or_default(), routes.unwrap_or_default());
            Some(Told { entry, rank })
        };
        let deltas = self
            .announcer
            .announce(now, |topic| told_of(topic, told::told_outside(&survey, topic)));
        let layer_deltas = self.layer_announcer.announce(now, |topic| {
            let told = TopicEntry {
                outside: told::told_inside(&survey, topic),
                ..own(topic).cloned().unwrap_or_default()
            };
            told_of(topic, Some(told).filter(|told| !told.is_empty()))
        });
        (deltas, layer_deltas)
    }

    /// Whether all that living flows of the inter scope have announced is known.
    #[must_use]
    pub fn knows_link(&self) -> bool {
        let mut living = self.remotes.values().filter(|remote| remote.ways.over_link());
        living.all(Remote::is_in_step)
    }

    /// Whether a flow was ever heard on the channel of the layer broker.
    pub(super) fn is_heard_on_layer(&self, flow: &FlowId) -> bool {
        self.remotes.get(flow).is_some_and(|remote| remote.ways.layer.is_some())
    }

    /// Whether a flow is reached over the layer broker, and not over the inter scope.
    pub(crate) fn is_on_layer_alone(&self, flow: &FlowId) -> bool {
        let ways = self.remotes.get(flow).map(|remote| remote.ways);
        ways.is_some_and(|ways| ways.over_layer() && !ways.over_link())
    }

    /// Whether a flow that was heard there is not any more, and says on the inter scope that it has
    /// another layer broker, or none.
    pub(super) fn has_left_layer(
        &self,
        flow: &FlowId,
        says: Option<crate::world::LayerScopeId>,
    ) -> bool {
        let own = self.world.own().and_then(|own| own.layer_scope);
        let sign = self.remotes.get(flow).and_then(|remote| remote.ways.layer);
        sign.is_some_and(|sign| sign.over) && says != own
    }

    /// Flows of other groups that are reached over the inter scope, or may be again in a moment.
    #[must_use]
    pub fn link_peers(&self) -> u32 {
        let reached = self.remotes.values().filter(|remote| remote.ways.layer.is_none());
        u32::try_from(reached.filter(|remote| remote.ways.over_link()).count()).unwrap_or(u32::MAX)
    }

    /// Whether this flow reaches nobody over the inter scope while another gateway of its group
    /// does: its way there is broken, and not that of all.
    #[must_use]
    pub fn is_cut_off(&self) -> bool {
        let gateway = |flow: &FlowId| {
            let view = self.world.flows.get(flow);
            view.is_some_and(|view| {
                view.role.is_gateway()
                    && view.reach == crate::world::Reach::Up
                    && view.state == FlowState::Ready
            })
        };
        self.link_peers() == 0
            && self.remotes.iter().any(|(flow, remote)| {
                remote.ways.over_layer() && remote.link_peers > 0 && gateway(flow)
            })
    }

    /// A flow whose process goes on has a new life on the inter scope: what it has announced stays.
    pub(super) fn follow_life(&mut self, flow: &FlowId, epoch: u64, began: u64) {
        let goes_on = self.remotes.get(flow).is_some_and(|remote| remote.began == Some(began));
        if let Some(view) = self.world.flows.get_mut(flow).filter(|_| goes_on) {
            view.epoch = view.epoch.max(epoch);
        }
    }

    /// Whether a part of a snapshot is to be said on the channel of the layer broker: not again
    /// right after it was.
    pub(super) fn say_part(&mut self, now: Instant, version: u64, part: u32) -> bool {
        let fresh = |at: &Instant| now.saturating_duration_since(*at) < SAID;
        self.said_parts.retain(|_, at| fresh(at));
        self.said_parts.insert((version, part), now).is_none()
    }

    /// What a flow says of itself on the channel of the layer broker.
    pub(super) fn said_role(
        &mut self,
        now: Instant,
        from: &FlowId,
        hello: &Hello,
    ) -> (AutoBool, Role) {
        let setting = match hello.gateway() {
            Gateway::Auto => AutoBool::Auto,
            Gateway::Never => AutoBool::No,
            Gateway::Always => AutoBool::Yes,
            // It knows of no gateways, so it is on the inter scope itself.
            Gateway::Unspecified => return (AutoBool::Yes, Role::Gateway),
        };
        if !hello.is_gateway {
            return (setting, Role::Member);
        }
        let before = self.world.flows.get(from).map(|view| (view.role, view.state));
        let role = match before {
            Some((Role::Member, FlowState::Ready)) => {
                if let Some(remote) = self.remotes.get_mut(from) {
                    remote.new_gateway = Some(now);
                }
                Role::NewGateway
            }
            Some((Role::NewGateway, _)) => Role::NewGateway,
            _ => Role::Gateway,
        };
        (setting, role)
    }

    /// Whoever has been a gateway for long enough is one like the others. Whether there is one.
    pub(super) fn end_of_grace(&mut self, now: Instant) -> bool {
        let mut ended = false;
        for (flow, remote) in &mut self.remotes {
            let Some(view) =
                self.world.flows.get_mut(flow).filter(|view| view.role == Role::NewGateway)
            else {
                continue;
            };
            let since = *remote.new_gateway.get_or_insert(now);
            if now.saturating_duration_since(since) >= GRACE {
                (view.role, remote.new_gateway) = (Role::Gateway, None);
                ended = true;
            }
        }
        ended
    }
}
