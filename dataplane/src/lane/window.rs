//! Whether a message of a writer was seen before.

/// Sequences below the highest that a window remembers one by one.
pub const WINDOW: u64 = 1024;
const WORDS: usize = 16;

/// Highest sequence of a writer and a bitmap of the last 1,024; anything older counts as seen.
#[derive(Debug, Clone, Default)]
pub struct DuplicateWindow {
    highest: u64,
    /// Bit `sequence % 1024`: seen.
    seen: [u64; WORDS],
}

impl DuplicateWindow {
    /// Notes a sequence. Returns whether it is new.
    pub fn insert(&mut self, sequence: u64) -> bool {
        if sequence > self.highest {
            self.advance(sequence);
        } else if self.highest - sequence >= WINDOW || self.has(sequence) {
            return false;
        }
        let (word, bit) = Self::place(sequence);
        self.seen[word] |= bit;
        true
    }

    /// As [`DuplicateWindow::insert`], but what is older than the newest that was noted is not new,
    /// seen or not.
    pub fn insert_newer(&mut self, sequence: u64) -> bool {
        sequence > self.highest && self.insert(sequence)
    }

    fn advance(&mut self, to: u64) {
        if to - self.highest >= WINDOW {
            self.seen = [0; WORDS];
        } else {
            for between in self.highest + 1..=to {
                let (word, bit) = Self::place(between);
                self.seen[word] &= !bit;
            }
        }
        self.highest = to;
    }

    fn has(&self, sequence: u64) -> bool {
        let (word, bit) = Self::place(sequence);
        self.seen[word] & bit != 0
    }

    fn place(sequence: u64) -> (usize, u64) {
        let index = (sequence % WINDOW) as usize;
        (index / 64, 1 << (index % 64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashSet;

    proptest! {
        #[test]
        fn within_the_window_it_is_a_set(steps in proptest::collection::vec((0u64..1500,
            any::<bool>()), 1..400)) {
            let mut window = DuplicateWindow::default();
            let mut seen = HashSet::new();
            let mut highest = 0u64;
            for (step, forward) in steps {
                let sequence =
                    if forward { highest + step + 1 } else { highest.saturating_sub(step).max(1) };
                let expected =
                    sequence > highest
                    || (highest - sequence < WINDOW && !seen.contains(&sequence));
                prop_assert_eq!(
                    window.insert(sequence),
                    expected,
                    "{} after {}",
                    sequence,
                    highest,
                );
                seen.insert(sequence);
                highest = highest.max(sequence);
            }
        }
    }

    #[test]
    fn what_is_older_than_the_newest_is_not_newer() {
        let mut window = DuplicateWindow::default();
        for (sequence, new) in
            [(8, true), (9, true), (7, false), (11, true), (10, false), (11, false), (12, true)]
        {
            assert_eq!(window.insert_newer(sequence), new, "{sequence}");
        }
        assert!(window.insert(10) && !window.insert(12));
    }

    #[test]
    fn the_largest_sequence_does_no_harm() {
        let mut window = DuplicateWindow::default();
        assert!(window.insert(u64::MAX));
        assert!(!window.insert(u64::MAX));
        assert!(!window.insert(5));
        assert!(window.insert(u64::MAX - 1023));
    }
}
