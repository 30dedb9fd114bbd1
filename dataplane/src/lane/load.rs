//! How much each bridge carries, and which topics could be given to another flow now without the
//! loss of a message.

use std::time::{Duration, Instant};

use blaze_domain::{Scope, TopicName};

use super::core::{DataCore, LaneLink};
use super::path::{BridgeState, Phase, Sink, TopicPath};
use crate::registry::MAX_PARTITIONS;

/// Time constant of the mean.
const TAU: Duration = Duration::from_secs(10);
/// Samples are at least this far apart.
const SAMPLE: Duration = Duration::from_millis(500);
/// A rate that was measured for this long is good enough to move a topic by.
const KNOWN_AFTER: Duration = Duration::from_secs(5);
/// A lane that needs longer than this for what waits in it is too far behind to be emptied in
/// passing.
const BEHIND: Duration = Duration::from_millis(250);

/// Bytes per second as an exponentially weighted mean over about 10 s. It counts nothing before its
/// beginning, so a young one shows the mean since then.
#[derive(Debug, Clone)]
pub struct LoadMeter {
    counted: u64,
    sampled: u64,
    at: Instant,
    sum: f64,
    weight: f64,
}

impl LoadMeter {
    /// A meter that has counted nothing.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self { counted: 0, sampled: 0, at: now, sum: 0.0, weight: 0.0 }
    }

    /// Counts one message.
    pub fn add(&mut self, bytes: u64) {
        self.counted = self.counted.wrapping_add(bytes);
    }

    /// What was counted since the last sample goes into the mean, if that is long enough ago.
    pub fn sample(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.at);
        if passed < SAMPLE {
            return;
        }
        let rate = self.counted.wrapping_sub(self.sampled) as f64 / passed.as_secs_f64();
        let keeps = (-passed.as_secs_f64() / TAU.as_secs_f64()).exp();
        self.sum = self.sum * keeps + rate * (1.0 - keeps);
        self.weight = self.weight * keeps + (1.0 - keeps);
        (self.sampled, self.at) = (self.counted, now);
    }

    /// Bytes per second; 0 before the first sample.
    #[must_use]
    pub fn bytes_per_s(&self) -> f64 {
        if self.weight > 0.0 { self.sum / self.weight } else { 0.0 }
    }

    /// Whether it was measured for 5 s at least.
    #[must_use]
    pub fn is_known(&self) -> bool {
        // A little less, because samples are never exactly as far apart as they are meant to be.
        let weight = 1.0 - (-0.95 * KNOWN_AFTER.as_secs_f64() / TAU.as_secs_f64()).exp();
        self.weight >= weight
    }
}

/// What a flow carries out of its layer of one topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicLoad {
    /// The topic.
    pub topic: TopicName,
    /// Payload bytes per second, one copy per lane.
    pub bytes_per_s: u64,
    /// It could be given to another flow now, and no message be lost or sent twice.
    pub may_move: bool,
}

/// What a flow carries, in payload bytes per second.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Loads {
    /// To other flows, one copy per lane.
    pub out_bytes_per_s: u64,
    /// From other flows, one copy per scope that it is written to.
    pub in_bytes_per_s: u64,
    /// Topics that are carried out of the layer.
    pub carried: Vec<TopicLoad>,
}

impl BridgeState {
    /// Payload bytes per second that it carries, after its filters and its rate; 0 unless it takes
    /// messages in.
    #[must_use]
    pub fn load(&self) -> u64 {
        match self.phase {
            Phase::Up { .. } => self.load.bytes_per_s().round() as u64,
            Phase::Draining { .. } | Phase::Failed { .. } | Phase::Ended => 0,
        }
    }

    /// Whether it carries what services of the layer scope publish to another group.
    pub(super) fn carries_out(&self) -> bool {
        self.from == Scope::Layer && matches!(self.sink, Sink::Lane { .. })
    }

    fn is_up(&self) -> bool {
        matches!(self.phase, Phase::Up { .. })
    }

    /// Whether its lane is so far behind, or its peer so silent, that it could not be emptied in
    /// passing.
    fn is_behind(&mut self, now: Instant, link: &dyn LaneLink) -> bool {
        let queued = self.lane_id().map_or(0, |lane| link.queued(lane)) + self.in_codec;
        let silent = self.receiver().is_some_and(|(_, peer)| link.is_suspect(peer));
        let in_passing = self.out_rate.rate(now).0 * BEHIND.as_secs_f64() + 1.0;
        queued > 0 && (silent || queued as f64 > in_passing)
    }
}

impl TopicPath {
    /// Whether another flow could go on with what this one carries out of the layer, and no message
    /// be lost or sent twice: it is known where the next one begins, nothing is kept for late
    /// joiners (that would be sent again), no bridge empties its queue, and no lane is behind.
    fn may_move(&mut self, now: Instant, link: &dyn LaneLink) -> bool {
        let draining = |bridge: &BridgeState| matches!(bridge.phase, Phase::Draining { .. });
        if !self.places.are_exact(MAX_PARTITIONS) || self.bridges.iter().any(draining) {
            return false;
        }
        let mut lanes =
            self.bridges.iter_mut().filter(|bridge| bridge.carries_out() && bridge.is_up());
        lanes.all(|bridge| {
            !bridge.lane.durable && bridge.load.is_known() && !bridge.is_behind(now, link)
        })
    }
}

impl DataCore {
    /// Takes a sample of what every bridge carries, and tells the whole; to be called once a
    /// second.
    pub fn measure(&mut self, now: Instant, link: &dyn LaneLink) -> Loads {
        let mut loads = Loads::default();
        for path in self.topics.iter_mut().filter(|path| !path.vacant) {
            let mut carried = None;
            for bridge in &mut path.bridges {
                bridge.load.sample(now);
                let bytes_per_s = bridge.load();
                match (&bridge.sink, bridge.from) {
                    (Sink::Lane { .. }, _) => loads.out_bytes_per_s += bytes_per_s,
                    (Sink::Publish { .. }, Scope::Inter) => loads.in_bytes_per_s += bytes_per_s,
                    (Sink::Publish { .. }, _) => {}
                }
                if bridge.carries_out() && bridge.is_up() {
                    *carried.get_or_insert(0) += bytes_per_s;
                }
            }
            if let Some(bytes_per_s) = carried {
                loads.carried.push(TopicLoad {
                    topic: path.name.clone(),
                    bytes_per_s,
                    may_move: path.may_move(now, link),
                });
            }
        }
        loads
    }

    /// Whether nothing of a topic that was carried out of the layer waits in a lane any more.
    #[must_use]
    pub fn has_emptied(&self, topic: &TopicName) -> bool {
        let Some(id) = self.find(topic.as_str()) else {
            return true;
        };
        let waits = |bridge: &BridgeState| {
            bridge.carries_out() && matches!(bridge.phase, Phase::Draining { .. })
        };
        !self.path(id).bridges.iter().any(waits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_change_is_followed_over_ten_seconds() {
        let start = Instant::now();
        let mut meter = LoadMeter::new(start);
        let mut run = |from: u32, to: u32, bytes: u64| {
            for second in from..to {
                meter.add(bytes);
                meter.sample(start + SECOND * (second + 1));
            }
            meter.bytes_per_s()
        };
        assert!((run(0, 100, 1000) - 1000.0).abs() < 0.1);
        let after = run(100, 110, 0);
        assert!((after - 1000.0 / std::f64::consts::E).abs() < 1.0, "{after}");
        assert!(run(110, 200, 0) < 1.0);
    }
}
