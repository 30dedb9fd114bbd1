//! Rates and latencies of the message path: fixed memory, no allocation per message.

use std::time::{Duration, Instant};

const SLOTS: usize = 6;
/// Whole seconds of a mean.
const WINDOW_S: u64 = SLOTS as u64 - 1;
/// The same, for whoever reckons with single messages.
pub const WINDOW: Duration = Duration::from_secs(WINDOW_S);

/// Messages and bytes per second, as the mean of the last five whole seconds.
#[derive(Debug, Clone)]
pub struct RateMeter {
    start: Instant,
    /// Messages and bytes of one second each; the slot of second `n` is `n % SLOTS`.
    slots: [(u64, u64); SLOTS],
    second: u64,
    begun: u64,
}

impl RateMeter {
    /// A meter that has seen nothing.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self { start: now, slots: [(0, 0); SLOTS], second: 0, begun: 0 }
    }

    /// Counts one message.
    pub fn add(&mut self, now: Instant, bytes: u64) {
        self.turn(now);
        let slot = &mut self.slots[(self.second % SLOTS as u64) as usize];
        slot.0 += 1;
        slot.1 += bytes;
    }

    /// Messages and bytes per second over the last five whole seconds, or over the time since the
    /// first second.
    pub fn rate(&mut self, now: Instant) -> (f64, f64) {
        self.turn(now);
        let current = (self.second % SLOTS as u64) as usize;
        let whole = (self.second - self.begun).min(WINDOW_S);
        if whole == 0 {
            let elapsed =
                now.saturating_duration_since(self.start).as_secs_f64() - self.second as f64;
            let (messages, bytes) = self.slots[current];
            return (messages as f64 / elapsed.max(0.1), bytes as f64 / elapsed.max(0.1));
        }
        let others = self.slots.iter().enumerate().filter(|(index, _)| *index != current);
        let (messages, bytes) =
            others.fold((0, 0), |sum, (_, slot)| (sum.0 + slot.0, sum.1 + slot.1));
        (messages as f64 / whole as f64, bytes as f64 / whole as f64)
    }

    /// Messages per second over the last [`WINDOW`]; `None` while it was not counted for so long,
    /// as after a silence.
    pub fn of_window(&mut self, now: Instant) -> Option<f64> {
        let hz = self.rate(now).0;
        (self.second - self.begun >= WINDOW_S).then_some(hz)
    }

    fn turn(&mut self, now: Instant) {
        let second = now.saturating_duration_since(self.start).as_secs();
        if second <= self.second {
            return;
        }
        if second - self.second >= SLOTS as u64 {
            self.slots = [(0, 0); SLOTS];
            // After a silence the mean begins anew, so that a topic that starts again shows its
            // rate at once.
            self.begun = second;
        } else {
            for passed in self.second + 1..=second {
                self.slots[(passed % SLOTS as u64) as usize] = (0, 0);
            }
        }
        self.second = second;
    }
}

const SUB_BUCKETS: usize = 8;
const BUCKETS: usize = 28 * SUB_BUCKETS;

/// Latencies from 1 µs to 268 s in buckets of at most 12.5 % width.
#[derive(Debug, Clone)]
pub struct LatencyHistogram {
    counts: Box<[u64; BUCKETS]>,
    count: u64,
    sum_us: u64,
}

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self { counts: Box::new([0; BUCKETS]), count: 0, sum_us: 0 }
    }
}

impl LatencyHistogram {
    /// Counts one latency in microseconds.
    pub fn record(&mut self, us: u64) {
        self.counts[Self::bucket(us)] += 1;
        self.count += 1;
        self.sum_us = self.sum_us.saturating_add(us);
    }

    /// Counts what another one has counted.
    pub fn merge(&mut self, other: &Self) {
        for (count, more) in self.counts.iter_mut().zip(other.counts.iter()) {
            *count += more;
        }
        self.count += other.count;
        self.sum_us = self.sum_us.saturating_add(other.sum_us);
    }

    /// How many were counted.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Their sum in microseconds.
    #[must_use]
    pub fn sum_us(&self) -> u64 {
        self.sum_us
    }

    /// The latency that a part (0 to 1) of them does not exceed, in milliseconds; `None` when
    /// nothing was counted.
    #[must_use]
    pub fn quantile_ms(&self, part: f64) -> Option<f64> {
        if self.count == 0 {
            return None;
        }
        let wanted = ((self.count as f64 * part).ceil() as u64).max(1);
        let mut below = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            below += count;
            if below >= wanted {
                return Some(Self::upper_us(bucket) as f64 / 1000.0);
            }
        }
        None
    }

    /// How many do not exceed a latency in microseconds (to the resolution of the buckets).
    #[must_use]
    pub fn count_up_to_us(&self, us: u64) -> u64 {
        self.counts[..=Self::bucket(us)].iter().sum()
    }

    fn bucket(us: u64) -> usize {
        if us < SUB_BUCKETS as u64 {
            return us as usize;
        }
        let power = 63 - us.leading_zeros() as usize; // at least 3
        let within = ((us >> (power - 3)) & 7) as usize;
        ((power - 2) * SUB_BUCKETS + within).min(BUCKETS - 1)
    }

    fn upper_us(bucket: usize) -> u64 {
        if bucket < SUB_BUCKETS {
            return bucket as u64;
        }
        let power = bucket / SUB_BUCKETS + 2;
        let within = (bucket % SUB_BUCKETS) as u64;
        ((8 + within + 1) << (power - 3)) - 1
    }
}

/// Microseconds of a duration, saturating.
#[must_use]
pub fn micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_steady_rate_is_measured() {
        let start = Instant::now();
        let mut meter = RateMeter::new(start);
        for n in 0..500u32 {
            meter.add(start + Duration::from_millis(20) * n, 100);
        }
        let (rate, bytes) = meter.rate(start + Duration::from_secs(10));
        assert!((rate - 50.0).abs() < 0.1 && (bytes - 5000.0).abs() < 10.0, "{rate} {bytes}");
        assert!(meter.rate(start + Duration::from_secs(60)).0.abs() < f64::EPSILON);
    }

    #[test]
    fn a_window_that_is_not_whole_tells_nothing() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut meter = RateMeter::new(start);
        for n in 0..10u64 {
            meter.add(at(n * 500), 1);
            assert_eq!(meter.of_window(at(n * 500)), None);
        }
        assert_eq!(meter.of_window(at(5_000)), Some(2.0));
        // A silence, after which the mean begins anew.
        meter.add(at(20_000), 1);
        assert_eq!(meter.of_window(at(24_900)), None);
        assert_eq!(meter.of_window(at(25_000)), Some(0.2));
    }

    #[test]
    fn histograms_add_up() {
        let (mut all, mut one, mut other) =
            (LatencyHistogram::default(), LatencyHistogram::default(), LatencyHistogram::default());
        for us in 0..1_000 {
            all.record(us);
            let part = if us % 3 == 0 { &mut one } else { &mut other };
            part.record(us);
        }
        one.merge(&other);
        assert_eq!((one.count(), one.sum_us()), (all.count(), all.sum_us()));
        assert_eq!(one.quantile_ms(0.5), all.quantile_ms(0.5));
    }

    proptest! {
        #[test]
        fn a_quantile_is_right_within_an_eighth(us in 0u64..200_000_000) {
            let mut histogram = LatencyHistogram::default();
            histogram.record(us);
            let got = histogram.quantile_ms(0.5).unwrap() * 1000.0;
            prop_assert!(got >= us as f64 && got <= us as f64 * 1.126 + 1.0, "{} for {}", got, us);
            prop_assert_eq!(histogram.count_up_to_us(us), 1);
        }
    }

    #[test]
    fn absurd_latencies_fall_into_the_last_bucket() {
        let mut histogram = LatencyHistogram::default();
        histogram.record(u64::MAX);
        assert_eq!(histogram.count(), 1);
        assert!(histogram.quantile_ms(1.0).unwrap() > 200_000.0);
    }
}
