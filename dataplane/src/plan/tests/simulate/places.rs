//! What there is in a system: places, the messages that are born there, and the flows that read and
//! write them.

use blaze_domain::FlowId;

use super::{Message, Place, Simulation, is_live};
use crate::plan::Form;
use crate::plan::tests::generate::{System, share_broker};
use crate::plan::tests::worlds::topic;
use crate::world::{Advertise, FlowView, Request, ScopeEntry};

impl<'a> Simulation<'a> {
    pub(super) fn layer_of(&self, id: &FlowId) -> Option<Place> {
        self.layers.get(id).cloned()
    }

    pub(super) fn find_layer(&self, id: &FlowId) -> Option<Place> {
        let scope = self.view(id).layer_scope;
        scope?;
        let mut sharing = self
            .flows()
            .filter(|(other, view)| share_broker((id, scope), (other, view.layer_scope)));
        sharing.next().map(|(first, _)| Place::Layer(first.clone(), false))
    }

    /// The ROS 2 network that a flow is on.
    pub(super) fn network_of(&self, id: &FlowId) -> Option<Place> {
        self.networks.get(id).cloned()
    }

    pub(super) fn is_on(&self, id: &FlowId, network: &Place) -> bool {
        self.networks.get(id) == Some(network)
    }

    /// All places with what their services say; of a ROS 2 network that is what its readers ask
    /// for, and the writers that the first flow owns.
    pub(super) fn places(&self) -> Vec<(Place, &'a ScopeEntry)> {
        let mut places = Vec::new();
        for (id, view) in self.flows() {
            let Some(entry) = view.topics.get(&topic()) else {
                continue;
            };
            if view.node_scope {
                places.push((Place::Node(id.clone(), Form::Framed), &entry.node));
            }
            let layer = Place::Layer(id.clone(), false);
            if self.layers.get(id) == Some(&layer) {
                places.push((layer, &entry.layer));
            }
            let network = Place::Ros2(id.clone());
            if self.is_on(id, &network) {
                places.push((network, &entry.ros2));
            }
        }
        places
    }

    pub(super) fn messages(&self) -> Vec<Message> {
        let mut messages = Vec::new();
        for (id, view) in self.flows() {
            let Some(entry) = view.topics.get(&topic()) else { continue };
            let node = view.node_scope.then(|| Place::Node(id.clone(), Form::Framed));
            let layer = Place::Layer(id.clone(), false);
            let first = (self.layers.get(id) == Some(&layer)).then_some(layer);
            let scopes = [
                (node, &entry.node, Some(id)),
                (first, &entry.layer, None),
                (self.network_of(id), &entry.ros2, Some(id)),
            ];
            for (born, scope, flow) in scopes {
                if let (Some(born), Some(advertise)) = (born, &scope.advertise) {
                    messages.extend(self.messages_of(&born, id, flow, advertise));
                }
            }
        }
        messages
    }

    pub(super) fn messages_of(
        &self,
        born: &Place,
        at: &FlowId,
        flow: Option<&FlowId>,
        advertise: &Advertise,
    ) -> Vec<Message> {
        let message = |source| Message {
            born: born.clone(),
            flow: flow.cloned(),
            layer: at.layer.to_string(),
            source,
            type_name: advertise.type_name.clone(),
        };
        let sources = self.system.sources(advertise, flow.map(|flow| flow.node.as_str()));
        sources.into_iter().map(message).collect()
    }

    /// Flows that read what others write to a place.
    pub(super) fn readers(&self, place: &Place) -> Vec<&'a FlowId> {
        let reads = |id: &FlowId| match place {
            Place::Node(flow, Form::Framed) => id == flow,
            Place::Layer(_, false) => self.layers.get(id) == Some(place),
            // Nobody reads copies, and of a network each flow reads the writers that it owns.
            Place::Node(..) | Place::Layer(..) | Place::Ros2(_) => false,
        };
        self.flows().filter(|(id, view)| is_live(view) && reads(id)).map(|(id, _)| id).collect()
    }

    /// Flows that read a message where it was born.
    pub(super) fn first_readers(&self, message: &Message) -> Vec<&'a FlowId> {
        let owner = message.flow.as_ref().filter(|_| matches!(message.born, Place::Ros2(_)));
        match owner {
            Some(owner) => {
                let own = self.flows().filter(|(id, view)| *id == owner && is_live(view));
                own.map(|(id, _)| id).collect()
            }
            None => self.readers(&message.born),
        }
    }

    /// Live flows that could write to a place.
    pub(super) fn writers(&self, place: &Place) -> Vec<&'a FlowId> {
        let writes = |id: &FlowId| match place {
            Place::Node(flow, _) => id == flow,
            Place::Layer(flow, _) => self.layer_of(id) == self.layer_of(flow),
            Place::Ros2(_) => self.is_on(id, place),
        };
        self.flows().filter(|(id, view)| is_live(view) && writes(id)).map(|(id, _)| id).collect()
    }
}

/// Where a request of a place is served.
pub(super) fn forms(place: &Place, request: &Request) -> Vec<Place> {
    match place {
        Place::Node(flow, _) => {
            let forms = Form::ALL.into_iter().filter(|form| match form {
                Form::Framed => request.framed,
                Form::Bare => request.bare,
                Form::Json => request.json,
            });
            forms.map(|form| Place::Node(flow.clone(), form)).collect()
        }
        Place::Layer(flow, _) => {
            let plain = request.framed.then(|| Place::Layer(flow.clone(), false));
            let json = request.json.then(|| Place::Layer(flow.clone(), true));
            plain.into_iter().chain(json).collect()
        }
        Place::Ros2(_) => vec![place.clone()],
    }
}

pub(super) fn find_network(system: &System, id: &FlowId, view: &FlowView) -> Option<Place> {
    let network = view.ros2?.id;
    let is_there = |(other, view): &(&FlowId, &FlowView)| {
        other.layer == id.layer && view.ros2.is_some_and(|ros2| ros2.id == network)
    };
    let first = system.world.flows.iter().find(is_there);
    first.map(|(first, _)| Place::Ros2(first.clone()))
}
