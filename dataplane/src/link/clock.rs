//! Time on a link: the engine's clocks, round trips, the offset to a peer's clock, loss and rate.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use blaze_proto::link::link_control::Clock;

/// Round trip that is assumed before one was measured.
pub(crate) const ASSUMED_ROUND_TRIP: Duration = Duration::from_millis(100);
/// A measured round trip above this is a mistake.
const LONGEST_ROUND_TRIP: Duration = Duration::from_secs(30);
/// Exchanges that the clock offset is chosen from.
const KEPT_EXCHANGES: usize = 8;
/// How long a smallest round trip counts as the one of an empty queue.
const MINIMUM_HOLDS: Duration = Duration::from_secs(10);

/// The engine's monotonic clock (nanoseconds since its start) and wall clock (since 1970).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Clocks {
    start: Instant,
    wall_at_start: i128,
}

impl Clocks {
    pub(crate) fn new(now: Instant, wall_ns: u64) -> Self {
        Self { start: now, wall_at_start: i128::from(wall_ns) }
    }

    pub(crate) fn set_wall(&mut self, now: Instant, wall_ns: u64) {
        self.wall_at_start = i128::from(wall_ns) - i128::from(self.monotonic_ns(now));
    }

    /// 1 at the start, so that 0 can mean none.
    pub(crate) fn monotonic_ns(&self, now: Instant) -> u64 {
        nanoseconds(now.saturating_duration_since(self.start)).saturating_add(1)
    }

    pub(crate) fn wall_ns(&self, now: Instant) -> u64 {
        u64::try_from(self.wall_at_start + i128::from(self.monotonic_ns(now))).unwrap_or(0)
    }
}

pub(crate) fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// Round trip of a link, smoothed.
#[derive(Debug, Clone, Default)]
pub(crate) struct RoundTrip {
    smoothed: Option<Duration>,
    newest: Duration,
    /// Smallest of the current and of the previous period.
    minimum: Option<(Instant, Duration, Duration)>,
}

impl RoundTrip {
    /// Takes a measurement: the echoed send time and how long the peer held it, both in
    /// nanoseconds.
    pub(crate) fn echo(
        &mut self,
        now: Instant,
        now_ns: u64,
        sent_ns: u64,
        held_ns: u64,
    ) -> Option<Duration> {
        let elapsed = now_ns.checked_sub(sent_ns)?.checked_sub(held_ns)?;
        let sample = Duration::from_nanos(elapsed);
        if sent_ns == 0 || sample > LONGEST_ROUND_TRIP {
            return None;
        }
        self.newest = sample;
        self.smoothed = Some(match self.smoothed {
            None => sample,
            Some(smoothed) => (smoothed * 7 + sample) / 8,
        });
        self.minimum = Some(match self.minimum {
            None => (now, sample, sample),
            Some((since, current, _)) if now.saturating_duration_since(since) > MINIMUM_HOLDS => {
                (now, sample, current)
            }
            Some((since, current, previous)) => (since, current.min(sample), previous),
        });
        Some(sample)
    }

    /// Measured, if it was.
    pub(crate) fn measured(&self) -> Option<Duration> {
        self.smoothed
    }

    /// Measured, or assumed.
    pub(crate) fn get(&self) -> Duration {
        self.smoothed.unwrap_or(ASSUMED_ROUND_TRIP)
    }

    /// How much longer the newest round trip took than the shortest of late.
    pub(crate) fn queueing(&self) -> Duration {
        self.minimum.map_or(Duration::ZERO, |(_, current, previous)| {
            self.newest.saturating_sub(current.min(previous))
        })
    }
}

/// Offset of a peer's wall clock from ours: that of the shortest of the last exchanges.
#[derive(Debug, Clone, Default)]
pub(crate) struct ClockOffset {
    exchanges: VecDeque<(Duration, i64)>,
}

impl ClockOffset {
    /// Takes the four times of an exchange (RFC 5905, section 8) that took `round_trip`, as a Hello
    /// brings them.
    pub(crate) fn exchange(&mut self, clock: &Clock, wall_now_ns: u64, round_trip: Duration) {
        let [t1, t2, t3, t4] =
            [clock.echo_received_wall_ns, clock.echo_wall_ns, clock.sent_wall_ns, wall_now_ns]
                .map(i128::from);
        let Ok(offset) = i64::try_from(((t2 - t1) + (t3 - t4)) / 2) else {
            return;
        };
        if self.exchanges.len() >= KEPT_EXCHANGES {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back((round_trip, offset));
    }

    /// Peer's clock minus ours in nanoseconds, and how far it may be off.
    pub(crate) fn get(&self) -> Option<(i64, Duration)> {
        let best = self.exchanges.iter().min_by_key(|exchange| exchange.0)?;
        Some((best.1, best.0 / 2))
    }
}

/// Share of samples that were lost of late.
#[derive(Debug, Clone, Default)]
pub(crate) struct LossMeter {
    received: f64,
    lost: f64,
    at: Option<Instant>,
}

impl LossMeter {
    pub(crate) fn add(&mut self, now: Instant, received: u32, lost: u32) {
        // What is five seconds old counts a third.
        if let Some(at) = self.at {
            let kept = (-now.saturating_duration_since(at).as_secs_f64() / 5.0).exp();
            self.received *= kept;
            self.lost *= kept;
        }
        self.at = Some(now);
        self.received += f64::from(received);
        self.lost += f64::from(lost);
    }

    pub(crate) fn counts(&self) -> (f64, f64) {
        (self.received, self.lost)
    }
}

/// Bytes per second at which a peer receives, from its cumulative count.
#[derive(Debug, Clone, Default)]
pub(crate) struct RateMeter {
    mark: Option<(Instant, u64)>,
    bytes_per_s: f64,
}

impl RateMeter {
    pub(crate) fn total(&mut self, now: Instant, bytes: u64) {
        let Some((at, before)) = self.mark else {
            self.mark = Some((now, bytes));
            return;
        };
        let elapsed = now.saturating_duration_since(at);
        if elapsed < Duration::from_millis(200) || bytes < before {
            return;
        }
        #[allow(clippy::cast_precision_loss, reason = "a rate for people and the planner")]
        let newest = (bytes - before) as f64 / elapsed.as_secs_f64();
        let share = (elapsed.as_secs_f64() / 1.0).min(1.0);
        self.bytes_per_s += (newest - self.bytes_per_s) * share;
        self.mark = Some((now, bytes));
    }

    pub(crate) fn bytes_per_s(&self) -> f64 {
        self.bytes_per_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trips_smooth_and_show_queueing() {
        let now = Instant::now();
        let mut trip = RoundTrip::default();
        assert_eq!(trip.get(), ASSUMED_ROUND_TRIP);
        let ms = 1_000_000;
        trip.echo(now, 60 * ms, 5 * ms, 5 * ms);
        assert_eq!(trip.measured(), Some(Duration::from_millis(50)));
        trip.echo(now, 140 * ms, 5 * ms, 5 * ms);
        assert_eq!(trip.queueing(), Duration::from_millis(80));
        assert_eq!(trip.get(), Duration::from_millis(60));
        assert_eq!(trip.echo(now, 5, 10, 0), None, "an echo from the future");
        assert_eq!(trip.echo(now, u64::MAX, 10, 0), None, "a day");
    }
}
