//! Token bucket of one lane (`docs/design/bandwidth.md`).

use std::time::Instant;

/// Tokens that a full bucket holds: `C = 2`.
pub const CAPACITY: f64 = 2.0;

/// `T ← min(C, T + r·Δt)`; a message passes if `T ≥ 1` and takes one token.
#[derive(Debug, Clone)]
pub struct TokenBucket {
    rate_hz: f64,
    tokens: f64,
    filled: Instant,
}

impl TokenBucket {
    /// A full bucket that refills at `rate_hz` tokens per second.
    #[must_use]
    pub fn new(rate_hz: f64, now: Instant) -> Self {
        Self { rate_hz: rate_hz.max(0.0), tokens: CAPACITY, filled: now }
    }

    /// Tokens per second.
    #[must_use]
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Changes the rate from now on; what has been saved stays.
    pub fn set_rate(&mut self, rate_hz: f64, now: Instant) {
        self.fill(now);
        self.rate_hz = rate_hz.max(0.0);
    }

    /// Whether one message may pass now.
    pub fn admit(&mut self, now: Instant) -> bool {
        self.fill(now);
        // A whole token less the rounding of many small additions.
        if self.tokens + 1e-9 < 1.0 {
            return false;
        }
        self.tokens -= 1.0;
        true
    }

    fn fill(&mut self, now: Instant) {
        let elapsed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.tokens = (self.tokens + self.rate_hz * elapsed).min(CAPACITY);
        self.filled = self.filled.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn fifty_hertz_is_thinned_to_ten() {
        let start = Instant::now();
        let mut bucket = TokenBucket::new(10.0, start);
        let passed =
            (0..5000u32).filter(|n| bucket.admit(start + Duration::from_millis(20) * *n)).count();
        assert!((1000..=1002).contains(&passed), "{passed} of 5000 in 100 s");
    }

    #[test]
    fn a_pause_saves_two_tokens_and_no_more() {
        let start = Instant::now();
        let mut bucket = TokenBucket::new(1.0, start);
        let later = start + Duration::from_secs(100);
        assert_eq!((0..5).filter(|_| bucket.admit(later)).count(), 2);
    }

    #[test]
    fn a_clock_that_stands_still_or_goes_back_gives_nothing() {
        let start = Instant::now() + Duration::from_secs(10);
        let mut bucket = TokenBucket::new(1000.0, start);
        assert!(bucket.admit(start) && bucket.admit(start));
        assert!(!bucket.admit(start.checked_sub(Duration::from_secs(5)).unwrap()));
    }
}
