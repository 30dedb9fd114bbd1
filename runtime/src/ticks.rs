//! Timers that fire together, so that a process that has little to do is woken seldom.
//!
//! tokio keeps timers in wheels, the first with slots of 1 ms, the second with slots of 64 ms: one
//! that ends amid a slot of the second wakes the process at the slot's beginning, and once more
//! when it is due. One that ends where a slot begins wakes it once.

use std::sync::OnceLock;
use std::time::Duration;

use tokio::time::{Instant, Interval, MissedTickBehavior, interval_at};

/// The periods of [`ticks`] are multiples of this.
pub const BEAT: Duration = Duration::from_millis(64);

static START: OnceLock<Instant> = OnceLock::new();

/// Counts from now on, if it does not yet: to be called before the runtime is built, which counts
/// its own milliseconds from then.
pub(crate) fn begin() {
    let _ = START.set(Instant::now());
}

/// Ticks at the multiples of a period since the start of the runtime: all of them together where
/// periods are multiples of [`BEAT`]. A tick that was missed is skipped.
///
/// # Panics
/// If the period is zero.
#[must_use]
pub fn ticks(period: Duration) -> Interval {
    let mut ticks = interval_at(next(Instant::now(), period), period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    ticks
}

/// Waits at least so long, and at most a [`BEAT`] longer, until the process wakes anyway.
pub async fn pause(least: Duration) {
    tokio::time::sleep_until(on_beat(Instant::now() + least)).await;
}

/// The [`BEAT`] after a time.
#[must_use]
pub fn on_beat(time: Instant) -> Instant {
    next(time, BEAT)
}

/// The first multiple of a period after a time.
fn next(time: Instant, period: Duration) -> Instant {
    let start = *START.get_or_init(Instant::now);
    let past = time.saturating_duration_since(start).as_nanos() % period.as_nanos();
    time + period - Duration::from_nanos(u64::try_from(past).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn timers_that_begin_at_different_times_fire_together() {
        let at = ticks(4 * BEAT).tick().await;
        for late in [3, 13, 20] {
            tokio::time::advance(Duration::from_millis(late)).await;
            let between = ticks(BEAT).tick().await - at;
            assert_eq!(between.as_nanos() % BEAT.as_nanos(), 0, "{between:?}");
            let begin = Instant::now();
            pause(Duration::from_millis(100)).await;
            assert_eq!((Instant::now() - at).as_nanos() % BEAT.as_nanos(), 0);
            assert!(begin.elapsed() >= Duration::from_millis(100), "{:?}", begin.elapsed());
            assert!(begin.elapsed() <= Duration::from_millis(100) + BEAT, "{:?}", begin.elapsed());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_missed_tick_is_skipped_and_the_next_is_in_time() {
        let mut ticks = ticks(BEAT);
        let first = ticks.tick().await;
        tokio::time::advance(2 * BEAT + BEAT / 2).await;
        ticks.tick().await;
        assert_eq!(ticks.tick().await, first + 3 * BEAT);
    }
}
