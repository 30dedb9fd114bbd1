//! Several openings of one store, one after the other or at once.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::Fixture;
use super::samples::{self, record};
use super::tools::{Dice, Model, by_key, log, store_name, within};
use blaze_config::store::{CommitError, FullStore, Op};

/// Whatever was there is there again, and writing goes on.
pub async fn a_store_that_is_reopened_is_the_same(fixture: &dyn Fixture) {
    let name = store_name("reopened");
    let mut model = Model::new(fixture, "unused").await;
    model.store = fixture.open(&name).await;
    let first = model.store.load().await.unwrap().store_id;
    for round in 0..3 {
        model.write(&[&["a", "b"], &["-b"]]).await;
        if round == 1 {
            model.store.trim(3, 1).await.unwrap();
        }
        model.store.close().await;
        model.store = fixture.open(&name).await;
        model.check_now().await;
        let snapshot = model.store.load().await.unwrap();
        assert_eq!(snapshot.store_id, first, "the identity of the store");
        assert_eq!(
            log(model.store.as_ref(), snapshot.floor).await.len(),
            model.commits_above(snapshot.floor),
            "the log"
        );
    }
}

impl Model {
    fn commits_above(&self, floor: u64) -> usize {
        self.commits.iter().filter(|commit| commit.revision > floor).count()
    }
}

/// Two that write as fast as they can: each revision is one's or the other's, none is missing, and
/// what was acknowledged is there.
pub async fn one_of_two_writers_has_each_revision(fixture: &dyn Fixture) {
    if !fixture.is_shared() {
        return;
    }
    let name = store_name("two");
    let stores = [fixture.open(&name).await, fixture.open(&name).await];
    for store in &stores {
        assert!(store.is_shared());
    }
    let (one, other) =
        tokio::join!(write_many(&stores[0], "one", 60), write_many(&stores[1], "other", 60));
    let commits = log(stores[0].as_ref(), 0).await;
    assert_eq!(commits.len(), 120, "how many commits there are");
    let found: BTreeSet<String> = commits.iter().map(|commit| commit.request_id.clone()).collect();
    let acknowledged: BTreeSet<String> = one.union(&other).cloned().collect();
    assert_eq!(found, acknowledged, "the commits");
    assert_eq!(log(stores[1].as_ref(), 0).await, commits, "the log through the other");
    let snapshot = stores[1].load().await.unwrap();
    let last = |name: &str| {
        let changes = commits.iter().flat_map(|commit| &commit.changes);
        changes
            .rev()
            .find(|change| change.document.key == samples::key(name))
            .map(|change| (*change.document).clone())
    };
    for document in snapshot.documents {
        let name = document.key.name().to_string();
        assert_eq!(Some(document), last(&name), "a document");
    }
}

/// Commits of one writer, one by one and in groups. Gives what was acknowledged, by request id.
async fn write_many(store: &Arc<dyn FullStore>, name: &str, count: u64) -> BTreeSet<String> {
    let mut acknowledged = BTreeSet::new();
    let mut written = 0;
    while written < count {
        let head = store.head().await.unwrap();
        let size = if written.is_multiple_of(3) { 1 } else { 3.min(count - written) };
        let group: Vec<_> = (1..=size)
            .map(|step| {
                let revision = head + step;
                let previous = (revision > 1).then(|| revision - 1);
                let mut commit = samples::commit_of(
                    revision,
                    vec![samples::change(Op::Update, "shared", revision, previous)],
                );
                commit.request_id = format!("{name}-{}", written + step);
                commit.batch = format!("{name}-{written}-{head}");
                record(commit)
            })
            .collect();
        match store.commit(&group).await {
            Ok(()) => {
                acknowledged.extend(group.iter().map(|record| record.commit.request_id.clone()));
                written += size;
                let seen = store.head().await.unwrap();
                assert!(
                    seen >= head + size,
                    "the head is {seen} after {} was acknowledged",
                    head + size
                );
            }
            Err(CommitError::Conflict) => tokio::task::yield_now().await,
            Err(error) => panic!("commit after {head}: {error}"),
        }
    }
    acknowledged
}

/// Who waits for commits of others hears of them, each time.
pub async fn a_foreign_commit_is_noticed(fixture: &dyn Fixture) {
    if !fixture.is_shared() {
        return;
    }
    let name = store_name("notice");
    let stores = [fixture.open(&name).await, fixture.open(&name).await];
    for revision in 1..=20 {
        let waits = async {
            while stores[1].head().await.unwrap() < revision {
                stores[1].foreign_commit().await;
            }
        };
        let group = [record(samples::commit(revision, &["a"]))];
        let writes = stores[0].commit(&group);
        let (written, ()) = tokio::join!(writes, within("a commit of another is noticed", waits));
        written.unwrap();
    }
}

/// A reader that follows the log while it is written and trimmed gets each commit once, in order,
/// or is told that he is below the floor.
pub async fn readers_never_see_a_hole_while_history_is_trimmed(fixture: &dyn Fixture) {
    const COMMITS: u64 = 150;
    let mut model = Model::new(fixture, "holes").await;
    let store = Arc::clone(&model.store);
    let over = AtomicBool::new(false);
    let writing = async {
        while model.revision() < COMMITS {
            let group: Vec<&[&str]> = vec![&["a", "b"], &["a"], &["b", "c"]];
            model.write(&group).await;
        }
        over.store(true, Ordering::Release);
    };
    let trimming = async {
        while !over.load(Ordering::Acquire) {
            let head = store.head().await.unwrap();
            store.trim(head.saturating_sub(4), 1).await.unwrap();
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let reading = async {
        let mut at = 0;
        loop {
            let done = over.load(Ordering::Acquire);
            let batch = store.commits_after(at, 5).await.unwrap();
            if batch.floor > at {
                // As one who lists again.
                at = store.load().await.unwrap().revision;
                continue;
            }
            for commit in &batch.commits {
                assert_eq!(commit.revision, at + 1, "the next commit");
                assert!(!commit.changes.is_empty());
                at += 1;
            }
            if batch.commits.is_empty() && done {
                return at;
            }
        }
    };
    let ((), (), at) = tokio::join!(writing, trimming, reading);
    assert_eq!(at, model.revision(), "the end of the log");
    model.check_now().await;
}

/// Several that tidy, some of which are cut off in the middle of it, and one that trims: what is
/// loaded is right after each commit.
pub async fn documents_are_right_whoever_tidies(fixture: &dyn Fixture) {
    const DOCUMENTS: u64 = 400;
    let rounds = if crate::full() { 12 } else { 4 };
    let name = store_name("tidied");
    let mut model = Model::new(fixture, "unused").await;
    model.store = fixture.open(&name).await;
    let mut others = Vec::new();
    for _ in 0..if fixture.is_shared() { 3 } else { 0 } {
        others.push(fixture.open(&name).await);
    }
    let writer = Arc::clone(&model.store);
    let stores: Vec<_> = others.iter().chain([&writer]).collect();
    let over = AtomicBool::new(false);
    let tidying =
        futures::future::join_all(stores.iter().zip((1..).step_by(2)).map(|(store, seed)| {
            let over = &over;
            async move {
                let mut dice = Dice::new(seed);
                while !over.load(Ordering::Acquire) {
                    let cut = Duration::from_millis(dice.roll(200));
                    if let Ok(done) = tokio::time::timeout(cut, store.tidy()).await {
                        done.unwrap();
                    }
                    tokio::time::sleep(Duration::from_millis(dice.roll(20))).await;
                }
            }
        }));
    let writing = async {
        let mut dice = Dice::new(7);
        for round in 0..rounds {
            let mut names: BTreeSet<String> = BTreeSet::new();
            for _ in 0..dice.roll(DOCUMENTS) {
                names.insert(format!("n{}", dice.roll(DOCUMENTS)));
            }
            let signed: Vec<String> = names
                .into_iter()
                .map(|name| {
                    match model.documents.contains_key(&samples::key(&name)) && dice.roll(3) == 0 {
                        true => format!("-{name}"),
                        false => name,
                    }
                })
                .collect();
            let mut group: Vec<&str> = signed.iter().map(String::as_str).collect();
            group.push("always");
            model.write(&[&group, &["always"]]).await;
            if round % 5 == 4 {
                model.store.trim(model.revision() - 5, 1).await.unwrap();
            }
            let reader = others.first().unwrap_or(&model.store);
            let snapshot = reader.load().await.unwrap();
            assert_eq!(snapshot.revision, model.revision(), "the loaded revision");
            let found = by_key(snapshot.documents);
            assert_eq!(found, model.documents, "the documents of {}", snapshot.revision);
        }
        over.store(true, Ordering::Release);
    };
    tokio::join!(writing, tidying);
    writer.tidy().await.unwrap();
    model.check_now().await;
}
