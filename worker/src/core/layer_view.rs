//! The layer's documents in memory, as the main service tells them.
//!
//! ```text
//! connect ─▶ Hello(resume_point) ─▶ Welcome ─┬─ resumed ──────────────────────▶ Commit, Bookmark, … ─▶ disconnected
//!                                            └─ Snapshot … Snapshot(last) ────▶        │
//!                                                                                      └─ a fault: Hello with revision 0:
//!                                                                                         asks for a snapshot
//! ```
//!
//! Whatever goes wrong, the documents stay as they were: those that have been served go on being
//! served.

use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::placement::whole_digest;
use blaze_domain::config::spec::json_size;
use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, MAX_DOCUMENTS, Timestamp};

use super::change::{Change, difference};
use super::incoming::{Edit, Incoming, MAX_SNAPSHOT_BYTES, OLDEST_PROTOCOL, PROTOCOL, SyncFault};

/// What a message did.
#[derive(Debug)]
pub enum Applied {
    /// Nothing to the documents; the known revision may be a higher one.
    Nothing,
    /// The documents are others. After a snapshot that holds what was there, no key has changed.
    Changed(Box<Change>),
    /// The stream is about to end; come again after this time.
    GoAway {
        /// When to come again.
        retry_after: Duration,
        /// Why.
        reason: String,
    },
}

/// What a Hello says of the copy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResumePoint {
    /// Store that the copy is of; empty: no copy.
    pub store_id: String,
    /// Revision of the copy; 0: no copy.
    pub revision: u64,
    /// Digest of the copy; empty: no copy.
    pub digest: String,
}

/// Where a stream stands.
#[derive(Default)]
enum Stream {
    /// There is none, or it has not begun.
    #[default]
    Closed,
    /// The parts of a snapshot come.
    Snapshot {
        store_id: String,
        /// Of the first part, once it is there.
        revision: Option<u64>,
        documents: Vec<Document>,
        /// Of their specs, as compact JSON.
        bytes: usize,
    },
    /// Commits come.
    Live {
        /// Revision of the last commit, or where the stream began.
        last_revision: u64,
        /// Revision from which the stream was resumed, until the first new commit: older ones may
        /// come again.
        resumed_from: Option<u64>,
    },
    /// Nothing sensible comes any more.
    Over,
}

/// The layer's documents in memory, at a revision.
#[derive(Default)]
pub struct LayerView {
    store_id: Option<String>,
    state: State,
    /// When it last knew itself in sync.
    as_of: Option<Timestamp>,
    /// The digest of `state`, once it was needed.
    digest: Option<String>,
    stream: Stream,
    in_sync: bool,
    /// Revision of the store when the stream began; in sync only from there on.
    sync_target: u64,
    /// The main service must send a full snapshot; resuming is not possible.
    needs_snapshot: bool,
}

impl LayerView {
    /// From a copy of a store.
    #[must_use]
    pub fn from_copy(store_id: String, state: State, as_of: Timestamp) -> Self {
        Self { store_id: Some(store_id), state, as_of: Some(as_of), ..Self::default() }
    }

    /// The store that it is a copy of.
    #[must_use]
    pub fn store_id(&self) -> Option<&str> {
        self.store_id.as_deref()
    }

    /// All documents, at the newest revision of which everything was told.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Whether the stream is there and everything was told.
    #[must_use]
    pub fn is_in_sync(&self) -> bool {
        self.in_sync
    }

    /// When it last knew itself in sync; `None`: never.
    #[must_use]
    pub fn as_of(&self) -> Option<Timestamp> {
        self.as_of
    }

    /// The digest over all documents; kept until they change.
    pub fn digest(&mut self) -> String {
        let state = &self.state;
        self.digest.get_or_insert_with(|| whole_digest(state)).clone()
    }

    /// What the next Hello says.
    pub fn resume_point(&mut self) -> ResumePoint {
        match &self.store_id {
            Some(store_id) if !self.needs_snapshot => ResumePoint {
                store_id: store_id.clone(),
                revision: self.state.revision(),
                digest: self.digest(),
            },
            Some(_) | None => {
                ResumePoint { store_id: String::new(), revision: 0, digest: String::new() }
            }
        }
    }

    /// The stream is gone. A snapshot that has not come whole is forgotten.
    pub fn disconnected(&mut self) {
        self.stream = Stream::Closed;
        self.in_sync = false;
    }

    /// Takes a message, told at a time.
    ///
    /// # Errors
    /// The stream must begin anew, with [`Self::resume_point`]; the documents stay as they are.
    pub fn apply(&mut self, incoming: Incoming, now: Timestamp) -> Result<Applied, SyncFault> {
        let applied = self.take(incoming);
        match &applied {
            Ok(Applied::GoAway { .. }) => {}
            Ok(Applied::Nothing | Applied::Changed(_)) => self.note_sync(now),
            Err(fault) => {
                self.stream = Stream::Over;
                self.in_sync = false;
                self.needs_snapshot |= fault.needs_snapshot();
            }
        }
        applied
    }

    fn note_sync(&mut self, now: Timestamp) {
        self.in_sync =
            matches!(self.stream, Stream::Live { .. }) && self.state.revision() >= self.sync_target;
        if self.in_sync {
            // A clock that was set back does not make the copy older than it is.
            self.as_of = Some(self.as_of.map_or(now, |before| before.max(now)));
        }
    }

    fn take(&mut self, incoming: Incoming) -> Result<Applied, SyncFault> {
        match incoming {
            Incoming::GoAway { retry_after, reason } => Ok(Applied::GoAway { retry_after, reason }),
            Incoming::Welcome { protocol, store_id, revision, resumed } => {
                self.welcome(protocol, store_id, revision, resumed).map(|()| Applied::Nothing)
            }
            Incoming::Snapshot { revision, documents, last } => {
                self.snapshot(revision, documents, last)
            }
            Incoming::Commit { revision, previous, edits } => {
                self.commit(revision, previous, edits)
            }
            Incoming::Bookmark { revision, digest, beside: _ } => {
                self.bookmark(revision, digest).map(|()| Applied::Nothing)
            }
        }
    }

    fn unexpected(&self, message: &'static str) -> SyncFault {
        let waited_for = match self.stream {
            Stream::Closed => "a Welcome",
            Stream::Snapshot { .. } => "a Snapshot",
            Stream::Live { .. } => "a Commit or a Bookmark",
            Stream::Over => "nothing after a fault",
        };
        SyncFault::Unexpected { message, waited_for }
    }

    fn welcome(
        &mut self,
        protocol: u32,
        store_id: String,
        revision: u64,
        resumed: bool,
    ) -> Result<(), SyncFault> {
        if !matches!(self.stream, Stream::Closed) {
            return Err(self.unexpected("Welcome"));
        }
        if !(OLDEST_PROTOCOL..=PROTOCOL).contains(&protocol) {
            return Err(SyncFault::Protocol { theirs: protocol });
        }
        self.sync_target = revision;
        let ours = self.state.revision();
        if !resumed {
            self.stream =
                Stream::Snapshot { store_id, revision: None, documents: Vec::new(), bytes: 0 };
            return Ok(());
        }
        if self.needs_snapshot || self.store_id.as_ref() != Some(&store_id) || revision < ours {
            return Err(SyncFault::OtherStore {
                store_id: self.store_id.clone(),
                other: store_id,
                ours,
                theirs: revision,
            });
        }
        self.stream = Stream::Live { last_revision: ours, resumed_from: Some(ours) };
        Ok(())
    }

    /// Collects the parts; only the last one changes anything.
    fn snapshot(
        &mut self,
        revision: u64,
        part: Vec<Document>,
        last: bool,
    ) -> Result<Applied, SyncFault> {
        let Stream::Snapshot { store_id, revision: first, documents, bytes } = &mut self.stream
        else {
            return Err(self.unexpected("Snapshot"));
        };
        let expected = *first.get_or_insert(revision);
        if expected != revision {
            return Err(SyncFault::Mixed { expected, got: revision });
        }
        if documents.len() + part.len() > MAX_DOCUMENTS {
            return Err(SyncFault::TooMany);
        }
        *bytes += part.iter().map(|document| json_size(&*document.spec)).sum::<usize>();
        if *bytes > MAX_SNAPSHOT_BYTES {
            return Err(SyncFault::TooLarge);
        }
        documents.extend(part);
        if !last {
            return Ok(Applied::Nothing);
        }
        let new = State::new(revision, std::mem::take(documents));
        self.store_id = Some(std::mem::take(store_id));
        self.stream = Stream::Live { last_revision: revision, resumed_from: None };
        self.sync_target = revision;
        self.needs_snapshot = false;
        let keys = difference(&self.state, &new);
        Ok(self.changed(keys, new))
    }

    fn commit(
        &mut self,
        revision: u64,
        previous: u64,
        edits: Vec<Edit>,
    ) -> Result<Applied, SyncFault> {
        let Stream::Live { last_revision, resumed_from } = &mut self.stream else {
            return Err(self.unexpected("Commit"));
        };
        if let Some(start) = *resumed_from {
            // After a resume the server may repeat commits up to `resumed_from`; skip them. The
            // first new commit may name either the last repeated commit or `resumed_from` as its
            // predecessor; both are complete.
            if revision <= start {
                *last_revision = revision;
                return Ok(Applied::Nothing);
            }
            if previous == start {
                *last_revision = start;
            }
        }
        if previous != *last_revision {
            return Err(SyncFault::Gap { expected: *last_revision, got: previous });
        }
        // A bookmark moves `state.revision()` past the last commit, so a new commit must be above
        // both.
        if revision <= (*last_revision).max(self.state.revision()) {
            return Err(SyncFault::Gap { expected: *last_revision, got: revision });
        }
        let mut new = self.state.clone();
        let mut keys: Vec<Key> = Vec::with_capacity(edits.len());
        for edit in edits {
            match edit {
                Edit::Put(document) => {
                    keys.push(document.key.clone());
                    new.put(Arc::new(document));
                }
                Edit::Remove(key) => {
                    new.remove(&key);
                    keys.push(key);
                }
            }
        }
        if new.len() > MAX_DOCUMENTS {
            return Err(SyncFault::TooMany);
        }
        new.advance(revision, []);
        *last_revision = revision;
        *resumed_from = None;
        keys.sort();
        keys.dedup();
        Ok(self.changed(keys, new))
    }

    fn changed(&mut self, keys: Vec<Key>, new: State) -> Applied {
        self.state = new.clone();
        self.digest = None;
        Applied::Changed(Box::new(Change { keys, new }))
    }

    fn bookmark(&mut self, revision: u64, theirs: String) -> Result<(), SyncFault> {
        if !matches!(self.stream, Stream::Live { .. }) {
            return Err(self.unexpected("Bookmark"));
        }
        if revision < self.state.revision() {
            // Nothing is to be learnt of what lies behind.
            return Ok(());
        }
        if !theirs.is_empty() {
            let ours = self.digest();
            if ours != theirs {
                return Err(SyncFault::Digest { revision, ours, theirs });
            }
        }
        self.state.advance(revision, []);
        Ok(())
    }
}

#[cfg(test)]
#[path = "layer_view_tests.rs"]
mod tests;
