//! Whether a delay or a loss is ours: less is sent, and it is seen whether it goes.
//!
//! It cannot be seen from its size: a route may have become longer, or the traffic of others may
//! stand in the way. Half of the delivered rate must shorten a queue of ours by half a second per
//! second. What stays, also at a quarter, is the path's own from then on, and has cost about a
//! second at these rates. It is what BBR does with ProbeRTT, but only when there is a reason. What
//! shrinks is ours, so that a standing queue of ours does not pass for the delay of the path.

use std::time::{Duration, Instant};

use super::path::{Delay, Lost};

/// Sent of what is delivered, to see whether the delay goes.
pub(super) const DRAINING: f64 = 0.5;
/// Sent of what is delivered, to see whether the loss goes.
pub(super) const SPARING: f64 = 0.85;
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

/// What a trial has shown of a delay or a loss.
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

/// What is being done.
#[derive(Debug, Clone)]
pub(super) enum Phase {
    /// The rate rises, or is at the limit.
    Rising,
    /// Half is sent until the delay is gone, or is seen to stay.
    Draining(Drain),
    /// Less is sent, to see whether less is lost.
    Sparing(Spare),
}

/// A trial whether a delay goes.
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
    pub(super) fn new(
        now: Instant,
        delay: &Delay,
        before: f64,
        carried: f64,
        trial: u32,
        shrinking: f64,
    ) -> Self {
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

    /// Looks at a new round trip; `sent` is how much is sent since the beginning, in bytes per
    /// second.
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

/// A trial whether a loss goes.
#[derive(Debug, Clone)]
pub(super) struct Spare {
    /// The rate to return to.
    pub(super) before: f64,
    /// What the bottleneck carries, if it is what loses.
    pub(super) carried: f64,
    share: f64,
    /// What was on the way at the beginning has been counted.
    settled: bool,
}

impl Spare {
    pub(super) fn new(before: f64, lost: Lost) -> Self {
        Self { before, carried: lost.delivered, share: lost.share, settled: false }
    }

    /// Looks at a new window; `ordinary` is the share that is lost anyway.
    pub(super) fn judge(&mut self, lost: Lost, ordinary: f64) -> Verdict {
        if !self.settled {
            self.settled = true;
            Verdict::Open
        } else if lost.share - ordinary < (self.share - ordinary) / 2.0 {
            Verdict::Gone
        } else {
            Verdict::Stays
        }
    }
}
