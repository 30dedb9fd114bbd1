//! Bringing the documents up to date with the log, beside the writing.
//!
//! ```text
//! documents of revision r, and commits above r ──▶ one transaction: documents of revision s, and s in the guard, if it was r
//! loading = documents of r, and the commits above r
//! ```
//!
//! Any process may do it at any time; whoever is second finds another r, and has done nothing.

use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt as _;
use mongodb::bson::{Document, doc};
use tokio::time::Instant;

use super::client::{USUAL, limited};
use super::errors::write_error;
use super::fence::since_boot;
use super::read::Part;
use super::rows::{self, Guard};
use super::statements::{RECORD_COMMITS, document_updates};
use super::{MongoStore, collect};
use crate::store::StoreError;
use crate::store::encode::signed;

/// Records that one step takes.
const STEP: usize = 1_000;
/// Steps of one call that is not urgent.
const STEPS: usize = 4;
/// Revisions that the documents may be behind the log, for [`FOLD_PERIOD`].
const BEHIND: i64 = 20_000;
pub(super) const FOLD_PERIOD: Duration = Duration::from_secs(30);
/// Revisions whose records one command removes.
const REMOVED: i64 = 1_000;

impl MongoStore {
    /// What can wait: bringing the documents up to date, removing what is below the floor.
    pub(super) async fn tidy_up(&self) -> Result<(), StoreError> {
        if self.is_time_to_fold().await? {
            for _ in 0..STEPS {
                if !self.fold_once().await? {
                    *self.folded.lock() = Some(Instant::now());
                    break;
                }
            }
        }
        let floor = self.read_floor().await?;
        self.remove_records(signed(floor)).await
    }

    /// Seldom, and many commits together: writers wait while the database is at it, and a document that changed often is
    /// written once.
    async fn is_time_to_fold(&self) -> Result<bool, StoreError> {
        let is_old = self.folded.lock().is_none_or(|last| last.elapsed() >= self.fold_period);
        if is_old {
            return Ok(true);
        }
        let newest = self.fence.lock().newest().unwrap_or(0);
        Ok(newest - self.read_guard().await?.folded > BEHIND)
    }

    /// Brings the documents to a revision, at least.
    pub(super) async fn fold_until(&self, revision: i64) -> Result<Guard, StoreError> {
        loop {
            let guard = self.read_guard().await?;
            if guard.folded >= revision || !self.fold_once().await? {
                return self.read_guard().await;
            }
        }
    }

    /// One step; `false` if there was nothing to do.
    async fn fold_once(&self) -> Result<bool, StoreError> {
        let guard = self.read_guard().await?;
        if self.fence.lock().newest().is_some_and(|newest| newest <= guard.folded) {
            return Ok(false);
        }
        let part = Part {
            after: guard.folded,
            records: STEP,
            whole: false,
        };
        let (records, _) = self.read_records(part).await?;
        let Some(last) = records.last().map(|record| record.last) else {
            return Ok(false);
        };
        let mut versions: Vec<_> = records.into_iter().flat_map(|record| record.versions).collect();
        versions.retain(|version| version.revision > guard.folded);
        let mut commands = vec![advance(guard, doc! { "folded": last })];
        commands.extend(document_updates(&versions));
        self.guarded(commands).await?;
        Ok(true)
    }

    /// Runs commands in one transaction; the first one must find the guard as it was. `false` if it did not.
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

    /// Removes records across a revision under which others lie: they came too late, see [`super::fence`].
    async fn remove_late_below(&self, revision: i64) -> Result<(), StoreError> {
        let across =
            doc! { "_id": { "$lte": revision, "$gt": revision - RECORD_COMMITS }, "last": { "$gt": revision } };
        let events = &self.tables.events;
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

    /// Removes records that are wholly below the floor, but never the newest one, and only those that were seen long ago.
    pub(super) async fn remove_records(&self, floor: i64) -> Result<(), StoreError> {
        let removable = self.fence.lock().removable(since_boot()).min(floor);
        if removable <= *self.removed.lock() {
            return Ok(());
        }
        let newest = signed(self.read_head().await?);
        let events = &self.tables.events;
        let mut place = 0;
        loop {
            let oldest = events
                .find_one(doc! { "_id": { "$gt": place } })
                .sort(doc! { "_id": 1 });
            let oldest = limited(USUAL, oldest.projection(doc! { "_id": 1 })).await?;
            let oldest = oldest.map(|found| rows::integer(&found, "_id")).transpose()?;
            let Some(oldest) = oldest.filter(|oldest| *oldest <= removable) else {
                break;
            };
            place = removable.min(oldest + REMOVED);
            let gone = doc! { "_id": { "$lte": place }, "last": { "$lte": removable.min(newest - 1) } };
            limited(USUAL, events.delete_many(gone)).await?;
        }
        self.remove_late_below(removable).await?;
        let mut removed = self.removed.lock();
        *removed = removable.max(*removed);
        Ok(())
    }
}

/// A command that changes the guard, as long as it is as it was.
pub(super) fn advance(guard: Guard, change: Document) -> Document {
    doc! { "update": "documents", "updates": [{ "q": guard.unchanged(), "u": { "$set": change } }] }
}
