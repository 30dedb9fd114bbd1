//! What a path does to datagrams: how long it takes, and what it loses.

use std::time::{Duration, Instant};

/// What every sample must exceed to count as a queue, at least and at most.
const LEAST_TOLERANCE: Duration = Duration::from_millis(25);
const MOST_TOLERANCE: Duration = Duration::from_millis(150);
/// How long and in how many samples it must do so.
const LASTING: Duration = Duration::from_millis(120);
const LASTING_SAMPLES: u32 = 4;
/// Samples further apart do not belong together.
const APART: Duration = Duration::from_secs(1);
/// A least round trip counts for this long, and as long again.
const BASE_HOLDS: Duration = Duration::from_secs(30);
/// Loss is judged over this time, and over so many datagrams.
const LOSS_WINDOW: Duration = Duration::from_secs(1);
const LOSS_DATAGRAMS: f64 = 200.0;

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
    /// Takes the round trip of a datagram, and the bytes that were delivered with it.
    pub(super) fn take(&mut self, now: Instant, round_trip: Duration, delivered: f64) {
        let (since, current, previous) = match self.base {
            None => (now, round_trip, round_trip),
            Some((since, current, _)) if now.saturating_duration_since(since) > BASE_HOLDS => (now, round_trip, current),
            Some((since, current, previous)) => (since, current.min(round_trip), previous),
        };
        // A pause is not jitter: it counts as twice what counts as a queue at least, at most.
        let change = round_trip.abs_diff(self.newest).min(LEAST_TOLERANCE * 2);
        if self.base.is_some() {
            self.jitter = (self.jitter * 15 + change) / 16;
        }
        self.base = Some((since, current, previous));
        self.newest = round_trip;
        self.queue = round_trip.saturating_sub(current.min(previous));
        if self.queue <= self.tolerance() {
            self.run = None;
        } else if let Some(run) = self.run.as_mut().filter(|run| now - run.until <= APART) {
            run.until = now;
            run.samples += 1;
            run.delivered += delivered;
        } else {
            self.run = Some(Run { since: now, until: now, samples: 1, delivered: 0.0 });
        }
    }

    /// Whether the newest round trip has a queue in it.
    pub(super) fn is_queued(&self) -> bool {
        self.run.is_some()
    }

    /// What came out of a queue that has lasted, in bytes per second.
    pub(super) fn carried(&self) -> Option<f64> {
        let run = self.run.as_ref()?;
        let lasted = run.until - run.since;
        (lasted >= LASTING && run.samples >= LASTING_SAMPLES).then(|| run.delivered / lasted.as_secs_f64())
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
    since: Instant,
    until: Instant,
    samples: u32,
    /// After the first.
    delivered: f64,
}

/// Share of bytes that are lost.
#[derive(Debug, Clone)]
pub(super) struct Loss {
    pub(super) since: Instant,
    pub(super) delivered: f64,
    pub(super) lost: f64,
    pub(super) newest: f64,
    /// What is lost whether much is sent or little.
    pub(super) ordinary: f64,
}

impl Loss {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            since: now,
            delivered: 0.0,
            lost: 0.0,
            newest: 0.0,
            ordinary: 0.0,
        }
    }

    pub(super) fn restart(&mut self, now: Instant) {
        (self.since, self.delivered, self.lost) = (now, 0.0, 0.0);
    }

    /// The share, and the bytes per second delivered, once there is enough to tell.
    pub(super) fn judge(&mut self, now: Instant, datagram_bytes: f64) -> Option<(f64, f64)> {
        let elapsed = now.saturating_duration_since(self.since);
        let total = self.delivered + self.lost;
        if elapsed < LOSS_WINDOW || total < (LOSS_DATAGRAMS * datagram_bytes).max(1.0) {
            return None;
        }
        self.newest = self.lost / total;
        let delivered = self.delivered / elapsed.as_secs_f64();
        self.restart(now);
        Some((self.newest, delivered))
    }
}

