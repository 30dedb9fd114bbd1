//! How old a record is, by the broker's clock, which may differ from ours.
//!
//! Two things tell of it: an own record was appended between its sending and its acknowledgement;
//! and a record that arrives was appended before. The first gives an estimate with half the round
//! trip as its error, of which the best of the last minute counts; the second a bound below, which
//! alone makes ages too small by the shortest delivery. Our own wall clock is never asked.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// How long an estimate counts, as clocks drift.
const WINDOW: Duration = Duration::from_secs(60);
/// Kafka's timestamps are whole milliseconds, rounded down: on average half of one is missing.
const HALF_TICK_US: i64 = 500;

struct Estimate {
    at: Instant,
    round_trip_us: i64,
    offset_us: i64,
}

/// The broker's clock as microseconds since 1970 minus those of our monotonic clock since `base`.
pub(super) struct BrokerClock {
    base: Instant,
    /// Each with a longer round trip than the one before: the first is the best.
    estimates: VecDeque<Estimate>,
    /// Largest bound below, of this window and of the one before.
    bounds: [Option<i64>; 2],
    bounds_since: Instant,
}

impl BrokerClock {
    /// Knows nothing yet.
    pub(super) fn new(now: Instant) -> Self {
        Self { base: now, estimates: VecDeque::new(), bounds: [None; 2], bounds_since: now }
    }

    fn micros(&self, at: Instant) -> i64 {
        let since = |a: Instant, b: Instant| {
            i64::try_from(a.saturating_duration_since(b).as_micros()).unwrap_or(i64::MAX)
        };
        since(at, self.base) - since(self.base, at)
    }

    fn stamp(append_ms: i64) -> i64 {
        append_ms.saturating_mul(1000).saturating_add(HALF_TICK_US)
    }

    /// An own record was handed over at `sent`, is acknowledged now, and was appended at
    /// `append_ms` of the broker's clock.
    pub(super) fn acknowledged(&mut self, sent: Instant, now: Instant, append_ms: i64) {
        let (from, to) = (self.micros(sent), self.micros(now));
        let round_trip_us = to.saturating_sub(from);
        let offset_us =
            Self::stamp(append_ms).saturating_sub(from.saturating_add(round_trip_us / 2));
        while self.estimates.back().is_some_and(|last| last.round_trip_us >= round_trip_us) {
            self.estimates.pop_back();
        }
        self.estimates.push_back(Estimate { at: now, round_trip_us, offset_us });
        while self.estimates.len() > 1
            && let Some(first) = self.estimates.front()
            && now.saturating_duration_since(first.at) > WINDOW
        {
            self.estimates.pop_front();
        }
    }

    /// Microseconds since a record was appended that arrives now.
    pub(super) fn age_us(&mut self, append_ms: i64, now: Instant) -> u64 {
        let now_us = self.micros(now);
        let stamp = Self::stamp(append_ms);
        self.note_bound(stamp.saturating_sub(now_us), now);
        let bound = self.bounds.iter().flatten().copied().max();
        let estimate = self.estimates.front().map(|estimate| estimate.offset_us);
        // The bound holds whatever the estimate says.
        let Some(offset) = bound.max(estimate) else { return 0 };
        u64::try_from(offset.saturating_add(now_us).saturating_sub(stamp)).unwrap_or(0)
    }

    fn note_bound(&mut self, bound: i64, now: Instant) {
        if now.saturating_duration_since(self.bounds_since) > WINDOW {
            self.bounds = [None, self.bounds[0]];
            self.bounds_since = now;
        }
        self.bounds[0] = self.bounds[0].max(Some(bound));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);
    /// Twelve years ahead of nothing.
    const BROKER_MS: i64 = 1_700_000_000_000;

    #[test]
    fn ages_are_right_though_the_clocks_differ() {
        let base = Instant::now();
        let mut clock = BrokerClock::new(base);
        // Appended 2 ms after it was sent, acknowledged after 4 ms.
        clock.acknowledged(base + 10 * MS, base + 14 * MS, BROKER_MS + 12);
        let age = clock.age_us(BROKER_MS + 100, base + 350 * MS);
        assert!((249_000..=251_000).contains(&age), "{age}");
        // A worse estimate changes nothing, a better one does.
        clock.acknowledged(base + 400 * MS, base + 900 * MS, BROKER_MS + 410);
        let age = clock.age_us(BROKER_MS + 1000, base + 1250 * MS);
        assert!((249_000..=251_000).contains(&age), "{age}");
        clock.acknowledged(base + 1300 * MS, base + 1301 * MS, BROKER_MS + 1290);
        let age = clock.age_us(BROKER_MS + 1400, base + 1660 * MS);
        assert!((249_000..=251_000).contains(&age), "{age}");
    }

    #[test]
    fn the_best_estimate_is_forgotten_after_a_minute_unless_it_is_the_only_one() {
        let base = Instant::now();
        let mut clock = BrokerClock::new(base);
        clock.acknowledged(base, base + MS, BROKER_MS);
        let later = base + Duration::from_secs(120);
        // The broker's clock was set back by 50 s meanwhile, as only the worse estimate knows.
        assert!(clock.age_us(BROKER_MS + 119_000, later) > 900_000);
        clock.acknowledged(later, later + 5 * MS, BROKER_MS + 70_002);
        let even_later = later + Duration::from_secs(130);
        clock.age_us(BROKER_MS, even_later);
        let age = clock.age_us(BROKER_MS + 199_000, even_later + Duration::from_secs(61));
        assert!((61_900_000..=62_100_000).contains(&age), "{age}");
    }

    #[test]
    fn without_own_records_the_freshest_record_is_the_measure() {
        let base = Instant::now();
        let mut clock = BrokerClock::new(base);
        assert_eq!(clock.age_us(BROKER_MS, base + 10 * MS), 0);
        assert_eq!(clock.age_us(BROKER_MS + 5, base + 35 * MS), 20_000);
        // Never negative.
        assert_eq!(clock.age_us(i64::MAX, base + 40 * MS), 0);
        assert!(clock.age_us(i64::MIN, base + 41 * MS) > 0);
    }
}
