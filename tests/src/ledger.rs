//! What was published of a numbered stream and what came of it, dropped by identity as the SDK
//! does.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

/// Writer and sequence of a message.
pub type Identity = (String, u64);

/// One stream, whose payloads begin with their number and a space.
#[derive(Debug, Default)]
pub struct Ledger {
    published: Vec<(u64, Instant)>,
    arrived: Vec<(u64, Instant)>,
    identities: BTreeSet<Identity>,
    repeats: u64,
}

/// What became of some messages of a stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Fate {
    /// How many there were.
    pub sent: usize,
    /// Never came.
    pub lost: usize,
    /// Came more than once, under different identities.
    pub twice: usize,
    /// Came after one with a higher number.
    pub reordered: usize,
    /// Repeats under one identity, since the start: consumers drop them.
    pub repeats: u64,
}

impl Ledger {
    /// A message was published.
    pub fn publish(&mut self, number: u64, at: Instant) {
        self.published.push((number, at));
    }

    /// A message came; one without a number is passed over.
    pub fn take(&mut self, identity: Identity, payload: &[u8], at: Instant) {
        let text = String::from_utf8_lossy(payload);
        let Some(number) = text.split(' ').next().and_then(|word| word.parse().ok()) else {
            return;
        };
        if self.identities.insert(identity) {
            self.arrived.push((number, at));
        } else {
            self.repeats += 1;
        }
    }

    /// What was published, in order.
    #[must_use]
    pub fn published(&self) -> &[(u64, Instant)] {
        &self.published
    }

    /// What came, in order.
    #[must_use]
    pub fn arrived(&self) -> &[(u64, Instant)] {
        &self.arrived
    }

    /// Repeats under one identity.
    #[must_use]
    pub fn repeats(&self) -> u64 {
        self.repeats
    }

    /// The number that was published last.
    #[must_use]
    pub fn last_published(&self) -> Option<u64> {
        self.published.last().map(|(number, _)| *number)
    }

    /// The number that came last.
    #[must_use]
    pub fn last_arrived(&self) -> Option<u64> {
        self.arrived.last().map(|(number, _)| *number)
    }

    /// What became of the messages that `of` names by number and time of publishing.
    pub fn fate(&self, of: impl Fn(u64, Instant) -> bool) -> Fate {
        let named = self.published.iter().filter(|(number, at)| of(*number, *at));
        let sent: BTreeSet<u64> = named.map(|(number, _)| *number).collect();
        let mut times: BTreeMap<u64, u64> = BTreeMap::new();
        for (number, _) in &self.arrived {
            *times.entry(*number).or_default() += 1;
        }
        let arrived: Vec<u64> = self.arrived.iter().map(|(number, _)| *number).collect();
        let of_sent: Vec<u64> =
            arrived.into_iter().filter(|number| sent.contains(number)).collect();
        Fate {
            sent: sent.len(),
            lost: sent.iter().filter(|number| !times.contains_key(number)).count(),
            twice: times.values().filter(|count| **count > 1).count(),
            reordered: of_sent.windows(2).filter(|pair| pair[1] < pair[0]).count(),
            repeats: self.repeats,
        }
    }

    /// The longest time without an arrival that has a part between two moments.
    #[must_use]
    pub fn gap(&self, from: Instant, to: Instant) -> Duration {
        let pairs = self.arrived.windows(2).filter(|pair| pair[1].1 > from && pair[0].1 < to);
        let gaps = pairs.map(|pair| pair[1].1.saturating_duration_since(pair[0].1));
        gaps.max().unwrap_or(Duration::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_lost_doubled_or_late_is_found() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut ledger = Ledger::default();
        for number in 1..=5 {
            ledger.publish(number, at(number));
        }
        for (sequence, number) in [(1, 1), (2, 3), (2, 3), (3, 2), (4, 3)] {
            let payload = format!("{number} ...");
            ledger.take(("w".to_owned(), sequence), payload.as_bytes(), at(sequence * 10));
        }
        ledger.take(("w".to_owned(), 9), b"no number", at(90));
        let found = ledger.fate(|number, _| number < 5);
        let expected = Fate { sent: 4, lost: 1, twice: 1, reordered: 1, repeats: 1 };
        assert_eq!(found, expected);
        assert_eq!(ledger.gap(at(0), at(25)), Duration::from_millis(10));
        assert_eq!((ledger.last_published(), ledger.last_arrived()), (Some(5), Some(3)));
    }
}
