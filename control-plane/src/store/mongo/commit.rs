//! Writing commits.
//!
//! ```text
//! start ─▶ events ─▶ versions ─▶ documents and the guard ─▶ audit ─▶ answers ─▶ commit (majority, journal)
//!   │ any of these fails: undone, nothing was written                              │ fails: unknown
//!   ▼                                                                              ▼
//! Conflict or NotWritten                              again ─▶ settle: seal the transaction, then look
//! ```
//!
//! Whoever inserts revision n + 1 first has it: `_id` is unique, and a second writer of it conflicts. A writer that slept
//! while its next revision was taken and then trimmed away would find that `_id` free, so the guard makes sure that the
//! floor, which the same snapshot shows, is below.

use std::time::Duration;

use mongodb::ClientSession;
use mongodb::bson::doc;
use mongodb::error::Error;
use mongodb::options::{ReadConcern, WriteConcern};
use tokio::time::{Instant, timeout, timeout_at};

use super::client::QUICK;
use super::errors::{is_write_conflict, not_written, store_error, surely_aborted, write_errors};
use super::rows::{self, FLOOR};
use super::statements::Statements;
use super::{MongoStore, stale};
use crate::store::encode::EncodedCommit;
use crate::store::rows::EventRow;
use crate::store::{CommitError, StoreError};

/// A transaction takes at most this, without finding out what became of it.
const LIMIT: Duration = Duration::from_secs(10);
/// One try to commit.
const TRY: Duration = Duration::from_secs(3);
/// How often a commit is tried before it is settled otherwise.
const TRIES: usize = 3;
/// How long it is tried to find out what became of a transaction.
const SETTLE: Duration = Duration::from_secs(5);
/// Between two of these tries.
const PAUSE: Duration = Duration::from_millis(100);
/// A revision that nobody takes and nobody can write for so long is held by a transaction whose process has gone.
const PATIENCE: Duration = Duration::from_millis(500);

/// A statement that failed.
struct Fault {
    error: CommitError,
    /// Another transaction that is still open is in the way.
    held: bool,
}

impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Self {
            held: is_write_conflict(&error),
            error: not_written(error),
        }
    }
}

impl From<CommitError> for Fault {
    fn from(error: CommitError) -> Self {
        Self { error, held: false }
    }
}

impl MongoStore {
    /// Writes a group in one transaction.
    pub(super) async fn write_group(&self, group: &[EncodedCommit]) -> Result<(), CommitError> {
        let Some(first) = group.first().map(|commit| &commit.event) else {
            return Ok(());
        };
        let statements = Statements::of(group, &self.writer);
        // Always the same session: a transaction on it ends what an earlier one may have left open on the server.
        let mut place = self.session.lock().await;
        let mut session = match place.take() {
            Some(session) => session,
            None => self.start_session().await.map_err(CommitError::NotWritten)?,
        };
        let deadline = Instant::now() + LIMIT;
        let (done, held) = match self.statements_within(deadline, &mut session, statements).await {
            Ok(()) => (self.finish(&mut session, first, deadline).await, false),
            Err(fault) => (Err(fault.error), fault.held),
        };
        *place = Some(session);
        drop(place);
        if self.is_held_for_long(first.revision, held) {
            stale::end_idle_transactions(&self.tables).await;
        }
        done
    }

    async fn start_session(&self) -> Result<ClientSession, StoreError> {
        let start = self.tables.client.start_session().causal_consistency(false);
        super::client::limited(QUICK, start).await
    }

    async fn statements_within(
        &self,
        deadline: Instant,
        session: &mut ClientSession,
        group: Statements,
    ) -> Result<(), Fault> {
        let work = async {
            begin(session).await?;
            self.statements(session, group).await
        };
        let done = timeout_at(deadline, work).await;
        let done = done.unwrap_or_else(|_| {
            let text = format!("MongoDB: the transaction was not done within {} s", LIMIT.as_secs());
            Err(CommitError::NotWritten(StoreError::Unavailable(text)).into())
        });
        if done.is_err() {
            abort(session).await;
        }
        done
    }

    async fn statements(&self, session: &mut ClientSession, group: Statements) -> Result<(), Fault> {
        let tables = &self.tables;
        tables.events.insert_many(group.events).session(&mut *session).await?;
        tables
            .versions
            .insert_many(group.versions)
            .session(&mut *session)
            .await?;
        for (command, count) in group.documents {
            let answer = tables.database.run_command(command).session(&mut *session).await?;
            if let Some(error) = write_errors(&answer) {
                return Err(error.into());
            }
            if rows::integer(&answer, "n").ok() != Some(count) {
                // The guard did not match: the revision was taken long ago.
                return Err(CommitError::Conflict.into());
            }
        }
        if !group.deleted.is_empty() {
            let gone = doc! { "_id": { "$in": group.deleted } };
            tables.documents.delete_many(gone).session(&mut *session).await?;
        }
        if !group.audit.is_empty() {
            tables.audit.insert_many(group.audit).session(&mut *session).await?;
        }
        for command in group.answers {
            let answer = tables.database.run_command(command).session(&mut *session).await?;
            if let Some(error) = write_errors(&answer) {
                return Err(error.into());
            }
        }
        Ok(())
    }

    /// Commits. What is unknown is tried again, then settled.
    async fn finish(
        &self,
        session: &mut ClientSession,
        first: &EventRow,
        deadline: Instant,
    ) -> Result<(), CommitError> {
        let mut because = StoreError::Unavailable("MongoDB: the commit was not answered in time".to_owned());
        for _ in 0..TRIES {
            match timeout(TRY, session.commit_transaction()).await {
                Ok(Ok(())) => return Ok(()),
                Ok(Err(error)) if surely_aborted(&error) => return Err(not_written(error)),
                Ok(Err(error)) => because = store_error(error),
                Err(_) => {}
            }
            if Instant::now() >= deadline {
                break;
            }
            tokio::time::sleep(PAUSE).await;
        }
        self.settle(session, first, because).await
    }

    /// Finds out what became of a transaction.
    async fn settle(
        &self,
        session: &mut ClientSession,
        first: &EventRow,
        because: StoreError,
    ) -> Result<(), CommitError> {
        let until = Instant::now() + SETTLE;
        loop {
            match timeout(QUICK, self.seal(session, first.revision)).await {
                Ok(Ok(Seen::Batch(batch))) if batch == first.batch => return Ok(()),
                Ok(Ok(Seen::Batch(_))) => return Err(CommitError::Conflict),
                Ok(Ok(Seen::Nothing)) => return Err(CommitError::NotWritten(because)),
                // It may have been written, and trimmed away since.
                Ok(Ok(Seen::Trimmed)) => return Err(CommitError::Unknown(because)),
                Ok(Err(_)) | Err(_) => abort(session).await,
            }
            if Instant::now() >= until {
                return Err(CommitError::Unknown(because));
            }
            tokio::time::sleep(PAUSE).await;
        }
    }

    /// A later transaction of the same session: once it is committed by a majority, the one before it is committed or
    /// never will be, and what this one saw is what is true.
    async fn seal(&self, session: &mut ClientSession, revision: i64) -> mongodb::error::Result<Seen> {
        let tables = &self.tables;
        begin(session).await?;
        let event = tables
            .events
            .find_one(doc! { "_id": revision })
            .session(&mut *session)
            .await?;
        let floor = tables
            .documents
            .find_one(doc! { "_id": FLOOR })
            .session(&mut *session)
            .await?;
        let count = doc! { "$inc": { "count": 1_i64 } };
        tables
            .meta
            .update_one(doc! { "_id": "settled" }, count)
            .upsert(true)
            .session(&mut *session)
            .await?;
        session.commit_transaction().await?;
        let floor = floor.and_then(|floor| rows::integer(&floor, FLOOR).ok()).unwrap_or(0);
        let batch = event.and_then(|event| rows::text(&event, "batch").ok());
        Ok(match batch {
            Some(batch) => Seen::Batch(batch),
            None if floor >= revision => Seen::Trimmed,
            None => Seen::Nothing,
        })
    }

    /// Whether this revision has been held by an open transaction for as long as no live process takes.
    fn is_held_for_long(&self, revision: i64, held: bool) -> bool {
        let mut since = self.held.lock();
        if !held {
            *since = None;
            return false;
        }
        match *since {
            Some((other, start)) if other == revision => {
                let long = start.elapsed() >= PATIENCE;
                if long {
                    *since = None;
                }
                long
            }
            _ => {
                *since = Some((revision, Instant::now()));
                false
            }
        }
    }
}

/// What a later transaction sees of an earlier one.
enum Seen {
    Batch(String),
    Nothing,
    Trimmed,
}

pub(super) async fn begin(session: &mut ClientSession) -> mongodb::error::Result<()> {
    let mut durable = WriteConcern::majority();
    durable.journal = Some(true);
    session
        .start_transaction()
        .read_concern(ReadConcern::snapshot())
        .write_concern(durable)
        .max_commit_time(LIMIT)
        .await
}

/// Undoes. If the server does not hear of it, the next transaction of the session undoes it.
async fn abort(session: &mut ClientSession) {
    // An answer changes nothing.
    let _ = timeout(QUICK, session.abort_transaction()).await;
}
