//! What the main service tells a worker, and what can be wrong with it.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::{Document, Key, MAX_DOCUMENTS, secret};

/// Version of the protocol that is spoken here. Version 2: Hello says whether texts of secrets are
/// wanted.
pub const PROTOCOL: u32 = 2;
/// Oldest version that is understood here: a worker serves with a main service that is one version
/// older.
pub const OLDEST_PROTOCOL: u32 = PROTOCOL - 1;
/// Specs of a snapshot, in bytes of their compact JSON, at most (512 MiB).
pub const MAX_SNAPSHOT_BYTES: usize = 512 * 1024 * 1024;

/// What a commit does to one document.
#[derive(Clone)]
pub enum Edit {
    /// It is so from now on, with secrets in clear.
    Put(Document),
    /// It is gone, or the layer does not see it any more.
    Remove(Key),
}

/// What the main service tells.
#[derive(Clone)]
pub enum Incoming {
    /// The first message of a stream.
    Welcome {
        /// Version of the protocol that it speaks.
        protocol: u32,
        /// Which store it serves.
        store_id: String,
        /// Where that store stands.
        revision: u64,
        /// Whether it goes on from the revision of the Hello; if not, a snapshot follows.
        resumed: bool,
    },
    /// A part of all documents.
    Snapshot {
        /// At which revision; the same in all parts.
        revision: u64,
        /// The documents of this part.
        documents: Vec<Document>,
        /// Whether it is the last part.
        last: bool,
    },
    /// A commit, as far as the layer sees it.
    Commit {
        /// Its revision.
        revision: u64,
        /// The commit that was told before it in this stream, or where the stream began.
        previous: u64,
        /// What it did.
        edits: Vec<Edit>,
    },
    /// Everything up to a revision has been told.
    Bookmark {
        /// Which revision.
        revision: u64,
        /// Digest of the view there; empty: not told.
        digest: String,
        /// Other workers of the same layer and node that are connected, with their addresses.
        beside: Vec<String>,
    },
    /// The stream is about to end.
    GoAway {
        /// When to come again.
        retry_after: Duration,
        /// Why.
        reason: String,
    },
}

/// Without the documents: they hold secrets in clear.
impl fmt::Debug for Incoming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Welcome { revision, .. } => write!(f, "Welcome({revision})"),
            Self::Snapshot { revision, .. } => write!(f, "Snapshot({revision})"),
            Self::Commit { revision, previous, .. } => {
                write!(f, "Commit({revision} after {previous})")
            }
            Self::Bookmark { revision, .. } => write!(f, "Bookmark({revision})"),
            Self::GoAway { reason, .. } => write!(f, "GoAway({reason:?})"),
        }
    }
}

impl Incoming {
    /// The same without the texts of secrets.
    #[must_use]
    pub fn redacted(mut self) -> Self {
        match &mut self {
            Self::Snapshot { documents, .. } => documents.iter_mut().for_each(redact),
            Self::Commit { edits, .. } => {
                for edit in edits {
                    if let Edit::Put(document) = edit {
                        redact(document);
                    }
                }
            }
            Self::Welcome { .. } | Self::Bookmark { .. } | Self::GoAway { .. } => {}
        }
        self
    }
}

/// Takes the texts of secrets out of a document.
pub(super) fn redact(document: &mut Document) {
    if secret::contains(&document.spec) {
        document.spec = Arc::new(secret::redact(&document.spec).into_owned());
    }
    if let Some(status) = document.status.as_ref().filter(|status| secret::contains(status)) {
        document.status = Some(secret::redact(status).into_owned());
    }
}

/// Why a stream must begin anew. The documents are what they were before the message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SyncFault {
    /// A commit follows on another one than the last that was told: something is missing.
    #[error(
        "the commit follows on revision {got}, but {expected} was told last: something is missing"
    )]
    Gap {
        /// What was told last in this stream.
        expected: u64,
        /// What the commit says was told before it; for a commit that is not newer than the last,
        /// its own revision.
        got: u64,
    },
    /// Both have other documents at the same revision.
    #[error("at revision {revision} the digest here is {ours}, that of the main service {theirs}")]
    Digest {
        /// Which revision.
        revision: u64,
        /// Over what is here.
        ours: String,
        /// What the main service says.
        theirs: String,
    },
    /// A message at a time at which it makes no sense.
    #[error("{message} when {waited_for} was waited for")]
    Unexpected {
        /// Which message.
        message: &'static str,
        /// What could have come.
        waited_for: &'static str,
    },
    /// The main service speaks another version.
    #[error(
        "the main service speaks version {theirs} of the protocol, this worker {OLDEST_PROTOCOL} \
         to {PROTOCOL}: \
         update the older of the two"
    )]
    Protocol {
        /// Its version.
        theirs: u32,
    },
    /// It goes on from a copy that is of another store, or newer than the store itself.
    #[error(
        "the main service would go on from revision {ours} of store {store_id:?}, but it is at \
         {theirs} of {other:?}"
    )]
    OtherStore {
        /// The store of the copy.
        store_id: Option<String>,
        /// The store of the main service.
        other: String,
        /// Where the copy stands.
        ours: u64,
        /// Where the store stands.
        theirs: u64,
    },
    /// The parts of a snapshot are of different revisions.
    #[error("a part of the snapshot of revision {expected} is of revision {got}")]
    Mixed {
        /// Of the first part.
        expected: u64,
        /// Of this one.
        got: u64,
    },
    /// There are more documents than any store may have.
    #[error("there are more than {MAX_DOCUMENTS} documents")]
    TooMany,
    /// They have more bytes than are taken.
    #[error("the documents of the snapshot have more than {MAX_SNAPSHOT_BYTES} bytes")]
    TooLarge,
}

impl SyncFault {
    /// Whether the copy cannot be gone on from: what is missing or different is only found again by
    /// a snapshot.
    #[must_use]
    pub fn needs_snapshot(&self) -> bool {
        match self {
            Self::Gap { .. } | Self::Digest { .. } | Self::OtherStore { .. } => true,
            Self::Unexpected { .. }
            | Self::Protocol { .. }
            | Self::Mixed { .. }
            | Self::TooMany
            | Self::TooLarge => false,
        }
    }
}
