//! Bringing the documents up to date with the log, beside the writing.
//!
//! ```text
//! commits above r, up to s ──▶ what each document that they change is at s ──▶ some at a time, each step one transaction
//!                                                                                └ the last one: s in the guard, too
//! loading = documents of r, some of which are newer already, and the commits above r
//! ```
//!
//! However often a document has changed, it is written once. Each read and each step counts up
//! `turn` in the guard, and finds it as the one before has left it: of two processes that are at it
//! one is overtaken, and stops. What it has written stays, and harms nobody: whatever changed above
//! r is taken from the log.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt as _;
use mongodb::bson::{Document, doc};
use tokio::time::{Instant, sleep};

use super::client::{USUAL, limited};
use super::errors::write_error;
use super::fence::since_boot;
use super::read::Part;
use super::rows::{self, Guard};
use super::statements::{RECORD_COMMITS, document_updates};
use super::{MongoStore, collect};
use crate::store::StoreError;
use crate::store::encode::signed;
use crate::store::rows::VersionRow;

/// Between two times that the documents are brought up to date, by whichever process. If another
/// one was at it, this one looks again after as long.
pub(super) const FOLD_PERIOD: Duration = Duration::from_secs(30);
/// How much longer it may take until it hurries: what is behind has to be read, and kept in memory,
/// by whoever starts.
const LATE: Duration = Duration::from_secs(30);
/// Records, and bytes of them, that are read at once.
const RECORDS: usize = 1_000;
const RECORDS_BYTES: i64 = 1024 * 1024;
/// Documents, bytes of them, and bytes of the log that are read before something is written.
const GATHERED: usize = 20_000;
const GATHERED_BYTES: usize = 32 * 1024 * 1024;
const READ: i64 = 256 * 1024 * 1024;
/// Documents, and bytes of them, of one step: writers wait while the database is at it.
const STEP: usize = 100;
const STEP_BYTES: usize = 1024 * 1024;
/// How many times as long as each read and each step the rest after it is.
const REST: u32 = 3;
/// The longest of them.
const LONGEST_REST: Duration = Duration::from_millis(500);
/// Before one that was overtaken looks again, if it cannot wait: longer than what another one that
/// is in a hurry needs between two of its turns.
const AGAIN: std::ops::Range<Duration> = Duration::from_millis(100)..Duration::from_millis(500);
/// Revisions whose records one command removes.
const REMOVED: i64 = 1_000;

/// How much it hurries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pace {
    /// Leaves most of the time to writers, up to a time.
    CalmUntil(Instant),
    Urgent,
}

impl Pace {
    /// Rests after work that began at a time.
    async fn rest(self, begun: Instant) {
        if matches!(self, Self::CalmUntil(until) if Instant::now() < until) {
            sleep(LONGEST_REST.min(begun.elapsed() * REST)).await;
        }
    }
}

/// What documents are at a revision.
#[derive(Debug, Default)]
pub(super) struct Gathered {
    pub(super) revision: i64,
    rows: BTreeMap<String, VersionRow>,
    bytes: usize,
    /// Of the log.
    read: i64,
}

impl Gathered {
    pub(super) fn add(&mut self, row: VersionRow) {
        self.bytes += size(&row);
        if let Some(before) = self.rows.insert(row.key.clone(), row) {
            self.bytes -= size(&before);
        }
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// Leaves out what has not changed since a revision.
    pub(super) fn keep_above(&mut self, revision: i64) {
        self.rows.retain(|_, row| row.revision > revision);
        self.bytes = self.rows.values().map(size).sum();
    }

    pub(super) fn is_full(&self) -> bool {
        self.rows.len() >= GATHERED || self.bytes >= GATHERED_BYTES || self.read >= READ
    }

    /// At least one, so that the revision is noted.
    pub(super) fn steps(self) -> Vec<Vec<VersionRow>> {
        let (mut steps, mut bytes) = (vec![Vec::new()], 0);
        for row in self.rows.into_values() {
            let is_full =
                steps.last().is_some_and(|step: &Vec<_>| step.len() >= STEP) || bytes >= STEP_BYTES;
            if is_full {
                steps.push(Vec::new());
                bytes = 0;
            }
            bytes += size(&row);
            if let Some(step) = steps.last_mut() {
                step.push(row);
            }
        }
        steps
    }
}

fn size(row: &VersionRow) -> usize {
    row.document.len() + row.paths.len() + rows::OVERHEAD_BYTES
}

impl MongoStore {
    /// What can wait: bringing the documents up to date, removing what is below the floor.
    pub(super) async fn tidy_up(&self) -> Result<(), StoreError> {
        let guard = self.read_guard().await?;
        self.recent.lock().look_at(guard);
        let due = *self.folded.lock() + self.fold_period;
        let is_due = Instant::now() >= due;
        let is_quiet = {
            let mut seen = self.turn.lock();
            let is_quiet = *seen == Some(guard.turn);
            if is_due || seen.is_none() {
                *seen = Some(guard.turn);
            }
            is_quiet
        };
        // If the turn has moved since the last look, another process is at it, or was.
        if is_due && is_quiet {
            let head = signed(self.read_head().await?);
            if !self.fold(guard, head, Pace::CalmUntil(due + LATE)).await? {
                *self.turn.lock() = None;
            }
        }
        if is_due {
            *self.folded.lock() = Instant::now();
        }
        self.remove_records(guard.floor).await
    }

    /// Brings the documents to a revision, at least. Whoever is at it without hurry is overtaken.
    pub(super) async fn fold_until(&self, revision: i64) -> Result<Guard, StoreError> {
        let mut turn = None;
        loop {
            let guard = self.read_guard().await?;
            if guard.folded >= revision {
                return Ok(guard);
            }
            // Another one that has overtaken this is waited for while its turn moves.
            if turn.replace(guard.turn).is_none_or(|seen| seen == guard.turn)
                && self.fold(guard, revision, Pace::Urgent).await?
            {
                return self.read_guard().await;
            }
            sleep(rand::random_range(AGAIN)).await;
        }
    }

    /// Brings the documents from those of a guard to a revision; `false` if another one has
    /// overtaken it, or has rewritten them.
    async fn fold(&self, mut guard: Guard, until: i64, pace: Pace) -> Result<bool, StoreError> {
        while guard.folded < until {
            let Some((claimed, gathered)) = self.gather(guard, until, pace).await? else {
                return Ok(false);
            };
            guard = claimed;
            let revision = gathered.revision;
            if revision == guard.folded {
                // There is nothing in the log.
                return Ok(true);
            }
            let mut steps = gathered.steps().into_iter().peekable();
            while let Some(rows) = steps.next() {
                let begun = Instant::now();
                let folded = if steps.peek().is_none() { revision } else { guard.folded };
                match self.step(guard, folded, &rows, pace).await? {
                    Some(next) => guard = next,
                    None => return Ok(false),
                }
                pace.rest(begun).await;
            }
        }
        Ok(true)
    }

    /// What the documents are that changed up to a revision, or up to one before it if there is
    /// much; `None` if another one has overtaken this. The turn is taken before each read, so that
    /// all see who is at it. What this process has written itself is not read.
    async fn gather(
        &self,
        mut guard: Guard,
        until: i64,
        pace: Pace,
    ) -> Result<Option<(Guard, Gathered)>, StoreError> {
        let mut gathered = Gathered { revision: guard.folded, ..Gathered::default() };
        loop {
            let begun = Instant::now();
            match self.step(guard, guard.folded, &[], pace).await? {
                Some(next) => guard = next,
                None => return Ok(None),
            }
            if gathered.revision == guard.folded
                && let Some(recent) = self.take_recent(guard).await?
            {
                return Ok(Some((guard, recent)));
            }
            let part = Part {
                after: gathered.revision,
                records: RECORDS,
                bytes: RECORDS_BYTES,
                whole: false,
            };
            let (records, _) = self.read_records(part).await?;
            let Some(last) = records.last().map(|record| record.last) else {
                return Ok(Some((guard, gathered)));
            };
            for record in records {
                gathered.read += record.bytes();
                let above = gathered.revision;
                record
                    .versions
                    .into_iter()
                    .filter(|version| version.revision > above)
                    .for_each(|version| gathered.add(version));
            }
            gathered.revision = last;
            if gathered.revision >= until || gathered.is_full() {
                return Ok(Some((guard, gathered)));
            }
            pace.rest(begun).await;
        }
    }

    /// What this process has written itself above the documents, if that is all that was written,
    /// and if the log still has it: a database that was set back to an earlier time has not.
    async fn take_recent(&self, guard: Guard) -> Result<Option<Gathered>, StoreError> {
        let Some(last) = self.recent.lock().last() else {
            return Ok(None);
        };
        let is_there = self.batch_at(last.first).await?.as_ref() == Some(&last.batch);
        let mut recent = self.recent.lock();
        if !is_there {
            recent.forget();
        }
        Ok(recent.take_above(guard))
    }

    /// One transaction: the next turn, and documents. Gives the guard as it is then; `None` if it
    /// was another one before.
    async fn step(
        &self,
        guard: Guard,
        folded: i64,
        rows: &[VersionRow],
        pace: Pace,
    ) -> Result<Option<Guard>, StoreError> {
        let turn = guard.turn + 1;
        let mut commands =
            vec![advance(guard.not_folded(), doc! { "turn": turn, "folded": folded })];
        commands.extend(document_updates(rows));
        if !self.guarded(commands).await? {
            return Ok(None);
        }
        if pace != Pace::Urgent {
            *self.turn.lock() = Some(turn);
        }
        Ok(Some(Guard { turn, folded, ..guard }))
    }

    /// Runs commands in one transaction; the first one must find the guard as it was. `false` if it
    /// did not.
    pub(super) async fn guarded(&self, commands: Vec<Document>) -> Result<bool, StoreError> {
        let commands = Arc::new(commands);
        let failed = Arc::new(parking_lot::Mutex::new(None));
        let note = Arc::clone(&failed);
        let done = self
            .in_transaction(move |tables, session| {
                let (commands, note) = (Arc::clone(&commands), Arc::clone(&note));
                async move {
                    for (place, command) in commands.iter().enumerate() {
                        let run = tables.database.run_command(command.clone());
                        let answer = run.session(&mut *session).await?;
                        if let Some(error) = write_error(&answer) {
                            *note.lock() = Some(error);
                            return Ok(false);
                        }
                        if place == 0 && answer.get_i32("n").is_ok_and(|found| found == 0) {
                            return Ok(false);
                        }
                    }
                    Ok(true)
                }
                .boxed()
            })
            .await?;
        let failed = failed.lock().take();
        failed.map_or(Ok(done), Err)
    }

    /// Removes records across a revision under which others lie: they came too late, see
    /// [`super::fence`].
    async fn remove_late_below(&self, revision: i64) -> Result<(), StoreError> {
        let tables = self.tables();
        let across = doc! {
            "_id": { "$lte": revision, "$gt": revision - RECORD_COMMITS },
            "last": { "$gt": revision },
        };
        let events = &tables.events;
        let found = events.find(across).projection(doc! { "last": 1, "batch": 1 });
        let across = collect(found, |found| {
            Ok((
                rows::integer(found, "_id")?,
                rows::integer(found, "last")?,
                rows::text(found, "batch")?,
            ))
        });
        for (first, last, batch) in across.await? {
            let next = events.find_one(doc! { "_id": { "$gt": first, "$lte": last } });
            if limited(USUAL, next.projection(doc! { "_id": 1 })).await?.is_some() {
                limited(USUAL, events.delete_one(doc! { "_id": first, "batch": batch })).await?;
            }
        }
        Ok(())
    }

    /// Removes records that are wholly below the floor, but never the newest one, and only those
    /// that were seen long ago.
    pub(super) async fn remove_records(&self, floor: i64) -> Result<(), StoreError> {
        let removable = self.fence.lock().removable(since_boot()).min(floor);
        if removable <= *self.removed.lock() {
            return Ok(());
        }
        let newest = signed(self.read_head().await?);
        let mut place = 0;
        loop {
            let tables = self.tables();
            let events = &tables.events;
            let oldest = events.find_one(doc! { "_id": { "$gt": place } }).sort(doc! { "_id": 1 });
            let oldest = limited(USUAL, oldest.projection(doc! { "_id": 1 })).await?;
            let oldest = oldest.map(|found| rows::integer(&found, "_id")).transpose()?;
            let Some(oldest) = oldest.filter(|oldest| *oldest <= removable) else {
                break;
            };
            place = removable.min(oldest + REMOVED);
            let gone =
                doc! { "_id": { "$lte": place }, "last": { "$lte": removable.min(newest - 1) } };
            limited(USUAL, events.delete_many(gone)).await?;
        }
        self.remove_late_below(removable).await?;
        let mut removed = self.removed.lock();
        *removed = removable.max(*removed);
        Ok(())
    }
}

/// A command that changes the guard, as long as it is a certain one.
pub(super) fn advance(guard: Document, change: Document) -> Document {
    doc! { "update": "documents", "updates": [{ "q": guard, "u": { "$set": change } }] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(key: &str, revision: i64, bytes: usize) -> VersionRow {
        VersionRow {
            key: key.to_owned(),
            revision,
            position: 0,
            op: "update".to_owned(),
            previous: None,
            time: 0,
            subject: String::new(),
            request_id: String::new(),
            paths: String::new(),
            document: "x".repeat(bytes),
        }
    }

    #[test]
    fn a_document_is_written_once_however_often_it_changed() {
        let mut gathered = Gathered::default();
        for revision in 1..=1_000 {
            gathered.add(row("Node/a", revision, 500));
            gathered.add(row("Node/b", revision, 300));
        }
        assert_eq!(gathered.bytes, 800 + 2 * rows::OVERHEAD_BYTES);
        let steps = gathered.steps();
        assert_eq!(steps.len(), 1);
        assert!(steps[0].iter().all(|row| row.revision == 1_000));
    }

    #[test]
    fn only_the_last_state_of_a_document_is_written() {
        let mut gathered = Gathered::default();
        for (key, revision, op) in [
            ("Node/a", 1, "create"),
            ("Node/b", 1, "create"),
            ("Node/a", 2, "update"),
            ("Node/b", 2, "delete"),
            ("Node/b", 3, "create"),
            ("Node/a", 4, "delete"),
        ] {
            let op = op.to_owned();
            gathered.add(VersionRow { op, ..row(key, revision, 10) });
        }
        let steps = gathered.steps();
        let commands = document_updates(&steps[0]);
        assert_eq!((steps.len(), commands.len()), (1, 2));
        assert_eq!(commands[0].get_array("updates").unwrap().len(), 1);
        assert_eq!(
            commands[1],
            doc! {
                "delete": "documents",
                "deletes": [{ "q": { "_id": { "$in": ["Node/a"] } }, "limit": 0 }],
            }
        );
    }

    #[test]
    fn steps_are_bounded_by_documents_and_by_bytes() {
        let mut gathered = Gathered::default();
        for number in 0..1_050 {
            gathered.add(row(&format!("Node/{number}"), 1, 100));
        }
        let steps = gathered.steps();
        assert_eq!(steps.len(), 11);
        assert!(steps.iter().all(|step| step.len() <= STEP));
        let mut gathered = Gathered::default();
        for number in 0..12 {
            gathered.add(row(&format!("Node/{number}"), 1, 256 * 1024));
        }
        let steps = gathered.steps();
        assert_eq!(steps.iter().map(Vec::len).collect::<Vec<_>>(), [4, 4, 4]);
        for command in steps.iter().flat_map(|step| document_updates(step)) {
            assert!(command.to_vec().unwrap().len() < 8 * 1024 * 1024);
        }
        assert_eq!(Gathered::default().steps(), [Vec::new()], "a revision without changes");
    }

    #[test]
    fn what_is_gathered_is_bounded() {
        let mut gathered = Gathered::default();
        while !gathered.is_full() {
            gathered.add(row(&format!("Node/{}", gathered.rows.len()), 1, 256 * 1024));
        }
        assert!(gathered.rows.len() < 130);
    }
}
