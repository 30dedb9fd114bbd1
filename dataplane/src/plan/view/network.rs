//! The ROS 2 network of the own flow, and those of others, as one topic sees them.

use blaze_domain::{FlowId, Scope};

use super::{Group, Publisher, Requester, TopicView};
use crate::plan::network::{self, Natives, Network};

impl<'w> TopicView<'w> {
    pub(crate) fn own_ros2_publisher(&self) -> Option<&Publisher<'w>> {
        self.publishers
            .iter()
            .find(|publisher| publisher.flow == self.me && publisher.scope == Scope::Ros2)
    }

    /// The own network, if this flow writes what comes from elsewhere to it.
    pub(crate) fn written_network(&self) -> Option<&Requester<'w>> {
        self.requesters
            .iter()
            .find(|requester| requester.flow == self.me && requester.scope == Scope::Ros2)
    }

    /// The own network, whichever flow writes to it.
    pub(crate) fn own_network(&self) -> Option<Requester<'w>> {
        let (flow, view) = self.world.flows.get_key_value(self.me)?;
        let (group, network) = (self.group, Some(Network::of(flow, view)?));
        let request = view.topics.get(self.topic)?.ros2.request.as_ref()?;
        Some(Requester { flow, group, scope: Scope::Ros2, network, request })
    }

    /// Whether the own network has a server of the service that this topic's requests go to: its
    /// clients need no other one.
    pub(crate) fn serves_itself(&self) -> bool {
        let own = self.world.flows.get_key_value(self.me);
        let network = own.and_then(|(id, view)| Network::of(id, view));
        let flows = network.and_then(|network| self.networks.get(&network));
        let has_server = |flow: &&FlowId| {
            let entry = self.world.flows.get(*flow).and_then(|view| view.topics.get(self.topic));
            entry.is_some_and(|entry| entry.ros2.request.is_some())
        };
        network::is_request(self.topic) && flows.into_iter().flatten().any(has_server)
    }

    /// Flows on the own network.
    pub(crate) fn natives(&self) -> Natives {
        if network::is_of_service(self.topic) {
            // Requests and replies name the flow that writes them.
            return Natives::default();
        }
        let own = self.world.flows.get_key_value(self.me);
        let network = own.and_then(|(id, view)| Network::of(id, view));
        let flows = network.and_then(|network| self.networks.get(&network));
        let flows = flows.into_iter().flatten().copied().cloned();
        let in_group = |id: &FlowId| {
            let view = self.world.flows.get_key_value(id);
            view.is_some_and(|(id, view)| Group::of(id, view) == self.group)
        };
        let (here, elsewhere) = flows.partition(in_group);
        Natives { here, elsewhere }
    }

    /// Whether a flow on a network carries topics.
    pub(crate) fn has_flows(&self, network: Network<'w>) -> bool {
        self.networks.contains_key(&network)
    }

    /// The flows that a requester is next to: those of its network, else its own.
    pub(crate) fn flows_behind(&self, requester: &Requester<'w>) -> Vec<&'w FlowId> {
        let on_network = requester.network.filter(|_| requester.scope == Scope::Ros2);
        let flows = on_network.and_then(|network| self.networks.get(&network));
        flows.cloned().unwrap_or_else(|| vec![requester.flow])
    }

    /// Whether a flow writes to its network what comes from elsewhere. Requests and replies of
    /// services name their flow: there each one writes its own.
    pub(super) fn writes(&self, flow: &FlowId, network: Option<Network<'w>>) -> bool {
        let writer =
            network.and_then(|network| network::writer(&self.networks, network, self.topic));
        network::is_of_service(self.topic) || writer == Some(flow)
    }
}
