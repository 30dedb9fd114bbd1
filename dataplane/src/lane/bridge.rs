//! What one bridge does with a message: filter, lifespan, rate, then broker or lane.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::{PublishOutcome, Publisher};
use blaze_domain::{DropReason, Priority};

use super::core::{Admitted, LaneLink};
use super::measure::RateMeter;
use super::path::{BridgeState, Phase, Sink, TopicId};
use super::stats::BridgeStats;
use crate::limit::bucket::TokenBucket;
use crate::link::{StreamKey, Submit};
use crate::plan::{Bridge, Target};

impl BridgeState {
    pub(super) fn new(now: Instant, planned: &Bridge, sink: Sink) -> Self {
        Self {
            from: planned.from,
            target: planned.to.clone(),
            lane: planned.lane.clone(),
            phase: Phase::Up { since: now },
            bucket: planned.lane.max_rate_hz.map(|rate| TokenBucket::new(rate, now)),
            sink,
            stats: BridgeStats::default(),
            out_rate: RateMeter::new(now),
        }
    }

    pub(super) fn renew(
        &mut self,
        now: Instant,
        planned: &Bridge,
        publisher: &mut impl FnMut(&Target) -> Option<Arc<dyn Publisher>>,
    ) {
        if !matches!(self.phase, Phase::Up { .. }) {
            self.phase = Phase::Up { since: now };
        }
        if let Sink::Publish { publisher: current, .. } = &mut self.sink
            && let Some(publisher) = publisher(&planned.to)
        {
            *current = publisher;
        }
        match (planned.lane.max_rate_hz, &mut self.bucket) {
            (Some(rate), Some(bucket)) => bucket.set_rate(rate, now),
            (Some(rate), bucket) => *bucket = Some(TokenBucket::new(rate, now)),
            (None, bucket) => *bucket = None,
        }
        self.lane = planned.lane.clone();
    }

    /// Whether the message is meant for this bridge at all; what is not is not counted as taken.
    pub(super) fn wants(&self, message: &Admitted) -> bool {
        let frame = &message.frame;
        // What a flow wrote stays in the layer: only what was born here leaves for another one.
        if matches!(self.target, Target::Inter { .. }) && !message.born_here {
            return false;
        }
        self.lane
            .carries(frame.origin_layer(), frame.origin_node(), frame.origin_service())
    }

    pub(super) fn pass(
        &mut self,
        now: Instant,
        topic: TopicId,
        message: &Admitted,
        large: bool,
        link: &mut dyn LaneLink,
    ) {
        let frame = &message.frame;
        let bytes = frame.payload().len() as u64;
        self.stats.taken.add(bytes);
        let lifespan_ms = match (frame.lifespan_ms(), self.lane.lifespan_ms) {
            (0, other) | (other, 0) => other,
            (one, other) => one.min(other),
        };
        if lifespan_ms > 0 && message.age_us > u64::from(lifespan_ms) * 1000 {
            self.stats.dropped.add(DropReason::Lifespan, 1);
            return;
        }
        if self.bucket.as_mut().is_some_and(|bucket| !bucket.admit(now)) {
            self.stats.dropped.add(DropReason::MaxRate, 1);
            return;
        }
        match &mut self.sink {
            Sink::Publish { publisher, bare } => {
                let deadline = (lifespan_ms > 0)
                    .then(|| now + Duration::from_millis(lifespan_ms.into()) - Duration::from_micros(message.age_us));
                let outcome = if *bare {
                    publisher.publish_bare(frame.payload(), deadline)
                } else {
                    publisher.publish(&frame.clone().with_hops_and_age(frame.hops() + 1, message.age_us), deadline)
                };
                match outcome {
                    PublishOutcome::Taken => {
                        self.stats.out.add(bytes);
                        self.stats.latency.record(message.here_us);
                        self.out_rate.add(now, bytes);
                    }
                    PublishOutcome::Dropped => self.stats.dropped.add(DropReason::BrokerError, 1),
                    PublishOutcome::TooLarge => self.stats.dropped.add(DropReason::TooLarge, 1),
                }
            }
            Sink::Lane { lane, class } => {
                let wanted = if large {
                    Priority::Bulk
                } else {
                    self.lane.priority.unwrap_or(Priority::State)
                };
                // A small message of the new class must not overtake a large one of the old.
                if wanted != *class && link.queued(*lane) == 0 {
                    *class = wanted;
                }
                let Target::Inter { receiver, .. } = &self.target else {
                    return;
                };
                let submit = Submit {
                    to: receiver,
                    class: *class,
                    lane: *lane,
                    stream: StreamKey {
                        topic: topic.0,
                        writer: frame.writer(),
                    },
                    frame: frame.clone().with_hops_and_age(frame.hops(), message.age_us),
                    arrived: now,
                    reliable: self.lane.reliable,
                    lifespan: (lifespan_ms > 0).then(|| Duration::from_millis(lifespan_ms.into())),
                    keep_newest: if *class == Priority::Bulk && !self.lane.reliable {
                        self.lane.depth.max(1) as usize
                    } else {
                        0
                    },
                };
                if let Err(reason) = link.submit(now, submit) {
                    self.stats.dropped.add(reason, 1);
                }
            }
        }
    }
}
