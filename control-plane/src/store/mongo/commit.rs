//! Writing commits.
//!
//! ```text
//! revision free? (fence: known, else asked) ─▶ insert one record (majority, journal) ─▶ in time? ─▶ done
//!                                                 │ taken: Conflict          │ no answer: unknown
//!                                                 ▼                          ▼
//!                                   the record there is another's      insert again: ours now, or taken ─▶ whose is it?
//!
//! too large for one record:
//! start ─▶ records ─▶ changes without room ─▶ commit (majority, journal)
//!   │ any of these fails: undone               │ fails: unknown
//!   ▼                                          ▼
//! Conflict or NotWritten      again ─▶ settle: seal the transaction, then look
//! ```
//!
//! A record begins where the newest one ended, and whoever inserts it first has its revisions:
//! `_id` is unique. See [`super::fence`] for why nobody can find a revision free that was taken and
//! trimmed away.

use std::collections::BTreeMap;
use std::time::Duration;

use mongodb::ClientSession;
use mongodb::bson::{Document, RawDocumentBuf, doc};
use mongodb::error::Error;
use mongodb::options::{ReadConcern, WriteConcern};
use tokio::time::{Instant, timeout, timeout_at};

use super::client::{QUICK, limited};
use super::errors::{
    DUPLICATE_KEY, TOO_SLOW, WRITE_CONFLICT, Wrong, command_code, is_refused, is_write_conflict,
    not_written, store_error, surely_aborted, was_not_sent, write_code,
};
use super::fence::{Proof, since_boot};
use super::rows::{self, FLOOR};
use super::statements::Statements;
use super::{MongoStore, stale};
use crate::store::encode::EncodedCommit;
use crate::store::rows::{EventRow, IdempotencyRow};
use crate::store::{CommitError, StoreError};

/// A commit takes at most this, without finding out what became of it.
const LIMIT: Duration = Duration::from_secs(10);
/// One try to insert or to commit.
const TRY: Duration = Duration::from_secs(3);
/// How often a commit is tried before it is settled otherwise.
const TRIES: usize = 3;
/// How long it is tried to find out what became of a transaction.
const SETTLE: Duration = Duration::from_secs(5);
/// Between two of these tries.
const PAUSE: Duration = Duration::from_millis(100);
/// A revision that nobody takes and nobody can write for so long is held by a transaction whose
/// process has gone.
const PATIENCE: Duration = Duration::from_millis(500);

/// An insertion that takes longer is held up by a transaction that somebody left open, or by the
/// disk.
const HELD: Duration = Duration::from_secs(1);

/// A statement that failed.
struct Fault {
    error: CommitError,
    /// Another transaction that is still open is in the way.
    held: bool,
}

impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Self { held: is_write_conflict(&error), error: not_written(error) }
    }
}

/// What became of one insertion.
enum Tried {
    Written,
    /// There is a record of that revision.
    Taken,
    /// An open transaction is in the way.
    Held,
    /// It surely is not there, and will not be.
    Failed(StoreError),
    /// It may be there, now or later.
    Unknown(StoreError),
}

impl MongoStore {
    /// Writes a group, whole or not at all.
    pub(super) async fn write_group(&self, group: &[EncodedCommit]) -> Result<(), CommitError> {
        let (Some(first), Some(last)) = (group.first(), group.last()) else {
            return Ok(());
        };
        let (first, last) = (&first.event, last.event.revision);
        let proof = self.prove_free(first.revision).await?;
        self.refuse_known_answers(group).await?;
        let begun = since_boot();
        let Statements { mut records, versions } = Statements::of(group, &self.writer);
        match (records.len(), records.pop()) {
            (1, Some(record)) if versions.is_empty() => self.insert(record, first, proof).await?,
            (_, Some(record)) => {
                records.push(record);
                self.write_large(Statements { records, versions }, first, proof).await?;
            }
            (_, None) => {}
        }
        if !proof.holds(since_boot())
            && self.read_floor().await.map_err(CommitError::Unknown)?
                >= first.revision.unsigned_abs()
        {
            // It is below the floor, where nobody looks, or was trimmed already; or it lies under
            // the records of others.
            self.remove_late(first).await;
            return Err(CommitError::Unknown(stood_still()));
        }
        self.fence.lock().newest_was(last, begun, since_boot());
        Ok(())
    }

    /// Removes what was written too late. If that fails, readers leave it out, and trimming removes
    /// it.
    async fn remove_late(&self, first: &EventRow) {
        let tables = self.tables();
        let ours = doc! { "_id": { "$gte": first.revision }, "batch": &first.batch };
        if let Err(error) = limited(QUICK, tables.events.delete_many(ours)).await {
            tracing::warn!(
                %error,
                revision = first.revision,
                "a commit that came too late could not be removed",
            );
        }
    }

    /// Makes sure that a revision comes right behind the newest.
    async fn prove_free(&self, revision: i64) -> Result<Proof, CommitError> {
        if let Some(proof) = self.fence.lock().is_free(revision, since_boot()) {
            return Ok(proof);
        }
        self.read_head().await.map_err(CommitError::NotWritten)?;
        let proof = self.fence.lock().is_free(revision, since_boot());
        proof.ok_or(CommitError::Conflict)
    }

    /// An idempotency key is answered once, until its answer has expired. Whoever else wrote one of
    /// these since it was looked for has taken the revision, too.
    async fn refuse_known_answers(&self, group: &[EncodedCommit]) -> Result<(), CommitError> {
        let rows = group.iter().filter_map(|commit| {
            Some((commit.idempotency.as_ref()?.id.as_str(), commit.event.time))
        });
        let times: BTreeMap<&str, i64> = rows.clone().collect();
        if times.len() < rows.count() {
            return Err(CommitError::Conflict);
        }
        if times.is_empty() {
            return Ok(());
        }
        let ids: Vec<&str> = times.keys().copied().collect();
        let known = self.read_answers(&ids).await.map_err(CommitError::NotWritten)?;
        let valid =
            |row: &IdempotencyRow| times.get(row.id.as_str()).is_some_and(|now| row.expires > *now);
        match known.iter().any(valid) {
            true => Err(CommitError::Conflict),
            false => Ok(()),
        }
    }

    /// Inserts one record, and finds out what became of it.
    async fn insert(
        &self,
        record: Document,
        first: &EventRow,
        proof: Proof,
    ) -> Result<(), CommitError> {
        let until = Instant::now() + LIMIT;
        let command = doc! {
            "insert": "events", "documents": [record],
            "maxTimeMS": i64::try_from(HELD.as_millis()).unwrap_or(i64::MAX),
            "writeConcern": { "w": "majority", "j": true },
        };
        let command = RawDocumentBuf::try_from(&command).map_err(|error| {
            CommitError::NotWritten(StoreError::Refused(format!(
                "MongoDB: the commit cannot be stored: {error}"
            )))
        })?;
        if !proof.holds(since_boot()) {
            return Err(CommitError::NotWritten(stood_still()));
        }
        let because = match self.try_insert(&command).await {
            Tried::Written => return Ok(()),
            Tried::Taken => return Err(CommitError::Conflict),
            Tried::Held => {
                stale::end_idle_transactions(&self.tables()).await;
                return Err(CommitError::Conflict);
            }
            Tried::Failed(error) => return Err(CommitError::NotWritten(error)),
            Tried::Unknown(error) => error,
        };
        // Once more: then it is there, or there is a record, and it can be seen whose.
        while Instant::now() < until {
            tokio::time::sleep(PAUSE).await;
            if !proof.holds(since_boot()) {
                break;
            }
            match self.try_insert(&command).await {
                Tried::Written => return Ok(()),
                Tried::Taken => match self.batch_at(first.revision).await {
                    Ok(Some(batch)) if batch == first.batch => return Ok(()),
                    Ok(Some(_)) => return Err(CommitError::Conflict),
                    Ok(None) | Err(_) => {}
                },
                Tried::Held | Tried::Failed(_) | Tried::Unknown(_) => {}
            }
        }
        Err(CommitError::Unknown(because))
    }

    async fn try_insert(&self, command: &RawDocumentBuf) -> Tried {
        let tables = self.tables();
        let run = tables.database.run_raw_command(command.clone());
        match timeout(TRY, run).await {
            Ok(Ok(answer)) => match write_code(&answer) {
                Some(Wrong::Document(code, _)) if code == DUPLICATE_KEY => Tried::Taken,
                Some(Wrong::Document(code, _)) if [WRITE_CONFLICT, TOO_SLOW].contains(&code) => {
                    Tried::Held
                }
                Some(Wrong::Document(_, text)) => {
                    Tried::Failed(StoreError::Unavailable(format!("MongoDB: {text}")))
                }
                Some(Wrong::Concern(text)) => {
                    Tried::Unknown(StoreError::Unavailable(format!("MongoDB: {text}")))
                }
                None => Tried::Written,
            },
            Ok(Err(error)) if command_code(&error) == Some(TOO_SLOW) => Tried::Held,
            Ok(Err(error)) if was_not_sent(&error) || is_refused(&error) => {
                Tried::Failed(store_error(error))
            }
            Ok(Err(error)) => Tried::Unknown(store_error(error)),
            Err(_) => Tried::Unknown(StoreError::Unavailable(format!(
                "MongoDB: no answer within {} s",
                TRY.as_secs()
            ))),
        }
    }

    /// Which batch has a revision, as no crash can change it any more.
    pub(super) async fn batch_at(&self, revision: i64) -> Result<Option<String>, StoreError> {
        let tables = self.tables();
        // Once a majority has a later write, it has whatever was in the way of the insertion.
        let count = doc! { "$inc": { "count": 1_i64 } };
        let later = tables.meta.update_one(doc! { "_id": "settled" }, count).upsert(true);
        limited(QUICK, later).await?;
        let found = tables.events.find_one(doc! { "_id": revision });
        let found = limited(QUICK, found.projection(doc! { "batch": 1 })).await?;
        found.map(|found| rows::text(&found, "batch")).transpose()
    }

    /// Writes in one transaction what is too large for one record.
    async fn write_large(
        &self,
        statements: Statements,
        first: &EventRow,
        proof: Proof,
    ) -> Result<(), CommitError> {
        // Always the same session: a transaction on it ends what an earlier one may have left open
        // on the server.
        let mut place = self.session.lock().await;
        let mut session = match place.take() {
            Some(session) => session,
            None => self.start_session().await.map_err(CommitError::NotWritten)?,
        };
        let deadline = Instant::now() + LIMIT;
        let (done, held) = match self.statements_within(deadline, &mut session, statements).await {
            Ok(()) if !proof.holds(since_boot()) => {
                abort(&mut session).await;
                (Err(CommitError::NotWritten(stood_still())), false)
            }
            Ok(()) => (self.finish(&mut session, first, deadline).await, false),
            Err(fault) => (Err(fault.error), fault.held),
        };
        *place = Some(session);
        drop(place);
        if self.is_held_for_long(first.revision, held) {
            stale::end_idle_transactions(&self.tables()).await;
        }
        done
    }

    async fn start_session(&self) -> Result<ClientSession, StoreError> {
        let tables = self.tables();
        let start = tables.client.start_session().causal_consistency(false);
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
            let text =
                format!("MongoDB: the transaction was not done within {} s", LIMIT.as_secs());
            Err(Fault {
                error: CommitError::NotWritten(StoreError::Unavailable(text)),
                held: false,
            })
        });
        if done.is_err() {
            abort(session).await;
        }
        done
    }

    async fn statements(
        &self,
        session: &mut ClientSession,
        group: Statements,
    ) -> Result<(), Fault> {
        let tables = self.tables();
        tables.events.insert_many(group.records).session(&mut *session).await?;
        if !group.versions.is_empty() {
            tables.versions.insert_many(group.versions).session(&mut *session).await?;
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
        let mut because =
            StoreError::Unavailable("MongoDB: the commit was not answered in time".to_owned());
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

    /// A later transaction of the same session: once it is committed by a majority, the one before
    /// it is committed or never will be, and what this one saw is what is true.
    async fn seal(
        &self,
        session: &mut ClientSession,
        revision: i64,
    ) -> mongodb::error::Result<Seen> {
        let tables = self.tables();
        begin(session).await?;
        let event = tables.events.find_one(doc! { "_id": revision }).session(&mut *session).await?;
        let floor = tables.documents.find_one(doc! { "_id": FLOOR }).session(&mut *session).await?;
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

    /// Whether this revision has been held by an open transaction for as long as no live process
    /// takes.
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

pub(super) fn stood_still() -> StoreError {
    StoreError::Unavailable("MongoDB: this process stood still meanwhile".to_owned())
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
