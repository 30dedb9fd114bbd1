//! What a store does for its operator: backup, restore, rewriting, closing.

use std::collections::BTreeMap;

use async_trait::async_trait;
use blaze_domain::config::{Document, Timestamp};
use serde::{Deserialize, Serialize};
use tokio::sync::mpsc;

use super::encode::{document, document_text};
use super::rows::{AuditRow, DocumentRow, IdempotencyRow, TokenRow, VersionRow};
use super::{Store, StoreError};

/// What `restore` adds to the revision, so that no client takes the restored store for the one it
/// knew.
pub const RESTORE_RAISES_BY: u64 = 1_000_000;

/// The first line of a backup: what it is of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BackupHead {
    /// Form of the file: 1.
    pub format: u32,
    /// Which store it was.
    pub store_id: String,
    /// Everything in it was true at this revision.
    pub revision: u64,
    /// Its floor.
    pub floor: u64,
    /// When it was made, RFC 3339.
    pub time: String,
}

/// One line of a backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BackupRow(pub(crate) Row);

/// What stands on the line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Row {
    Document(DocumentRow),
    Version(VersionRow),
    Audit(Box<AuditRow>),
    Idempotency(IdempotencyRow),
    Token(TokenRow),
}

impl Row {
    /// What it counts as.
    pub(crate) fn table(&self) -> &'static str {
        match self {
            Self::Document(_) => "documents",
            Self::Version(_) => "versions",
            Self::Audit(_) => "audit",
            Self::Idempotency(_) => "idempotency",
            Self::Token(_) => "tokens",
        }
    }
}

/// How many rows of each table.
pub type Counts = BTreeMap<String, u64>;

/// A backup on its way out of a store or into one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Piece {
    /// First, once.
    Head(BackupHead),
    /// Then these.
    Row(BackupRow),
    /// Last, once. Without it, the backup is not whole.
    End,
}

/// What a restored store is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restored {
    /// Its new identity.
    pub store_id: String,
    /// Its revision: that of the backup and [`RESTORE_RAISES_BY`]. It is also the floor.
    pub revision: u64,
}

/// Makes the new form of a document; `None` leaves it as it is.
pub type Rewriter<'a> = &'a (dyn Fn(&Document) -> Option<Document> + Sync);

/// A store as its operator knows it.
#[async_trait]
pub trait Upkeep: Send + Sync + 'static {
    /// Sends everything that is true at one revision: documents, versions, audit, tokens, answers
    /// to repeat. Writing goes on meanwhile.
    ///
    /// # Errors
    /// [`StoreError`]; also when nobody takes the pieces any more.
    async fn export(&self, pieces: mpsc::Sender<Piece>) -> Result<(), StoreError>;

    /// Fills an empty store. Nothing of it can be seen before [`Piece::End`] was there.
    ///
    /// # Errors
    /// [`StoreError::Refused`] if the store is not empty or the pieces are not whole;
    /// [`StoreError`].
    async fn import(&self, pieces: mpsc::Receiver<Piece>) -> Result<Restored, StoreError>;

    /// Replaces the form of current documents and of all versions, without a commit: what they mean
    /// must stay the same. Works in small steps and may be done again after a failure. Gives how
    /// many were replaced.
    ///
    /// # Errors
    /// [`StoreError`].
    async fn rewrite(&self, make: Rewriter<'_>) -> Result<u64, StoreError>;

    /// Lets go of files, threads and connections. Whatever comes later is
    /// [`StoreError::Unavailable`].
    async fn close(&self);
}

/// All that a store does, also for its operator.
pub trait FullStore: Store + Upkeep {}
impl<T: Store + Upkeep> FullStore for T {}

/// The new text of a stored document, if it gets one.
pub(crate) fn rewritten(
    key: &str,
    text: &str,
    make: Rewriter<'_>,
) -> Result<Option<String>, StoreError> {
    let key =
        key.parse().map_err(|error| super::encode::corrupt(format_args!("{key:?}: {error}")))?;
    match make(&document(key, text)?) {
        None => Ok(None),
        Some(new) => Ok(Some(document_text(&new)?).filter(|new| new != text)),
    }
}

/// The time of day, to milliseconds; before 1970 it is 1970.
#[must_use]
pub fn now() -> Timestamp {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let millis = since.map_or(0, |since| i64::try_from(since.as_millis()).unwrap_or(i64::MAX));
    Timestamp::from_millis(millis)
}

/// Sends a piece of an export.
#[cfg(feature = "mongodb")]
pub(crate) async fn send(pieces: &mpsc::Sender<Piece>, piece: Piece) -> Result<(), StoreError> {
    pieces.send(piece).await.map_err(|_| gone())
}

/// Why an export ends early.
pub(crate) fn gone() -> StoreError {
    StoreError::Unavailable("the backup is not being written any more".to_owned())
}

/// Why an import ends early.
pub(crate) fn not_whole() -> StoreError {
    StoreError::Refused("the backup ends too early: nothing was restored".to_owned())
}

/// Why an import does not begin.
pub(crate) fn not_empty() -> StoreError {
    StoreError::Refused(
        "a backup is restored into an empty store only: name a new file or database".to_owned(),
    )
}
