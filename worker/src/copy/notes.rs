//! Small things that must survive besides documents.
//!
//! Both lists are bounded; what goes for want of room is counted. A roll-out that is forgotten could be tried again here,
//! and a place that is forgotten gets a notice that it did not need: both after thousands of newer ones.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use blaze_domain::config::effective::At;

/// Roll-outs that are remembered as failed, at most.
pub const MAX_FAILED: usize = 1_000;
/// Places that are remembered with what they were last told, at most.
pub const MAX_TOLD: usize = 20_000;

/// What a place was last told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Revision of it: nothing older is told again.
    pub revision: u64,
    /// Hash of the configuration; none: that it is gone.
    pub hash: Option<Arc<str>>,
}

/// What must survive besides documents.
#[derive(Clone, Default)]
pub struct Notes {
    /// Oldest first.
    failed: VecDeque<String>,
    told: BTreeMap<At, Told>,
    /// The same, by age: who was told last the longest ago goes first.
    by_age: BTreeSet<(u64, At)>,
    dropped: u64,
}

impl Notes {
    /// Remembers a roll-out, by its `uid`, as failed here. The oldest one goes if there are too many.
    pub fn fail(&mut self, uid: &str) {
        if self.has_failed(uid) {
            return;
        }
        if self.failed.len() >= MAX_FAILED {
            self.failed.pop_front();
            self.dropped += 1;
        }
        self.failed.push_back(uid.to_owned());
    }

    /// Whether a roll-out failed here.
    #[must_use]
    pub fn has_failed(&self, uid: &str) -> bool {
        self.failed.iter().any(|known| known == uid)
    }

    /// Roll-outs that failed here, oldest first.
    pub fn failed(&self) -> impl Iterator<Item = &str> {
        self.failed.iter().map(String::as_str)
    }

    /// Remembers what a place was told. That of the lowest revision goes if there are too many.
    pub fn tell(&mut self, place: At, told: Told) {
        self.forget(&place);
        self.by_age.insert((told.revision, place.clone()));
        self.told.insert(place, told);
        if self.told.len() > MAX_TOLD
            && let Some((_, oldest)) = self.by_age.pop_first()
        {
            self.told.remove(&oldest);
            self.dropped += 1;
        }
    }

    /// What a place was last told.
    #[must_use]
    pub fn told(&self, place: &At) -> Option<&Told> {
        self.told.get(place)
    }

    /// Forgets a place.
    pub fn forget(&mut self, place: &At) {
        if let Some(told) = self.told.remove(place) {
            self.by_age.remove(&(told.revision, place.clone()));
        }
    }

    /// All places with what they were last told.
    pub fn all_told(&self) -> impl Iterator<Item = (&At, &Told)> {
        self.told.iter()
    }

    /// Takes over what another one has beyond this: all failures, and of each place what was told last.
    pub fn merge(&mut self, other: &Self) {
        for uid in other.failed() {
            self.fail(uid);
        }
        for (place, told) in other.all_told() {
            if self.told(place).is_none_or(|known| known.revision < told.revision) {
                self.tell(place.clone(), told.clone());
            }
        }
    }

    /// How many went for want of room, since the start of the process.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
}

/// What was dropped does not count: a copy does not keep it.
impl PartialEq for Notes {
    fn eq(&self, other: &Self) -> bool {
        self.failed == other.failed && self.told == other.told
    }
}

/// The sizes alone: the lists are long.
impl std::fmt::Debug for Notes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Notes")
            .field("failed", &self.failed.len())
            .field("told", &self.told.len())
            .field("dropped", &self.dropped)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(number: usize) -> At {
        At {
            service: Some(format!("s{number}").parse().unwrap()),
            ..At::default()
        }
    }

    fn told(revision: u64) -> Told {
        Told { revision, hash: None }
    }

    #[test]
    fn the_oldest_failures_go_and_are_counted() {
        let mut notes = Notes::default();
        for number in 0..=MAX_FAILED {
            notes.fail(&number.to_string());
            notes.fail(&number.to_string());
        }
        assert_eq!((notes.failed().count(), notes.dropped()), (MAX_FAILED, 1));
        assert!(!notes.has_failed("0") && notes.has_failed("1") && notes.has_failed("1000"));
    }

    #[test]
    fn the_place_that_was_told_the_longest_ago_goes() {
        let mut notes = Notes::default();
        for number in 0..MAX_TOLD {
            notes.tell(place(number), told(number as u64 + 1));
        }
        // The first one is told again, so the second one is the oldest.
        notes.tell(place(0), told(99_999));
        assert_eq!(notes.dropped(), 0);
        notes.tell(place(MAX_TOLD), told(99_999));
        assert_eq!((notes.all_told().count(), notes.dropped()), (MAX_TOLD, 1));
        assert_eq!(notes.told(&place(0)), Some(&told(99_999)));
        assert_eq!(notes.told(&place(1)), None);
        notes.forget(&place(2));
        assert_eq!(notes.told(&place(2)), None);
        assert_eq!(notes.by_age.len(), notes.told.len());
    }

    #[test]
    fn merging_keeps_failures_and_what_was_told_last() {
        let mut one = Notes::default();
        one.fail("a");
        one.tell(place(1), told(5));
        one.tell(place(2), told(5));
        let mut other = Notes::default();
        other.fail("b");
        other.tell(place(1), told(4));
        other.tell(place(2), told(6));
        other.tell(place(3), told(1));
        one.merge(&other);
        assert!(one.has_failed("a") && one.has_failed("b"));
        let revisions: Vec<u64> = one.all_told().map(|(_, told)| told.revision).collect();
        assert_eq!(revisions, [5, 6, 1]);
    }
}
