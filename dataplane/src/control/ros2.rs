//! The ROS 2 network that a flow is on: what its adapter reports, what other flows offer shows
//! there, and whether another layer has it.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use blaze_domain::{FlowId, Scope, TopicName};

use super::{ControlCore, Output, ScopeHealth};
use crate::plan::network::{self, Shown};
use crate::registry::FoundEndpoint;
use crate::world::Ros2Network;

/// What the core remembers of the network.
#[derive(Debug, Default)]
pub(super) struct Ros2 {
    /// Where the adapter is.
    network: Option<Ros2Network>,
    /// Full names of the nodes that flows have there.
    nodes: BTreeSet<String>,
    /// Whether the adapter works.
    health: ScopeHealth,
    /// The flow of another layer that the network belongs to.
    holder: Option<FlowId>,
    /// What other flows are told.
    told: Option<Ros2Network>,
    /// What other flows offer, as it shows there.
    shown: BTreeMap<TopicName, Shown>,
}

impl ControlCore {
    /// The adapter is on a ROS 2 network, or no longer.
    pub fn set_ros2_network(&mut self, now: Instant, network: Option<Ros2Network>) {
        self.ros2.network = network;
        let changed = self.registry.set_ros2_network(now, network);
        self.touch(now, changed);
        self.follow_ros2(now);
    }

    /// Full names of the nodes that flows have on the network.
    pub fn set_ros2_nodes(&mut self, now: Instant, nodes: BTreeSet<String>) {
        self.ros2.nodes = nodes;
        self.follow_ros2(now);
    }

    /// Replaces what was found on the network.
    pub fn set_found(&mut self, now: Instant, found: BTreeMap<TopicName, Vec<FoundEndpoint>>) {
        let changed = self.registry.set_found(now, found);
        self.touch(now, changed);
    }

    /// The flow of another layer that the network belongs to, so that this one does not use it.
    #[must_use]
    pub fn ros2_holder(&self) -> Option<&FlowId> {
        self.ros2.holder.as_ref()
    }

    /// The health of the network, where its adapter has this one.
    pub(super) fn ros2_health(&mut self, health: ScopeHealth) -> ScopeHealth {
        self.ros2.health = health;
        if self.ros2.holder.is_some() { ScopeHealth::InUse } else { health }
    }

    /// Does what follows from flows that came or went.
    pub(super) fn follow_ros2(&mut self, now: Instant) {
        let world = self.registry.world();
        let network = self.ros2.network;
        let holder = network.and_then(|network| network::holder(world, network, &self.ros2.nodes));
        self.ros2.holder = holder.cloned();
        self.set_scope_health(now, Scope::Ros2, self.ros2.health);
        let changed = self.registry.update_found(now);
        self.touch(now, changed);
        let shown = self.registry.world().own().and_then(|own| own.ros2);
        if shown != self.ros2.told {
            self.ros2.told = shown;
            self.outputs.push_back(Output::Ros2(shown));
            self.hello_now();
        }
    }

    /// Lets the adapter know which writers this flow owns, if that has changed.
    pub(super) fn tell_owned(&mut self) {
        if let Some(owned) = self.registry.take_owned() {
            self.outputs.push_back(Output::Owned(owned));
        }
    }

    /// What other flows offer of a topic shows on the network, or no longer.
    pub(super) fn show(&mut self, topic: &TopicName, shown: Option<Shown>) {
        if self.ros2.shown.get(topic) == shown.as_ref() {
            return;
        }
        match &shown {
            Some(shown) => _ = self.ros2.shown.insert(topic.clone(), shown.clone()),
            None => _ = self.ros2.shown.remove(topic),
        }
        self.outputs.push_back(Output::Show { topic: topic.clone(), shown });
    }
}
