//! The rate of a counter that is read now and then.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::limits::RATE_WINDOW;

/// Distance of two readings that are kept: four in a window are enough.
const SPACING: Duration = Duration::from_millis(2_500);

/// Readings of a counter during the last [`RATE_WINDOW`].
#[derive(Debug, Clone, Default)]
pub(super) struct Rate {
    readings: VecDeque<(Instant, f64)>,
}

impl Rate {
    /// Takes a reading; growth per second, as a mean over the window. A counter that restarts
    /// begins anew.
    pub(super) fn read(&mut self, now: Instant, value: f64) -> f64 {
        if self.readings.back().is_some_and(|(_, last)| value < *last) {
            self.readings.clear();
        }
        let is_due = |last: &(Instant, f64)| now.saturating_duration_since(last.0) >= SPACING;
        if self.readings.back().is_none_or(is_due) {
            self.readings.push_back((now, value));
        }
        let age = |reading: &(Instant, f64)| now.saturating_duration_since(reading.0);
        while self.readings.get(1).is_some_and(|second| age(second) >= RATE_WINDOW) {
            self.readings.pop_front();
        }
        let Some(first) = self.readings.front() else { return 0.0 };
        (value - first.1) / age(first).max(RATE_WINDOW).as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_the_growth_of_the_window_and_survives_a_restart_of_the_counter() {
        let (start, mut rate) = (Instant::now(), Rate::default());
        let mut at = |s: u64, value: f64| rate.read(start + Duration::from_secs(s), value);
        assert!(at(0, 1_000.0).abs() < 1e-9, "the first reading says nothing");
        assert!((at(1, 1_010.0) - 1.0).abs() < 1e-9, "ten in a window of ten seconds");
        for s in 2..40 {
            at(s, 1_010.0);
        }
        assert!(at(40, 1_010.0).abs() < 1e-9, "nothing more came");
        assert!(at(41, 3.0).abs() < 1e-9, "it began anew");
        assert!((at(42, 23.0) - 2.0).abs() < 1e-9);
        assert!(rate.readings.len() <= 6);
    }
}
