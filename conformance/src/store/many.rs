//! Several openings of one store, one after the other or at once.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::Fixture;
use super::samples::{self, record};
use super::tools::{Dice, Model, Outcome, by_key, log, same, store_name, told, within};
use blaze_config::store::{CommitError, FullStore, Op};

/// Whatever was there is there again, and writing goes on.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_store_that_is_reopened_is_the_same(fixture: &dyn Fixture) -> Outcome {
    let name = store_name("reopened");
    let mut model = Model::new(fixture, "unused").await?;
    model.store = fixture.open(&name).await?;
    let first = told("load", model.store.load().await)?.store_id;
    for round in 0..3 {
        model.write(&[&["a", "b"], &["-b"]]).await?;
        if round == 1 {
            told("trim", model.store.trim(3, 1).await)?;
        }
        model.store.close().await;
        model.store = fixture.open(&name).await?;
        model.check_now().await?;
        let snapshot = told("load", model.store.load().await)?;
        same("the identity of the store", &snapshot.store_id, &first)?;
        same(
            "the log",
            &log(model.store.as_ref(), snapshot.floor).await?.len(),
            &model.commits_above(snapshot.floor),
        )?;
    }
    Ok(())
}

impl Model {
    fn commits_above(&self, floor: u64) -> usize {
        self.commits.iter().filter(|commit| commit.revision > floor).count()
    }
}

/// Two that write as fast as they can: each revision is one's or the other's, none is missing, and what was acknowledged
/// is there.
///
/// # Errors
/// How the store breaks the rule.
pub async fn one_of_two_writers_has_each_revision(fixture: &dyn Fixture) -> Outcome {
    if !fixture.is_shared() {
        return Ok(());
    }
    let name = store_name("two");
    let stores = [fixture.open(&name).await?, fixture.open(&name).await?];
    for store in &stores {
        same("that it is shared", &store.is_shared(), &true)?;
    }
    let (one, other) = tokio::join!(write_many(&stores[0], "one", 60), write_many(&stores[1], "other", 60));
    let (one, other) = (one?, other?);
    let commits = log(stores[0].as_ref(), 0).await?;
    same("how many commits there are", &commits.len(), &120)?;
    let found: BTreeSet<String> = commits.iter().map(|commit| commit.request_id.clone()).collect();
    let acknowledged: BTreeSet<String> = one.union(&other).cloned().collect();
    same("the commits", &found, &acknowledged)?;
    same(
        "the log through the other",
        &log(stores[1].as_ref(), 0).await?,
        &commits,
    )?;
    let snapshot = told("load", stores[1].load().await)?;
    let last = |name: &str| {
        let changes = commits.iter().flat_map(|commit| &commit.changes);
        changes
            .rev()
            .find(|change| change.document.key == samples::key(name))
            .map(|change| (*change.document).clone())
    };
    for document in snapshot.documents {
        let name = document.key.name().to_string();
        same("a document", &Some(document), &last(&name))?;
    }
    Ok(())
}

/// Commits of one writer, one by one and in groups. Gives what was acknowledged, by request id.
async fn write_many(store: &Arc<dyn FullStore>, name: &str, count: u64) -> Outcome<BTreeSet<String>> {
    let mut acknowledged = BTreeSet::new();
    let mut written = 0;
    while written < count {
        let head = told("head", store.head().await)?;
        let size = if written.is_multiple_of(3) {
            1
        } else {
            3.min(count - written)
        };
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
                let seen = told("head", store.head().await)?;
                if seen < head + size {
                    return Err(format!(
                        "the head is {seen} after revision {} was acknowledged",
                        head + size
                    ));
                }
            }
            Err(CommitError::Conflict) => tokio::task::yield_now().await,
            Err(error) => return Err(format!("commit after {head}: {error}")),
        }
    }
    Ok(acknowledged)
}

/// Who waits for commits of others hears of them, each time.
///
/// # Errors
/// How the store breaks the rule.
pub async fn a_foreign_commit_is_noticed(fixture: &dyn Fixture) -> Outcome {
    if !fixture.is_shared() {
        return Ok(());
    }
    let name = store_name("notice");
    let stores = [fixture.open(&name).await?, fixture.open(&name).await?];
    for revision in 1..=20 {
        let waits = async {
            while told("head", stores[1].head().await)? < revision {
                stores[1].foreign_commit().await;
            }
            Ok::<_, String>(())
        };
        let writes = async {
            told(
                "commit",
                stores[0].commit(&[record(samples::commit(revision, &["a"]))]).await,
            )
        };
        let (written, noticed) = tokio::join!(writes, within("a commit of another is noticed", waits));
        written?;
        noticed??;
    }
    Ok(())
}

/// A reader that follows the log while it is written and trimmed gets each commit once, in order, or is told that he is
/// below the floor.
///
/// # Errors
/// How the store breaks the rule.
pub async fn readers_never_see_a_hole_while_history_is_trimmed(fixture: &dyn Fixture) -> Outcome {
    const COMMITS: u64 = 150;
    let mut model = Model::new(fixture, "holes").await?;
    let store = Arc::clone(&model.store);
    let over = AtomicBool::new(false);
    let writing = async {
        while model.revision() < COMMITS {
            let group: Vec<&[&str]> = vec![&["a", "b"], &["a"], &["b", "c"]];
            model.write(&group).await?;
        }
        over.store(true, Ordering::Release);
        Ok::<_, String>(())
    };
    let trimming = async {
        while !over.load(Ordering::Acquire) {
            let head = told("head", store.head().await)?;
            told("trim", store.trim(head.saturating_sub(4), 1).await)?;
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        Ok::<_, String>(())
    };
    let reading = async {
        let (mut at, mut below) = (0, 0_u32);
        loop {
            let done = over.load(Ordering::Acquire);
            let batch = told("commits_after", store.commits_after(at, 5).await)?;
            if batch.floor > at {
                // As one who lists again.
                below += 1;
                at = told("load", store.load().await)?.revision;
                continue;
            }
            for commit in &batch.commits {
                same("the next commit", &commit.revision, &(at + 1))?;
                same("its changes", &commit.changes.is_empty(), &false)?;
                at += 1;
            }
            if batch.commits.is_empty() && done {
                return Ok::<_, String>((at, below));
            }
        }
    };
    let (written, trimmed, read) = tokio::join!(writing, trimming, reading);
    written?;
    trimmed?;
    let (at, _below) = read?;
    same("the end of the log", &at, &model.revision())?;
    model.check_now().await
}

/// Several that tidy, some of which are cut off in the middle of it, and one that trims: what is loaded is right after each
/// commit.
///
/// # Errors
/// How the store breaks the rule.
pub async fn documents_are_right_whoever_tidies(fixture: &dyn Fixture) -> Outcome {
    const DOCUMENTS: u64 = 400;
    let rounds = if crate::full() { 40 } else { 10 };
    let name = store_name("tidied");
    let mut model = Model::new(fixture, "unused").await?;
    model.store = fixture.open(&name).await?;
    let mut others = Vec::new();
    for _ in 0..if fixture.is_shared() { 3 } else { 0 } {
        others.push(fixture.open(&name).await?);
    }
    let writer = Arc::clone(&model.store);
    let stores: Vec<_> = others.iter().chain([&writer]).collect();
    let over = AtomicBool::new(false);
    let tidying = futures::future::try_join_all(stores.iter().zip((1..).step_by(2)).map(|(store, seed)| {
        let over = &over;
        async move {
            let mut dice = Dice::new(seed);
            while !over.load(Ordering::Acquire) {
                let cut = Duration::from_millis(dice.roll(200));
                if let Ok(done) = tokio::time::timeout(cut, store.tidy()).await {
                    told("tidy", done)?;
                }
                tokio::time::sleep(Duration::from_millis(dice.roll(20))).await;
            }
            Ok::<_, String>(())
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
                .map(
                    |name| match model.documents.contains_key(&samples::key(&name)) && dice.roll(3) == 0 {
                        true => format!("-{name}"),
                        false => name,
                    },
                )
                .collect();
            let mut group: Vec<&str> = signed.iter().map(String::as_str).collect();
            group.push("always");
            model.write(&[&group, &["always"]]).await?;
            if round % 5 == 4 {
                told("trim", model.store.trim(model.revision() - 5, 1).await)?;
            }
            let reader = others.first().unwrap_or(&model.store);
            let snapshot = told("load", reader.load().await)?;
            same("the loaded revision", &snapshot.revision, &model.revision())?;
            let found = by_key(snapshot.documents);
            same(
                &format!("the documents of {}", snapshot.revision),
                &found,
                &model.documents,
            )?;
        }
        over.store(true, Ordering::Release);
        Ok::<_, String>(())
    };
    tokio::try_join!(writing, tidying)?;
    told("tidy", writer.tidy().await)?;
    model.check_now().await
}
