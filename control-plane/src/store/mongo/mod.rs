//! Documents in a MongoDB replica set, for any number of processes.
//!
//! ```text
//! events      the log: one record per group of commits, _id = its first revision (the fence between writers), with their
//!             changes, audit entries and answers to repeat
//! documents   one record per document, _id = key: what was at revision `folded`, or later; and `floor`, the guard of the
//!             log
//! versions    history below the floor, one record per change, _id = key@revision; and changes that a record of the log
//!             had no room for
//! audit, idempotency   of commits below the floor, and of what was no commit; removed by the server when they expire
//! tokens      removed by the server when they expire
//! meta        store: identity, min_version · members: who uses it · lease: who migrates · trimmed · settled
//! migrations  which steps are done
//! ```
//!
//! Writing is the insertion of one record, acknowledged when a majority of the members has it in
//! its journal; all else follows beside it (`fold`) or when history is trimmed (`trim`). No process
//! leads. Documents are JSON texts: the database looks at no key or value of a user's.

mod archive;
mod client;
mod commit;
mod errors;
mod fence;
mod fold;
mod follow;
mod members;
mod migrate;
mod read;
mod recent;
mod rows;
mod stale;
mod statements;
mod transaction;
mod trim;
mod upkeep;

use std::future::IntoFuture;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use blaze_domain::config::{Document as Config, Key, Timestamp};
use blaze_domain::node_file::MongoSection;
use blaze_runtime::pause;
use futures::TryStreamExt as _;
use mongodb::bson::Document;
use mongodb::{ClientSession, Cursor};
use tokio::sync::mpsc;
use tokio::time::Instant;

pub use self::client::check_uri;
use self::client::{Connection, Tables, USUAL, limited_steps};
use self::errors::store_error;
use self::fence::Fence;
use self::follow::Stream;
use self::members::Members;
use self::recent::Recent;
use super::encode::encode_group;
use super::migrate::{Migrations, Plan};
use super::upkeep::{Piece, Restored, Rewriter, Upkeep};
use super::{
    Archive, AuditEntry, AuditQuery, CommitBatch, CommitError, CommitLog, CommitRecord,
    IdempotencyRecord, Snapshot, StoreError, TokenRecord, TokenStore, Version,
};

/// Between two looks at the file of the password.
const PASSWORD_LOOK: Duration = Duration::from_secs(1);
/// Of a record, before one was read.
const USUAL_RECORD_BYTES: i64 = 16 * 1024;

/// A store in a database of a replica set.
pub struct MongoStore {
    connection: Arc<Connection>,
    /// Which opening of the store this is; marks its commits, so that it need not be told of them.
    writer: String,
    /// Itself and others; none before it is open.
    members: Option<Members>,
    /// The newest revision of commits of which it is not known whether they were written.
    doubt: AtomicU64,
    /// What is known of the newest revision.
    fence: parking_lot::Mutex<Fence>,
    /// When the documents were last brought up to date with the log, or the store was opened; and
    /// how long that is left.
    folded: parking_lot::Mutex<Instant>,
    fold_period: Duration,
    /// The guard's turn when that was last looked at, or after the last step of this process that
    /// was in no hurry.
    turn: parking_lot::Mutex<Option<i64>>,
    /// How large the records were that were read last, on average.
    record_bytes: AtomicI64,
    /// What was written and is not in the documents.
    recent: parking_lot::Mutex<Recent>,
    /// Records up to this revision were removed already, if they could be.
    removed: parking_lot::Mutex<i64>,
    /// The session of large commits; none before the first one, and while one is under way.
    session: tokio::sync::Mutex<Option<ClientSession>>,
    /// Commits of others.
    stream: tokio::sync::Mutex<Option<Stream>>,
    /// A revision that could not be written because an open transaction holds it, and since when.
    held: parking_lot::Mutex<Option<(i64, Instant)>>,
}

impl MongoStore {
    /// Connects to the replica set, and migrates the database.
    ///
    /// # Errors
    /// [`StoreError::Refused`] for a server without transactions, a wrong password, a database of a
    /// newer program; [`StoreError::Unavailable`] if no primary answers.
    pub async fn open(section: &MongoSection) -> Result<Self, StoreError> {
        Self::open_with(section, &Migrations::default()).await
    }

    /// As [`MongoStore::open`], with migrations of one's own.
    ///
    /// # Errors
    /// As [`MongoStore::open`].
    pub async fn open_with(
        section: &MongoSection,
        migrations: &Migrations,
    ) -> Result<Self, StoreError> {
        let mut store = Self::connect(section).await?;
        store.migrate(migrations).await?;
        store.members = Some(Members::join(&store.connection, &store.writer).await?);
        Ok(store)
    }

    /// Removes records below the floor at once, where others are sure not to be late, and brings
    /// the documents up to date at each tidying: for tests.
    #[doc(hidden)]
    #[must_use]
    pub fn in_a_hurry(self) -> Self {
        *self.fence.lock() = Fence::removing_after(Duration::ZERO);
        Self { fold_period: Duration::ZERO, ..self }
    }

    /// How many records the log has: for tests.
    ///
    /// # Errors
    /// [`StoreError`].
    #[doc(hidden)]
    pub async fn records(&self) -> Result<u64, StoreError> {
        client::limited(USUAL, self.tables().events.count_documents(mongodb::bson::doc! {})).await
    }

    /// What opening the database would migrate. Nothing is changed.
    ///
    /// # Errors
    /// As [`MongoStore::open`].
    pub async fn plan(section: &MongoSection, migrations: &Migrations) -> Result<Plan, StoreError> {
        let store = Self::connect(section).await?;
        let plan = store.plan_of(migrations).await;
        store.close().await;
        plan
    }

    /// Reads a whole database while other processes use it, as [`Upkeep::export`] does.
    ///
    /// # Errors
    /// [`StoreError::Refused`] if it is of another schema than this program's; [`StoreError`].
    pub async fn export_beside(
        section: &MongoSection,
        pieces: mpsc::Sender<Piece>,
    ) -> Result<(), StoreError> {
        let store = Self::connect(section).await?;
        let plan = store.plan_of(&Migrations::default()).await?;
        let done = match plan.pending.is_empty() {
            true => store.send_all(&pieces).await,
            false => Err(StoreError::Refused(format!(
                "{} is no store of schema {}: run `blaze-config migrate` first",
                section.database, plan.target
            ))),
        };
        store.close().await;
        done
    }

    /// Reads what other processes reckon with this one to read.
    async fn as_member<T>(
        &self,
        read: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, StoreError> {
        let joined = self.admitted().await?;
        let found = read.await?;
        match self.is_still_admitted(joined) {
            true => Ok(found),
            false => Err(commit::stood_still()),
        }
    }

    /// Waits until other processes reckon with this one.
    async fn admitted(&self) -> Result<u64, StoreError> {
        match &self.members {
            Some(members) => members.admitted().await,
            None => Ok(0),
        }
    }

    fn is_still_admitted(&self, joined: u64) -> bool {
        self.members.as_ref().is_none_or(|members| members.is_still(joined))
    }

    /// The collections, as they are reached now. Whoever works with a session takes them once.
    fn tables(&self) -> Arc<Tables> {
        self.connection.tables()
    }

    /// Connects anew whenever the file of the password holds another one, for ever. Until the
    /// server takes that, the connections of before serve.
    pub async fn follow_password(&self) {
        let mut told = None;
        loop {
            pause(PASSWORD_LOOK).await;
            match self.connection.connect_anew().await {
                Ok(None) => told = None,
                Ok(Some(tables)) => {
                    {
                        // A session is of the client that made it.
                        let mut session = self.session.lock().await;
                        self.connection.replace(tables);
                        *session = None;
                    }
                    // It would keep the client of before.
                    self.stream.lock().await.take();
                    tracing::info!("connected to MongoDB with another password");
                }
                Err(error) => {
                    // Not by its text: that of a server that is away changes from look to look.
                    let kind = std::mem::discriminant(&error);
                    if told.replace(kind) != Some(kind) {
                        tracing::warn!(
                            %error,
                            "the password of MongoDB that the file holds is not used",
                        );
                    }
                }
            }
        }
    }

    async fn connect(section: &MongoSection) -> Result<Self, StoreError> {
        Ok(Self {
            connection: Arc::new(Connection::open(section).await?),
            writer: uuid::Uuid::now_v7().to_string(),
            members: None,
            doubt: AtomicU64::new(0),
            fence: parking_lot::Mutex::default(),
            folded: parking_lot::Mutex::new(Instant::now()),
            fold_period: fold::FOLD_PERIOD,
            turn: parking_lot::Mutex::default(),
            record_bytes: AtomicI64::new(USUAL_RECORD_BYTES),
            recent: parking_lot::Mutex::default(),
            removed: parking_lot::Mutex::default(),
            session: tokio::sync::Mutex::new(None),
            stream: tokio::sync::Mutex::new(None),
            held: parking_lot::Mutex::new(None),
        })
    }
}

/// Reads all that a query finds.
async fn collect<T>(
    find: impl IntoFuture<Output = mongodb::error::Result<Cursor<Document>>>,
    read: impl FnMut(&Document) -> Result<T, StoreError>,
) -> Result<Vec<T>, StoreError> {
    collect_within(USUAL, find, read).await
}

/// As [`collect`], with a limit of its own.
async fn collect_within<T>(
    limit: Duration,
    find: impl IntoFuture<Output = mongodb::error::Result<Cursor<Document>>>,
    mut read: impl FnMut(&Document) -> Result<T, StoreError>,
) -> Result<Vec<T>, StoreError> {
    limited_steps(limit, async {
        let mut cursor = find.into_future().await.map_err(store_error)?;
        let mut all = Vec::new();
        while let Some(found) = cursor.try_next().await.map_err(store_error)? {
            all.push(read(&found)?);
        }
        Ok(all)
    })
    .await
}

#[async_trait]
impl CommitLog for MongoStore {
    fn is_shared(&self) -> bool {
        true
    }

    async fn load(&self) -> Result<Snapshot, StoreError> {
        self.as_member(self.read_all()).await
    }

    fn alone(&self) -> Option<u64> {
        let above = self.members.as_ref().and_then(Members::alone)?;
        Some(above.max(self.doubt.load(Ordering::Acquire)))
    }

    async fn head(&self) -> Result<u64, StoreError> {
        self.as_member(self.read_head()).await
    }

    async fn commits_after(&self, revision: u64, limit: usize) -> Result<CommitBatch, StoreError> {
        self.as_member(self.read_commits(revision, limit)).await
    }

    async fn commit(&self, records: &[CommitRecord]) -> Result<(), CommitError> {
        let group = encode_group(records).map_err(CommitError::NotWritten)?;
        let joined = self.admitted().await.map_err(CommitError::NotWritten)?;
        let rewrites = self.recent.lock().rewrites();
        let done = match self.write_group(&group).await {
            // Another process may have thought that it is alone, and answered reads without this.
            Ok(()) if !self.is_still_admitted(joined) => {
                Err(CommitError::Unknown(commit::stood_still()))
            }
            done => done,
        };
        match (&done, group.last()) {
            (Ok(()), _) => self.recent.lock().keep(group, rewrites),
            (Err(CommitError::Unknown(_)), Some(last)) => {
                // Until these revisions are taken, memory may lack them.
                self.doubt.fetch_max(last.event.revision.unsigned_abs(), Ordering::AcqRel);
            }
            (Err(_), _) => {}
        }
        done
    }

    async fn foreign_commit(&self) {
        self.wait_for_others().await;
    }
}

#[async_trait]
impl Archive for MongoStore {
    async fn versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError> {
        self.read_versions(key, below, limit).await
    }

    async fn documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Config>)>, StoreError> {
        self.read_documents_at(revision, until).await
    }

    async fn trim(&self, floor: u64, keep_versions: u32) -> Result<u64, StoreError> {
        self.trim_to(floor, keep_versions).await
    }

    async fn expiry_time(&self, clock: Timestamp, most: Duration) -> Result<Timestamp, StoreError> {
        self.move_expiry(clock.as_millis(), most).await.map(Timestamp::from_millis)
    }

    async fn revision_before(&self, time: Timestamp) -> Result<u64, StoreError> {
        self.find_revision_before(time).await
    }

    async fn append_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        self.write_audit(entries).await
    }

    async fn audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, StoreError> {
        self.read_audit(query).await
    }

    async fn tidy(&self) -> Result<(), StoreError> {
        self.tidy_up().await
    }

    async fn idempotency(
        &self,
        id: &str,
        now: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        self.read_answer(id, now).await
    }
}

#[async_trait]
impl TokenStore for MongoStore {
    async fn add_token(&self, token: &TokenRecord, audit: &AuditEntry) -> Result<(), StoreError> {
        self.write_token(token, audit).await
    }

    async fn revoke_token(
        &self,
        id: &str,
        time: Timestamp,
        audit: &AuditEntry,
    ) -> Result<bool, StoreError> {
        self.write_revocation(id, time, audit).await
    }

    async fn tokens(&self, now: Timestamp) -> Result<Vec<TokenRecord>, StoreError> {
        self.read_tokens(now).await
    }
}

#[async_trait]
impl Upkeep for MongoStore {
    async fn export(&self, pieces: mpsc::Sender<Piece>) -> Result<(), StoreError> {
        self.send_all(&pieces).await
    }

    async fn import(&self, pieces: mpsc::Receiver<Piece>) -> Result<Restored, StoreError> {
        self.receive_all(pieces).await
    }

    async fn rewrite(&self, make: Rewriter<'_>) -> Result<u64, StoreError> {
        self.rewrite_all(make, &|| Box::pin(std::future::ready(Ok(())))).await
    }

    async fn close(&self) {
        if let Some(members) = &self.members {
            members.leave().await;
        }
        // Both hold on to the connection.
        self.stream.lock().await.take();
        self.session.lock().await.take();
        self.tables().client.clone().shutdown().immediate(true).await;
    }
}
