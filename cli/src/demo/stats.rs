//! What a subscription received: lost, duplicated, reordered, rates and latency.
//!
//! No clock in here: times are given.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use blaze_flow::lane::measure::{LatencyHistogram, micros};

/// Gaps that are remembered per writer; the oldest are settled as lost.
const MAX_GAPS: usize = 4_096;
/// Writers that are followed per subscription; messages of further ones are counted without their sequence.
const MAX_WRITERS: usize = 1_024;

/// One message as a consumer saw it.
#[derive(Debug, Clone, Copy)]
pub struct Arrival {
    /// Its publisher.
    pub writer: WriterId,
    /// Its number, per publisher.
    pub sequence: u64,
    /// The origin's clock, nanoseconds since 1970.
    pub publish_time_ns: u64,
    /// From publication to the consumer.
    pub latency: Duration,
    /// Bytes of the payload.
    pub bytes: usize,
}

/// Which numbers of one writer have come.
#[derive(Debug, Clone, Default)]
pub struct SequenceTracker {
    /// Ranges that have come, first → last, none adjacent.
    ranges: BTreeMap<u64, u64>,
    duplicated: u64,
    reordered: u64,
    /// All below it is settled: what is missing there is lost.
    floor: u64,
    /// Missing numbers below the first range that is still kept.
    settled_lost: u64,
}

impl SequenceTracker {
    /// Notes one number.
    pub fn add(&mut self, sequence: u64) {
        if sequence < self.floor {
            // Whether it came before is not known any more. It is late for certain.
            self.reordered += 1;
            return;
        }
        let before = self
            .ranges
            .range(..=sequence)
            .next_back()
            .map(|(first, last)| (*first, *last));
        if before.is_some_and(|(_, last)| sequence <= last) {
            self.duplicated += 1;
            return;
        }
        let after = self
            .ranges
            .range(sequence..)
            .next()
            .map(|(first, last)| (*first, *last));
        if after.is_some() {
            self.reordered += 1;
        }
        self.insert(sequence, before, after);
        self.settle();
    }

    fn insert(&mut self, sequence: u64, before: Option<(u64, u64)>, after: Option<(u64, u64)>) {
        let mut first = sequence;
        let mut last = sequence;
        if let Some((start, _)) = before.filter(|(_, end)| end.checked_add(1) == Some(sequence)) {
            first = start;
        }
        if let Some((start, end)) = after.filter(|(start, _)| sequence.checked_add(1) == Some(*start)) {
            self.ranges.remove(&start);
            last = end;
        }
        self.ranges.insert(first, last);
    }

    fn settle(&mut self) {
        if self.ranges.len() <= MAX_GAPS + 1 {
            return;
        }
        if let (Some((_, last)), Some(entry)) = (self.ranges.pop_first(), self.ranges.first_entry()) {
            self.settled_lost += entry.key() - last - 1;
            self.floor = *entry.key();
        }
    }

    /// Numbers that are missing between the smallest and the largest that came.
    #[must_use]
    pub fn lost(&self) -> u64 {
        let gaps = self.ranges.iter().zip(self.ranges.iter().skip(1));
        self.settled_lost + gaps.map(|((_, last), (next, _))| next - last - 1).sum::<u64>()
    }

    /// Numbers that came again.
    #[must_use]
    pub fn duplicated(&self) -> u64 {
        self.duplicated
    }

    /// Numbers that came after a larger one, without repeats.
    #[must_use]
    pub fn reordered(&self) -> u64 {
        self.reordered
    }
}

/// Counters of one subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Messages, repeats included.
    pub received: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Missing between the first and the last of each writer.
    pub lost: u64,
    /// Came again.
    pub duplicated: u64,
    /// Came after a later one.
    pub reordered: u64,
}

/// What a subscription received over some time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Period {
    /// Its length in seconds.
    pub seconds: f64,
    /// What was counted. A late message that fills a gap of an earlier period lowers no earlier count.
    pub counters: Counters,
    /// Median latency in milliseconds.
    pub p50_ms: Option<f64>,
    /// 99 % of the messages were at least as fast, in milliseconds.
    pub p99_ms: Option<f64>,
}

/// One subscription: everything since its start, and since the last look.
#[derive(Debug)]
pub struct SubscriptionStats {
    started: Instant,
    writers: HashMap<WriterId, SequenceTracker>,
    received: u64,
    bytes: u64,
    all: LatencyHistogram,
    recent: LatencyHistogram,
    looked: Instant,
    before: Counters,
    /// When the first message came, and its publication.
    pub first: Option<(Instant, u64)>,
    /// When the last message came, and its publication.
    pub last: Option<(Instant, u64)>,
}

impl SubscriptionStats {
    /// Counts from now on.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self {
            started: now,
            writers: HashMap::new(),
            received: 0,
            bytes: 0,
            all: LatencyHistogram::default(),
            recent: LatencyHistogram::default(),
            looked: now,
            before: Counters::default(),
            first: None,
            last: None,
        }
    }

    /// Notes one message.
    pub fn add(&mut self, arrival: &Arrival, now: Instant) {
        self.received += 1;
        self.bytes += arrival.bytes as u64;
        let latency_us = micros(arrival.latency);
        self.all.record(latency_us);
        self.recent.record(latency_us);
        self.first.get_or_insert((now, arrival.publish_time_ns));
        self.last = Some((now, arrival.publish_time_ns));
        if self.writers.len() < MAX_WRITERS || self.writers.contains_key(&arrival.writer) {
            self.writers.entry(arrival.writer).or_default().add(arrival.sequence);
        }
    }

    /// Everything since the start.
    #[must_use]
    pub fn counters(&self) -> Counters {
        let sum = |part: fn(&SequenceTracker) -> u64| self.writers.values().map(part).sum();
        Counters {
            received: self.received,
            bytes: self.bytes,
            lost: sum(SequenceTracker::lost),
            duplicated: sum(SequenceTracker::duplicated),
            reordered: sum(SequenceTracker::reordered),
        }
    }

    /// The whole time from the start, or from the first message if that is later, to `end`.
    #[must_use]
    pub fn total(&self, end: Instant) -> Period {
        let from = self.first.map_or(self.started, |(at, _)| at);
        Period {
            seconds: end.saturating_duration_since(from).as_secs_f64(),
            counters: self.counters(),
            p50_ms: self.all.quantile_ms(0.5),
            p99_ms: self.all.quantile_ms(0.99),
        }
    }

    /// What came since the last call of this function.
    pub fn take_recent(&mut self, now: Instant) -> Period {
        let counters = self.counters();
        let before = std::mem::replace(&mut self.before, counters);
        let period = Period {
            seconds: now.saturating_duration_since(self.looked).as_secs_f64(),
            counters: Counters {
                received: counters.received - before.received,
                bytes: counters.bytes - before.bytes,
                lost: counters.lost.saturating_sub(before.lost),
                duplicated: counters.duplicated - before.duplicated,
                reordered: counters.reordered - before.reordered,
            },
            p50_ms: self.recent.quantile_ms(0.5),
            p99_ms: self.recent.quantile_ms(0.99),
        };
        self.looked = now;
        self.recent = LatencyHistogram::default();
        period
    }
}

#[cfg(test)]
#[path = "stats_tests.rs"]
mod tests;
