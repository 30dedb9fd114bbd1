//! What a consumer received: rates and latency.
//!
//! No clock in here: times are given.

use std::time::{Duration, Instant};

use blaze_flow::lane::measure::{LatencyHistogram, micros};

/// One message as a consumer saw it.
#[derive(Debug, Clone, Copy)]
pub struct Arrival {
    /// The origin's clock, nanoseconds since 1970.
    pub publish_time_ns: u64,
    /// From publication to the consumer.
    pub latency: Duration,
    /// Bytes of the payload.
    pub bytes: usize,
}

/// What a consumer received over some time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Period {
    /// Its length in seconds.
    pub seconds: f64,
    /// Messages.
    pub received: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Median latency in milliseconds.
    pub p50_ms: Option<f64>,
    /// 99 % of the messages were at least as fast, in milliseconds.
    pub p99_ms: Option<f64>,
}

/// What came since some time.
#[derive(Debug)]
struct Tally {
    since: Instant,
    received: u64,
    bytes: u64,
    latency: LatencyHistogram,
}

impl Tally {
    fn new(since: Instant) -> Self {
        Self { since, received: 0, bytes: 0, latency: LatencyHistogram::default() }
    }

    fn add(&mut self, arrival: &Arrival) {
        self.received += 1;
        self.bytes += arrival.bytes as u64;
        self.latency.record(micros(arrival.latency));
    }

    fn until(&self, end: Instant) -> Period {
        Period {
            seconds: end.saturating_duration_since(self.since).as_secs_f64(),
            received: self.received,
            bytes: self.bytes,
            p50_ms: self.latency.quantile_ms(0.5),
            p99_ms: self.latency.quantile_ms(0.99),
        }
    }
}

/// One consumer: everything since its start, and since the last look.
#[derive(Debug)]
pub struct ConsumerStats {
    all: Tally,
    recent: Tally,
    /// When the first message came, and its publication.
    pub first: Option<(Instant, u64)>,
    /// When the last message came, and its publication.
    pub last: Option<(Instant, u64)>,
}

impl ConsumerStats {
    /// Counts from now on.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self { all: Tally::new(now), recent: Tally::new(now), first: None, last: None }
    }

    /// Notes one message.
    pub fn add(&mut self, arrival: &Arrival, now: Instant) {
        if self.first.is_none() {
            self.first = Some((now, arrival.publish_time_ns));
            self.all.since = now;
        }
        self.last = Some((now, arrival.publish_time_ns));
        self.all.add(arrival);
        self.recent.add(arrival);
    }

    /// Messages since the start.
    #[must_use]
    pub fn received(&self) -> u64 {
        self.all.received
    }

    /// The whole time from the start, or from the first message if that is later, to `end`.
    #[must_use]
    pub fn total(&self, end: Instant) -> Period {
        self.all.until(end)
    }

    /// What came since the last call of this function.
    pub fn take_recent(&mut self, now: Instant) -> Period {
        std::mem::replace(&mut self.recent, Tally::new(now)).until(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrival(sequence: u64, millis: u64) -> Arrival {
        Arrival {
            publish_time_ns: sequence * 1_000_000,
            latency: Duration::from_millis(millis),
            bytes: 100,
        }
    }

    #[test]
    fn periods_count_what_came_in_them() {
        let start = Instant::now();
        let second = |count| start + Duration::from_secs(count);
        let mut stats = ConsumerStats::new(start);
        for sequence in [1, 2, 4] {
            stats.add(&arrival(sequence, 1), second(1));
        }
        let first = stats.take_recent(second(1));
        assert_eq!((first.received, first.bytes, first.seconds), (3, 300, 1.0));
        for sequence in [3, 50] {
            stats.add(&arrival(sequence, 100), second(2));
        }
        let recent = stats.take_recent(second(3));
        assert_eq!((recent.received, recent.bytes, recent.seconds), (2, 200, 2.0));
        assert!((recent.p50_ms.unwrap() - 100.0).abs() < 12.5);
        let total = stats.total(second(5));
        assert_eq!((total.received, total.bytes, total.seconds), (5, 500, 4.0));
        assert_eq!(stats.first.unwrap().1, 1_000_000);
        assert_eq!(stats.last, Some((second(2), 50_000_000)));
    }
}
