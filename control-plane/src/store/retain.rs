//! Which versions of a document stay when history is trimmed.

use serde::{Deserialize, Serialize};

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
