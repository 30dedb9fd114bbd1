//! What a path does to datagrams: how long it takes, and what it loses.
//!
//! - Delay of the empty path: the least round trip of the last 30 to 60 s, as the base delay of
//!   LEDBAT (RFC 6817, 4.2).
//! - A delay counts when each round trip of a while exceeds that by 25 ms, or by five times the
//!   jitter (smoothed as in RFC 3550, 6.4.1). It must last, as the overuse of draft-ietf-rmcat-gcc:
//!   a pause of the receiver ends before.
//! - Loss counts less than delay: radio loses without being full, and to send less does not help
//!   it. A bottleneck with a queue of more than 25 ms shows a delay before it loses.

use std::time::{Duration, Instant};

/// What every sample must exceed to count as a queue, at least and at most.
const LEAST_TOLERANCE: Duration = Duration::from_millis(25);
const MOST_TOLERANCE: Duration = Duration::from_millis(150);
/// How long and in how many samples it must do so.
const LASTING: Duration = Duration::from_millis(120);
const LASTING_SAMPLES: u32 = 4;
/// A larger change from one sample to the next is a pause, and counts as jitter with no more than
/// this.
const LARGEST_CHANGE: Duration = Duration::from_millis(35);
/// Over what time it is measured what comes out of the queue, later on.
const BLOCK: Duration = Duration::from_millis(300);
/// Samples nearer to one another count once: after a pause of the sender's many come at a time.
const TOGETHER: Duration = Duration::from_millis(20);
/// Samples further apart do not belong together.
const APART: Duration = Duration::from_secs(1);
/// A least round trip counts for this long, and as long again.
const BASE_HOLDS: Duration = Duration::from_secs(30);
/// Loss is judged over this time, and over so many datagrams.
const LOSS_WINDOW: Duration = Duration::from_secs(1);
const LOSS_DATAGRAMS: f64 = 400.0;

/// Round trips of a path, and how much of the newest is queueing.
#[derive(Debug, Clone, Default)]
pub(super) struct Delay {
    pub(super) newest: Duration,
    pub(super) queue: Duration,
    jitter: Duration,
    /// Least of the current and of the previous period, and when the current one began.
    base: Option<(Instant, Duration, Duration)>,
    run: Option<Run>,
}

impl Delay {
    /// Takes the bytes that were delivered.
    pub(super) fn delivered(&mut self, bytes: f64) {
        if let Some(run) = &mut self.run {
            run.delivered += bytes;
        }
    }

    /// Takes the round trip of a datagram.
    pub(super) fn take(&mut self, now: Instant, round_trip: Duration) {
        let (since, current, previous) = match self.base {
            None => (now, round_trip, round_trip),
            Some((since, current, _)) if now.saturating_duration_since(since) > BASE_HOLDS => {
                (now, round_trip, current)
            }
            Some((since, current, previous)) => (since, current.min(round_trip), previous),
        };
        let change = round_trip.abs_diff(self.newest).min(LARGEST_CHANGE);
        if self.base.is_some() {
            self.jitter = (self.jitter * 15 + change) / 16;
        }
        self.base = Some((since, current, previous));
        self.newest = round_trip;
        self.queue = round_trip.saturating_sub(current.min(previous));
        if self.queue <= self.tolerance() {
            self.run = None;
        } else if let Some(run) = self.run.as_mut().filter(|run| now - run.until <= APART) {
            run.add(now);
        } else {
            self.run = Some(Run {
                since: now,
                until: now,
                samples: 1,
                counted: now,
                delivered: 0.0,
                carried: None,
            });
        }
    }

    /// Whether the newest round trip has a queue in it.
    pub(super) fn is_queued(&self) -> bool {
        self.run.is_some()
    }

    /// What comes out of a queue that lasts, in bytes per second.
    pub(super) fn carried(&self) -> Option<f64> {
        self.run.as_ref().and_then(Run::bytes_per_s)
    }

    /// Begins to look for a queue anew.
    pub(super) fn restart(&mut self) {
        self.run = None;
    }

    pub(super) fn tolerance(&self) -> Duration {
        (self.jitter * 5).clamp(LEAST_TOLERANCE, MOST_TOLERANCE)
    }

    /// So much of what was taken for queueing is the path's own.
    pub(super) fn is_own(&mut self, now: Instant, queue: Duration) {
        let base = self.newest.saturating_sub(self.queue) + queue;
        self.base = Some((now, base, base));
        self.queue = self.newest.saturating_sub(base);
    }
}

/// Samples in a row that all have a queue before them.
#[derive(Debug, Clone)]
struct Run {
    /// Of the current block, as what follows.
    since: Instant,
    until: Instant,
    samples: u32,
    /// When a sample was counted last.
    counted: Instant,
    /// After its first sample.
    delivered: f64,
    /// Of the blocks before it.
    carried: Option<f64>,
}

impl Run {
    fn add(&mut self, now: Instant) {
        if now - self.counted >= TOGETHER {
            self.counted = now;
            self.samples += 1;
        }
        self.until = now;
        if now - self.since >= BLOCK {
            self.carried = self.bytes_per_s();
            (self.since, self.delivered, self.samples) = (now, 0.0, 1);
        }
    }

    fn bytes_per_s(&self) -> Option<f64> {
        let lasted = self.until - self.since;
        let tells = lasted >= LASTING && self.samples >= LASTING_SAMPLES;
        let newest = tells.then(|| self.delivered / lasted.as_secs_f64());
        match (newest, self.carried) {
            // What is much less is not the same rate measured again.
            (Some(newest), Some(before)) if newest > 0.8 * before => {
                Some(f64::midpoint(newest, before))
            }
            (newest, before) => newest.or(before),
        }
    }
}

/// Share of bytes that are lost.
#[derive(Debug, Clone)]
pub(super) struct Loss {
    since: Instant,
    delivered: f64,
    lost: f64,
    /// Of the window before, if it counts.
    pub(super) previous: Option<f64>,
    /// What is lost whether much is sent or little.
    pub(super) ordinary: f64,
}

/// A window.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lost {
    pub(super) share: f64,
    /// Lesser share of this one and the one before: a rate that changed in between would be
    /// mistaken.
    pub(super) lasting: f64,
    /// In bytes per second.
    pub(super) delivered: f64,
}

impl Loss {
    pub(super) fn new(now: Instant) -> Self {
        Self { since: now, delivered: 0.0, lost: 0.0, previous: None, ordinary: 0.0 }
    }

    /// Begins to count anew.
    pub(super) fn restart(&mut self, now: Instant) {
        self.begin(now);
        self.previous = None;
    }

    fn begin(&mut self, now: Instant) {
        (self.since, self.delivered, self.lost) = (now, 0.0, 0.0);
    }

    pub(super) fn add(&mut self, delivered: f64, lost: f64) {
        self.delivered += delivered;
        self.lost += lost;
    }

    /// The window, once there is enough in it to tell.
    pub(super) fn judge(&mut self, now: Instant, datagram_bytes: f64) -> Option<Lost> {
        let elapsed = now.saturating_duration_since(self.since);
        let total = self.delivered + self.lost;
        if elapsed < LOSS_WINDOW || total < (LOSS_DATAGRAMS * datagram_bytes).max(1.0) {
            return None;
        }
        let share = self.lost / total;
        let lost = Lost {
            share,
            lasting: self.previous.map_or(0.0, |previous| previous.min(share)),
            delivered: self.delivered / elapsed.as_secs_f64(),
        };
        self.previous = Some(share);
        self.begin(now);
        Some(lost)
    }
}
