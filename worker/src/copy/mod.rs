//! The copy of the layer's view that outlives the process: a local database and a last-known-good file.
//!
//! ```text
//!                      ┌─[newest state, coalesced]─▶ writer ──▶ SqliteCopy | MongoCopy      (local database)
//! Replica ──▶ Copies ──┤
//!                      └─[newest state, coalesced]─▶ writer ──▶ FileCopy                    (last-known-good file)
//!
//! at the start:  local database, else last-known-good file  ([`choose`]), else mounted file  ([`defaults`])
//! later:         a copy that could not be read at the start ──[Found]──▶ engine, before anything is written there
//! ```
//!
//! A copy is never replaced by an older state of the same store: what was read in time may be older than what was not.
//!
//! A write is all or nothing: whoever dies in the middle of it leaves the old content or the new one, whole. Serving never
//! waits for a write. A file that cannot be read is never written over: the first write moves it aside. In MongoDB a copy that
//! is broken gives way, and one of a newer format stays and is not written.
//!
//! # Secrets at rest
//! In each copy alike, the text of a secret is there only encrypted under `worker.key_file`. Without such a key the texts
//! are left out and the versions kept ([`Vault`]): the configuration has the same hash, and the worker asks the main
//! service for everything again to have the texts ([`Loaded::lacks_secrets`]).

mod aside;
#[cfg(test)]
mod conformance;
mod copies;
pub mod defaults;
mod error;
#[cfg(test)]
pub(crate) mod fake;
mod file;
mod file_format;
mod json;
#[cfg(test)]
mod kill_tests;
#[cfg(feature = "mongodb")]
mod mongo;
#[cfg(feature = "mongodb")]
pub(crate) mod mongo_client;
#[cfg(feature = "mongodb")]
mod mongo_rows;
mod notes;
mod progress;
#[cfg(test)]
mod samples;
mod slot;
mod sqlite;
mod sqlite_database;
mod start;
mod steps;
mod vault;

use std::fmt;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::LayerName;
use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, Key, Timestamp};

pub use copies::{Changed, Copies, Counts, Found, Target, Update};
pub use error::CopyError;
pub use file::{FILE_NAME, FileCopy};
pub use json::{FormError, document_from_json};
#[cfg(feature = "mongodb")]
pub use mongo::MongoCopy;
pub use notes::{MAX_FAILED, MAX_TOLD, Notes, Told};
pub use sqlite::{DATABASE_NAME, SqliteCopy};
pub use start::{DATABASE_LIMIT, Problem, Start, choose};
pub use vault::Vault;

/// How far a copy is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Position {
    /// Which store of a main service the documents are from.
    pub store_id: String,
    /// Whose view it is.
    pub layer: LayerName,
    /// Revision of the last commit that is in it.
    pub revision: u64,
    /// When the worker last knew itself in sync with the main service.
    pub as_of: Timestamp,
}

impl Position {
    /// Whether this one is to be preferred: of one store the later revision, of different stores the later time.
    #[must_use]
    pub fn is_newer_than(&self, other: &Self) -> bool {
        if self.store_id == other.store_id {
            (self.revision, self.as_of) > (other.revision, other.as_of)
        } else {
            self.as_of > other.as_of
        }
    }
}

/// What a copy holds.
#[derive(Clone, PartialEq)]
pub struct Loaded {
    /// How far it is.
    pub position: Position,
    /// The documents of the layer's view, in the order of their keys.
    pub documents: Vec<Arc<Document>>,
    /// What must survive besides.
    pub notes: Arc<Notes>,
}

impl Loaded {
    /// Whether the text of a secret is not there: it was written without a key, or under another one. Who serves from this
    /// asks the main service for a whole snapshot, not for what is new.
    #[must_use]
    pub fn lacks_secrets(&self) -> bool {
        self.documents.iter().any(|document| {
            let status = document.status.as_ref();
            lacks_text(&document.spec) || status.is_some_and(lacks_text)
        })
    }
}

/// Whether a secret is there without its text.
pub(crate) fn lacks_text(value: &serde_json::Value) -> bool {
    let mut lacks = false;
    secret::walk(value, &mut |_, found| {
        lacks |= matches!(Secret::of(found), Some(Ok(Secret::Redacted { .. })));
    });
    lacks
}

/// Without the documents, for they may hold texts of secrets.
impl fmt::Debug for Loaded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Loaded")
            .field("position", &self.position)
            .field("documents", &self.documents.len())
            .field("notes", &self.notes)
            .finish()
    }
}

/// One place that keeps a copy. Every call may be made again without harm.
#[async_trait]
pub trait LocalCopy: Send + Sync {
    /// Reads everything; `None` where nothing was written yet. Never changes what is there.
    ///
    /// # Errors
    /// [`CopyError`].
    async fn load(&self) -> Result<Option<Loaded>, CopyError>;

    /// Makes this the content, whatever was there before but a later state of the same store.
    ///
    /// # Errors
    /// [`CopyError::Newer`] for that one; else [`CopyError`]: the old content is still there, or, where the answer was lost, the new one.
    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError>;

    /// Takes over one or many commits at once: documents that are new or changed, and those that are gone. Notes that are
    /// not given stay as they are.
    ///
    /// # Errors
    /// [`CopyError::Behind`] if there is nothing of this store to go on from, or something newer: then [`Self::replace`].
    /// Else as there.
    async fn advance(
        &self,
        position: &Position,
        puts: &[Arc<Document>],
        removes: &[Key],
        notes: Option<&Notes>,
    ) -> Result<(), CopyError>;

    /// What it is, for people: kind and place, no password.
    fn describe(&self) -> String;

    /// Whether [`Self::advance`] costs as much as [`Self::replace`], so that whoever has everything at hand gives everything.
    fn writes_whole(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use blaze_domain::config::Timestamp;

    use super::*;

    #[test]
    fn of_one_store_the_revision_counts_and_of_two_the_time() {
        let at = |store_id: &str, revision, as_of| Position {
            store_id: store_id.to_owned(),
            layer: "edge".parse().unwrap(),
            revision,
            as_of: Timestamp::from_millis(as_of),
        };
        assert!(at("a", 5, 1).is_newer_than(&at("a", 4, 9)));
        assert!(!at("a", 4, 9).is_newer_than(&at("a", 5, 1)));
        assert!(at("b", 1, 9).is_newer_than(&at("a", 5, 1)));
        assert!(!at("b", 9, 1).is_newer_than(&at("a", 5, 1)));
        assert!(!at("a", 5, 1).is_newer_than(&at("a", 5, 1)));
    }

    #[test]
    fn a_text_that_was_left_out_is_noticed_and_none_is_shown() {
        let loaded = |spec| Loaded {
            documents: vec![Arc::new(samples::service("slam", 7, spec))],
            ..samples::loaded(7, [])
        };
        let with = loaded(serde_json::json!({ "config": { "pw": { "$secret": { "text": "canary", "version": 3 } } } }));
        assert!(!with.lacks_secrets());
        assert!(!format!("{with:?}").contains("canary"));
        let without =
            loaded(serde_json::json!({ "config": { "pw": [{ "$secret": { "redacted": true, "version": 3 } }] } }));
        assert!(without.lacks_secrets());
    }
}
