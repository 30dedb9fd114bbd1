//! What the allocator of F9 is told of the lanes, and what its word means for them.
//!
//! A lane is thinned where the budget does not hold what is published. One that gets all of it is not: a publisher is never quite
//! regular, and a bucket at just its rate would skip a message now and then. Who publishes more than a tenth faster than was advertised is
//! held to what was advertised; but not where a lane is reliable: there what is published counts as advertised.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::{LayerName, TopicName};

use super::core::DataCore;
use super::path::{BridgeState, Phase, TopicId, TopicPath};
use crate::limit::allocate::Class;
use crate::limit::rates::{Demand, LaneDemand, Rates};

/// A measured rate is believed anew when it has moved by this share, and a publisher may be so much faster than it says.
const MOVED: f64 = 0.1;
/// Rounding of rates.
const ROUNDING: f64 = 1e-9;

/// What was decided for a topic that leaves on the inter scope.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Granted {
    /// Whether it is large.
    pub class: Class,
    /// `s`, in bytes.
    pub size_bytes: u64,
    /// `r_adv`, in Hz.
    pub advertised_hz: f64,
}

/// One topic with its lanes, as the allocator is told.
#[derive(Debug, Clone)]
struct WantedTopic {
    id: TopicId,
    name: TopicName,
    size_bytes: u64,
    advertised_hz: f64,
    /// It is published faster than that, and is to be held to it.
    exceeded: bool,
    lanes: Vec<WantedLane>,
}

#[derive(Debug, Clone)]
struct WantedLane {
    bridge: usize,
    layer: LayerName,
    max_rate_hz: Option<f64>,
}

/// All topics that leave on the inter scope, at one moment.
#[derive(Debug, Clone, Default)]
pub struct Wanted(Vec<WantedTopic>);

impl Wanted {
    /// As the allocator takes it.
    #[must_use]
    pub fn demands(&self) -> Vec<Demand<'_>> {
        self.0
            .iter()
            .map(|topic| Demand {
                topic: topic.name.as_str(),
                size_bytes: topic.size_bytes,
                advertised_hz: topic.advertised_hz,
                class: None,
                lanes: topic.lanes.iter().map(WantedLane::demand).collect(),
            })
            .collect()
    }

    /// Topics that leave.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether nothing leaves.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl WantedLane {
    fn demand(&self) -> LaneDemand<'_> {
        LaneDemand {
            layer: &self.layer,
            max_rate_hz: self.max_rate_hz,
        }
    }
}

impl BridgeState {
    fn leaves(&self) -> bool {
        self.lane_id().is_some() && matches!(self.phase, Phase::Up { .. })
    }
}

impl TopicPath {
    /// `r_adv`: what publishers say, or what was measured where one of them does not say; and whether they exceed what they say.
    fn advertised(&mut self, now: Instant) -> (f64, bool) {
        let measured = self.in_rate.rate(now).0;
        let reliable = self.bridges.iter().any(|bridge| bridge.leaves() && bridge.lane.reliable);
        if (measured - self.believed_hz).abs() > MOVED * self.believed_hz {
            self.believed_hz = measured;
        }
        match self.info.rate_hz {
            Some(said) if self.believed_hz > said * (1.0 + MOVED) && reliable => (self.believed_hz, false),
            Some(said) => (said, self.believed_hz > said * (1.0 + MOVED)),
            None => (self.believed_hz, false),
        }
    }

    /// `s`: the largest payload as sent; before the first the largest seen or advertised.
    fn size_to_send(&self) -> u64 {
        match self.sent_size.largest() {
            0 => self.size_bytes(),
            largest => largest,
        }
    }
}

impl DataCore {
    /// Whether bridges, sizes or advertisements have changed since the last call.
    pub fn take_allocation_due(&mut self) -> bool {
        std::mem::take(&mut self.allocation_due)
    }

    /// Looks whether measured rates have moved, and lets go of sizes that are older than the window; to be called about twice a second.
    /// Returns whether the rates have to be worked out anew.
    pub fn look_at_rates(&mut self, now: Instant, size_window: Option<Duration>) -> bool {
        let mut changed = false;
        for path in self.topics.iter_mut().filter(|path| !path.vacant) {
            if !path.bridges.iter().any(BridgeState::leaves) {
                continue;
            }
            let before = path.advertised_told;
            let told = path.advertised(now);
            changed |= path.sent_size.forget(now, size_window) || before != Some(told);
        }
        changed
    }

    /// What the allocator is to know.
    pub fn wanted(&mut self, now: Instant) -> Wanted {
        let mut wanted = Vec::new();
        for (index, path) in self.topics.iter_mut().enumerate().filter(|(_, path)| !path.vacant) {
            let lane = |(bridge, state): (usize, &BridgeState)| {
                let (layer, _) = state.receiver().filter(|_| state.leaves())?;
                Some(WantedLane {
                    bridge,
                    layer: layer.clone(),
                    max_rate_hz: state.lane.max_rate_hz,
                })
            };
            let lanes: Vec<WantedLane> = path.bridges.iter().enumerate().filter_map(lane).collect();
            if lanes.is_empty() {
                path.granted = None;
                continue;
            }
            let told = path.advertised(now);
            path.advertised_told = Some(told);
            wanted.push(WantedTopic {
                id: super::places::topic_id(index),
                name: path.name.clone(),
                size_bytes: path.size_to_send(),
                advertised_hz: told.0,
                exceeded: told.1,
                lanes,
            });
        }
        Wanted(wanted)
    }

    /// Makes the lanes run as was worked out. Lanes that have changed meanwhile are left to the next time.
    pub fn set_rates(&mut self, now: Instant, wanted: &Wanted, rates: &Rates) {
        for (topic, rates) in wanted.0.iter().zip(&rates.topics) {
            let path = &mut self.topics[topic.id.0 as usize];
            if path.vacant || path.name != topic.name {
                continue;
            }
            path.granted = Some(Granted {
                class: rates.class,
                size_bytes: topic.size_bytes,
                advertised_hz: topic.advertised_hz,
            });
            for (lane, hz) in topic.lanes.iter().zip(&rates.lanes_hz) {
                let same = |bridge: &&mut BridgeState| {
                    bridge.leaves() && bridge.receiver().is_some_and(|(layer, _)| *layer == lane.layer)
                };
                let Some(bridge) = path.bridges.get_mut(lane.bridge).filter(same) else {
                    continue;
                };
                bridge.allocated_hz = Some(*hz);
                let asked = lane.max_rate_hz.map_or(topic.advertised_hz, |most| most.min(topic.advertised_hz));
                let thinned = *hz < asked * (1.0 - ROUNDING);
                bridge.gate.set_allocated((thinned || topic.exceeded).then_some(*hz), now);
            }
        }
    }

    /// Payload bytes of messages that were sent, by destination, each copy counted once.
    #[must_use]
    pub fn sent_payload(&self) -> BTreeMap<LayerName, u64> {
        let mut sent = BTreeMap::new();
        for bridge in self.topics.iter().flat_map(|path| &path.bridges) {
            if let Some((layer, _)) = bridge.receiver() {
                *sent.entry(layer.clone()).or_default() += bridge.sent_bytes;
            }
        }
        sent
    }
}
