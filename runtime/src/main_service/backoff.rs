//! How long to wait before the next try.

use std::time::Duration;

/// Shortest upper bound of a wait.
const FIRST: Duration = Duration::from_millis(100);
/// Upper bound while the main service was there a short while ago.
const SOON: Duration = Duration::from_secs(2);
/// Upper bound once it has been away for longer.
const LATER: Duration = Duration::from_secs(30);
/// What a short while is.
const RECENT: Duration = Duration::from_secs(5 * 60);

/// Waits with full jitter: anything from nothing to an upper bound that doubles with every failure,
/// so that a fleet that lost its main service at one moment does not come back at one moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Backoff {
    failures: u32,
}

impl Backoff {
    /// The next wait. `since_contact` is the time since the main service last said something
    /// (`None`: never), `random` a number of at least 0 and below 1.
    pub fn next(&mut self, since_contact: Option<Duration>, random: f64) -> Duration {
        let most = match since_contact {
            Some(since) if since < RECENT => SOON,
            Some(_) | None => LATER,
        };
        // Beyond 16 doublings every bound is reached.
        let bound = FIRST.saturating_mul(1 << self.failures.min(16)).min(most);
        self.failures = self.failures.saturating_add(1);
        bound.mul_f64(random.clamp(0.0, 1.0))
    }

    /// The main service has answered.
    pub fn reset(&mut self) {
        self.failures = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn the_bound_doubles_up_to_two_seconds_soon_after_contact_and_to_thirty_later() {
        for (since, most) in [
            (Some(SECOND), 2.0),
            (Some(299 * SECOND), 2.0),
            (Some(300 * SECOND), 30.0),
            (None, 30.0),
        ] {
            let mut backoff = Backoff::default();
            let waits: Vec<f64> = (0..40).map(|_| backoff.next(since, 1.0).as_secs_f64()).collect();
            assert_eq!(waits[..4], [0.1, 0.2, 0.4, 0.8], "{since:?}");
            assert_eq!(waits[39], most, "{since:?}");
            assert!(waits.is_sorted());
        }
    }

    #[test]
    fn an_answer_begins_anew_and_chance_chooses_below_the_bound() {
        let mut backoff = Backoff::default();
        for _ in 0..10 {
            backoff.next(Some(SECOND), 0.5);
        }
        assert_eq!(backoff.next(Some(SECOND), 0.0), Duration::ZERO);
        assert_eq!(backoff.next(Some(SECOND), 0.5), SECOND);
        backoff.reset();
        assert_eq!(backoff.next(Some(SECOND), 0.5), Duration::from_millis(50));
    }
}
