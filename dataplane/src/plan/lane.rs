//! What a lane carries: the most that its requesters ask for, within what its publishers offer and
//! the operator allows.

use std::collections::BTreeSet;

use blaze_domain::node_file::TopicValues;
use blaze_domain::{Durability, Priority, Reliability};

use super::{LaneSpec, Publisher, Requester};
use crate::world::{Advertise, OriginFilter, Request};

/// Makes the lanes of one topic.
pub(super) struct LaneBuilder {
    /// The operator's word.
    rules: TopicValues,
}

impl LaneBuilder {
    pub(super) fn new(rules: TopicValues) -> Self {
        Self { rules }
    }

    /// The lane for the given pairs of publisher and requester, each of which matches; `None`
    /// without a pair.
    pub(super) fn lane<'p, 'w: 'p>(
        &self,
        pairs: impl Iterator<Item = (&'p Publisher<'w>, &'p Requester<'w>)>,
    ) -> Option<LaneSpec> {
        let pairs: Vec<Pair<'p>> =
            pairs.map(|(publisher, requester)| (publisher.advertise, requester.request)).collect();
        if pairs.is_empty() {
            return None;
        }
        let mut lane = LaneSpec {
            max_rate_hz: highest_rate(&pairs),
            lifespan_ms: lifespan(&pairs),
            reliable: pairs
                .iter()
                .any(|(offer, ask)| is_reliable(offer.reliability) && is_reliable(ask.reliability)),
            durable: pairs
                .iter()
                .any(|(offer, ask)| is_durable(offer.durability) && is_durable(ask.durability)),
            depth: pairs
                .iter()
                .map(|(offer, ask)| offer.depth.min(ask.depth))
                .max()
                .unwrap_or(1)
                .max(1),
            priority: priority(&pairs),
            from: origins(&pairs),
            ..LaneSpec::default()
        };
        self.cap(&mut lane);
        Some(lane)
    }

    /// The operator's word: it bounds rate and lifespan, and replaces the class.
    fn cap(&self, lane: &mut LaneSpec) {
        lane.max_rate_hz = match (lane.max_rate_hz, self.rules.max_rate_hz) {
            (Some(asked), Some(cap)) => Some(asked.min(cap)),
            (asked, cap) => asked.or(cap),
        };
        lane.lifespan_ms = shorter(lane.lifespan_ms, self.rules.lifespan_ms.unwrap_or(0));
        lane.priority = self.rules.priority.or(lane.priority);
    }
}

type Pair<'p> = (&'p Advertise, &'p Request);

/// Whether a request asks for a better quality of service than is offered.
pub(crate) fn asks_too_much(offer: &Advertise, ask: &Request) -> bool {
    (is_reliable(ask.reliability) && !is_reliable(offer.reliability))
        || (is_durable(ask.durability) && !is_durable(offer.durability))
}

fn is_reliable(reliability: Reliability) -> bool {
    reliability == Reliability::Reliable
}

fn is_durable(durability: Durability) -> bool {
    durability == Durability::TransientLocal
}

fn highest_rate(pairs: &[Pair<'_>]) -> Option<f64> {
    let rates: Option<Vec<f64>> = pairs.iter().map(|(_, ask)| ask.max_rate_hz).collect();
    rates?.into_iter().reduce(f64::max)
}

fn lifespan(pairs: &[Pair<'_>]) -> u32 {
    let offered = longer(pairs.iter().map(|(offer, _)| offer.lifespan_ms));
    shorter(offered, longer(pairs.iter().map(|(_, ask)| ask.lifespan_ms)))
}

/// The longest lifespan, where 0 is infinite.
fn longer(lifespans: impl Iterator<Item = u32>) -> u32 {
    lifespans.reduce(|a, b| if a == 0 || b == 0 { 0 } else { a.max(b) }).unwrap_or(0)
}

/// The shorter lifespan, where 0 is infinite.
fn shorter(a: u32, b: u32) -> u32 {
    if a == 0 || b == 0 { a.max(b) } else { a.min(b) }
}

/// The highest class that is published, lowered to the highest that is asked for if every requester
/// names one.
fn priority(pairs: &[Pair<'_>]) -> Option<Priority> {
    let asked: Option<Vec<Priority>> = pairs.iter().map(|(_, ask)| ask.priority).collect();
    let asked = asked.and_then(|asked| asked.into_iter().min());
    // What says nothing is `state` unless it is large, so a publisher that says `bulk` does not
    // lower it.
    let named = pairs.iter().filter_map(|(offer, _)| offer.priority).min();
    let silent = pairs.iter().any(|(offer, _)| offer.priority.is_none());
    let offered = named.filter(|named| !silent || *named < Priority::Bulk);
    match (offered, asked) {
        (Some(offered), Some(asked)) => Some(offered.max(asked)),
        (offered @ Some(_), None) => offered,
        (None, Some(Priority::Bulk)) => Some(Priority::Bulk),
        (None, _) => None,
    }
}

fn origins(pairs: &[Pair<'_>]) -> Vec<OriginFilter> {
    if pairs.iter().any(|(_, ask)| ask.from.is_empty()) {
        return Vec::new();
    }
    let all: BTreeSet<&OriginFilter> = pairs.iter().flat_map(|(_, ask)| &ask.from).collect();
    all.into_iter().cloned().collect()
}
