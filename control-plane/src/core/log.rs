//! The newest state, and the commits that led to it: bounded, for watchers and for reading a little
//! way back.

use std::collections::VecDeque;
use std::sync::{Arc, OnceLock};

use blaze_domain::config::{Document, Key};
use parking_lot::RwLock;
use tokio::sync::watch;

use super::types::WatchCommit;
use crate::store::{Change, Commit};
use blaze_domain::config::state::{Effect, State};

/// Commits that are kept in memory, at most.
const MAX_COMMITS: usize = 8192;
/// Bytes of their documents, at most, about.
const MAX_BYTES: usize = 24 * 1024 * 1024;
/// What a commit takes besides its documents, about.
const OVERHEAD_BYTES: usize = 512;

/// A commit as it was applied.
#[derive(Debug)]
pub(crate) struct Applied {
    pub(crate) commit: Arc<Commit>,
    /// Changed documents first, then those that only moved.
    pub(crate) effects: Vec<Effect>,
    /// What the changed documents were.
    originals: Vec<(Key, Option<Arc<Document>>)>,
    pub(crate) bytes: usize,
    /// As it is for watchers that see everything.
    pub(crate) unfiltered: OnceLock<Arc<WatchCommit>>,
}

struct Inner {
    state: State,
    floor: u64,
    commits: VecDeque<Arc<Applied>>,
    bytes: usize,
}

/// The newest state and the way to it.
pub(crate) struct Log {
    inner: RwLock<Inner>,
    head: watch::Sender<u64>,
}

impl Log {
    /// Begins with what the store has.
    pub(crate) fn new(state: State, floor: u64) -> Self {
        Self {
            head: watch::Sender::new(state.revision()),
            inner: RwLock::new(Inner { state, floor, commits: VecDeque::new(), bytes: 0 }),
        }
    }

    /// The newest state.
    pub(crate) fn state(&self) -> State {
        self.inner.read().state.clone()
    }

    /// Its revision.
    pub(crate) fn revision(&self) -> u64 {
        *self.head.borrow()
    }

    /// Changes with every commit.
    pub(crate) fn subscribe(&self) -> watch::Receiver<u64> {
        self.head.subscribe()
    }

    /// The smallest revision that a watch may start after.
    pub(crate) fn floor(&self) -> u64 {
        self.inner.read().floor
    }

    /// Raises the floor. What is in memory stays: a watch that began above the old floor still gets
    /// all of it.
    pub(crate) fn raise_floor(&self, floor: u64) {
        let mut inner = self.inner.write();
        inner.floor = inner.floor.max(floor);
    }

    /// Applies the next commit; one that is there already changes nothing. `false` if one before it
    /// is missing.
    pub(crate) fn append(&self, commit: Arc<Commit>) -> bool {
        let mut inner = self.inner.write();
        let next = inner.state.revision() + 1;
        if commit.revision < next {
            return true;
        }
        if commit.revision > next {
            return false;
        }
        let originals =
            inner.state.originals(commit.changes.iter().map(|change| &change.document.key));
        let effects = inner.state.apply(commit.revision, commit.changes.iter().map(Change::step));
        let bytes = commit_bytes(&commit);
        inner.bytes += bytes;
        inner.commits.push_back(Arc::new(Applied {
            commit,
            effects,
            originals,
            bytes,
            unfiltered: OnceLock::new(),
        }));
        while inner.commits.len() > MAX_COMMITS
            || (inner.bytes > MAX_BYTES && inner.commits.len() > 1)
        {
            inner.drop_oldest();
        }
        drop(inner);
        self.head.send_replace(next);
        true
    }

    /// Starts anew from what the store has, when commits in between cannot be had any more. Never
    /// goes back: another task may have come further meanwhile.
    pub(crate) fn reset(&self, state: State, floor: u64) {
        let mut inner = self.inner.write();
        let revision = state.revision();
        if revision <= inner.state.revision() {
            return;
        }
        *inner = Inner { state, floor, commits: VecDeque::new(), bytes: 0 };
        drop(inner);
        self.head.send_replace(revision);
    }

    /// Commits after a revision, at most `limit`; `None` if the memory does not reach back so far.
    pub(crate) fn after(&self, revision: u64, limit: usize) -> Option<Vec<Arc<Applied>>> {
        let inner = self.inner.read();
        if revision >= inner.state.revision() {
            return Some(Vec::new());
        }
        let first = inner.commits.front()?.commit.revision;
        let skip = usize::try_from((revision + 1).checked_sub(first)?).ok()?;
        Some(inner.commits.iter().skip(skip).take(limit).cloned().collect())
    }

    /// The state at an older revision; `None` if the memory does not reach back so far.
    pub(crate) fn state_at(&self, revision: u64) -> Option<State> {
        let (mut state, commits) = {
            let inner = self.inner.read();
            if revision > inner.state.revision() {
                return None;
            }
            let first = inner
                .commits
                .front()
                .map_or(inner.state.revision() + 1, |applied| applied.commit.revision);
            if revision + 1 < first {
                return None;
            }
            let newer =
                inner.commits.iter().rev().take_while(|applied| applied.commit.revision > revision);
            (inner.state.clone(), newer.cloned().collect::<Vec<_>>())
        };
        for applied in commits {
            state.undo(&applied.originals, applied.commit.revision - 1);
        }
        Some(state)
    }
}

impl Inner {
    fn drop_oldest(&mut self) {
        if let Some(applied) = self.commits.pop_front() {
            self.bytes -= applied.bytes;
        }
    }
}

/// Bytes that a commit takes, about.
pub(crate) fn commit_bytes(commit: &Commit) -> usize {
    commit.changes.iter().map(change_bytes).sum::<usize>() + OVERHEAD_BYTES
}

/// Bytes of a document, about: counted from its spec's text would cost more than it is worth.
fn change_bytes(change: &Change) -> usize {
    fn value_bytes(value: &serde_json::Value) -> usize {
        use serde_json::Value;
        match value {
            Value::Null | Value::Bool(_) | Value::Number(_) => 16,
            Value::String(text) => 24 + text.len(),
            Value::Array(list) => 32 + list.iter().map(value_bytes).sum::<usize>(),
            Value::Object(members) => {
                64 + members
                    .iter()
                    .map(|(name, value)| 48 + name.len() + value_bytes(value))
                    .sum::<usize>()
            }
        }
    }
    2 * value_bytes(&change.document.spec) + 256
}
