//! What the control core knows of the brokers of its local scopes, and what follows for leases,
//! plans and channels.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use blaze_domain::{Scope, TopicName, WhyCode};
use bytes::Bytes;

use super::{ControlCore, Output};
use crate::plan::{Bridge, Target};
use crate::registry::Restored;

/// Others are told of a layer broker that has not answered for this long: it is as long as they
/// need to notice that a flow has died.
const AWAY: Duration = Duration::from_millis(2500);

/// Whether the broker of a scope can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ScopeHealth {
    /// It answers.
    #[default]
    Up,
    /// It does not: nobody can renew a lease there.
    Away,
    /// The scope belongs to another flow: for this one it is as if it were not there.
    InUse,
}

impl ScopeHealth {
    /// The code of `why`, where something is wrong.
    #[must_use]
    pub fn fault(self) -> Option<WhyCode> {
        match self {
            Self::Up => None,
            Self::Away => Some(WhyCode::BrokerDown),
            Self::InUse => Some(WhyCode::ScopeInUse),
        }
    }
}

/// Health of the scopes, and the channels that were asked for on them.
#[derive(Debug, Default)]
pub(super) struct Scopes {
    health: BTreeMap<Scope, ScopeHealth>,
    /// Channels in use on brokers with a flow's side, with their depth.
    prepared: BTreeMap<(Scope, ChannelName), u32>,
    /// Since when the layer broker has not answered.
    layer_away: Option<Instant>,
    /// Whether others are told so.
    says_away: bool,
}

impl Scopes {
    pub(super) fn health(&self, scope: Scope) -> ScopeHealth {
        self.health.get(&scope).copied().unwrap_or_default()
    }
}

impl ControlCore {
    /// The broker of a local scope has changed.
    pub fn set_scope_health(&mut self, now: Instant, scope: Scope, health: ScopeHealth) {
        let health = if scope == Scope::Ros2 { self.ros2_health(health) } else { health };
        let before = self.scopes.health(scope);
        if before == health {
            return;
        }
        self.scopes.health.insert(scope, health);
        if scope == Scope::Layer {
            self.scopes.layer_away = (health == ScopeHealth::Away).then_some(now);
        }
        self.registry.set_renewable(now, scope, health != ScopeHealth::Away);
        if (before == ScopeHealth::InUse) != (health == ScopeHealth::InUse) {
            let in_use = health == ScopeHealth::InUse;
            let changed = self.registry.set_in_use(now, scope, in_use);
            self.update_channels_of(&changed);
            self.touch(now, changed);
            if scope == Scope::Layer {
                self.outputs.push_back(Output::LayerScope { shared: !in_use });
            }
        }
        // What other flows are told of routes over this scope changes with it.
        self.touch_all(now);
    }

    /// Tells others when another flow of the layer serves its broker better, and when that is over.
    pub(super) fn tell_layer_away(&mut self, now: Instant) {
        let since = self.scopes.layer_away;
        let away = since.is_some_and(|since| now.saturating_duration_since(since) >= AWAY);
        if away != self.scopes.says_away {
            self.scopes.says_away = away;
            self.outputs.push_back(Output::LayerAway(away));
        }
    }

    /// Whether the kept leases of a scope are still to be read, so that the flow cannot be ready.
    #[must_use]
    pub fn is_reading_leases(&self, scope: Scope) -> bool {
        self.registry.is_reading(scope) && self.scopes.health(scope) != ScopeHealth::InUse
    }

    /// Takes the leases that the broker of a scope has kept.
    pub fn restore_leases(
        &mut self,
        now: Instant,
        scope: Scope,
        kept: &[(String, Bytes)],
    ) -> Restored {
        let restored = self.registry.restore(now, scope, kept);
        self.skipped_leases += restored.skipped;
        self.touch(now, restored.changed.clone());
        for topic in &restored.topics {
            self.update_channels(topic);
        }
        self.save_leases();
        restored
    }

    /// Hands over what brokers are to change in the leases that they keep.
    pub(super) fn save_leases(&mut self) {
        let unsaved = self.registry.take_unsaved();
        self.outputs.extend(unsaved.into_iter().map(Output::SaveLease));
    }

    /// Lets brokers make the channels of topics that are leased on them or that a bridge writes,
    /// and release the others.
    pub(super) fn update_channels(&mut self, topic: &TopicName) {
        for scope in Scope::LOCAL {
            if !self.config.lease_stores.contains(&scope) {
                continue;
            }
            let leased = self.registry.channel_depth(topic, scope);
            let bridges = self.plans.get(topic).map_or(&[][..], |plan| &plan.bridges);
            let written = bridges.iter().filter(|bridge| writes(bridge, scope)).map(depth_of).max();
            let released =
                self.update_channel(scope, ChannelName::from(topic), leased.max(written));
            if released && scope == Scope::Layer {
                self.registry.forget_foreign_name(topic);
            }
        }
        if self.config.lease_stores.contains(&Scope::Layer) {
            let leased = self.registry.wants_json(topic, Scope::Layer).then_some(0);
            let bridges = self.plans.get(topic).map_or(&[][..], |plan| &plan.bridges);
            let copies = bridges.iter().filter(|bridge| bridge.to == Target::Layer { json: true });
            let wanted = leased.max(copies.map(depth_of).max());
            self.update_channel(Scope::Layer, ChannelName::json(topic), wanted);
        }
    }

    /// The same for one channel. Whether it was released.
    fn update_channel(&mut self, scope: Scope, channel: ChannelName, wanted: Option<u32>) -> bool {
        let key = (scope, channel.clone());
        if self.scopes.prepared.get(&key).copied() == wanted {
            return false;
        }
        if let Some(depth) = wanted {
            self.scopes.prepared.insert(key, depth);
            self.outputs.push_back(Output::Prepare { scope, channel, depth });
            false
        } else {
            self.scopes.prepared.remove(&key);
            self.outputs.push_back(Output::Release { scope, channel });
            true
        }
    }

    /// The same for many topics.
    pub(super) fn update_channels_of(&mut self, topics: &BTreeSet<TopicName>) {
        for topic in topics {
            self.update_channels(topic);
        }
    }
}

fn writes(bridge: &Bridge, scope: Scope) -> bool {
    bridge.to.scope() == scope && !bridge.to.is_headless()
}

fn depth_of(bridge: &Bridge) -> u32 {
    if bridge.lane.durable { bridge.lane.depth } else { 0 }
}
