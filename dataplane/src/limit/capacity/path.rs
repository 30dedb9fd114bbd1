/// Round trips of a path, and how much of the newest is queueing.
#[derive(Debug, Clone, Default)]
struct Delay {
    newest: Duration,
    queue: Duration,
    jitter: Duration,
    /// Least of the current and of the previous period, and when the current one began.
    base: Option<(Instant, Duration, Duration)>,
}

impl Delay {
    fn take(&mut self, now: Instant, round_trip: Duration) -> Duration {
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
        self.queue
    }

    fn tolerance(&self) -> Duration {
        (self.jitter * 5).clamp(LEAST_TOLERANCE, MOST_TOLERANCE)
    }

    /// So much of what was taken for queueing is the path's own.
    fn is_own(&mut self, now: Instant, queue: Duration) {
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

impl Run {
    fn new(now: Instant) -> Self {
        Self {
            since: now,
            until: now,
            samples: 1,
            delivered: 0.0,
        }
    }

    /// What came out of the queue in bytes per second, if it has lasted.
    fn bytes_per_s(&self) -> Option<f64> {
        let lasted = self.until - self.since;
        (lasted >= LASTING && self.samples >= LASTING_SAMPLES).then(|| self.delivered / lasted.as_secs_f64())
    }
}

/// Share of bytes that are lost.
#[derive(Debug, Clone)]
struct Loss {
    since: Instant,
    delivered: f64,
    lost: f64,
    newest: f64,
    /// What is lost whether much is sent or little.
    ordinary: f64,
}

impl Loss {
    fn new(now: Instant) -> Self {
        Self {
            since: now,
            delivered: 0.0,
            lost: 0.0,
            newest: 0.0,
            ordinary: 0.0,
        }
    }

    fn restart(&mut self, now: Instant) {
        (self.since, self.delivered, self.lost) = (now, 0.0, 0.0);
    }

    /// The share, and the bytes per second delivered, once that many bytes tell.
    fn judge(&mut self, now: Instant, bytes: f64) -> Option<(f64, f64)> {
        let elapsed = now.saturating_duration_since(self.since);
        let total = self.delivered + self.lost;
        if elapsed < LOSS_WINDOW || total < bytes.max(1.0) {
            return None;
        }
        self.newest = self.lost / total;
        let delivered = self.delivered / elapsed.as_secs_f64();
        self.restart(now);
        Some((self.newest, delivered))
    }
}

