//! What every copy must do, run on each of them. MongoDB only where `BLAZE_TEST_MONGODB_URI` (or `BLAZE_TEST_MONGODB`) names
//! a server, standalone or replica set.

#[cfg(feature = "mongodb")]
mod rows;
mod subject;

use std::sync::Arc;

use blaze_domain::config::{Document, Key};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use serde_json::json;

use super::samples::{any_documents, any_notes, loaded, notes, position, service, with_secret};
use super::{CopyError, Loaded, LocalCopy, Notes, Position, Vault, progress};
#[cfg(feature = "mongodb")]
use subject::mongo_server;
use subject::{KEY, Kind, Subject};

/// What a caller does: go on if the copy can, else write everything.
async fn advance(
    copy: &dyn LocalCopy,
    held: &Loaded,
    next: (Position, &[Arc<Document>], &[Key], Option<&Notes>),
) -> Result<Loaded, CopyError> {
    let (position, puts, removes, notes) = next;
    let whole = progress::advanced(
        Some(held.clone()),
        position.clone(),
        puts,
        removes,
        notes.cloned(),
        "model",
    )?;
    match copy.advance(&position, puts, removes, notes).await {
        Err(CopyError::Behind { .. }) => copy.replace(&whole).await?,
        advanced => advanced?,
    }
    Ok(whole)
}

fn sample(revision: u64) -> Loaded {
    let text = |name: &str| json!({ "config": { "a": format!("{name} at {revision}") } });
    Loaded {
        notes: Arc::new(notes(&format!("uid-{revision}"), revision)),
        ..loaded(
            revision,
            [
                service("a", revision, text("a")),
                service("b", 1, text("b")),
                with_secret("c", revision, "canary-5f1c"),
            ],
        )
    }
}

fn of_store(store_id: &str, mut loaded: Loaded) -> Loaded {
    loaded.position.store_id = store_id.to_owned();
    loaded
}

/// One that no copy has yet, so that revisions begin anew.
fn new_store() -> String {
    format!("store-{:016x}", rand::random::<u64>())
}

fn nothing_is_there_before_the_first_write(subject: &Subject) {
    subject.runtime.block_on(async {
        assert_eq!(subject.found().await, None);
        let behind = subject.open().advance(&position(1), &[], &[], None).await.unwrap_err();
        assert!(matches!(behind, CopyError::Behind { .. }), "{behind}");
        assert_eq!(subject.found().await, None);
    });
}

fn what_was_written_is_found(subject: &Subject) {
    let mut runner = TestRunner::new(ProptestConfig::with_cases(24));
    let any = (any_documents(), any_notes(), 1..1_u64 << 53);
    let same = runner.run(&any, |(documents, notes, revision)| {
        let whole = Loaded {
            position: Position {
                revision,
                store_id: new_store(),
                ..position(1)
            },
            documents,
            notes: Arc::new(notes),
        };
        let found = subject.runtime.block_on(async {
            subject.open().replace(&whole).await.unwrap();
            subject.found().await
        });
        prop_assert_eq!(found, Some(whole));
        Ok(())
    });
    same.unwrap();
}

fn a_large_document_is_kept(subject: &Subject) {
    subject.runtime.block_on(async {
        let text = "\u{e4}".repeat(120 * 1024);
        let whole = loaded(
            7,
            (0..12).map(|number| service(&format!("s{number}"), 7, json!({ "config": { "a": text } }))),
        );
        subject.open().replace(&whole).await.unwrap();
        assert!(subject.found().await == Some(whole));
    });
}

/// Commits, each of documents that are put, and numbers of documents that are removed.
fn any_commits() -> impl Strategy<Value = Vec<(Vec<Arc<Document>>, Vec<prop::sample::Index>, bool)>> {
    prop::collection::vec(
        (
            any_documents(),
            prop::collection::vec(any::<prop::sample::Index>(), 0..3),
            any::<bool>(),
        ),
        1..5,
    )
}

fn commits_end_where_a_snapshot_does(subject: &Subject) {
    let mut runner = TestRunner::new(ProptestConfig::with_cases(16));
    let same = runner.run(&(any_documents(), any_commits()), |(documents, commits)| {
        let expected = subject.runtime.block_on(async {
            let store_id = new_store();
            let mut held = Loaded {
                documents,
                ..of_store(&store_id, loaded(1, []))
            };
            let mut copy = subject.open();
            copy.replace(&held).await.unwrap();
            for (revision, (puts, removes, reopens)) in (2..).zip(commits) {
                if reopens {
                    copy = subject.open();
                }
                let there: Vec<Key> = held.documents.iter().map(|document| document.key.clone()).collect();
                let gone = removes
                    .iter()
                    .filter(|_| !there.is_empty())
                    .map(|at| at.get(&there).clone());
                let gone: Vec<Key> = gone.filter(|key| puts.iter().all(|put| put.key != *key)).collect();
                let notes = notes("uid", revision);
                let notes = (revision % 2 == 0).then_some(&notes);
                let to = Position {
                    store_id: store_id.clone(),
                    ..position(revision)
                };
                held = advance(&*copy, &held, (to, &puts, &gone, notes)).await.unwrap();
            }
            held
        });
        prop_assert_eq!(subject.runtime.block_on(subject.found()), Some(expected));
        Ok(())
    });
    same.unwrap();
}

fn deletes_stay_deleted_and_notes_stay(subject: &Subject) {
    subject.runtime.block_on(async {
        let copy = subject.open();
        let mut held = sample(1);
        copy.replace(&held).await.unwrap();
        let key: Key = "Service/a".parse().unwrap();
        let again = Arc::new(service("a", 4, json!({ "config": { "a": "again" } })));
        let steps: [(&[Arc<Document>], &[Key]); 4] = [
            (&[], std::slice::from_ref(&key)),
            (&[], std::slice::from_ref(&key)),
            (std::slice::from_ref(&again), &[]),
            (&[], std::slice::from_ref(&key)),
        ];
        for (revision, (puts, removes)) in (2..).zip(steps) {
            held = advance(&*copy, &held, (position(revision), puts, removes, None))
                .await
                .unwrap();
            let found = subject.found().await.unwrap();
            assert_eq!(found, held, "{revision}");
            assert_eq!(
                found.documents.iter().any(|document| document.key == key),
                revision == 4
            );
            assert!(found.notes.has_failed("uid-1"));
        }
        let other = notes("uid-9", 9);
        held = advance(&*copy, &held, (position(9), &[], &[], Some(&other)))
            .await
            .unwrap();
        let found = subject.found().await.unwrap();
        assert_eq!((&*found.notes, &found), (&other, &held));
    });
}

fn a_write_may_be_done_again(subject: &Subject) {
    subject.runtime.block_on(async {
        let copy = subject.open();
        let held = sample(1);
        for _ in 0..3 {
            copy.replace(&held).await.unwrap();
        }
        assert_eq!(subject.found().await.as_ref(), Some(&held));
        let put = Arc::new(service("d", 2, json!({})));
        let gone: Key = "Service/b".parse().unwrap();
        for _ in 0..3 {
            let next = (
                position(2),
                std::slice::from_ref(&put),
                std::slice::from_ref(&gone),
                None,
            );
            let expected = advance(&*copy, &held, next).await.unwrap();
            assert_eq!(subject.found().await, Some(expected));
        }
    });
}

fn a_commit_of_another_store_or_an_older_one_is_refused(subject: &Subject) {
    subject.runtime.block_on(async {
        let copy = subject.open();
        let held = sample(5);
        copy.replace(&held).await.unwrap();
        let other = Position {
            store_id: "store-b".to_owned(),
            ..position(9)
        };
        for to in [other, position(4)] {
            // After a refusal everything may have to be written; the content stays all the same.
            let refused = copy.advance(&to, &[], &[], None).await.unwrap_err();
            assert!(matches!(refused, CopyError::Behind { .. }), "{refused}");
            assert_eq!(subject.found().await.as_ref(), Some(&held));
        }
    });
}

/// Whoever began from an older state, because this copy could not be read then, does not write it over the newer one.
fn nothing_older_of_the_same_store_replaces_it(subject: &Subject) {
    subject.runtime.block_on(async {
        let held = sample(5);
        subject.open().replace(&held).await.unwrap();
        for copy in [subject.open(), subject.open()] {
            let refused = copy.replace(&sample(4)).await.unwrap_err();
            assert!(!refused.is_unreadable(), "{refused}");
            assert_eq!(subject.found().await.as_ref(), Some(&held));
        }
        let again = Loaded {
            documents: Vec::new(),
            ..held
        };
        subject.open().replace(&again).await.unwrap();
        assert_eq!(
            subject.found().await,
            Some(again),
            "of the same revision the later counts"
        );
        // A restored store has another identity.
        let other = of_store("store-b", sample(3));
        subject.open().replace(&other).await.unwrap();
        assert_eq!(subject.found().await, Some(other));
    });
}

/// Three writes by a process that dies after each number of steps in turn: a process that starts then finds what the write
/// began from or what it leads to, whole, and can go on.
fn a_crash_leaves_the_old_or_the_new(subject: &Subject) {
    let put = Arc::new(with_secret("a", 3, "canary-5f1c"));
    let (fresh, gone) = (
        Arc::new(service("new", 3, json!({}))),
        "Service/b".parse::<Key>().unwrap(),
    );
    let (puts, removes) = ([put, fresh], [gone]);
    let other = notes("uid-3", 3);
    subject.runtime.block_on(async {
        for steps in 0.. {
            let store_id = new_store();
            let [first, second, fourth] = [1, 2, 4].map(|revision| of_store(&store_id, sample(revision)));
            let to = Position {
                store_id: store_id.clone(),
                ..position(3)
            };
            let third = progress::advanced(
                Some(second.clone()),
                to.clone(),
                &puts,
                &removes,
                Some(other.clone()),
                "model",
            )
            .unwrap();
            subject.open().replace(&first).await.unwrap();
            let copy = subject.open_as(Vault::with_key(KEY), Some(steps));
            let mut allowed = vec![&first];
            let done = async {
                allowed.push(&second);
                copy.replace(&second).await?;
                allowed = vec![&second, &third];
                advance(&*copy, &second, (to, &puts, &removes, Some(&other))).await?;
                allowed = vec![&third, &fourth];
                copy.replace(&fourth).await?;
                allowed = vec![&fourth];
                Ok::<(), CopyError>(())
            };
            let done = done.await;
            drop(copy);
            let found = subject.found().await.unwrap();
            assert!(allowed.contains(&&found), "after {steps} steps: {:?}", found.position);
            let last = of_store(&store_id, sample(9));
            let next = subject.open();
            next.replace(&last).await.unwrap();
            assert_eq!(subject.found().await.as_ref(), Some(&last), "after {steps} steps");
            if done.is_ok() {
                return;
            }
            assert!(steps < 200, "it never ends");
        }
    });
}

fn without_a_key_texts_are_left_out_and_all_else_is_there(subject: &Subject) {
    subject.runtime.block_on(async {
        let whole = sample(7);
        let plain = subject.open_as(Vault::default(), None);
        plain.replace(&whole).await.unwrap();
        let found = plain.load().await.unwrap().unwrap();
        assert!(found.lacks_secrets() && !whole.lacks_secrets());
        assert!(!format!("{:?}", found.documents).contains("canary"));
        let hashes = |loaded: &Loaded| -> Vec<String> {
            let hash = |document: &Arc<Document>| blaze_domain::config::canonical::hash(&document.spec);
            loaded.documents.iter().map(hash).collect()
        };
        assert_eq!(hashes(&found), hashes(&whole));
        assert_eq!((found.position, found.notes), (whole.position, whole.notes));
    });
}

fn names_without_passwords(subject: &Subject) {
    let place = subject.open().describe();
    assert!(!place.is_empty() && !place.contains("://"), "{place}");
}

macro_rules! suite {
    ($module:ident, $kind:expr, [$($test:ident),* $(,)?]) => {
        mod $module {
            $(#[test]
            fn $test() {
                let Some(kind) = $kind else { return };
                super::$test(&super::Subject::new(kind));
            })*
        }
    };
}

macro_rules! suites {
    ($($module:ident: $kind:expr;)*) => {
        $(suite!($module, $kind, [
            nothing_is_there_before_the_first_write,
            what_was_written_is_found,
            a_large_document_is_kept,
            commits_end_where_a_snapshot_does,
            deletes_stay_deleted_and_notes_stay,
            a_write_may_be_done_again,
            a_commit_of_another_store_or_an_older_one_is_refused,
            nothing_older_of_the_same_store_replaces_it,
            a_crash_leaves_the_old_or_the_new,
            without_a_key_texts_are_left_out_and_all_else_is_there,
            names_without_passwords,
        ]);)*
    };
}

suites! {
    file: Some(super::Kind::File);
    sqlite: Some(super::Kind::Sqlite);
}

#[cfg(feature = "mongodb")]
suites! {
    mongo: super::mongo_server();
}
