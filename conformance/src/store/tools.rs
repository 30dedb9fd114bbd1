//! What the rules share: stores, waiting, comparing.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use blaze_domain::config::{Document, Key};

use super::{Fixture, samples};
use blaze_config::store::{Commit, CommitError, CommitRecord, FullStore, Op, StoreError};

/// How long a condition may take to come true; generous, because it is only spent where a rule is
/// broken.
pub(super) const DEADLINE: Duration = Duration::from_secs(20);

/// A name of a store that no other rule uses.
pub(super) fn store_name(base: &str) -> String {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    let random = uuid::Uuid::now_v7().simple().to_string();
    format!("{base}-{count}-{}", random.get(24..).unwrap_or_default())
}

/// A store that is empty.
pub(super) async fn fresh(fixture: &dyn Fixture, base: &str) -> Arc<dyn FullStore> {
    fixture.open(&store_name(base)).await
}

/// Waits for something that may never come.
pub(super) async fn within<F: Future>(what: &str, future: F) -> F::Output {
    let done = tokio::time::timeout(DEADLINE, future).await;
    done.unwrap_or_else(|_| panic!("{what}: not within {DEADLINE:?}"))
}

/// Insists on [`CommitError::Conflict`].
pub(super) fn conflict(what: &str, result: &Result<(), CommitError>) {
    assert!(
        matches!(result, Err(CommitError::Conflict)),
        "{what} is a conflict, but was {result:?}"
    );
}

/// Commits, and tries again when another transaction was in the way without taking the revision.
pub(super) async fn commit(store: &dyn FullStore, records: &[CommitRecord]) {
    let first = records.first().map_or(0, |record| record.commit.revision);
    loop {
        match store.commit(records).await {
            Err(CommitError::Conflict) if store.head().await.unwrap() < first => {
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
            result => return result.unwrap(),
        }
    }
}

/// All commits after a revision, over as many reads as it takes.
pub(super) async fn log(store: &dyn FullStore, after: u64) -> Vec<Commit> {
    let mut commits: Vec<Commit> = Vec::new();
    loop {
        let from = commits.last().map_or(after, |commit| commit.revision);
        let batch = store.commits_after(from, 100).await.unwrap();
        assert!(batch.floor <= from, "the floor is {} above {from}", batch.floor);
        if batch.commits.is_empty() {
            return commits;
        }
        commits.extend(batch.commits);
    }
}

/// Documents by key.
pub(super) fn by_key(documents: Vec<Document>) -> BTreeMap<Key, Document> {
    documents.into_iter().map(|document| (document.key.clone(), document)).collect()
}

/// What the store must hold, kept beside it. Writes one commit after another.
pub(super) struct Model {
    pub(super) store: Arc<dyn FullStore>,
    pub(super) documents: BTreeMap<Key, Document>,
    /// The documents at each revision, from 0.
    pub(super) states: Vec<BTreeMap<Key, Document>>,
    pub(super) commits: Vec<Commit>,
}

impl Model {
    pub(super) async fn new(fixture: &dyn Fixture, base: &str) -> Self {
        Self {
            store: fresh(fixture, base).await,
            documents: BTreeMap::new(),
            states: vec![BTreeMap::new()],
            commits: Vec::new(),
        }
    }

    pub(super) fn revision(&self) -> u64 {
        u64::try_from(self.commits.len()).unwrap_or(u64::MAX)
    }

    /// Adds a commit to the model: each name is created or updated, or deleted with a `-` in front.
    pub(super) fn record(&mut self, names: &[&str]) -> CommitRecord {
        let revision = self.revision() + 1;
        let mut changes = Vec::new();
        for name in names {
            let (name, delete) = name.strip_prefix('-').map_or((*name, false), |name| (name, true));
            let key = samples::key(name);
            let previous = self.documents.get(&key).map(|document| document.revision);
            let op = match (delete, previous) {
                (true, _) => Op::Delete,
                (false, None) => Op::Create,
                (false, Some(_)) => Op::Update,
            };
            let mut change = samples::change(op, name, revision, previous);
            if delete {
                // What it was last.
                if let Some(last) = self.documents.remove(&key) {
                    change.document = Arc::new(last);
                }
            } else {
                self.documents.insert(key, (*change.document).clone());
            }
            changes.push(change);
        }
        let commit = samples::commit_of(revision, changes);
        self.commits.push(commit.clone());
        self.states.push(self.documents.clone());
        samples::record(commit)
    }

    /// Adds commits to model and store, as one group.
    pub(super) async fn write(&mut self, group: &[&[&str]]) {
        let mut records: Vec<CommitRecord> = group.iter().map(|names| self.record(names)).collect();
        if let Some(batch) = records.first().map(|record| record.commit.batch.clone()) {
            // A group has one batch.
            let place = self.commits.len() - records.len();
            for (record, commit) in records.iter_mut().zip(self.commits.iter_mut().skip(place)) {
                commit.batch.clone_from(&batch);
                record.commit = Arc::new(commit.clone());
            }
        }
        commit(self.store.as_ref(), &records).await;
        // Whatever a store does beside must change nothing of what it says.
        if self.revision().is_multiple_of(3) {
            self.store.tidy().await.unwrap();
        }
    }

    /// Insists that the store has this state.
    pub(super) async fn check_now(&self) {
        let snapshot = self.store.load().await.unwrap();
        assert_eq!(snapshot.revision, self.revision(), "the loaded revision");
        assert_eq!(by_key(snapshot.documents), self.documents, "the documents");
        assert_eq!(self.store.head().await.unwrap(), self.revision(), "the head");
    }

    /// Insists that what was at each revision from `floor` on can be told.
    pub(super) async fn check_past(&self, floor: u64) {
        let now = self.revision();
        for at in floor..=now {
            let changed = self.store.documents_at(at, now).await.unwrap();
            let mut found = self.documents.clone();
            for (key, before) in changed {
                match before {
                    Some(document) => found.insert(key, document),
                    None => found.remove(&key),
                };
            }
            let expected = &self.states[usize::try_from(at).unwrap()];
            assert_eq!(found, *expected, "the documents at {at}");
        }
    }
}

/// Insists on an error of the store that a later try may not have.
pub(super) fn unavailable<T>(what: &str, result: Result<T, StoreError>) {
    let error = result.err().unwrap_or_else(|| panic!("{what} was answered"));
    assert!(matches!(error, StoreError::Unavailable(_)), "{what}: {error}");
}

/// Numbers that look random and are the same each time.
pub(super) struct Dice(u64);

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        Self(seed | 1)
    }

    /// From 0 to below `sides`.
    pub(super) fn roll(&mut self, sides: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % sides.max(1)
    }
}
