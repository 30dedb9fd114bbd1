//! How much a link carries: an estimate from what its peer reports. A state machine without I/O;
//! time is passed in.
//!
//! ```text
//! new ────▶ unknown: all of the limit ─┐                    it goes: it was ours
//!                                      ├─ delay or loss ──▶ backing_off ──▶ steady: 0.95 of what was delivered, then
//! outage ─▶ slow_start: 1/32 of it, ───┘  that lasts         │              in steps up to the limit or the next delay
//!           then in steps                                    └─ it stays: it is the path's; the rate is as before
//! ```
//!
//! A slow start begins higher where what is small needs more than 1/32 of the limit.
//!
//! Nothing is concluded from a delivered rate alone: it may be low because little was offered. What
//! tells is a queue that does not go away (`path.rs`): as long as it lasts, what comes out of it is
//! what the bottleneck carries, as the delivery rate of BBR (draft-ietf-ccwg-bbr). Whether the
//! queue is ours is tried out (`trial.rs`).
//!
//! The rate rises in steps only while at least half of it is used, as RFC 7661 has it for windows;
//! else it doubles in half a minute, so that an estimate is forgotten in the end even if the
//! traffic is thinned because of it.

mod path;
mod trial;

use std::time::{Duration, Instant};

use path::{Delay, Loss};
use serde::Serialize;
use trial::{DRAINING, Drain, Phase, SPARING, Spare, TRIALS, Verdict};

/// The rate never falls below this, in bytes per second, unless the limit is lower: what is small
/// must get through.
pub const FLOOR_BYTES_PER_S: f64 = 16.0 * 1024.0;
/// Nor below this share of the limit.
pub const FLOOR_SHARE: f64 = 0.01;
/// Share of the limit that slow start begins with: five doublings below, which take three seconds
/// at a round trip of 50 ms. A path that now carries a hundredth of the limit gets three times
/// that, not a hundred times.
pub const START_SHARE: f64 = 1.0 / 32.0;
/// … but with so many times what is small needs at least: it is not what fills a link, and should
/// not wait until the link is known.
pub const START_MARGIN: f64 = 1.25;
/// Loss above the ordinary that counts as the sign of a full link, as in draft-ietf-rmcat-gcc.
pub const LOSS: f64 = 0.1;

/// No limit is taken for more than this, in bytes per second.
const HIGHEST_LIMIT: f64 = 1e12;
/// Sent of the estimate after a back-off, so that the queue stays empty.
const KEPT: f64 = 0.95;
/// Estimates nearer to one another than this are of one rate.
const SAME: f64 = 0.2;
/// Share of what has been sent without a queue that the link carries for certain.
const PROVES: f64 = 0.9;
/// Share of the rate that must be used for it to rise by steps.
const USED: f64 = 0.5;
/// Steps: in slow start, up to 1.25 times the estimate, and beyond that.
const STEP_START: f64 = 1.5;
const STEP_NEAR: f64 = 1.05;
const STEP_FAR: f64 = 1.25;
/// How long a step is tried, besides a round trip: two Feedback, and what a delay must last to
/// count.
const STEP: Duration = Duration::from_millis(250);
/// In what time an unused rate doubles.
const FORGET_S: f64 = 30.0;
/// Time at the limit without a queue after which nothing limits.
const UNLIMITED: Duration = Duration::from_secs(10);
/// Pause before the first step after a back-off; doubled each time the same estimate comes out, to
/// spare the dips.
const HOLD: Duration = Duration::from_secs(2);
const LONGEST_HOLD: Duration = Duration::from_secs(8);
/// A round trip above this is a mistake.
const LONGEST_ROUND_TRIP: Duration = Duration::from_secs(30);

/// What a Feedback tells. Bytes are wire bytes, as for [`Capacity::sent`]: a caller that counts
/// less multiplies by its wire factor.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Seen {
    /// Received since the last Feedback.
    pub delivered_bytes: u64,
    /// Found to be lost since the last Feedback.
    pub lost_bytes: u64,
    /// Of the newest datagram received, without the time that the peer held it.
    pub round_trip: Option<Duration>,
}

/// What is known of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Nothing limits below the limit, as far as is known.
    Unknown,
    /// It begins low and rises.
    SlowStart,
    /// There is an estimate.
    Steady,
    /// It finds out whether a delay or a loss is its own doing.
    BackingOff,
}

/// The estimate of one link, and the rate that may be sent over it.
#[derive(Debug, Clone)]
pub struct Capacity {
    /// The newest time that was passed.
    now: Instant,
    limit: f64,
    rate: f64,
    /// What is small needs so much, in bytes per second.
    needed: f64,
    estimate: Option<f64>,
    phase: Phase,
    delay: Delay,
    loss: Loss,
    /// Mean size of a datagram.
    datagram_bytes: f64,
    /// When the rate was set, and what has been sent at it.
    step: Instant,
    step_sent: f64,
    /// Before the next step.
    pause: Duration,
    hold: Duration,
    /// What has been sent without a queue since the estimate, less what may be in a queue that is
    /// not seen yet.
    proven: f64,
}

impl Capacity {
    /// A link of which nothing is known: all of the limit may be sent.
    #[must_use]
    pub fn new(limit_bytes_per_s: f64, now: Instant) -> Self {
        let limit = sane_limit(limit_bytes_per_s);
        Self {
            now,
            limit,
            rate: limit,
            needed: 0.0,
            estimate: None,
            phase: Phase::Rising,
            delay: Delay::default(),
            loss: Loss::new(now),
            datagram_bytes: 0.0,
            step: now,
            step_sent: 0.0,
            pause: Duration::ZERO,
            hold: HOLD,
            proven: 0.0,
        }
    }

    /// Changes the limit in bytes per second from now on. Where nothing else limits, the rate
    /// follows at once.
    pub fn set_limit(&mut self, limit_bytes_per_s: f64, now: Instant) {
        self.advance(now);
        let limit = sane_limit(limit_bytes_per_s);
        let unlimited = self.state() == State::Unknown;
        // A step goes on if nothing changes for it, however often the limit is told.
        let rate = if unlimited { limit } else { self.rate };
        let is_same = limit == self.limit;
        self.limit = limit;
        self.estimate = self.estimate.filter(|estimate| *estimate < limit);
        if !is_same {
            self.set_rate(rate);
        }
    }

    /// So much is needed for what is small, LinkControl too, in bytes per second: no slow start is
    /// below that.
    pub fn set_needed(&mut self, bytes_per_s: f64, now: Instant) {
        self.advance(now);
        self.needed = if bytes_per_s.is_finite() { bytes_per_s.max(0.0) } else { 0.0 };
        // It is known after the peer is back what goes there.
        if self.state() == State::SlowStart && self.rate < self.start().min(self.limit) {
            self.set_rate(self.start());
        }
    }

    /// What slow start begins with.
    fn start(&self) -> f64 {
        (self.limit * START_SHARE).max(self.needed * START_MARGIN)
    }

    /// Takes what has left, of all classes and LinkControl too: one call per datagram.
    pub fn sent(&mut self, now: Instant, wire_bytes: usize) {
        self.advance(now);
        let bytes = wire_bytes as f64;
        self.datagram_bytes += (bytes - self.datagram_bytes) / 16.0;
        self.step_sent += bytes;
    }

    /// The peer was suspect or down and is back, or a link epoch begins: the path may be another
    /// one. Slow start.
    pub fn outage(&mut self, now: Instant) {
        self.advance(now);
        self.estimate = None;
        self.phase = Phase::Rising;
        self.delay = Delay::default();
        self.loss = Loss::new(self.now);
        self.hold = HOLD;
        self.pause = Duration::ZERO;
        self.set_rate(self.start().min(self.rate));
    }

    /// Takes a Feedback of any class.
    pub fn feedback(&mut self, now: Instant, seen: &Seen) {
        self.advance(now);
        let delivered = seen.delivered_bytes as f64;
        self.loss.add(delivered, seen.lost_bytes as f64);
        // A Feedback of an idle class echoes a datagram of long ago: its delay is none of now.
        let sample = seen.round_trip.filter(|_| seen.delivered_bytes > 0);
        self.delay.delivered(delivered);
        if let Some(round_trip) = sample.filter(|round_trip| *round_trip <= LONGEST_ROUND_TRIP) {
            self.delay.take(self.now, round_trip);
            self.judge_delay();
        }
        self.judge_loss();
        self.rise();
    }

    /// What may be sent now, in bytes per second: at most the limit, at least [`FLOOR_BYTES_PER_S`]
    /// and [`FLOOR_SHARE`] of the limit, if the limit allows.
    #[must_use]
    pub fn bytes_per_s(&self) -> f64 {
        self.rate
    }

    /// What the link carries, in bytes per second, at most the limit. `None`: nothing is known to
    /// limit below that.
    #[must_use]
    pub fn measured(&self) -> Option<f64> {
        let estimate = self.estimate?;
        // The steps near the estimate are to find its end; what is far above it is carried too.
        let is_far = self.rate > STEP_FAR * estimate;
        Some(if is_far { self.rate } else { estimate }.min(self.limit))
    }

    /// The state, for people.
    #[must_use]
    pub fn state(&self) -> State {
        match (&self.phase, self.estimate) {
            (Phase::Draining(_) | Phase::Sparing(_), _) => State::BackingOff,
            (Phase::Rising, Some(_)) => State::Steady,
            (Phase::Rising, None) if self.rate < self.limit => State::SlowStart,
            (Phase::Rising, None) => State::Unknown,
        }
    }

    fn advance(&mut self, now: Instant) {
        self.now = self.now.max(now);
    }

    fn since(&self, then: Instant) -> Duration {
        self.now.saturating_duration_since(then)
    }

    fn floor(&self) -> f64 {
        FLOOR_BYTES_PER_S.max(self.limit * FLOOR_SHARE).min(self.limit)
    }

    /// Since the rate was set.
    fn sent_bytes_per_s(&self) -> f64 {
        self.step_sent / self.since(self.step).as_secs_f64().max(1e-3)
    }

    fn set_rate(&mut self, bytes_per_s: f64) {
        self.rate = bytes_per_s.max(self.floor()).min(self.limit);
        self.step = self.now;
        self.step_sent = 0.0;
    }

    fn judge_delay(&mut self) {
        // Below the floor it cannot go, whatever arrives.
        let can_fall = self.rate > self.floor();
        let sent = if can_fall { self.sent_bytes_per_s() } else { 0.0 };
        let before = match &mut self.phase {
            Phase::Rising => self.rate,
            Phase::Sparing(spare) => spare.before,
            Phase::Draining(drain) => {
                let verdict = drain.judge(self.now, &self.delay, sent);
                let drain = drain.clone();
                self.conclude(verdict, &drain);
                return;
            }
        };
        if let Some(carried) = self.delay.carried() {
            self.drain(before, carried, 1);
        }
    }

    fn drain(&mut self, before: f64, carried: f64, trial: u32) {
        // The floor may be more than the half.
        let shrinking = 1.0 - self.floor() / carried;
        self.phase =
            Phase::Draining(Drain::new(self.now, &self.delay, before, carried, trial, shrinking));
        self.set_rate(carried * DRAINING);
    }

    fn conclude(&mut self, verdict: Verdict, drain: &Drain) {
        match verdict {
            Verdict::Open => {}
            Verdict::Gone => self.learn(drain.carried),
            Verdict::Slower | Verdict::Less => self.drain(drain.before, drain.carried, 1),
            // The link may have become slower meanwhile, by as much as was tried.
            Verdict::Stays if drain.trial < TRIALS => {
                self.drain(drain.before, drain.carried, drain.trial + 1);
            }
            Verdict::Stays => {
                self.delay.is_own(self.now, drain.least);
                self.resume(drain.before);
            }
        }
    }

    /// The back-off helped: the link carries so much.
    fn learn(&mut self, carried: f64) {
        let carried = carried / (1.0 - self.loss.ordinary);
        let known = self.estimate.map(|estimate| estimate.max(self.proven));
        let near = known.filter(|known| (carried / known - 1.0).abs() < SAME);
        let estimate = near.map_or(carried, |known| f64::midpoint(known, carried));
        let estimate = estimate.max(self.floor()).min(self.limit);
        self.estimate = Some(estimate);
        self.hold = if near.is_some() { (self.hold * 2).min(LONGEST_HOLD) } else { HOLD };
        self.resume(estimate * KEPT);
        self.pause = self.hold;
        self.proven = 0.0;
    }

    fn resume(&mut self, bytes_per_s: f64) {
        self.phase = Phase::Rising;
        self.delay.restart();
        self.pause = Duration::ZERO;
        self.loss.restart(self.now);
        self.set_rate(bytes_per_s);
    }

    /// Where the link is known to limit, less is needed to see it again.
    fn tolerated_loss(&self) -> f64 {
        let excess = if self.estimate.is_some() { LOSS / 2.0 } else { LOSS };
        self.loss.ordinary + excess
    }

    fn judge_loss(&mut self) {
        let Some(lost) = self.loss.judge(self.now, self.datagram_bytes) else {
            return;
        };
        let (ordinary, tolerated) = (self.loss.ordinary, self.tolerated_loss());
        match &mut self.phase {
            Phase::Draining(_) => {}
            Phase::Rising if lost.lasting > tolerated => {
                self.phase = Phase::Sparing(Spare::new(self.rate, lost));
                self.set_rate(lost.delivered / (1.0 - ordinary) * SPARING);
            }
            Phase::Rising => self.loss.ordinary = ordinary.min(lost.share),
            Phase::Sparing(spare) => {
                let (before, carried) = (spare.before, spare.carried);
                match spare.judge(lost, ordinary) {
                    Verdict::Gone => self.learn(carried),
                    Verdict::Stays => {
                        self.loss.ordinary = lost.share.min(0.9);
                        self.resume(before);
                    }
                    Verdict::Open | Verdict::Less | Verdict::Slower => {}
                }
            }
        }
    }

    fn rise(&mut self) {
        let elapsed = self.since(self.step);
        let settled = elapsed >= self.pause.max(self.delay.newest + STEP);
        let loses = self.loss.previous.is_some_and(|share| share > self.tolerated_loss());
        if !settled || loses || self.delay.is_queued() || !matches!(self.phase, Phase::Rising) {
            return;
        }
        if self.rate >= self.limit {
            self.estimate = None;
        }
        let sent = self.sent_bytes_per_s();
        self.proven = self.proven.max(PROVES * sent.min(self.rate));
        let factor = match self.estimate {
            _ if sent < USED * self.rate => (elapsed.as_secs_f64().min(1.0) / FORGET_S).exp2(),
            None => STEP_START,
            Some(estimate) if self.rate < STEP_FAR * estimate => STEP_NEAR,
            Some(_) => STEP_FAR,
        };
        self.set_rate(self.rate * factor);
        let trial = self.estimate.is_some() && self.rate >= self.limit;
        self.pause = if trial { UNLIMITED } else { Duration::ZERO };
    }
}

fn sane_limit(bytes_per_s: f64) -> f64 {
    if bytes_per_s.is_nan() { 1.0 } else { bytes_per_s.clamp(1.0, HIGHEST_LIMIT) }
}

#[cfg(test)]
mod tests;
