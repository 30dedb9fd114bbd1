//! Which versions of a document stay when history is trimmed.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The time by which records expire, in ms: `clock`, but at most `most` after the one before.
pub(crate) fn expiry_time(clock: i64, before: Option<i64>, most: Duration) -> i64 {
    let most = i64::try_from(most.as_millis()).unwrap_or(i64::MAX);
    before.map_or(clock, |before| clock.min(before.saturating_add(most)))
}

/// How far history was trimmed: a document is looked at again only when it may have versions to
/// spare since then.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct Trimmed {
    /// The floor then.
    pub(crate) floor: i64,
    /// The newest revision then.
    pub(crate) head: i64,
    /// How many versions of each document were kept.
    pub(crate) keep: u32,
}

impl Trimmed {
    /// Ranges of revisions (above, up to) such that documents without a version in one of them have
    /// none to spare now that they did not have before.
    pub(crate) fn ranges_until(self, now: Self) -> Vec<(i64, i64)> {
        if now.keep != self.keep {
            return vec![(-1, now.head)];
        }
        // Below a higher floor another version holds; with a new version, the oldest of those kept
        // is one too many.
        let ranges = [(self.floor, now.floor), (self.head, now.head)];
        ranges.into_iter().filter(|(above, until)| above < until).collect()
    }
}

/// The revisions of versions that go: those that neither hold at `floor` or above, nor are among
/// the newest `keep`. `revisions` are those of one document, newest first.
pub(crate) fn to_spare(revisions: &[i64], floor: i64, keep: u32) -> Vec<i64> {
    let holding = revisions.iter().position(|revision| *revision <= floor);
    let kept = usize::try_from(keep).unwrap_or(usize::MAX);
    let after = |place: usize| {
        revisions.get(place.saturating_add(1).max(kept)..).unwrap_or_default().to_vec()
    };
    holding.map(after).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_holds_at_the_floor_stays() {
        let revisions = [9, 7, 5, 3, 1];
        assert_eq!(to_spare(&revisions, 6, 0), [3, 1]);
        assert_eq!(to_spare(&revisions, 5, 0), [3, 1]);
        assert_eq!(to_spare(&revisions, 6, 4), [1]);
        assert_eq!(to_spare(&revisions, 6, 5), [0_i64; 0]);
        assert_eq!(to_spare(&revisions, 0, 0), [0_i64; 0]);
        assert_eq!(to_spare(&revisions, 99, 1), [7, 5, 3, 1]);
        assert_eq!(to_spare(&revisions, 99, u32::MAX), [0_i64; 0]);
        assert_eq!(to_spare(&[], 5, 0), [0_i64; 0]);
    }

    proptest! {
        #[test]
        fn each_revision_from_the_floor_on_finds_its_version(
            mut revisions in prop::collection::btree_set(1_i64..100, 0..20)
                .prop_map(|set| set.into_iter().collect::<Vec<_>>()),
            floor in 0_i64..110,
            keep in 0_u32..6,
        ) {
            revisions.reverse();
            let gone = to_spare(&revisions, floor, keep);
            let left: Vec<i64> =
                revisions.iter().copied().filter(|revision| !gone.contains(revision)).collect();
            for at in floor..110 {
                let holds = |all: &[i64]| all.iter().copied().find(|revision| *revision <= at);
                prop_assert_eq!(holds(&left), holds(&revisions));
            }
            let newest = revisions.len().min(usize::try_from(keep).unwrap());
            prop_assert_eq!(&left[..newest], &revisions[..newest]);
        }
    }

    #[test]
    fn a_clock_that_leaps_ahead_is_followed_step_by_step() {
        let step = Duration::from_millis(10);
        assert_eq!(expiry_time(5_000, None, step), 5_000);
        assert_eq!(expiry_time(5_000, Some(100), step), 110);
        assert_eq!(expiry_time(105, Some(100), step), 105);
        assert_eq!(expiry_time(50, Some(100), step), 50, "it was ahead, and is right again");
        assert_eq!(expiry_time(i64::MAX, Some(i64::MAX), Duration::MAX), i64::MAX);
    }

    #[test]
    fn only_documents_that_changed_are_looked_at_again() {
        let then = Trimmed { floor: 10, head: 50, keep: 3 };
        assert!(then.ranges_until(then).is_empty());
        assert_eq!(
            then.ranges_until(Trimmed { floor: 20, head: 60, keep: 3 }),
            [(10, 20), (50, 60)]
        );
        assert_eq!(then.ranges_until(Trimmed { floor: 10, head: 60, keep: 3 }), [(50, 60)]);
        assert_eq!(then.ranges_until(Trimmed { keep: 2, ..then }), [(-1, 50)]);
    }
}
