//! Whether a delay is that of a queue of ours: less is sent, and it is seen whether it goes.

use std::time::{Duration, Instant};

use super::path::Delay;

/// Sent of what is delivered, to see whether the delay goes.
pub(super) const DRAINING: f64 = 0.5;
/// Trials in a row that must gain nothing for a delay to be the path's own.
pub(super) const TRIALS: u32 = 2;
/// By how much a queue of ours shrinks in a trial, besides the tolerance.
const SHRINKS: Duration = Duration::from_millis(100);
/// By how much a delay must have become less.
const LESS: Duration = Duration::from_millis(60);
/// For how long it is looked at what the trial has brought.
const LOOK: Duration = Duration::from_millis(150);
/// After what time it is known what arrives of the lower rate.
const KNOWN: Duration = Duration::from_millis(250);

/// What is known of a delay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Nothing yet.
    Open,
    /// It is gone.
    Gone,
    /// It is on its way down.
    Less,
    /// Even the lower rate is more than arrives.
    Slower,
    /// It does not change.
    Stays,
}

/// A trial.
#[derive(Debug, Clone)]
pub(super) struct Drain {
    since: Instant,
    /// The rate to return to.
    pub(super) before: f64,
    /// What the bottleneck carries, if the delay is that of its queue.
    pub(super) carried: f64,
    /// Which one this is of those in a row without a gain, from 1.
    pub(super) trial: u32,
    /// How long it takes.
    takes: Duration,
    /// Longest delay of what was sent before.
    peak: Duration,
    /// Shortest of what was sent at the end.
    pub(super) least: Duration,
}

impl Drain {
    /// Begins; `shrinking` is by how many seconds per second a queue of ours becomes shorter.
    pub(super) fn new(now: Instant, delay: &Delay, before: f64, carried: f64, trial: u32, shrinking: f64) -> Self {
        Self {
            since: now,
            before,
            carried,
            trial,
            takes: (SHRINKS + delay.tolerance()).div_f64(shrinking.clamp(0.05, DRAINING)),
            peak: delay.queue,
            least: Duration::MAX,
        }
    }

    /// Looks at a new round trip; `sent` is how much is sent since the beginning, in bytes per second.
    pub(super) fn judge(&mut self, now: Instant, delay: &Delay, sent: f64) -> Verdict {
        // The longer the queue lasts, the better is known what comes out of it.
        self.carried = delay.carried().unwrap_or(self.carried);
        if delay.queue <= delay.tolerance() * 3 / 4 {
            return Verdict::Gone;
        }
        let elapsed = now.saturating_duration_since(self.since);
        if elapsed >= KNOWN && self.carried < 0.8 * sent {
            return Verdict::Slower;
        }
        // How long after the beginning the newest datagram was sent.
        let after = elapsed.saturating_sub(delay.newest);
        if after.is_zero() {
            self.peak = self.peak.max(delay.queue);
        } else if after >= self.takes {
            self.least = self.least.min(delay.queue);
        }
        if after < self.takes + LOOK {
            Verdict::Open
        } else if self.peak.saturating_sub(self.least) >= delay.tolerance().max(LESS) {
            Verdict::Less
        } else {
            Verdict::Stays
        }
    }
}
