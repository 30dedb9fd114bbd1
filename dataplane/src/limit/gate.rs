//! How often one bridge lets a message pass, as far as those who ask for it say. What the budget
//! says is for whole lanes: [`LaneGates`](crate::lane::allocation::LaneGates).

use std::time::Instant;

use super::bucket::TokenBucket;

/// The gate of one bridge.
#[derive(Debug, Clone)]
pub struct Gate {
    bucket: Option<TokenBucket>,
}

impl Gate {
    /// A gate for what requesters ask for at most, and the operator allows, in Hz; `None`: all that
    /// is published.
    #[must_use]
    pub fn new(max_rate_hz: Option<f64>, now: Instant) -> Self {
        Self { bucket: max_rate_hz.map(|most| TokenBucket::new(most, now)) }
    }

    /// Requesters ask for another rate.
    pub fn set_max_rate(&mut self, max_rate_hz: Option<f64>, now: Instant) {
        let before = self.bucket.take();
        self.bucket = max_rate_hz.map(|most| {
            let mut bucket = before.unwrap_or_else(|| TokenBucket::new(most, now));
            bucket.set_rate(most, now);
            bucket
        });
    }

    /// Whether one message may pass now.
    pub fn admit(&mut self, now: Instant) -> bool {
        self.bucket.as_mut().is_none_or(|bucket| bucket.admit(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// How many of ten seconds at 50 Hz pass.
    fn passed(gate: &mut Gate, start: Instant) -> usize {
        (0..500u32)
            .filter(|message| gate.admit(start + Duration::from_millis(20) * *message))
            .count()
    }

    #[test]
    fn a_new_rate_keeps_what_was_saved_and_gives_nothing_for_the_past() {
        let start = Instant::now();
        let mut gate = Gate::new(Some(1.0), start);
        assert!(gate.admit(start) && gate.admit(start) && !gate.admit(start));
        gate.set_max_rate(Some(100.0), start + Duration::from_millis(100));
        assert!(!gate.admit(start + Duration::from_millis(100)), "a tenth of a token is none");
        assert!(gate.admit(start + Duration::from_millis(110)));
        gate.set_max_rate(None, start + Duration::from_millis(110));
        assert_eq!(passed(&mut gate, start + Duration::from_millis(110)), 500);
    }
}
