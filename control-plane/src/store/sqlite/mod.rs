//! Documents in a file, for one process.
//!
//! ```text
//! callers ──▶ writer thread: one transaction per group (BEGIN IMMEDIATE, write-ahead log, synchronous = FULL)
//!        ├──▶ reader thread: a connection of its own, never held up by the writer
//!        ├──▶ look-up thread: another one, for what takes no time and what others wait for, never held up by long reads
//!        └──▶ log thread: copies the write-ahead log into the file once a second, beside the writing
//! <path>       the database        <path>.lock   held by the process that uses it
//! ```
//!
//! A transaction is on the disk before it is acknowledged. A full or read-only disk is an error of
//! the write, and the store goes on when there is room again.

mod archive;
mod commit;
mod connection;
mod errors;
mod lock;
mod migrate;
mod rows;
#[cfg(test)]
mod tests;
mod trim;
mod upkeep;
mod worker;

use std::path::{Path, PathBuf};
use std::time::Duration;

use async_trait::async_trait;
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use rusqlite::Connection;
use tokio::sync::{mpsc, oneshot};

use self::lock::FileLock;
use self::upkeep::Texts;
use self::worker::Worker;
use super::encode::encode_group;
use super::migrate::{Migrations, Plan, apply};
use super::rows::{AuditRow, TokenRow};
use super::upkeep::{Piece, Restored, Rewriter, Upkeep, now, rewritten};
use super::{
    Archive, AuditEntry, AuditQuery, CommitBatch, CommitError, CommitLog, CommitRecord,
    IdempotencyRecord, Snapshot, StoreError, TokenRecord, TokenStore, Version,
};

/// Documents that one step of a rewriting or trimming looks at.
const STEP: usize = 200;

/// A store in a file, or in memory. Dropped or closed, its threads end and the file is free for
/// another process.
pub struct SqliteStore {
    /// None in memory, where there is only one connection.
    beside: Option<Beside>,
    /// Closed last: then it empties the write-ahead log.
    writer: Worker,
    path: Option<PathBuf>,
    supervisor: Supervisor,
}

/// The threads beside the writer.
struct Beside {
    /// Whatever may take long.
    long: Worker,
    /// Single rows, which commits and health wait for.
    short: Worker,
    /// Copies the write-ahead log into the file, which a commit would else wait for.
    log: Worker,
}

impl SqliteStore {
    /// Opens the file, makes it if it is not there, and migrates it.
    ///
    /// # Errors
    /// [`StoreError::Refused`] if another process has it, it is of a newer program or of another
    /// one, or its folder is not there or not for this user; [`StoreError::Unavailable`] if it
    /// cannot be read and written.
    pub async fn open(path: &Path, supervisor: &Supervisor) -> Result<Self, StoreError> {
        Self::open_with(path, &Migrations::default(), supervisor).await
    }

    /// As [`SqliteStore::open`], with migrations of one's own.
    ///
    /// # Errors
    /// As [`SqliteStore::open`].
    pub async fn open_with(
        path: &Path,
        migrations: &Migrations,
        supervisor: &Supervisor,
    ) -> Result<Self, StoreError> {
        let path = connection::real_path(path)?;
        let lock = FileLock::take(&path)?;
        let writer = Worker::start(
            "sqlite-writer",
            connection::open_writer(&path)?,
            Some(lock),
            supervisor,
        )?;
        writer.run(connection::bootstrap).await??;
        let reader =
            |name: &str| Worker::start(name, connection::open_reader(&path)?, None, supervisor);
        let beside = Beside {
            long: reader("sqlite-reader")?,
            short: reader("sqlite-look-up")?,
            log: Worker::start("sqlite-log", connection::open_copier(&path)?, None, supervisor)?,
        };
        let store =
            Self { beside: Some(beside), writer, path: Some(path), supervisor: supervisor.clone() };
        apply(&store, migrations).await?;
        Ok(store)
    }

    /// A store that is gone when it is dropped.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`].
    pub async fn in_memory(supervisor: &Supervisor) -> Result<Self, StoreError> {
        let writer = Worker::start("sqlite-memory", connection::open_memory()?, None, supervisor)?;
        writer.run(connection::bootstrap).await??;
        let store = Self { beside: None, writer, path: None, supervisor: supervisor.clone() };
        apply(&store, &Migrations::default()).await?;
        Ok(store)
    }

    /// What opening the file would migrate. The file is not changed, nor made.
    ///
    /// # Errors
    /// As [`SqliteStore::open`].
    pub async fn plan(path: &Path, migrations: &Migrations) -> Result<Plan, StoreError> {
        match path.exists() {
            true => migrate::look(connection::open_reader(path)?, migrations).await,
            false => migrate::look_at_nothing(migrations).await,
        }
    }

    /// Reads a whole file while another process may be using it, as [`Upkeep::export`] does.
    ///
    /// # Errors
    /// [`StoreError::Refused`] if it is of another schema than this program's; [`StoreError`].
    pub async fn export_beside(
        path: &Path,
        supervisor: &Supervisor,
        pieces: mpsc::Sender<Piece>,
    ) -> Result<(), StoreError> {
        let plan = Self::plan(path, &Migrations::default()).await?;
        if !path.exists() || !plan.pending.is_empty() {
            return Err(StoreError::Refused(format!(
                "{} is no store of schema {}: run `blaze-config migrate` first",
                path.display(),
                plan.target
            )));
        }
        export_apart(connection::open_reader(path)?, supervisor, pieces).await
    }

    async fn write<T, F>(&self, job: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&mut Connection) -> Result<T, StoreError> + Send + 'static,
    {
        self.writer.run(job).await?
    }

    async fn read<T, F>(&self, job: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&mut Connection) -> Result<T, StoreError> + Send + 'static,
    {
        let reader = self.beside.as_ref().map_or(&self.writer, |beside| &beside.long);
        reader.run(job).await?
    }

    /// As [`SqliteStore::read`], for a few rows that are found by a key.
    async fn look_up<T, F>(&self, job: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&mut Connection) -> Result<T, StoreError> + Send + 'static,
    {
        let reader = self.beside.as_ref().map_or(&self.writer, |beside| &beside.short);
        reader.run(job).await?
    }

    async fn rewrite_texts(&self, texts: Texts, make: Rewriter<'_>) -> Result<u64, StoreError> {
        let limit = i64::try_from(STEP).unwrap_or(i64::MAX);
        let (mut place, mut replaced) = (0, 0);
        loop {
            let found = self.read(move |connection| texts.after(connection, place, limit)).await?;
            let Some(last) = found.last() else {
                return Ok(replaced);
            };
            place = last.rowid;
            let mut new = Vec::new();
            for text in found {
                if let Some(made) = rewritten(&text.key, &text.text, make)? {
                    new.push((text.rowid, text.text, made));
                }
            }
            if !new.is_empty() {
                replaced += self.write(move |connection| texts.replace(connection, &new)).await?;
            }
        }
    }
}

/// An export on a thread of its own: it holds its snapshot for as long as the other side takes.
async fn export_apart(
    mut connection: Connection,
    supervisor: &Supervisor,
    pieces: mpsc::Sender<Piece>,
) -> Result<(), StoreError> {
    let (answer, answered) = oneshot::channel();
    let run = move || {
        // Who asked may have gone.
        let _ = answer.send(upkeep::export(&mut connection, &pieces));
    };
    supervisor
        .spawn_thread("sqlite-export", TaskPolicy::MayEnd, run)
        .map_err(|error| StoreError::Unavailable(format!("no thread for the export: {error}")))?;
    answered.await.map_err(|_| StoreError::Unavailable("the export ended".to_owned()))?
}

#[async_trait]
impl CommitLog for SqliteStore {
    fn is_shared(&self) -> bool {
        false
    }

    async fn load(&self) -> Result<Snapshot, StoreError> {
        self.read(commit::load).await
    }

    async fn head(&self) -> Result<u64, StoreError> {
        let head = self.look_up(|connection| connection::head(connection)).await?;
        super::encode::unsigned(head)
    }

    async fn commits_after(&self, revision: u64, limit: usize) -> Result<CommitBatch, StoreError> {
        self.read(move |connection| commit::commits_after(connection, revision, limit)).await
    }

    async fn commit(&self, records: &[CommitRecord]) -> Result<(), CommitError> {
        let group = encode_group(records).map_err(CommitError::NotWritten)?;
        // A job that was not taken was not done; one that was taken answers.
        let done = self.writer.run(move |connection| commit::commit(connection, &group)).await;
        done.map_err(CommitError::NotWritten)?
    }

    async fn foreign_commit(&self) {
        std::future::pending::<()>().await;
    }
}

#[async_trait]
impl Archive for SqliteStore {
    async fn versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError> {
        let key = key.clone();
        self.read(move |connection| archive::versions(connection, &key, below, limit)).await
    }

    async fn documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Document>)>, StoreError> {
        self.read(move |connection| archive::documents_at(connection, revision, until)).await
    }

    async fn trim(&self, floor: u64, keep_versions: u32) -> Result<u64, StoreError> {
        let work = self
            .write(move |connection| trim::raise_floor(connection, floor, keep_versions))
            .await?;
        let now_trimmed = work.now;
        while self
            .write(move |connection| trim::remove_events(connection, now_trimmed.floor))
            .await?
        {}
        for keys in work.keys.chunks(STEP) {
            let keys = keys.to_vec();
            self.write(move |connection| trim::remove_versions(connection, now_trimmed, &keys))
                .await?;
        }
        self.write(move |connection| trim::note(connection, now_trimmed)).await?;
        let clock = now().as_millis();
        let time = self.write(move |connection| trim::expiry(connection, clock)).await?;
        while self.write(move |connection| trim::remove_expired(connection, time)).await? {}
        super::encode::unsigned(now_trimmed.floor)
    }

    async fn expiry_time(&self, clock: Timestamp, most: Duration) -> Result<Timestamp, StoreError> {
        let clock = clock.as_millis();
        let time = self.write(move |connection| trim::move_expiry(connection, clock, most)).await?;
        Ok(Timestamp::from_millis(time))
    }

    async fn tidy(&self) -> Result<(), StoreError> {
        match &self.beside {
            Some(beside) => beside.log.run(|connection| connection::copy_log(connection)).await?,
            None => Ok(()),
        }
    }

    async fn revision_before(&self, time: Timestamp) -> Result<u64, StoreError> {
        self.read(move |connection| archive::revision_before(connection, time)).await
    }

    async fn append_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        let entries: Vec<AuditRow> =
            entries.iter().map(AuditRow::encode).collect::<Result<_, _>>()?;
        self.write(move |connection| archive::append_audit(connection, &entries)).await
    }

    async fn audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, StoreError> {
        let query = query.clone();
        self.read(move |connection| archive::audit(connection, &query)).await
    }

    async fn idempotency(
        &self,
        id: &str,
        now: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        let id = id.to_owned();
        self.look_up(move |connection| archive::idempotency(connection, &id, now)).await
    }
}

#[async_trait]
impl TokenStore for SqliteStore {
    async fn add_token(&self, token: &TokenRecord, audit: &AuditEntry) -> Result<(), StoreError> {
        let (token, audit) = (TokenRow::encode(token)?, AuditRow::encode(audit)?);
        self.write(move |connection| archive::add_token(connection, &token, &audit)).await
    }

    async fn revoke_token(
        &self,
        id: &str,
        time: Timestamp,
        audit: &AuditEntry,
    ) -> Result<bool, StoreError> {
        let (id, audit) = (id.to_owned(), AuditRow::encode(audit)?);
        self.write(move |connection| archive::revoke_token(connection, &id, time, &audit)).await
    }

    async fn tokens(&self, now: Timestamp) -> Result<Vec<TokenRecord>, StoreError> {
        // What was revoked is asked for every few seconds.
        self.look_up(move |connection| archive::tokens(connection, now)).await
    }
}

#[async_trait]
impl Upkeep for SqliteStore {
    async fn export(&self, pieces: mpsc::Sender<Piece>) -> Result<(), StoreError> {
        match &self.path {
            Some(path) => {
                export_apart(connection::open_reader(path)?, &self.supervisor, pieces).await
            }
            None => self.write(move |connection| upkeep::export(connection, &pieces)).await,
        }
    }

    async fn import(&self, pieces: mpsc::Receiver<Piece>) -> Result<Restored, StoreError> {
        self.write(move |connection| upkeep::import(connection, pieces)).await
    }

    async fn rewrite(&self, make: Rewriter<'_>) -> Result<u64, StoreError> {
        let documents = self.rewrite_texts(Texts::Documents, make).await?;
        Ok(documents + self.rewrite_texts(Texts::Versions, make).await?)
    }

    async fn close(&self) {
        if let Some(Beside { long, short, log }) = &self.beside {
            tokio::join!(long.close(), short.close(), log.close());
        }
        self.writer.close().await;
    }
}
