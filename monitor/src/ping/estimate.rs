//! Offset of another node's clock from one round trip, with the error that it cannot exceed.
//!
//! Offsets are kept relative to the monotonic clock of this node and converted to its wall clock
//! when they are read. So a correction of the own wall clock spoils no sample.
//!
//! Why the true offset lies within the error: half the time on the way, `(R - hold)/2`, covers any
//! asymmetry of the two ways. While a sample is made and ages, for `R + age`, the clocks drift apart
//! by at most the stated ppm; `R` includes the hold.

use std::collections::VecDeque;
use std::time::Duration;

use serde::Serialize;

use super::limits::{CLOCK_SAMPLES, DRIFT_PPM, DRIFT_SYNCHRONIZED_PPM, STEP_NS};

/// The clocks of this node at one moment, read together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Now {
    /// Monotonic clock, since any start.
    pub monotonic: Duration,
    /// Wall clock, in nanoseconds since 1970.
    pub wall_ns: i64,
    /// Whether the wall clock is synchronised, as the kernel says.
    pub synchronized: bool,
}

impl Now {
    /// What the wall clock is ahead of the monotonic clock, in nanoseconds.
    pub(super) fn course_ns(self) -> i64 {
        self.wall_ns.saturating_sub(nanos(self.monotonic))
    }
}

/// Source of the offset to a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// Pings of this monitor.
    Ping,
    /// Exchanges of Hellos between the flow of this node and that of the other.
    Link,
    /// Two offsets in a row: to a third node, and from there to the other.
    Via,
}

/// What the clock of another node is ahead of the wall clock here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offset {
    /// Theirs minus ours, in seconds.
    pub offset_s: f64,
    /// The true offset is not farther away than this, in seconds.
    pub error_s: f64,
    /// Where it is from.
    pub source: Source,
}

/// Times of one round trip.
#[derive(Debug, Clone, Copy)]
pub(super) struct RoundTrip {
    /// Ping given to the client, by the monotonic clock.
    pub(super) sent: Duration,
    /// Answer read from the client, by the monotonic clock.
    pub(super) received: Duration,
    /// Wall clock of the other node, in nanoseconds: ping received, answer sent.
    pub(super) t2: i64,
    pub(super) t3: i64,
    pub(super) hold_ns: u64,
    /// Whether both clocks were synchronised.
    pub(super) synchronized: bool,
}

/// What one round trip says.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    received: Duration,
    /// Their wall clock minus our monotonic clock, in nanoseconds.
    ahead_ns: i64,
    /// `(R - hold)/2`, rounded up, in nanoseconds.
    latency_ns: i64,
    /// R, in nanoseconds.
    round_ns: i64,
    synchronized: bool,
}

impl Sample {
    /// `None` if it was on its way for a negative time, which no true figures give.
    pub(super) fn new(trip: RoundTrip) -> Option<Self> {
        let (sent, received) = (nanos(trip.sent), nanos(trip.received));
        let round_ns = received.checked_sub(sent)?;
        let way_ns =
            i64::try_from(trip.hold_ns).ok().and_then(|hold| round_ns.checked_sub(hold))?;
        if way_ns < 0 {
            return None;
        }
        let twice =
            i128::from(trip.t2) - i128::from(sent) + i128::from(trip.t3) - i128::from(received);
        Some(Self {
            received: trip.received,
            ahead_ns: clamped(twice / 2),
            latency_ns: way_ns / 2 + way_ns % 2,
            round_ns,
            synchronized: trip.synchronized,
        })
    }

    /// Time on one way, in seconds.
    pub(super) fn latency_s(&self) -> f64 {
        seconds(self.latency_ns)
    }

    pub(super) fn error_s(&self, now: Now) -> f64 {
        let age = now.monotonic.saturating_sub(self.received);
        let round = Duration::from_nanos(self.round_ns.unsigned_abs());
        let ppm = drift_ppm(self.synchronized && now.synchronized);
        // One nanosecond for what integers round off.
        seconds(self.latency_ns + 1) + drift_s(ppm, age.saturating_add(round))
    }

    pub(super) fn offset(&self, now: Now) -> Offset {
        let offset = i128::from(self.ahead_ns) - i128::from(now.course_ns());
        Offset {
            offset_s: seconds(clamped(offset)),
            error_s: self.error_s(now),
            source: Source::Ping,
        }
    }

    /// Whether a clock without a step can explain both samples.
    fn agrees(&self, other: &Self, now: Now) -> bool {
        let apart = (i128::from(self.ahead_ns) - i128::from(other.ahead_ns)).unsigned_abs();
        (apart as f64) * 1e-9 <= self.error_s(now) + other.error_s(now)
    }
}

/// The last samples of one clock.
#[derive(Debug, Default)]
pub(super) struct Clock {
    samples: VecDeque<Sample>,
}

impl Clock {
    /// Adds a sample. Older ones that contradict it were taken before a step that nobody announced.
    pub(super) fn add(&mut self, sample: Sample, now: Now) {
        self.samples.retain(|older| older.agrees(&sample, now));
        if self.samples.len() >= CLOCK_SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
    }

    /// Forgets all samples, after a step.
    pub(super) fn clear(&mut self) {
        self.samples.clear();
    }

    /// The offset of the sample with the least error now.
    pub(super) fn offset(&self, now: Now) -> Option<Offset> {
        let offsets = self.samples.iter().map(|sample| sample.offset(now));
        offsets.min_by(|a, b| a.error_s.total_cmp(&b.error_s))
    }
}

/// The wall clock of this node, watched for steps.
#[derive(Debug)]
pub(super) struct OwnClock {
    last: Now,
    /// Number of its present course: random at the start, one more after each step.
    pub(super) number: i64,
}

impl OwnClock {
    pub(super) fn new(now: Now, number: u32) -> Self {
        Self { last: now, number: i64::from(number) }
    }

    /// Whether the wall clock stepped since the last call. What it drifts or is slewed against the
    /// monotonic clock is no step.
    pub(super) fn steps(&mut self, now: Now) -> bool {
        let passed = now.monotonic.saturating_sub(self.last.monotonic);
        let allowed = STEP_NS.saturating_add(nanos(passed.mul_f64(DRIFT_PPM * 1e-6)));
        let moved = i128::from(now.course_ns()) - i128::from(self.last.course_ns());
        self.last = now;
        let stepped = moved.unsigned_abs() > u128::from(allowed.unsigned_abs());
        if stepped {
            self.number = self.number.wrapping_add(1);
        }
        stepped
    }
}

/// Drift that is assumed between two clocks, in parts per million.
pub(super) fn drift_ppm(synchronized: bool) -> f64 {
    if synchronized { DRIFT_SYNCHRONIZED_PPM } else { DRIFT_PPM }
}

/// What clocks drift apart in a time, in seconds.
pub(super) fn drift_s(ppm: f64, time: Duration) -> f64 {
    ppm * 1e-6 * time.as_secs_f64()
}

/// Nanoseconds of a duration; at most those of 292 years.
pub(super) fn nanos(time: Duration) -> i64 {
    i64::try_from(time.as_nanos()).unwrap_or(i64::MAX)
}

fn clamped(value: i128) -> i64 {
    i64::try_from(value).unwrap_or(if value < 0 { i64::MIN } else { i64::MAX })
}

fn seconds(nanos: i64) -> f64 {
    nanos as f64 * 1e-9
}
