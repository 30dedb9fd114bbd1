//! What a store must do. One conformance suite (`store/conformance`) is run against every adapter.
//!
//! ```text
//! CommitLog   what is true: commits in revision order, each whole or not at all
//! Archive     what was: versions of documents, the floor below which commits are gone, audit, answers to repeat
//! TokenStore  tokens that were given out, and which of them are revoked
//! ```

use async_trait::async_trait;
use blaze_domain::config::state::Step;
use blaze_domain::config::{Document, Key, Timestamp};
use std::sync::Arc;
use std::time::Duration;

/// What a change did to a document.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Op {
    /// It is new.
    Create,
    /// It was changed.
    Update,
    /// It is gone.
    Delete,
    /// It was set back to an earlier content (or made again with it).
    Rollback,
}

impl Op {
    /// The word in history and store.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Create => "create",
            Self::Update => "update",
            Self::Delete => "delete",
            Self::Rollback => "rollback",
        }
    }
}

/// One document that a commit changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// How.
    pub op: Op,
    /// What it is from now on; of a deleted one, what it was last.
    pub document: Arc<Document>,
    /// Revision of the version before, if the document existed.
    pub previous: Option<u64>,
    /// JSON pointers to what changed in labels, annotations and spec, sorted.
    pub paths: Vec<String>,
}

impl Change {
    /// What it does to the documents.
    #[must_use]
    pub fn step(&self) -> Step {
        match self.op {
            Op::Delete => Step::Remove(self.document.key.clone()),
            Op::Create | Op::Update | Op::Rollback => Step::Put(Arc::clone(&self.document)),
        }
    }
}

/// One commit: everything that became true with one revision.
#[derive(Debug, Clone, PartialEq)]
pub struct Commit {
    /// Its number: one more than that of the commit before.
    pub revision: u64,
    /// Which transaction brought it: the same for all that were written together.
    pub batch: String,
    /// When, for people.
    pub time: Timestamp,
    /// Whose token.
    pub subject: String,
    /// Which request.
    pub request_id: String,
    /// At least one, each of another key.
    pub changes: Vec<Change>,
}

/// One line of the audit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditEntry {
    /// UUIDv7: in the order of time.
    pub id: String,
    /// When.
    pub time: Timestamp,
    /// Revision of the change; none for what changed nothing.
    pub revision: Option<u64>,
    /// Whose token; empty if none was accepted.
    pub subject: String,
    /// Roles of the token.
    pub roles: Vec<String>,
    /// What was done or tried: `create`, `update`, …
    pub action: String,
    /// Of which document, if of one.
    pub key: Option<Key>,
    /// Whether it was done (`true`) or refused.
    pub allowed: bool,
    /// Error code of a refusal.
    pub code: Option<String>,
    /// JSON pointers to what changed.
    pub paths: Vec<String>,
    /// Which request.
    pub request_id: String,
    /// From where.
    pub address: String,
    /// What a refused token lacked, for people.
    pub detail: Option<String>,
}

/// The first answer to a request with an idempotency key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyRecord {
    /// Hash of subject, path and key.
    pub id: String,
    /// Hash of the body.
    pub body: String,
    /// Until when it is kept.
    pub expires: Timestamp,
    /// Revision of the answer.
    pub revision: u64,
    /// The answer as JSON, secrets redacted.
    pub answer: String,
}

/// A commit with what is written beside it, in the same transaction.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitRecord {
    /// The commit.
    pub commit: Arc<Commit>,
    /// One entry per document changed.
    pub audit: Vec<AuditEntry>,
    /// The answer to repeat.
    pub idempotency: Option<IdempotencyRecord>,
}

/// Everything that is true at one revision, read in one snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Which store this is; another one after a restore.
    pub store_id: String,
    /// The smallest revision that a watch may start after.
    pub floor: u64,
    /// The newest commit; 0 for an empty store.
    pub revision: u64,
    /// All documents.
    pub documents: Vec<Document>,
}

/// Commits after a revision.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitBatch {
    /// Ascending and contiguous; may be fewer than there are.
    pub commits: Vec<Commit>,
    /// The floor, read *after* the commits: if it is above the revision that was asked for, the
    /// commits have a gap.
    pub floor: u64,
}

/// One version of a document.
#[derive(Debug, Clone, PartialEq)]
pub struct Version {
    /// Revision of the commit.
    pub revision: u64,
    /// When.
    pub time: Timestamp,
    /// Whose token.
    pub subject: String,
    /// Which request.
    pub request_id: String,
    /// The change itself; of [`Op::Delete`], `document` is what it was last.
    pub change: Change,
}

/// Which entries of the audit, newest first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AuditQuery {
    /// Of this subject.
    pub subject: Option<String>,
    /// Of this kind, as it is written.
    pub kind: Option<String>,
    /// Of documents of this name.
    pub name: Option<String>,
    /// Of this action.
    pub action: Option<String>,
    /// `true`: what was done; `false`: what was refused.
    pub allowed: Option<bool>,
    /// Not before.
    pub since: Option<Timestamp>,
    /// Before.
    pub until: Option<Timestamp>,
    /// Entries with an id below this one (the last of the page before).
    pub below: Option<String>,
    /// At most.
    pub limit: usize,
}

/// A token that was given out. The text of the token is kept nowhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenRecord {
    /// `jti`.
    pub id: String,
    /// `sub`.
    pub subject: String,
    /// `roles`.
    pub roles: Vec<String>,
    /// `layer`.
    pub layer: Option<String>,
    /// When it was made.
    pub create_time: Timestamp,
    /// `exp`; the record may go then.
    pub expire_time: Timestamp,
    /// When it was revoked.
    pub revoke_time: Option<Timestamp>,
}

/// Why a store did not do what was asked. Reading again may help if [`StoreError::is_transient`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// It cannot be reached, or not in time.
    #[error("the store cannot be reached: {0}")]
    Unavailable(String),
    /// It holds something that this program did not write.
    #[error("the store holds what this program cannot read: {0}")]
    Corrupt(String),
    /// It was made by a newer program, or is used by another one.
    #[error("{0}")]
    Refused(String),
}

impl StoreError {
    /// The same without addresses, paths and names, for those who bring no token.
    #[must_use]
    pub fn told(&self) -> &'static str {
        match self {
            Self::Unavailable(_) => "the store cannot be reached",
            Self::Corrupt(_) | Self::Refused(_) => {
                "the store cannot be used; see the log of the service"
            }
        }
    }

    /// Whether the same may succeed later.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Unavailable(_))
    }
}

/// Why commits were not written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CommitError {
    /// Another process has taken one of the revisions or idempotency records: nothing was written.
    #[error("another process was first")]
    Conflict,
    /// Nothing was written.
    #[error("nothing was written: {0}")]
    NotWritten(StoreError),
    /// All of it was written, or nothing.
    #[error("it is not known whether it was written: {0}")]
    Unknown(StoreError),
}

/// The truth: commits in revision order.
#[async_trait]
pub trait CommitLog: Send + Sync + 'static {
    /// Whether other processes may write to it too. `false`: nobody does while this one lives.
    fn is_shared(&self) -> bool;

    /// A revision such that whoever has read it, and wrote all newer ones, has the newest state
    /// *now*: no other process can have written since, or read what this one has not. `None`: ask
    /// for the [`CommitLog::head`].
    fn alone(&self) -> Option<u64> {
        (!self.is_shared()).then_some(0)
    }

    /// Everything, in one snapshot.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn load(&self) -> Result<Snapshot, StoreError>;

    /// The newest revision that no crash can take back. At least that of every commit that was
    /// acknowledged anywhere before the call.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn head(&self) -> Result<u64, StoreError>;

    /// Commits after a revision, at most `limit` and about 8 MiB of them (at least one if there is
    /// one).
    ///
    /// # Errors
    /// [`StoreError`].
    async fn commits_after(&self, revision: u64, limit: usize) -> Result<CommitBatch, StoreError>;

    /// Writes commits with contiguous revisions, all or none of them, durable before it returns. An
    /// unknown result is settled here, by the batch id, as long as the store can be read.
    ///
    /// # Errors
    /// [`CommitError`].
    async fn commit(&self, records: &[CommitRecord]) -> Result<(), CommitError>;

    /// Returns when another process may have committed; at the latest after 100 ms where the store
    /// cannot tell, and now and then all the same. Never returns where nobody else can write.
    async fn foreign_commit(&self);
}

/// The past, and what is written beside commits.
#[async_trait]
pub trait Archive: Send + Sync + 'static {
    /// Versions of a document, newest first, those with a revision below `below`.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn versions(
        &self,
        key: &Key,
        below: Option<u64>,
        limit: usize,
    ) -> Result<Vec<Version>, StoreError>;

    /// For every document that changed after `revision` and up to `until`: what it was at
    /// `revision`. Exact for revisions from the floor on.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn documents_at(
        &self,
        revision: u64,
        until: u64,
    ) -> Result<Vec<(Key, Option<Document>)>, StoreError>;

    /// Raises the floor to `floor` (never lowers it), then removes commits up to it, and versions
    /// that neither hold at the floor or above, nor are among the newest `keep_versions` of their
    /// document. Gives the floor that now is.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn trim(&self, floor: u64, keep_versions: u32) -> Result<u64, StoreError>;

    /// Moves on the time by which records expire and returns it: `clock`, but at most `most` after
    /// the time before, which another process may have left. At first that is the time of the
    /// newest commit. A clock that is far ahead for a while makes nothing expire at once.
    /// [`Self::trim`] goes by the last one, and by the clock where there is none.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn expiry_time(&self, clock: Timestamp, most: Duration) -> Result<Timestamp, StoreError>;

    /// Does what can wait, in small parts. To be called about once a second; nothing but time is
    /// lost without.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn tidy(&self) -> Result<(), StoreError> {
        Ok(())
    }

    /// The newest revision that is older than a time; 0 if there is none. For trimming by age.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn revision_before(&self, time: Timestamp) -> Result<u64, StoreError>;

    /// Writes what belongs to no commit: refusals, revelations, tokens.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn append_audit(&self, entries: &[AuditEntry]) -> Result<(), StoreError>;

    /// Entries of the audit, newest first.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn audit(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, StoreError>;

    /// The record of an idempotency key that has not expired at `now`.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn idempotency(
        &self,
        id: &str,
        now: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError>;
}

/// Tokens that the service gave out.
#[async_trait]
pub trait TokenStore: Send + Sync + 'static {
    /// Keeps a new one, with its audit entry in the same transaction.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn add_token(&self, token: &TokenRecord, audit: &AuditEntry) -> Result<(), StoreError>;

    /// Revokes one, with its audit entry in the same transaction; `false` if there is none of that
    /// id. Revoking twice keeps the first time. An id that was not given out here can be revoked as
    /// well if `expire_time` is given.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn revoke_token(
        &self,
        id: &str,
        time: Timestamp,
        audit: &AuditEntry,
    ) -> Result<bool, StoreError>;

    /// All that have not expired at `now`, newest first.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn tokens(&self, now: Timestamp) -> Result<Vec<TokenRecord>, StoreError>;
}

/// All that a store does.
pub trait Store: CommitLog + Archive + TokenStore {}
impl<T: CommitLog + Archive + TokenStore> Store for T {}
