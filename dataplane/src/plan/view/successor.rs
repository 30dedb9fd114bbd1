//! Who goes on with a topic that a flow carries out of its layer.

use blaze_domain::FlowId;

use super::{Group, TopicView};
use crate::plan::rendezvous;
use crate::world::{Carrying, Hold, Reach};

impl<'w> TopicView<'w> {
    /// Who is to carry what this flow carries, of those that could: itself, unless it gives the
    /// topic to another one.
    pub(super) fn successor(
        &self,
        mut able: impl Iterator<Item = &'w FlowId>,
    ) -> Option<&'w FlowId> {
        let hold = self.part_of(self.me).map_or(&Hold::Hashing, |part| &part.hold);
        match hold {
            Hold::Hashing => {
                let able = able.filter(|flow| *flow == self.me || self.is_settled(flow));
                rendezvous::choose(self.topic.as_str(), able)
            }
            Hold::Stays => Some(self.me),
            Hold::GivesTo(to) => able.find(|flow| *flow == to).or(Some(self.me)),
        }
    }

    /// The flow that a topic was given to which nobody carries, if it could.
    pub(super) fn given_to(
        &self,
        group: Group<'w>,
        mut able: impl Iterator<Item = &'w FlowId>,
    ) -> Option<&'w FlowId> {
        let of_group = self.world.flows.iter().filter(|(id, flow)| {
            // Of itself a flow knows that it lives.
            (flow.reach != Reach::Down || *id == self.me) && Group::of(id, flow) == group
        });
        let mut given = of_group.filter_map(|(id, _)| match &self.part_of(id)?.carrying {
            Carrying::HandedOver(handover) => handover.to.as_ref(),
            Carrying::No | Carrying::Carries => None,
        });
        let to = given.next()?;
        able.find(|flow| *flow == to)
    }
}
