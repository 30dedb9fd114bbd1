//! What the allocator (`docs/design/bandwidth.md`) is told of the lanes, and what its rates mean
//! for them.
//!
//! A lane is all of a topic that goes to one receiver: what is published on the node scope and what
//! is published on the layer scope share it, its rate and its bucket.
//!
//! A lane is thinned where the budget does not hold what is published. One that gets all of it is
//! not: a publisher is never quite regular, and a bucket at just its rate would skip a message now
//! and then. Who publishes more than a tenth faster than was advertised is held to what was
//! advertised; but not where a lane is reliable: there what is published counts as advertised.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, FlowId, LayerName, TopicName};

use super::compress_stage::CompressStats;
use super::core::DataCore;
use super::measure::{LatencyHistogram, WINDOW};
use super::path::{BridgeState, Phase, TopicId, TopicPath};
use crate::limit::allocate::Class;
use crate::limit::bucket::TokenBucket;
use crate::limit::rates::{Demand, LaneDemand, Rates};
use crate::limit::wire_factor::MAX_LAYERS;
use crate::link::{Begun, LaneId};

/// A measured rate is believed anew when it has moved by this share, and a publisher may be so much
/// faster than it says.
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

/// `r_adv` of a topic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Told {
    hz: f64,
    /// It is published faster than that, and is to be held to it.
    exceeded: bool,
}

/// How fast a topic is published for its lanes, and what is believed of that.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Published {
    /// In Hz, as it was when it last moved.
    believed_hz: f64,
    /// Whether it is more than advertised.
    exceeds: bool,
}

impl Published {
    /// Takes what was measured: the mean of late, and that of a whole [`WINDOW`] where there is
    /// one. A regular publisher has a message more in some windows than in others, which for a slow
    /// one is more than a tenth.
    fn take(&mut self, hz: f64, of_window_hz: Option<f64>, said_hz: Option<f64>) {
        if (hz - self.believed_hz).abs() > MOVED * self.believed_hz {
            self.believed_hz = hz;
        }
        let (Some(hz), Some(said)) = (of_window_hz, said_hz) else {
            self.exceeds &= said_hz.is_some();
            return;
        };
        if hz <= said * (1.0 + MOVED) {
            self.exceeds = false;
        } else if (hz - said) * WINDOW.as_secs_f64() > 1.0 + ROUNDING {
            self.exceeds = true;
        }
    }

    fn told(&self, said_hz: Option<f64>, reliable: bool) -> Told {
        let (hz, exceeded) = match said_hz {
            Some(said) if self.exceeds && reliable => (self.believed_hz.max(said), false),
            Some(said) => (said, self.exceeds),
            None => (self.believed_hz, false),
        };
        Told { hz, exceeded }
    }
}

/// One topic with its lanes, as the allocator is told.
#[derive(Debug, Clone)]
struct WantedTopic {
    id: TopicId,
    name: TopicName,
    size_bytes: u64,
    told: Told,
    lanes: Vec<WantedLane>,
}

#[derive(Debug, Clone)]
struct WantedLane {
    /// Its bridges: one for each scope that the topic is published on.
    bridges: Vec<usize>,
    layer: LayerName,
    receiver: FlowId,
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
                advertised_hz: topic.told.hz,
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
            receiver: Some(&self.receiver),
            max_rate_hz: self.max_rate_hz,
        }
    }
}

/// What holds back the lanes of one topic that get less than is published.
#[derive(Debug, Default)]
pub struct LaneGates(Vec<LaneGate>);

#[derive(Debug)]
struct LaneGate {
    receiver: FlowId,
    bucket: TokenBucket,
    /// What is skipped counts as this.
    reason: DropReason,
}

impl LaneGates {
    /// Whether a message may pass to a receiver now.
    ///
    /// # Errors
    /// `rate_limit` where the budget is what holds it back, `max_rate` where nobody there asks for
    /// more.
    pub fn admit(&mut self, now: Instant, receiver: &FlowId) -> Result<(), DropReason> {
        match self.0.iter_mut().find(|gate| gate.receiver == *receiver) {
            Some(gate) => gate.bucket.admit(now).then_some(()).ok_or(gate.reason),
            None => Ok(()),
        }
    }

    /// Whether the budget holds back what goes to a receiver, or what was advertised does.
    #[must_use]
    pub fn limits(&self, receiver: &FlowId) -> bool {
        let of_receiver = self.0.iter().find(|gate| gate.receiver == *receiver);
        of_receiver.is_some_and(|gate| gate.reason == DropReason::RateLimit)
    }

    /// A lane runs at a rate from now on, and what it has saved stays.
    fn hold(&mut self, now: Instant, receiver: &FlowId, rate_hz: f64, reason: DropReason) {
        match self.0.iter_mut().find(|gate| gate.receiver == *receiver) {
            Some(gate) => {
                gate.bucket.set_rate(rate_hz, now);
                gate.reason = reason;
            }
            None => self.0.push(LaneGate {
                receiver: receiver.clone(),
                bucket: TokenBucket::new(rate_hz, now),
                reason,
            }),
        }
    }

    /// All others let everything pass.
    fn keep(&mut self, held: &[&FlowId]) {
        self.0.retain(|gate| held.contains(&&gate.receiver));
    }
}

/// `s` of the messages that were sent, added up since the start: what wire bytes are compared with.
/// Each copy counts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Reckoned {
    /// To all layers.
    pub all: u64,
    /// To single ones, [`MAX_LAYERS`] at most.
    pub by_layer: BTreeMap<LayerName, u64>,
}

impl Reckoned {
    pub(super) fn add(&mut self, layer: &LayerName, bytes: u64) {
        self.all += bytes;
        let layers = self.by_layer.len();
        match self.by_layer.get_mut(layer) {
            Some(sum) => *sum += bytes,
            None if layers < MAX_LAYERS => {
                self.by_layer.insert(layer.clone(), bytes);
            }
            None => {}
        }
    }
}

/// One topic that leaves on the inter scope, as it is shown.
#[derive(Debug, Clone)]
pub struct TopicFacts {
    /// Which one.
    pub id: TopicId,
    /// Its name.
    pub name: TopicName,
    /// What was decided for it.
    pub granted: Granted,
    /// Published for its lanes, in Hz.
    pub published_hz: f64,
    /// What compression did.
    pub compress_stats: CompressStats,
    /// The level of now; 0: payloads go as they are.
    pub level: u8,
    /// Where it goes.
    pub lanes: Vec<LaneFacts>,
}

/// One lane, as it is shown.
#[derive(Debug, Clone)]
pub struct LaneFacts {
    /// Its receiver.
    pub receiver: FlowId,
    /// What the budget allows, in Hz; `None` while that is not worked out, and of a lane that only
    /// empties its queue.
    pub allocated_hz: Option<f64>,
    /// What is asked for at most, in Hz.
    pub asked_hz: Option<f64>,
    /// Sent, in Hz.
    pub actual_hz: f64,
    /// It gets less than is published.
    pub limited: bool,
    /// It is held to the rate that was advertised, because more is published.
    pub exceeds_advertised: bool,
    /// Messages that were skipped, for whatever rate.
    pub skipped: u64,
    /// Messages that are in it.
    pub queued: u64,
    /// How long messages waited in this flow, since the lane was first made.
    pub waits: LatencyHistogram,
}

impl BridgeState {
    /// Whether it takes messages for another flow.
    fn leaves(&self) -> bool {
        self.lane_id().is_some() && matches!(self.phase, Phase::Up { .. })
    }

    /// What was worked out for its lane holds no more.
    fn forget_rates(&mut self) {
        self.allocated_hz = None;
        self.exceeds_advertised = false;
    }
}

impl TopicPath {
    /// Notes that a message was published for a lane, whether it passes there or not.
    pub(super) fn note_offered(&mut self, now: Instant, bytes: u64) {
        self.offered.add(now, bytes);
    }

    /// As how many bytes a message counts: as many as the allocation takes each of them for. One
    /// that is larger has just been seen for the first time.
    pub(super) fn reckoned_bytes(&self, bytes: u64) -> u64 {
        self.granted.map_or(bytes, |granted| granted.size_bytes.max(bytes))
    }

    /// `r_adv`: what publishers say, or what was measured where one of them does not say.
    fn advertised(&mut self, now: Instant) -> Told {
        let said = self.info.rate_hz;
        let (hz, of_window) = (self.offered.rate(now).0, self.offered.of_window(now));
        self.published.take(hz, of_window, said);
        let reliable = self.bridges.iter().any(|bridge| bridge.leaves() && bridge.lane.reliable);
        self.published.told(said, reliable)
    }

    /// `s`: the largest payload as sent; before the first the largest seen or advertised.
    fn size_to_send(&self) -> u64 {
        match self.sent_size.largest() {
            0 => self.size_bytes(),
            largest => largest,
        }
    }

    /// Its lanes, each with what anybody at its end asks for at most.
    fn lanes(&self) -> Vec<WantedLane> {
        let mut lanes: Vec<WantedLane> = Vec::new();
        for (at, bridge) in self.bridges.iter().enumerate().filter(|(_, bridge)| bridge.leaves()) {
            let Some((layer, receiver)) = bridge.receiver() else {
                continue;
            };
            let asked = bridge.lane.max_rate_hz;
            if let Some(lane) = lanes.iter_mut().find(|lane| lane.receiver == *receiver) {
                lane.bridges.push(at);
                lane.max_rate_hz = lane.max_rate_hz.zip(asked).map(|(one, other)| one.max(other));
            } else {
                lanes.push(WantedLane {
                    bridges: vec![at],
                    layer: layer.clone(),
                    receiver: receiver.clone(),
                    max_rate_hz: asked,
                });
            }
        }
        lanes
    }

    /// Nothing of it leaves any more.
    fn stays(&mut self) {
        self.granted = None;
        self.told = None;
        self.gates = LaneGates::default();
        self.bridges.iter_mut().for_each(BridgeState::forget_rates);
    }

    /// Its lanes run as was worked out. Those that have changed meanwhile are left to the next
    /// time.
    fn set_rates(&mut self, now: Instant, topic: &WantedTopic, lanes_hz: &[f64]) {
        let mut held: Vec<&FlowId> = Vec::new();
        for (lane, hz) in topic.lanes.iter().zip(lanes_hz) {
            let asked = lane.max_rate_hz.map_or(topic.told.hz, |most| most.min(topic.told.hz));
            let thinned = *hz < asked * (1.0 - ROUNDING);
            let exceeds =
                topic.told.exceeded && !thinned && lane.max_rate_hz.is_none_or(|most| *hz < most);
            if thinned || exceeds {
                self.gates.hold(now, &lane.receiver, *hz, DropReason::RateLimit);
                held.push(&lane.receiver);
            } else if let Some(most) = lane.max_rate_hz.filter(|_| lane.bridges.len() > 1) {
                // Each of its bridges lets so much pass.
                self.gates.hold(now, &lane.receiver, most, DropReason::MaxRate);
                held.push(&lane.receiver);
            }
            for at in &lane.bridges {
                let same = |bridge: &&mut BridgeState| {
                    bridge.leaves()
                        && bridge.receiver().is_some_and(|(_, receiver)| *receiver == lane.receiver)
                };
                if let Some(bridge) = self.bridges.get_mut(*at).filter(same) {
                    bridge.allocated_hz = Some(*hz);
                    bridge.exceeds_advertised = exceeds;
                }
            }
        }
        self.gates.keep(&held);
    }

    fn facts(&mut self, now: Instant, id: TopicId) -> Option<TopicFacts> {
        let granted = self.granted.filter(|_| !self.vacant)?;
        let mut lanes: Vec<LaneFacts> = Vec::new();
        for bridge in self.bridges.iter_mut().filter(|bridge| bridge.phase != Phase::Ended) {
            let Some(receiver) = bridge.receiver().map(|(_, receiver)| receiver.clone()) else {
                continue;
            };
            let actual_hz = bridge.out_rate.rate(now).0;
            let (stats, leaves) = (&bridge.stats, bridge.leaves());
            let skipped =
                stats.dropped.get(DropReason::RateLimit) + stats.dropped.get(DropReason::MaxRate);
            if let Some(lane) = lanes.iter_mut().find(|lane| lane.receiver == receiver) {
                lane.allocated_hz = lane.allocated_hz.or(bridge.allocated_hz);
                lane.asked_hz =
                    lane.asked_hz.zip(bridge.lane.max_rate_hz).map(|(one, other)| one.max(other));
                lane.actual_hz += actual_hz;
                lane.exceeds_advertised |= bridge.exceeds_advertised;
                lane.skipped += skipped;
                lane.queued += stats.queued();
                lane.waits.merge(&stats.latency);
            } else {
                lanes.push(LaneFacts {
                    limited: leaves && self.gates.limits(&receiver),
                    receiver,
                    allocated_hz: bridge.allocated_hz,
                    asked_hz: bridge.lane.max_rate_hz,
                    actual_hz,
                    exceeds_advertised: bridge.exceeds_advertised,
                    skipped,
                    queued: stats.queued(),
                    waits: stats.latency.clone(),
                });
            }
        }
        (!lanes.is_empty()).then(|| TopicFacts {
            id,
            name: self.name.clone(),
            granted,
            published_hz: self.offered.rate(now).0,
            compress_stats: self.compress_stats,
            level: self.level(),
            lanes,
        })
    }
}

impl DataCore {
    /// Whether a size has grown since the last call.
    pub fn take_allocation_due(&mut self) -> bool {
        std::mem::take(&mut self.allocation_due)
    }

    /// Whether lanes or advertisements have changed since the last call, or what counts as large.
    pub fn take_lanes_changed(&mut self) -> bool {
        std::mem::take(&mut self.lanes_changed)
    }

    /// Looks whether measured rates have moved, and lets go of sizes that are older than the
    /// window; to be called about twice a second. Returns whether the rates have to be worked out
    /// anew.
    pub fn look_at_rates(&mut self, now: Instant, size_window: Option<Duration>) -> bool {
        let mut changed = false;
        for id in &self.leaving {
            let path = &mut self.topics[id.0 as usize];
            if path.vacant || !path.bridges.iter().any(BridgeState::leaves) {
                continue;
            }
            let (before, told) = (path.told, path.advertised(now));
            changed |= path.sent_size.forget(now, size_window) || before != Some(told);
        }
        changed
    }

    /// What the allocator is to know.
    pub fn wanted(&mut self, now: Instant) -> Wanted {
        let topics = &mut self.topics;
        let mut wanted = Vec::new();
        self.leaving.retain(|id| {
            let path = &mut topics[id.0 as usize];
            let lanes = path.lanes();
            if path.vacant || lanes.is_empty() {
                path.stays();
                return false;
            }
            for bridge in path.bridges.iter_mut().filter(|bridge| !bridge.leaves()) {
                bridge.forget_rates();
            }
            let told = path.advertised(now);
            path.told = Some(told);
            wanted.push(WantedTopic {
                id: *id,
                name: path.name.clone(),
                size_bytes: path.size_to_send(),
                told,
                lanes,
            });
            true
        });
        Wanted(wanted)
    }

    /// Makes the lanes run as was worked out.
    pub fn set_rates(&mut self, now: Instant, wanted: &Wanted, rates: &Rates) {
        for (topic, rates) in wanted.0.iter().zip(&rates.topics) {
            let path = &mut self.topics[topic.id.0 as usize];
            if path.vacant || path.name != topic.name {
                continue;
            }
            path.granted = Some(Granted {
                class: rates.class,
                size_bytes: topic.size_bytes,
                advertised_hz: topic.told.hz,
            });
            path.set_rates(now, topic, &rates.lanes_hz);
        }
    }

    /// What was sent, as the allocation reckons; of messages that are being sent the share that has
    /// left. Without that a single image on a slow link would move the wire factor, whose wire
    /// bytes are counted as they leave.
    #[must_use]
    pub fn reckoned(&self, being_sent: impl Iterator<Item = (LaneId, Begun)>) -> Reckoned {
        let mut reckoned = self.reckoned.clone();
        for (lane, begun) in being_sent {
            if let Some((layer, bytes)) = self.what_left(lane, begun) {
                reckoned.add(layer, bytes);
            }
        }
        reckoned
    }

    /// A message is dropped of which some parts have left: they have cost what others do.
    pub fn lane_cut(&mut self, lane: LaneId, begun: Begun) {
        if let Some((layer, bytes)) = self.what_left(lane, begun) {
            let layer = layer.clone();
            self.reckoned.add(&layer, bytes);
        }
    }

    fn what_left(&self, lane: LaneId, begun: Begun) -> Option<(&LayerName, u64)> {
        let (topic, at) = self.lanes.get(lane.0 as usize)?;
        let path = self.topics.get(topic.0 as usize)?;
        let (layer, _) = path.bridges.get(*at)?.receiver()?;
        let size = path.reckoned_bytes(begun.payload_bytes as u64);
        Some((layer, size * begun.parts_sent as u64 / begun.parts.max(1) as u64))
    }

    /// Some of the topics that leave on the inter scope: those that are looked at next after one of
    /// them, or the first ones. The second is the last that was looked at; `None`: there are no
    /// more.
    pub fn allocation_facts(
        &mut self,
        now: Instant,
        after: Option<TopicId>,
        most: usize,
    ) -> (Vec<TopicFacts>, Option<TopicId>) {
        let from = after.map_or(Bound::Unbounded, Bound::Excluded);
        let ids: Vec<TopicId> =
            self.leaving.range((from, Bound::Unbounded)).take(most).copied().collect();
        let topics = &mut self.topics;
        let facts = ids.iter().filter_map(|id| topics[id.0 as usize].facts(now, *id)).collect();
        (facts, ids.last().copied())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_excess_begins_and_ends_with_whole_windows() {
        let mut published = Published::default();
        let mut exceeds = |hz: f64, of_window: Option<f64>| {
            published.take(hz, of_window, Some(10.0));
            let told = published.told(Some(10.0), false);
            assert_eq!(told.hz, 10.0);
            told.exceeded
        };
        assert!(!exceeds(50.0, None), "the first moments of a publisher tell nothing");
        assert!(exceeds(11.4, Some(11.4)));
        assert!(exceeds(10.6, None), "nor does what comes after a silence");
        // Less than a tenth below what is believed, and not above what was said.
        assert!(!exceeds(10.6, Some(10.6)));
    }

    #[test]
    fn one_message_more_in_a_window_is_no_excess() {
        for (said, measured, exceeded) in
            [(1.0, 1.2, false), (1.0, 1.4, true), (0.1, 0.2, false), (50.0, 56.0, true)]
        {
            let mut published = Published::default();
            published.take(measured, Some(measured), Some(said));
            let told = published.told(Some(said), false);
            assert_eq!(told.exceeded, exceeded, "{measured} instead of {said}");
        }
    }
}
