//! How often one bridge lets a message pass: a token bucket at the smaller of two rates.

use std::time::Instant;

use blaze_domain::DropReason;

use super::bucket::TokenBucket;

/// The gate of one bridge.
#[derive(Debug, Clone)]
pub struct Gate {
    /// What requesters ask for at most, and the operator allows, in Hz.
    max_rate_hz: Option<f64>,
    /// What the budget allows, where that is less than what is published, in Hz.
    allocated_hz: Option<f64>,
    bucket: Option<TokenBucket>,
}

impl Gate {
    /// A gate that only knows what requesters ask for.
    #[must_use]
    pub fn new(max_rate_hz: Option<f64>, now: Instant) -> Self {
        let mut gate = Self {
            max_rate_hz,
            allocated_hz: None,
            bucket: None,
        };
        gate.follow(now);
        gate
    }

    /// Requesters ask for another rate.
    pub fn set_max_rate(&mut self, max_rate_hz: Option<f64>, now: Instant) {
        self.max_rate_hz = max_rate_hz;
        self.follow(now);
    }

    /// The budget allows another rate; `None`: all that is published.
    pub fn set_allocated(&mut self, allocated_hz: Option<f64>, now: Instant) {
        self.allocated_hz = allocated_hz;
        self.follow(now);
    }

    /// Whether one message may pass now.
    ///
    /// # Errors
    /// `rate_limit` where the budget is what holds it back, `max_rate` where nobody asks for more.
    pub fn admit(&mut self, now: Instant) -> Result<(), DropReason> {
        let limited = self.is_limited();
        match &mut self.bucket {
            Some(bucket) => match (bucket.admit(now), limited) {
                (true, _) => Ok(()),
                (false, true) => Err(DropReason::RateLimit),
                (false, false) => Err(DropReason::MaxRate),
            },
            None => Ok(()),
        }
    }

    /// Whether the budget holds back more than requesters do.
    #[must_use]
    pub fn is_limited(&self) -> bool {
        match (self.allocated_hz, self.max_rate_hz) {
            (Some(allocated), Some(most)) => allocated < most,
            (allocated, _) => allocated.is_some(),
        }
    }

    fn follow(&mut self, now: Instant) {
        let rate = match (self.allocated_hz, self.max_rate_hz) {
            (Some(allocated), Some(most)) => Some(allocated.min(most)),
            (allocated, most) => allocated.or(most),
        };
        match (rate, &mut self.bucket) {
            (Some(rate), Some(bucket)) => bucket.set_rate(rate, now),
            (Some(rate), bucket) => *bucket = Some(TokenBucket::new(rate, now)),
            (None, bucket) => *bucket = None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// Messages of ten seconds at 50 Hz: how many pass, and why the others do not.
    fn passed(gate: &mut Gate, start: Instant) -> (u32, Option<DropReason>) {
        let mut reason = None;
        let mut passed = 0;
        for message in 0..500 {
            match gate.admit(start + Duration::from_millis(20) * message) {
                Ok(()) => passed += 1,
                Err(why) => reason = Some(why),
            }
        }
        (passed, reason)
    }

    #[test]
    fn the_smaller_rate_holds_and_gives_the_reason() {
        let start = Instant::now();
        let gate = |asked, allocated| {
            let mut gate = Gate::new(asked, start);
            gate.set_allocated(allocated, start);
            gate
        };
        assert_eq!(passed(&mut gate(None, None), start), (500, None));
        let (count, reason) = passed(&mut gate(Some(10.0), None), start);
        assert!((100..=102).contains(&count) && reason == Some(DropReason::MaxRate));
        let (count, reason) = passed(&mut gate(Some(10.0), Some(5.0)), start);
        assert!((50..=52).contains(&count) && reason == Some(DropReason::RateLimit));
        let (count, reason) = passed(&mut gate(Some(10.0), Some(20.0)), start);
        assert!((100..=102).contains(&count) && reason == Some(DropReason::MaxRate));
    }

    #[test]
    fn a_new_rate_keeps_what_was_saved_and_gives_nothing_for_the_past() {
        let start = Instant::now();
        let mut gate = Gate::new(None, start);
        gate.set_allocated(Some(1.0), start);
        assert!(gate.admit(start).is_ok() && gate.admit(start).is_ok() && gate.admit(start).is_err());
        gate.set_allocated(Some(100.0), start + Duration::from_millis(100));
        assert!(gate.admit(start + Duration::from_millis(100)).is_err(), "a tenth of a token is none");
        assert!(gate.admit(start + Duration::from_millis(110)).is_ok());
    }
}
