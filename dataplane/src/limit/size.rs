//! `s` of the allocation: the largest payload of a topic as it is sent.

use std::time::{Duration, Instant};

/// The largest recent size. It is remembered for ever or for a while (`size_window_s`), so that one
/// outlier does not lower the rate of its topic until the flow is started again.
#[derive(Debug, Clone, Default)]
pub struct SizeMeter {
    /// Of the current window and the one before; without a window all is in the first.
    largest: [u64; 2],
    begun: Option<Instant>,
}

impl SizeMeter {
    /// Notes a payload. Returns whether it is larger than all before it.
    pub fn note(&mut self, now: Instant, bytes: u64) -> bool {
        self.begun.get_or_insert(now);
        let before = self.largest();
        self.largest[0] = self.largest[0].max(bytes);
        self.largest() > before
    }

    /// The largest size in bytes; 0 before the first.
    #[must_use]
    pub fn largest(&self) -> u64 {
        self.largest[0].max(self.largest[1])
    }

    /// Lets go of what is older than the window, at most two of them. Returns whether the largest
    /// is another one now. To be called now and then; without messages of late the last ones count
    /// on.
    pub fn forget(&mut self, now: Instant, window: Option<Duration>) -> bool {
        let Some((window, begun)) = window.zip(self.begun) else {
            return false;
        };
        if now.saturating_duration_since(begun) < window || self.largest[0] == 0 {
            return false;
        }
        let before = self.largest();
        self.largest = [0, self.largest[0]];
        self.begun = Some(now);
        self.largest() != before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn the_largest_stays_for_ever_without_a_window() {
        let start = Instant::now();
        let mut meter = SizeMeter::default();
        assert!(meter.note(start, 900) && !meter.note(start, 100) && meter.note(start, 901));
        assert!(!meter.forget(start + SECOND * 1_000_000, None));
        assert_eq!(meter.largest(), 901);
    }

    #[test]
    fn an_outlier_is_forgotten_after_two_windows_at_most() {
        let start = Instant::now();
        let mut meter = SizeMeter::default();
        meter.note(start, 5_000);
        let mut changed = Vec::new();
        for second in 1..60u32 {
            let now = start + SECOND * second;
            meter.note(now, 100);
            if meter.forget(now, Some(SECOND * 10)) {
                changed.push(second);
            }
        }
        assert_eq!((changed, meter.largest()), (vec![20], 100));
    }

    #[test]
    fn silence_forgets_nothing() {
        let start = Instant::now();
        let mut meter = SizeMeter::default();
        meter.note(start, 5_000);
        for second in 1..100u32 {
            meter.forget(start + SECOND * second, Some(SECOND));
        }
        assert_eq!(meter.largest(), 5_000);
    }
}
