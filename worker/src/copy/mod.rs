//! The copy of the layer's view that outlives the process: one file, and a MongoDB where one is
//! configured.
//!
//! ```text
//!                        ┌─[newest state, coalesced]─▶ writer ──▶ FileCopy
//! LayerView ──▶ Copies ──┤
//!                        └─[newest state, coalesced]─▶ writer ──▶ MongoCopy     (where the node file has `database.mongodb`)
//!
//! at the start:  the newer of both ([`choose`]), else the mounted file ([`defaults`])
//! later:         a copy that could not be read at the start ──[Found]──▶ engine, before anything is written there
//! ```
//!
//! Both hold the same bytes (module `format`). A write replaces the whole copy and is all or
//! nothing: a process that dies during a write leaves the old content or the new content. A copy is
//! never replaced by an older state of the same store. Serving never waits for a write. An
//! unreadable file is moved aside by the first write; an unreadable copy in MongoDB is replaced,
//! except one of a newer format.
//!
//! # Secrets at rest
//! With `worker.key_file` a copy is encrypted as a whole, but for its first line. Without a key the
//! texts of secrets are left out and the versions stay ([`Vault`]): the configuration has the same
//! hash, and the worker asks the main service for everything again to have the texts
//! ([`Loaded::lacks_secrets`]).

#[cfg(test)]
mod conformance;
mod copies;
pub mod defaults;
mod error;
#[cfg(test)]
pub(crate) mod fake;
mod file;
mod format;
mod json;
#[cfg(test)]
mod kill_tests;
#[cfg(feature = "mongodb")]
mod mongo;
#[cfg(feature = "mongodb")]
pub(crate) mod mongo_client;
mod notes;
#[cfg(test)]
mod samples;
mod start;
mod vault;

use std::fmt;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::LayerName;
use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, Timestamp};
use serde::{Deserialize, Serialize};

pub use copies::{Copies, Counts, Found, Target, Update};
pub use error::CopyError;
pub use file::{FILE_NAME, FileCopy};
#[cfg(feature = "mongodb")]
pub use mongo::MongoCopy;
#[cfg(feature = "mongodb")]
pub use mongo_client::check_uri;
pub use notes::Notes;
pub use start::{Start, choose};
pub use vault::Vault;

/// How far a copy is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Position {
    /// Which store of a main service the documents are from.
    pub store_id: String,
    /// Whose view it is.
    pub layer: LayerName,
    /// Revision of the last commit that is in it.
    pub revision: u64,
    /// When the worker last knew itself in sync with the main service.
    #[serde(with = "json::time")]
    pub as_of: Timestamp,
}

impl Position {
    /// Whether this one is to be preferred: of one store the later revision, of different stores
    /// the later time.
    #[must_use]
    pub fn is_newer_than(&self, other: &Self) -> bool {
        if self.store_id == other.store_id {
            (self.revision, self.as_of) > (other.revision, other.as_of)
        } else {
            self.as_of > other.as_of
        }
    }

    /// Whether a copy at this position may be replaced by a state at `next`.
    ///
    /// # Errors
    /// [`CopyError::Newer`].
    pub(crate) fn check_replaced_by(&self, next: &Self, place: &str) -> Result<(), CopyError> {
        if self.store_id == next.store_id && self.revision > next.revision {
            return Err(CopyError::Newer {
                place: place.to_owned(),
                held: self.revision,
                offered: next.revision,
            });
        }
        Ok(())
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
    /// Whether the text of a secret is not there: it was written without a key, or under another
    /// one. Who serves from this asks the main service for a whole snapshot, not for what is new.
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

    /// Makes this the content, unless a later state of the same store is there.
    ///
    /// # Errors
    /// [`CopyError::Newer`] for a later state; else [`CopyError`]: the old content is still there
    /// or, where the answer was lost, the new content.
    async fn replace(&self, whole: &Loaded) -> Result<(), CopyError>;

    /// What it is, for people: kind and place, no password.
    fn describe(&self) -> String;
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
}
