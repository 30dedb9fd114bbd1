//! Bridges that carried nothing, and why some of them may stand all the same.

use blaze_domain::{FlowId, Scope};

use super::{Message, Place, Simulation, wants};
use crate::plan::Target;
use crate::world::Request;

impl Simulation<'_> {
    /// Every bridge carried something towards a requester, or waits beside an intake that a sender
    /// could move away.
    pub(super) fn check_needless(&self) -> Result<(), String> {
        for (flow, plan) in self.plans {
            for bridge in &plan.bridges {
                let key = (flow.clone(), bridge.from, bridge.to.clone());
                if !self.useful.contains(&key) && !self.stands_by(flow, bridge.from, &bridge.to) {
                    return Err(format!(
                        "{flow} has a needless bridge {:?} to {:?}",
                        bridge.from, bridge.to
                    ));
                }
            }
        }
        Ok(())
    }

    /// A bridge from the layer to the node or the network of a flow that takes the same from the
    /// inter scope, while another flow of the layer asks for something of the same publishing scope
    /// too, so that its sender may have chosen that one.
    fn stands_by(&self, flow: &FlowId, from: Scope, to: &Target) -> bool {
        if !self.view(flow).role.is_inside() && (from == Scope::Layer || to.scope() == Scope::Layer)
        {
            // It is not told which origins there are outside.
            return true;
        }
        let takes_it = self.useful.contains(&(flow.clone(), Scope::Inter, to.clone()));
        let Some(layer) = self.layer_of(flow).filter(|_| from == Scope::Layer && takes_it) else {
            return false;
        };
        let messages = self.messages();
        let wanted = |requests: &[&Request], like: &Message| {
            let same = |other: &&Message| (&other.born, &other.flow) == (&like.born, &like.flow);
            let mut sent = messages.iter().filter(same);
            sent.any(|message| requests.iter().any(|request| wants(request, message)))
        };
        let own = match to {
            Target::Ros2 => {
                let network = self.network_of(flow);
                network.map(|network| self.requests_at(&network)).unwrap_or_default()
            }
            _ => self.node_requests(flow),
        };
        let Place::Layer(first, _) = &layer else { return false };
        let json = Place::Layer(first.clone(), true);
        let shared = [self.requests_at(&layer), self.requests_at(&json)].concat();
        let (others, members): (Vec<_>, Vec<_>) = self
            .readers(&layer)
            .into_iter()
            .filter(|other| *other != flow)
            .partition(|other| self.view(other).role.is_inside());
        let behind = |other: &FlowId, message: &Message| {
            wanted(&self.requests_behind(other, message), message)
        };
        messages.iter().any(|message| {
            let origins = self.first_readers(message);
            let outside =
                !origins.iter().any(|origin| self.layer_of(origin).as_ref() == Some(&layer));
            let for_members = || members.iter().any(|other| behind(other, message));
            let could = |other: &FlowId| {
                wanted(&shared, message) || behind(other, message) || for_members()
            };
            !origins.is_empty()
                && outside
                && wanted(&own, message)
                && others.iter().any(|other| could(other))
        })
    }
}
