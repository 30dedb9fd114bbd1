//! How much a link carries: an estimate from what its peer reports. A state machine without I/O; time is passed in.
//!
//! ```text
//!            at the limit, or rising          delay or loss lasts           it went: it was ours
//! new ─────▶ unknown ───────────────────────▶ backing_off ────────────────▶ steady: 0.95 of what was delivered,
//! outage ──▶ slow_start ────────────────────▶      │                        then in steps up to the limit
//!                                                  └─ it stayed: not ours; it is the path's own, and the rate returns
//! ```
//!
//! Nothing is concluded from a delivered rate alone: it may be low because little was offered. What tells is a queue that
//! does not go away. A delay above that of the empty path is a queue before the bottleneck, and as long as it lasts, what
//! comes out of it is what the bottleneck carries (the delivery rate of BBR, draft-ietf-ccwg-bbr).
//!
//! Whether a delay (or a loss) is that of a queue of ours cannot be seen from its size: a route may have become longer, or
//! somebody else's traffic may stand in the way. So it is tried out: half of the delivered rate is sent, which must shorten
//! a queue of ours by half a second per second. What does not go away then belongs to the path, is its own from then on, and
//! costs no more than that trial. It does what BBR does with ProbeRTT, only when there is a reason, and never takes a
//! standing queue of ours for the delay of the path.
//!
//! - Delay of the empty path: the least round trip of the last 30 to 60 s, as the base delay of LEDBAT (RFC 6817, 4.2).
//! - A delay counts when it exceeds that by 25 ms, or by five times the jitter (RFC 3550, 6.4.1), in every sample for a
//!   while, as the overuse time of draft-ietf-rmcat-gcc. So a pause of the receiver does not count: it ends in between.
//! - Loss alone counts only above [`LOSS`], as in draft-ietf-rmcat-gcc: radio loses without being full, and to send less does
//!   not help there. A bottleneck with a queue of more than 25 ms shows a delay before it loses.
//! - The rate rises only while at least half of it is used, as RFC 7661 has it; else it doubles in half a minute, so that
//!   what was learned is forgotten in the end, even if the traffic is thinned because of it.

mod drain;
mod path;

use std::time::{Duration, Instant};

use drain::{DRAINING, Drain, TRIALS, Verdict};
use path::{Delay, Loss};

/// The rate never falls below this, in bytes per second, unless the limit is lower: what is small must get through.
pub const FLOOR_BYTES_PER_S: f64 = 16.0 * 1024.0;
/// Nor below this share of the limit.
pub const FLOOR_SHARE: f64 = 0.01;
/// Share of the limit that slow start begins with. Five doublings reach the limit, in about two seconds; and a path that
/// has become a hundred times slower than the limit gets no more than three times what it carries.
pub const START_SHARE: f64 = 1.0 / 32.0;
/// Loss above the ordinary that counts as a sign of a full link.
pub const LOSS: f64 = 0.1;

/// No limit is taken for more than this, in bytes per second.
const HIGHEST_LIMIT: f64 = 1e12;
/// Used of the estimate after a back-off, so that the queue stays empty.
const KEPT: f64 = 0.95;
/// Sent of what is delivered, to see whether the loss goes.
const SPARING: f64 = 0.85;
/// Estimates nearer to one another than this are of one rate.
const SAME: f64 = 0.2;
/// Share of the rate that must be used for it to rise by steps.
const USED: f64 = 0.5;
/// Steps: in slow start, up to 1.25 times the estimate, and beyond that.
const STEP_START: f64 = 1.5;
const STEP_NEAR: f64 = 1.05;
const STEP_FAR: f64 = 1.25;
/// How long a step is tried, besides a round trip: two Feedback, and what a delay must last to count.
const STEP: Duration = Duration::from_millis(250);
/// In what time an unused rate doubles.
const FORGET_S: f64 = 30.0;
/// Time at the limit without a queue after which nothing limits.
const PROVEN: Duration = Duration::from_secs(10);
/// Pause before the first step after a back-off; doubled each time the same estimate comes out, to spare the dips.
const HOLD: Duration = Duration::from_secs(2);
const LONGEST_HOLD: Duration = Duration::from_secs(8);
/// A round trip above this is a mistake.
const LONGEST_ROUND_TRIP: Duration = Duration::from_secs(30);

/// What a Feedback tells. Bytes are wire bytes, as for [`Capacity::sent`]: a caller that counts less multiplies by its wire
/// factor.
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
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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

impl State {
    /// As in the admin JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::SlowStart => "slow_start",
            Self::Steady => "steady",
            Self::BackingOff => "backing_off",
        }
    }
}

/// The estimate of one link, and the rate that may be sent over it.
#[derive(Debug, Clone)]
pub struct Capacity {
    /// The newest time that was passed.
    now: Instant,
    limit: f64,
    rate: f64,
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
}

#[derive(Debug, Clone)]
enum Phase {
    /// The rate rises, or is at the limit.
    Rising,
    /// Half is sent until the delay is gone, or is seen to stay.
    Draining(Drain),
    /// Less is sent, to see whether less is lost.
    Sparing(Spare),
}

#[derive(Debug, Clone)]
struct Spare {
    before: f64,
    carried: f64,
    share: f64,
    /// What was on the way at the beginning has been counted.
    settled: bool,
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
            estimate: None,
            phase: Phase::Rising,
            delay: Delay::default(),
            loss: Loss::new(now),
            datagram_bytes: 0.0,
            step: now,
            step_sent: 0.0,
            pause: Duration::ZERO,
            hold: HOLD,
        }
    }

    /// Changes the limit in bytes per second from now on. Where nothing else limits, the rate follows at once.
    pub fn set_limit(&mut self, limit_bytes_per_s: f64, now: Instant) {
        let unlimited = self.state() == State::Unknown;
        self.limit = sane_limit(limit_bytes_per_s);
        self.estimate = self.estimate.filter(|estimate| *estimate < self.limit);
        self.advance(now);
        self.set_rate(if unlimited { self.limit } else { self.rate });
    }

    /// Takes what has left, of all classes and LinkControl too: one call per datagram.
    pub fn sent(&mut self, now: Instant, wire_bytes: usize) {
        self.advance(now);
        let bytes = wire_bytes as f64;
        self.datagram_bytes += (bytes - self.datagram_bytes) / 16.0;
        self.step_sent += bytes;
    }

    /// The peer was suspect or down and is back, or a link epoch begins: the path may be another one. Slow start.
    pub fn outage(&mut self, now: Instant) {
        self.advance(now);
        self.estimate = None;
        self.phase = Phase::Rising;
        self.delay = Delay::default();
        self.loss = Loss::new(self.now);
        self.hold = HOLD;
        self.pause = Duration::ZERO;
        self.set_rate((self.limit * START_SHARE).min(self.rate));
    }

    /// Takes a Feedback of any class.
    pub fn feedback(&mut self, now: Instant, seen: &Seen) {
        self.advance(now);
        let delivered = seen.delivered_bytes as f64;
        self.loss.delivered += delivered;
        self.loss.lost += seen.lost_bytes as f64;
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

    /// What may be sent now, in bytes per second: at most the limit, at least [`FLOOR_BYTES_PER_S`] and [`FLOOR_SHARE`] of the
    /// limit, if the limit allows.
    #[must_use]
    pub fn bytes_per_s(&self) -> f64 {
        self.rate
    }

    /// What the link carries, in bytes per second, at most the limit. `None`: nothing is known to limit below the limit.
    #[must_use]
    pub fn measured(&self) -> Option<f64> {
        // The steps near the estimate are to find its end; what is far above it is carried too.
        let reached = |estimate: f64| if self.rate > STEP_FAR * estimate { self.rate } else { estimate };
        self.estimate.map(|estimate| reached(estimate).min(self.limit))
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

    /// How much longer the newest round trip took than that of the empty path.
    #[must_use]
    pub fn queueing_delay(&self) -> Duration {
        self.delay.queue
    }

    /// Share of bytes that was lost of late, 0 to 1.
    #[must_use]
    pub fn loss(&self) -> f64 {
        self.loss.newest
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

    fn set_rate(&mut self, bytes_per_s: f64) {
        self.rate = bytes_per_s.max(self.floor()).min(self.limit);
        self.step = self.now;
        self.step_sent = 0.0;
    }

    fn judge_delay(&mut self) {
        let before = match &mut self.phase {
            Phase::Rising => self.rate,
            Phase::Sparing(spare) => spare.before,
            Phase::Draining(drain) => {
                let elapsed = self.now.saturating_duration_since(self.step).as_secs_f64();
                let sent = self.step_sent / elapsed.max(1e-3);
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
        self.phase = Phase::Draining(Drain::new(self.now, &self.delay, before, carried, trial, shrinking));
        self.set_rate(carried * DRAINING);
    }

    fn conclude(&mut self, verdict: Verdict, drain: &Drain) {
        match verdict {
            Verdict::Open => {}
            Verdict::Gone => self.learn(drain.carried),
            Verdict::Slower if self.rate <= self.floor() => {}
            Verdict::Slower | Verdict::Less => self.drain(drain.before, drain.carried, 1),
            // The link may have become slower meanwhile, by as much as was tried.
            Verdict::Stays if drain.trial < TRIALS => self.drain(drain.before, drain.carried, drain.trial + 1),
            Verdict::Stays => {
                self.delay.is_own(self.now, drain.least);
                self.resume(drain.before);
            }
        }
    }

    /// The back-off helped: the link carries so much.
    fn learn(&mut self, carried: f64) {
        let carried = carried / (1.0 - self.loss.ordinary);
        let near = self.estimate.filter(|estimate| (carried / estimate - 1.0).abs() < SAME);
        let estimate = near.map_or(carried, |estimate| f64::midpoint(estimate, carried));
        let estimate = estimate.max(self.floor()).min(self.limit);
        self.estimate = Some(estimate);
        self.hold = if near.is_some() { (self.hold * 2).min(LONGEST_HOLD) } else { HOLD };
        self.resume(estimate * KEPT);
        self.pause = self.hold;
    }

    fn resume(&mut self, bytes_per_s: f64) {
        self.phase = Phase::Rising;
        self.delay.restart();
        self.pause = Duration::ZERO;
        self.loss.restart(self.now);
        self.set_rate(bytes_per_s);
    }

    fn judge_loss(&mut self) {
        let Some((share, delivered)) = self.loss.judge(self.now, self.datagram_bytes) else {
            return;
        };
        let ordinary = self.loss.ordinary;
        match &mut self.phase {
            Phase::Draining(_) => {}
            Phase::Rising if share > ordinary + LOSS => {
                self.phase = Phase::Sparing(Spare {
                    before: self.rate,
                    carried: delivered,
                    share,
                    settled: false,
                });
                self.set_rate(delivered / (1.0 - ordinary) * SPARING);
            }
            Phase::Rising => self.loss.ordinary = ordinary.min(share),
            Phase::Sparing(spare) if !spare.settled => spare.settled = true,
            Phase::Sparing(spare) => {
                let (before, carried) = (spare.before, spare.carried);
                if share - ordinary < (spare.share - ordinary) / 2.0 {
                    self.learn(carried);
                } else {
                    self.loss.ordinary = share.min(0.9);
                    self.resume(before);
                }
            }
        }
    }

    fn rise(&mut self) {
        let elapsed = self.since(self.step);
        let settled = elapsed >= self.pause.max(self.delay.newest + STEP);
        if !settled || self.delay.is_queued() || !matches!(self.phase, Phase::Rising) {
            return;
        }
        if self.rate >= self.limit {
            self.estimate = None;
        }
        let elapsed = elapsed.as_secs_f64();
        let factor = match self.estimate {
            _ if self.step_sent < USED * self.rate * elapsed => (elapsed.min(1.0) / FORGET_S).exp2(),
            None => STEP_START,
            Some(estimate) if self.rate < STEP_FAR * estimate => STEP_NEAR,
            Some(_) => STEP_FAR,
        };
        self.set_rate(self.rate * factor);
        let trial = self.estimate.is_some() && self.rate >= self.limit;
        self.pause = if trial { PROVEN } else { Duration::ZERO };
    }
}

fn sane_limit(bytes_per_s: f64) -> f64 {
    // The larger of NaN and a number is the number.
    bytes_per_s.max(1.0).min(HIGHEST_LIMIT)
}

#[cfg(test)]
mod tests;
