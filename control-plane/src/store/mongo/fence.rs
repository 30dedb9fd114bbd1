//! What lets one insertion be a whole commit, although what it rests on may be trimmed away
//! meanwhile.
//!
//! ```text
//! n was the newest at t ──▶ insert n + 1 ──▶ answered before t + 60 s: nobody can have removed another n + 1
//!                                                          └ later: look whether the floor is above it
//! removed are only commits that this process saw at least 120 s ago
//! ```
//!
//! A record of the log begins where the newest one ended, and its first revision is unique: who is
//! second finds it taken. Only where it was taken *and removed again* would a late insertion
//! succeed. So a process inserts only soon after it knew that its revision was free, and removes
//! only long after it saw that it was taken. Times are those that a process measures by itself,
//! from the start of its machine, also while that slept: no two clocks are ever compared, they must
//! only run less than twice as fast as each other.

use std::collections::VecDeque;
use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

/// How old the knowledge may be that a revision is free, when its insertion begins.
const FRESH: Duration = Duration::from_secs(20);
/// How old it may be when the insertion is answered.
const CERTAIN: Duration = Duration::from_secs(60);
/// How long a commit has been seen when it is removed, at least.
const SEEN: Duration = Duration::from_secs(120);
/// Between two notes of what was seen.
const NOTED: Duration = Duration::from_secs(10);

/// Since the start of this machine. A machine that cannot tell makes every proof too old, and
/// removes nothing.
pub(super) fn since_boot() -> Option<Duration> {
    clock_gettime(ClockId::CLOCK_BOOTTIME).ok().map(Duration::from)
}

/// A revision was the newest at a time, or later.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Proof {
    revision: i64,
    at: Duration,
}

impl Proof {
    /// Whether what was inserted on this proof cannot have been removed before, at `now`.
    pub(super) fn holds(self, now: Option<Duration>) -> bool {
        now.and_then(|now| now.checked_sub(self.at)).is_some_and(|age| age <= CERTAIN)
    }
}

/// What one process knows of the newest revision.
#[derive(Debug)]
pub(super) struct Fence {
    newest: Option<Proof>,
    /// [`SEEN`], but for tests.
    patience: Duration,
    /// What was seen, and when; oldest first.
    seen: VecDeque<(Duration, i64)>,
}

impl Default for Fence {
    fn default() -> Self {
        Self::removing_after(SEEN)
    }
}

impl Fence {
    /// One that is in more of a hurry than is safe.
    pub(super) fn removing_after(patience: Duration) -> Self {
        Self { newest: None, patience, seen: VecDeque::new() }
    }

    /// The store was asked at `asked`, and its newest revision was this one, then or later.
    pub(super) fn newest_was(
        &mut self,
        revision: i64,
        asked: Option<Duration>,
        now: Option<Duration>,
    ) {
        let (Some(at), Some(now)) = (asked, now) else { return };
        match &mut self.newest {
            Some(known) if known.revision > revision => {}
            Some(known) if known.revision == revision => known.at = known.at.max(at),
            known => *known = Some(Proof { revision, at }),
        }
        if self.seen.back().is_none_or(|(last, _)| now >= *last + NOTED.min(self.patience)) {
            self.seen.push_back((now, revision));
        }
        // Of those that are old enough, the newest says it all.
        while self.seen.get(1).is_some_and(|(at, _)| *at + self.patience <= now) {
            self.seen.pop_front();
        }
    }

    /// The proof that a revision is free, if it is fresh.
    pub(super) fn is_free(&self, revision: i64, now: Option<Duration>) -> Option<Proof> {
        let proof = self.newest.filter(|proof| proof.revision + 1 == revision)?;
        let age = now?.checked_sub(proof.at)?;
        (age <= FRESH).then_some(proof)
    }

    /// Commits up to this one may be removed, if they are below the floor; 0 for none.
    pub(super) fn removable(&self, now: Option<Duration>) -> i64 {
        let old = |(at, _): &&(Duration, i64)| now.is_some_and(|now| *at + self.patience <= now);
        self.seen.iter().rev().find(old).map_or(0, |(_, revision)| *revision)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Option<Duration> {
        Some(Duration::from_secs(seconds))
    }

    #[test]
    fn a_revision_is_free_only_behind_the_newest_and_only_for_a_while() {
        let mut fence = Fence::default();
        assert_eq!(fence.is_free(1, at(1)), None);
        fence.newest_was(4, at(100), at(101));
        let proof = fence.is_free(5, at(120)).unwrap();
        assert_eq!(fence.is_free(4, at(100)), None);
        assert_eq!(fence.is_free(6, at(100)), None);
        assert_eq!(fence.is_free(5, at(121)), None, "too old");
        assert_eq!(fence.is_free(5, None), None);
        assert!(proof.holds(at(160)));
        assert!(!proof.holds(at(161)) && !proof.holds(None));
        assert!(!proof.holds(at(99)), "a clock that went back proves nothing");
        // An answer that was late says nothing new.
        fence.newest_was(3, at(130), at(130));
        assert_eq!(fence.is_free(4, at(130)), None);
        fence.newest_was(4, at(115), at(131));
        assert!(fence.is_free(5, at(135)).is_some());
    }

    #[test]
    fn only_what_was_seen_long_ago_is_removed() {
        let mut fence = Fence::default();
        for second in 0..1_000_u32 {
            let now = at(u64::from(second));
            fence.newest_was(i64::from(second), now, now);
            let removable = fence.removable(now);
            assert!(removable + 120 <= i64::from(second) || removable == 0, "{second}");
            assert!(removable + 135 >= i64::from(second), "{second}");
            assert!(fence.seen.len() < 20);
        }
        assert_eq!(fence.removable(None), 0);
        assert_eq!(fence.removable(at(5_000)), 990);
    }

    #[test]
    fn an_insertion_that_counts_was_there_before_any_removal() {
        // Worst case, with one clock twice as fast: inserted on a proof of 60 s by the slow clock,
        // 120 s by the fast one.
        assert!(CERTAIN * 2 <= SEEN);
        assert!(FRESH < CERTAIN);
    }
}
