//! How much the flows that share the layer broker carry, and which of them have just given a topic
//! to another.
//!
//! Loads come with every Hello on the channel of the layer broker. They are no part of what is
//! announced, so they change neither version nor digest, and no topic is planned anew because of
//! them.

use std::time::{Duration, Instant};

use blaze_domain::FlowId;
use blaze_proto::link::link_control::Hello;

use super::Registry;
use crate::world::{FlowState, Handover, Reach};

/// A flow that has given or got a topic by load does neither again for this long: what it carries
/// now is not measured yet.
pub const REST: Duration = Duration::from_secs(10);

/// Payload bytes per second of one flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Load {
    /// What its bridges have for the inter scope: one copy per lane, after their rates.
    pub out_bytes_per_s: u64,
    /// What it takes in from the inter scope: one copy per scope that it writes.
    pub in_bytes_per_s: u64,
    /// What its wire may take; 0 = not known.
    pub limit_bytes_per_s: u64,
}

impl Load {
    /// Both directions.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.out_bytes_per_s.saturating_add(self.in_bytes_per_s)
    }

    /// What a Hello says; `None` where it says nothing of what the flow takes in.
    pub(super) fn said(hello: &Hello) -> Option<Self> {
        let egress = hello.egress.unwrap_or_default();
        Some(Self {
            out_bytes_per_s: egress.demand_bytes_per_s,
            in_bytes_per_s: hello.ingress_bytes_per_s?,
            limit_bytes_per_s: egress.limit_bytes_per_s,
        })
    }
}

impl Registry {
    /// What a flow that shares the layer broker says of its load.
    #[must_use]
    pub fn load_of(&self, flow: &FlowId) -> Option<Load> {
        self.remotes.get(flow)?.ways.layer?.load
    }

    /// The other flows that could be given a topic now: they share the layer broker, live and have
    /// settled.
    pub fn settled_replicas(&self) -> impl Iterator<Item = &FlowId> {
        let others = self.world.flows.iter().filter(|(flow, _)| **flow != self.config.me);
        // One that is not on the inter scope could not carry anything there.
        let settled = others.filter(|(_, view)| {
            let carries = view.state == FlowState::Ready && view.role.is_gateway();
            view.settled && carries && view.reach != Reach::Down
        });
        settled.map(|(flow, _)| flow).filter(|flow| self.shares_layer(flow))
    }

    /// Whether a flow has given or got a topic by load within [`REST`].
    #[must_use]
    pub fn rests(&self, now: Instant, flow: &FlowId) -> bool {
        let moved = self.moves.get(flow);
        moved.is_some_and(|at| now.saturating_duration_since(*at) < REST)
    }

    /// When a flow of the group last gave a topic to another one by load.
    #[must_use]
    pub fn last_move(&self) -> Option<Instant> {
        self.moves.values().max().copied()
    }

    /// A flow has handed a topic over: if by name, both are left alone for a while.
    pub(super) fn note_move(&mut self, now: Instant, from: &FlowId, handover: &Handover) {
        let Some(to) = &handover.to else { return };
        self.moves.retain(|_, at| now.saturating_duration_since(*at) < REST);
        for flow in [from, to].into_iter().filter(|flow| self.world.flows.contains_key(*flow)) {
            self.moves.insert(flow.clone(), now);
        }
    }
}
