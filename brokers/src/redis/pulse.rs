//! Whether a server answers, and how long to wait before it is tried again. Nothing here reads a clock.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Time between two looks.
pub(super) const LOOK: Duration = Duration::from_millis(250);
/// An idle connection is asked after this time without a sign of life.
const ASK_AFTER: Duration = Duration::from_secs(1);
/// Without an answer for this long the server is silent.
const SILENCE: Duration = Duration::from_secs(1);
/// The same for connections of large messages: one message of 16 MiB takes 1.3 s at 100 Mbit/s.
const SILENCE_LARGE: Duration = Duration::from_secs(3);
/// Bytes per second that a server takes at least; what was handed over may take its time.
const SLOWEST: u64 = 10_000_000;

/// When something was last heard on a connection; told by several tasks.
#[derive(Debug)]
pub(super) struct Heard {
    base: Instant,
    last_ms: AtomicU64,
}

impl Heard {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            base: now,
            last_ms: AtomicU64::new(0),
        }
    }

    pub(super) fn note(&self, now: Instant) {
        let ms = u64::try_from(now.saturating_duration_since(self.base).as_millis()).unwrap_or(u64::MAX);
        self.last_ms.fetch_max(ms, Ordering::Relaxed);
    }

    pub(super) fn last(&self) -> Instant {
        self.base + Duration::from_millis(self.last_ms.load(Ordering::Relaxed))
    }
}

/// What a look at a connection gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    /// It answers, or there is nothing to answer.
    Fine,
    /// Nothing was heard for long, and nothing was asked: ask.
    Ask,
    /// It was asked and does not answer.
    Silent,
}

/// Watches one connection.
#[derive(Debug)]
pub(super) struct Pulse {
    waiting_since: Option<Instant>,
    last_look: Instant,
    silence: Duration,
}

impl Pulse {
    pub(super) fn new(large: bool, now: Instant) -> Self {
        Self {
            waiting_since: None,
            last_look: now,
            silence: if large { SILENCE_LARGE } else { SILENCE },
        }
    }

    /// Tells whether answers are due.
    pub(super) fn expect(&mut self, waiting: bool, now: Instant) {
        match (waiting, self.waiting_since) {
            (true, None) => self.waiting_since = Some(now),
            (false, Some(_)) => self.waiting_since = None,
            _ => {}
        }
    }

    /// Looks, once per [`LOOK`]. `bytes` were handed over and are not answered.
    pub(super) fn look(&mut self, now: Instant, heard: Instant, bytes: usize) -> Look {
        // Where this process stood still, answers may lie unread.
        let stalled = now.saturating_duration_since(self.last_look) > 3 * LOOK;
        self.last_look = now;
        match self.waiting_since {
            None if now.saturating_duration_since(heard) >= ASK_AFTER => Look::Ask,
            Some(since) if !stalled => {
                let allowance = self.silence + Duration::from_millis(bytes as u64 * 1000 / SLOWEST);
                if now.saturating_duration_since(since.max(heard)) >= allowance {
                    Look::Silent
                } else {
                    Look::Fine
                }
            }
            _ => Look::Fine,
        }
    }
}

/// Pauses between attempts to connect: 50 ms, doubling to 500 ms, of which a random part is left out.
#[derive(Debug, Default)]
pub(super) struct Backoff {
    attempts: u32,
}

impl Backoff {
    /// The next pause; `random` is in [0, 1).
    pub(super) fn next(&mut self, random: f64) -> Duration {
        const FIRST_MS: u64 = 50;
        const LONGEST_MS: u64 = 500;
        let ms = (FIRST_MS << self.attempts.min(8)).min(LONGEST_MS);
        self.attempts = self.attempts.saturating_add(1);
        Duration::from_millis(ms).mul_f64(1.0 - 0.5 * random.clamp(0.0, 1.0))
    }

    /// The connection held.
    pub(super) fn reset(&mut self) {
        self.attempts = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn an_idle_connection_is_asked_and_silence_is_noticed() {
        let start = Instant::now();
        let mut pulse = Pulse::new(false, start);
        assert_eq!(pulse.look(start + 500 * MS, start, 0), Look::Fine);
        assert_eq!(pulse.look(start + 1000 * MS, start, 0), Look::Ask);
        pulse.expect(true, start + 1000 * MS);
        assert_eq!(pulse.look(start + 1500 * MS, start, 0), Look::Fine);
        assert_eq!(pulse.look(start + 2000 * MS, start, 0), Look::Silent);
        assert_eq!(
            pulse.look(start + 2100 * MS, start + 1900 * MS, 0),
            Look::Fine,
            "something was heard"
        );
        pulse.expect(false, start + 2200 * MS);
        assert_eq!(pulse.look(start + 2200 * MS, start + 2200 * MS, 0), Look::Fine);
    }

    #[test]
    fn what_was_handed_over_may_take_its_time() {
        let start = Instant::now();
        let mut pulse = Pulse::new(false, start);
        pulse.expect(true, start);
        for (after, expected) in [(700, Look::Fine), (1400, Look::Fine), (2100, Look::Silent)] {
            assert_eq!(
                pulse.look(start + after * MS, start, 10_000_000),
                expected,
                "{after} ms"
            );
        }
    }

    #[test]
    fn a_process_that_stood_still_judges_nobody() {
        let start = Instant::now();
        let mut pulse = Pulse::new(false, start);
        pulse.expect(true, start);
        assert_eq!(pulse.look(start + 10_000 * MS, start, 0), Look::Fine);
        assert_eq!(pulse.look(start + 10_250 * MS, start, 0), Look::Silent);
    }

    #[test]
    fn pauses_grow_to_half_a_second() {
        let mut backoff = Backoff::default();
        let pauses: Vec<_> = (0..6).map(|_| backoff.next(0.0)).collect();
        assert_eq!(pauses, [50 * MS, 100 * MS, 200 * MS, 400 * MS, 500 * MS, 500 * MS]);
        assert_eq!(backoff.next(1.0), 250 * MS);
        backoff.reset();
        assert_eq!(backoff.next(0.0), 50 * MS);
    }
}
