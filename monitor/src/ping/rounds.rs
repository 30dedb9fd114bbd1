//! When the nodes of each layer are asked: once a period, and once a second at the start of a node.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_domain::LayerName;
use rand::RngExt;
use rand::rngs::StdRng;

use super::limits::{JITTER, START_INTERVAL};
use super::nodes::Nodes;

/// Times of one layer, by the monotonic clock.
#[derive(Debug)]
struct Round {
    /// All nodes of the layer that are asked.
    next: Duration,
    /// Those that start.
    start: Option<Duration>,
}

/// Times of all layers that have a node that is asked.
#[derive(Debug, Default)]
pub(super) struct Rounds(BTreeMap<LayerName, Round>);

impl Rounds {
    /// New random times for all layers, for a new period.
    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// Follows the nodes that are asked. A new layer begins somewhere in the period, so that nodes
    /// that start together are spread over it.
    pub(super) fn follow(&mut self, now: Duration, nodes: &Nodes, rng: &mut StdRng) {
        self.0.retain(|layer, _| nodes.asked().any(|(node, _)| node.layer == *layer));
        for (node, series) in nodes.asked() {
            let round = self.0.entry(node.layer.clone()).or_insert_with(|| Round {
                next: now.saturating_add(up_to(nodes.period(), rng)),
                start: None,
            });
            if series.start > 0 && round.start.is_none() {
                round.start = Some(now.saturating_add(up_to(START_INTERVAL, rng)));
            }
        }
    }

    /// Layers to ask now, and whether all their nodes are asked or those that start alone.
    pub(super) fn due(&self, now: Duration) -> Vec<(LayerName, bool)> {
        let due = self.0.iter().filter(|(_, round)| round.at() <= now);
        due.map(|(layer, round)| (layer.clone(), round.next <= now)).collect()
    }

    /// Sets the next times of a layer that was asked.
    pub(super) fn asked(
        &mut self,
        now: Duration,
        layer: &LayerName,
        all: bool,
        nodes: &Nodes,
        rng: &mut StdRng,
    ) {
        let Some(round) = self.0.get_mut(layer) else { return };
        if all {
            let share = rng.random_range(1.0 - JITTER..=1.0 + JITTER);
            round.next = now.saturating_add(nodes.period().mul_f64(share));
        }
        let starts = nodes.asked().any(|(node, series)| node.layer == *layer && series.start > 0);
        round.start = starts.then(|| now.saturating_add(START_INTERVAL));
    }

    pub(super) fn deadline(&self) -> Option<Duration> {
        self.0.values().map(Round::at).min()
    }
}

impl Round {
    fn at(&self) -> Duration {
        self.start.map_or(self.next, |start| start.min(self.next))
    }
}

/// A random time from zero up to the given one.
pub(super) fn up_to(most: Duration, rng: &mut StdRng) -> Duration {
    most.mul_f64(rng.random_range(0.0..=1.0))
}
