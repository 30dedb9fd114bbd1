//! The ROS 2 network that a flow is on: what its adapter reports, and whether another layer has it.

use std::collections::BTreeSet;
use std::time::Instant;

use blaze_domain::{FlowId, Scope, TopicName};

use super::{ControlCore, Output, ScopeHealth};
use crate::plan::network;
use crate::registry::FoundEndpoint;
use crate::world::Ros2Network;

/// What the core remembers of the network.
#[derive(Debug, Default)]
pub(super) struct Ros2 {
    /// Where the adapter is.
    network: Option<Ros2Network>,
    /// Flows whose participants were found there.
    flows: BTreeSet<FlowId>,
    /// The flow of another layer that the network belongs to.
    holder: Option<FlowId>,
    /// What other flows are told.
    told: Option<Ros2Network>,
}

impl ControlCore {
    /// The adapter is on a ROS 2 network, or no longer.
    pub fn set_ros2_network(&mut self, now: Instant, network: Option<Ros2Network>) {
        self.ros2.network = network;
        let changed = self.registry.set_ros2_network(now, network);
        self.touch(now, changed);
        self.follow_ros2(now);
    }

    /// The flows whose participants were found on the network.
    pub fn set_ros2_flows(&mut self, now: Instant, flows: BTreeSet<FlowId>) {
        self.ros2.flows = flows;
        self.follow_ros2(now);
    }

    /// Replaces what was found of a topic on the network; an empty list takes it away.
    pub fn set_found(&mut self, now: Instant, topic: &TopicName, endpoints: Vec<FoundEndpoint>) {
        let changed = self.registry.set_found(now, topic, endpoints);
        self.touch(now, changed);
    }

    /// The flow of another layer that the network belongs to, so that this one does not use it.
    #[must_use]
    pub fn ros2_holder(&self) -> Option<&FlowId> {
        self.ros2.holder.as_ref()
    }

    /// Does what follows from flows that came or went.
    pub(super) fn follow_ros2(&mut self, now: Instant) {
        let world = self.registry.world();
        let network = self.ros2.network;
        let holder = network.and_then(|network| network::holder(world, network, &self.ros2.flows));
        self.ros2.holder = holder.cloned();
        let in_use = self.ros2.holder.is_some();
        let health = if in_use { ScopeHealth::InUse } else { ScopeHealth::Up };
        self.set_scope_health(now, Scope::Ros2, health);
        let changed = self.registry.update_found(now);
        self.touch(now, changed);
        let shown = self.registry.world().own().and_then(|own| own.ros2);
        if shown != self.ros2.told {
            self.ros2.told = shown;
            self.outputs.push_back(Output::Ros2(shown));
            self.hello_now();
        }
    }
}
