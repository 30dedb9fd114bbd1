//! Jitter that keeps the order of packets by itself.
//!
//! A delay drawn anew for each packet would have to be held back to that of the packet before, so
//! at thousands of packets a second it would always be the largest. Here it wanders: from one
//! random value to the next in a time of four times the jitter, so that it never falls faster than
//! half as fast as time passes, and no packet can overtake another.

use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};

const MIN_PERIOD: Duration = Duration::from_millis(1);

/// A value between −1 and 1 that wanders.
#[derive(Debug)]
pub(super) struct Wander {
    random: StdRng,
    leg: Option<Leg>,
}

#[derive(Debug, Clone, Copy)]
struct Leg {
    from: Instant,
    until: Instant,
    start: f64,
    end: f64,
}

impl Wander {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: StdRng::seed_from_u64(seed), leg: None }
    }

    /// A value that does not depend on those before.
    fn jump(&mut self) -> f64 {
        self.random.random_range(-1.0..=1.0)
    }

    /// The value at a time, which is not before that of the last call.
    pub(super) fn at(&mut self, time: Instant, jitter: Duration) -> f64 {
        let period = (jitter * 4).max(MIN_PERIOD);
        let leg = match self.leg {
            Some(leg) if time <= leg.until => leg,
            Some(leg) if time <= leg.until + period => {
                Leg { from: leg.until, until: leg.until + period, start: leg.end, end: self.jump() }
            }
            // The last packet is so long ago that none can be overtaken.
            _ => Leg { from: time, until: time + period, start: self.jump(), end: self.jump() },
        };
        self.leg = Some(leg);
        let passed = time.saturating_duration_since(leg.from).as_secs_f64();
        let share = passed / (leg.until - leg.from).as_secs_f64();
        leg.start + (leg.end - leg.start) * share
    }
}
