//! What this process has written itself, so that bringing the documents up to date need not read it
//! from the log: that would be much for the database and for this process, while others wait for
//! both.
//!
//! ```text
//! group, written ──▶ goes on where the one before ended? ── no ──▶ begin anew with it
//!                        │ yes                                          ▲
//!                        ▼                                              │
//!                    the last state of each document ── too much ───────┘
//! ```
//!
//! It may lack anything, but never something in the middle: it holds whatever changed above a
//! revision, up to another.

use super::fold::Gathered;
use super::rows::Guard;
use crate::store::encode::EncodedCommit;

#[derive(Debug, Default)]
pub(super) struct Recent {
    /// How often the log had been rewritten before the first of these was written; nothing is kept
    /// before that is known.
    rewrites: Option<i64>,
    /// Changes above this revision, up to the one of `gathered`.
    after: i64,
    gathered: Gathered,
    last: Option<Written>,
}

/// By which a group of commits is known in the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Written {
    pub(super) first: i64,
    pub(super) batch: String,
}

impl Recent {
    /// Forgets what the documents have, and what was written before the log was rewritten for the
    /// last time.
    pub(super) fn look_at(&mut self, guard: Guard) {
        if self.rewrites != Some(guard.rewrites) {
            self.forget();
            self.rewrites = Some(guard.rewrites);
        } else if self.gathered.revision <= guard.folded {
            self.begin_after(self.gathered.revision);
        }
    }

    /// Forgets all of it.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// The newest that it has, if it has anything.
    pub(super) fn last(&self) -> Option<Written> {
        self.last.clone()
    }

    fn begin_after(&mut self, revision: i64) -> Gathered {
        self.after = revision;
        self.last = None;
        let gathered = std::mem::take(&mut self.gathered);
        self.gathered.revision = revision;
        gathered
    }

    /// How often the log was rewritten, as far as is known: to be noted before something is
    /// written.
    pub(super) fn rewrites(&self) -> Option<i64> {
        self.rewrites
    }

    /// Keeps what surely was written, after the log had been rewritten so often.
    pub(super) fn keep(&mut self, group: Vec<EncodedCommit>, rewrites: Option<i64>) {
        let (Some(first), Some(last)) = (group.first(), group.last()) else {
            return;
        };
        let (first, last) = (&first.event, last.event.revision);
        if rewrites.is_none() || rewrites != self.rewrites {
            return;
        }
        if first.revision != self.gathered.revision + 1 || self.gathered.is_full() {
            self.begin_after(first.revision - 1);
        }
        self.last = Some(Written { first: first.revision, batch: first.batch.clone() });
        for mut row in group.into_iter().flat_map(|commit| commit.versions) {
            // The collection has no paths of changes, and a text that was just serialised has room
            // to spare.
            row.paths = String::new();
            row.document.shrink_to_fit();
            self.gathered.add(row);
        }
        self.gathered.revision = last;
    }

    /// Gives away all that is above the revision of the documents, if there is something and
    /// nothing is missing.
    pub(super) fn take_above(&mut self, guard: Guard) -> Option<Gathered> {
        self.look_at(guard);
        if self.after > guard.folded || self.gathered.revision <= guard.folded {
            return None;
        }
        let mut taken = self.begin_after(self.gathered.revision);
        taken.keep_above(guard.folded);
        Some(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::encode::encode_group;
    use crate::store::samples::{commit, record};

    fn group(revisions: std::ops::RangeInclusive<u64>, key: &str) -> Vec<EncodedCommit> {
        let records: Vec<_> = revisions.map(|revision| record(commit(revision, &[key]))).collect();
        encode_group(&records).unwrap()
    }

    fn guard(folded: i64, rewrites: i64) -> Guard {
        Guard { floor: 0, folded, turn: 0, rewrites }
    }

    fn recent() -> Recent {
        let mut recent = Recent::default();
        recent.look_at(guard(0, 0));
        recent
    }

    fn keep(recent: &mut Recent, group: Vec<EncodedCommit>) {
        recent.keep(group, recent.rewrites());
    }

    fn taken(recent: &mut Recent, guard: Guard) -> Option<(i64, Vec<(String, i64)>)> {
        let taken = recent.take_above(guard)?;
        let revision = taken.revision;
        let rows = taken.steps().into_iter().flatten().map(|row| (row.key, row.revision));
        Some((revision, rows.collect()))
    }

    #[test]
    fn the_last_state_of_each_document_is_kept_and_given_away_once() {
        let mut recent = recent();
        keep(&mut recent, group(1..=3, "a"));
        keep(&mut recent, group(4..=5, "b"));
        let (a, b) = ("Node/a".to_owned(), "Node/b".to_owned());
        assert_eq!(taken(&mut recent, guard(0, 0)), Some((5, vec![(a.clone(), 3), (b, 5)])));
        assert_eq!(
            taken(&mut recent, guard(0, 0)),
            None,
            "what failed to be written is read from the log"
        );
        keep(&mut recent, group(6..=7, "a"));
        assert_eq!(taken(&mut recent, guard(4, 0)), None, "5 may be missing");
        assert_eq!(taken(&mut recent, guard(5, 0)), Some((7, vec![(a, 7)])));
    }

    #[test]
    fn nothing_is_given_where_something_may_be_missing() {
        let mut recent = recent();
        keep(&mut recent, group(1..=3, "a"));
        keep(&mut recent, group(5..=6, "b"));
        assert_eq!(taken(&mut recent, guard(0, 0)), None, "another process has written 4");
        assert_eq!(taken(&mut recent, guard(3, 0)), None);
        assert_eq!(taken(&mut recent, guard(4, 0)), Some((6, vec![("Node/b".to_owned(), 6)])));
        assert_eq!(taken(&mut recent, guard(6, 0)), None, "there is nothing new");
    }

    #[test]
    fn what_the_documents_have_is_left_out() {
        let mut recent = recent();
        keep(&mut recent, group(1..=3, "a"));
        keep(&mut recent, group(4..=6, "b"));
        assert_eq!(taken(&mut recent, guard(3, 0)), Some((6, vec![("Node/b".to_owned(), 6)])));
    }

    #[test]
    fn what_was_written_before_the_log_was_rewritten_is_forgotten() {
        let mut recent = Recent::default();
        keep(&mut recent, group(1..=1, "a"));
        assert_eq!(taken(&mut recent, guard(0, 0)), None, "the log may have been rewritten since");
        keep(&mut recent, group(2..=2, "a"));
        assert_eq!(taken(&mut recent, guard(1, 1)), None);
        let before = recent.rewrites();
        recent.look_at(guard(1, 2));
        recent.keep(group(3..=3, "a"), before);
        assert_eq!(
            taken(&mut recent, guard(2, 2)),
            None,
            "it was rewritten between writing and keeping"
        );
        keep(&mut recent, group(4..=4, "a"));
        assert!(taken(&mut recent, guard(3, 2)).is_some());
    }

    #[test]
    fn what_another_process_has_brought_to_the_documents_is_forgotten() {
        let mut recent = recent();
        keep(&mut recent, group(1..=3, "a"));
        keep(&mut recent, group(4..=5, "b"));
        let last = recent.last().unwrap();
        assert_eq!(last.first, 4);
        recent.look_at(guard(4, 0));
        assert_eq!((recent.gathered.len(), recent.last()), (2, Some(last)), "5 is not there yet");
        recent.look_at(guard(5, 0));
        assert_eq!((recent.gathered.len(), recent.last()), (0, None));
        keep(&mut recent, group(6..=6, "a"));
        assert_eq!(taken(&mut recent, guard(5, 0)), Some((6, vec![("Node/a".to_owned(), 6)])));
    }

    #[test]
    fn it_is_bounded() {
        let mut recent = recent();
        for revision in 1..=60_000 {
            keep(&mut recent, group(revision..=revision, &format!("n{revision}")));
            assert!(recent.gathered.len() <= 20_001);
        }
        assert_eq!(taken(&mut recent, guard(0, 0)), None);
        assert!(taken(&mut recent, guard(45_000, 0)).is_some());
    }
}
