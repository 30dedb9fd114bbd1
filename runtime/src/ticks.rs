//! Timers that fire together.

use std::sync::OnceLock;
use std::time::Duration;

use tokio::time::{Instant, Interval, MissedTickBehavior, interval_at};

/// Ticks at the multiples of a period since the first call in this process, so that periods of
/// which one is a multiple of the other fire together: a process that has little to do is woken
/// once for all of them. A tick that was missed is skipped.
///
/// # Panics
/// If the period is zero.
#[must_use]
pub fn ticks(period: Duration) -> Interval {
    static START: OnceLock<Instant> = OnceLock::new();
    let now = Instant::now();
    let start = *START.get_or_init(|| now);
    let past = now.saturating_duration_since(start).as_nanos() % period.as_nanos();
    let past = u64::try_from(past).unwrap_or(0);
    let mut ticks = interval_at(now + period - Duration::from_nanos(past), period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    ticks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn timers_that_begin_at_different_times_fire_together() {
        let at = ticks(Duration::from_millis(200)).tick().await;
        for late in [3, 13, 20] {
            tokio::time::advance(Duration::from_millis(late)).await;
            let between = ticks(Duration::from_millis(50)).tick().await - at;
            assert_eq!(between.as_nanos() % 50_000_000, 0, "{between:?}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_missed_tick_is_skipped_and_the_next_is_in_time() {
        let mut ticks = ticks(Duration::from_millis(50));
        let first = ticks.tick().await;
        tokio::time::advance(Duration::from_millis(120)).await;
        ticks.tick().await;
        assert_eq!(ticks.tick().await, first + Duration::from_millis(150));
    }
}
