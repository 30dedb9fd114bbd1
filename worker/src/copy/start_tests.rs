//! Which copy is taken at the start.

use std::sync::atomic::Ordering;

use serde_json::json;
use tokio::sync::Semaphore;

use super::*;
use crate::copy::Position;
use crate::copy::fake::Fake;
use crate::copy::samples::{loaded, notes, service, with_secret};

fn at(revision: u64, name: &str) -> Loaded {
    loaded(revision, [service(name, revision, json!({}))])
}

fn hanging(held: Loaded) -> Arc<dyn LocalCopy> {
    let fake = Fake {
        permits: Semaphore::new(0),
        ..Fake::new("database")
    };
    *fake.held.lock() = Some(held);
    Arc::new(fake)
}

#[tokio::test(start_paused = true)]
async fn the_higher_revision_of_one_store_is_taken() {
    for (in_database, in_file, is_file) in [(5, 4, false), (5, 6, true), (5, 5, false)] {
        let database = Fake::with("database", at(in_database, "a"));
        let file = Fake::with("file", at(in_file, "a"));
        let start = choose(Some(&database), Some(&file), DATABASE_LIMIT).await;
        assert_eq!(start.loaded.unwrap().position.revision, in_database.max(in_file));
        assert_eq!(start.from.as_deref(), Some(if is_file { "file" } else { "database" }));
        assert_eq!(start.is_database_current, in_database >= in_file);
        assert_eq!(start.is_file_current, in_file >= in_database);
    }
}

#[tokio::test(start_paused = true)]
async fn of_two_stores_the_later_time_counts() {
    let mut other = at(1, "b");
    other.position = Position {
        store_id: "store-b".to_owned(),
        as_of: blaze_domain::config::Timestamp::from_millis(i64::MAX),
        ..other.position
    };
    let (database, file) = (Fake::with("database", at(9, "a")), Fake::with("file", other));
    let start = choose(Some(&database), Some(&file), DATABASE_LIMIT).await;
    assert_eq!(start.loaded.unwrap().position.store_id, "store-b");
}

#[tokio::test(start_paused = true)]
async fn a_database_that_does_not_answer_costs_one_second() {
    let (database, file) = (hanging(at(9, "a")), Fake::with("file", at(5, "a")));
    let began = tokio::time::Instant::now();
    let start = choose(Some(&database), Some(&file), DATABASE_LIMIT).await;
    assert_eq!(began.elapsed().as_secs(), DATABASE_LIMIT.as_secs());
    assert_eq!(start.loaded.as_ref().unwrap().position.revision, 5);
    assert!(start.is_from_file && start.is_file_current && !start.is_database_current);
    assert!(start.is_unread(&*database) && !start.is_unread(&*file));
    assert!(matches!(&start.problems[..], [Problem { place, error: CopyError::Away { .. } }] if place == "database"));
}

#[tokio::test(start_paused = true)]
async fn without_a_file_a_slow_database_is_waited_for() {
    let slow = Arc::new(Fake {
        permits: Semaphore::new(0),
        ..Fake::new("database")
    });
    *slow.held.lock() = Some(at(9, "a"));
    let database: Arc<dyn LocalCopy> = Arc::clone(&slow) as Arc<dyn LocalCopy>;
    let file: Arc<dyn LocalCopy> = Arc::new(Fake::new("file"));
    let late = async {
        tokio::time::sleep(DATABASE_LIMIT * 3).await;
        slow.permits.add_permits(1);
    };
    let (start, ()) = tokio::join!(choose(Some(&database), Some(&file), DATABASE_LIMIT), late);
    assert_eq!(start.loaded.unwrap().position.revision, 9);
    let began = tokio::time::Instant::now();
    let start = choose(Some(&database), None, DATABASE_LIMIT).await;
    assert!(start.loaded.is_none() && start.from.is_none());
    assert_eq!(began.elapsed().as_secs(), (DATABASE_LIMIT * PATIENT).as_secs());
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_cannot_be_read_is_told_and_the_other_one_is_taken() {
    let broken = Fake::new("database");
    broken.is_away.store(true, Ordering::Relaxed);
    let broken: Arc<dyn LocalCopy> = Arc::new(broken);
    let good = Fake::with("file", at(5, "a"));
    let start = choose(Some(&broken), Some(&good), DATABASE_LIMIT).await;
    assert_eq!((start.problems.len(), start.from.as_deref()), (1, Some("file")));
    let start = choose(Some(&good), Some(&broken), DATABASE_LIMIT).await;
    assert!(start.loaded.is_some() && start.is_database_current && !start.is_from_file);
    assert!(choose(None, None, DATABASE_LIMIT).await.loaded.is_none());
}

#[tokio::test(start_paused = true)]
async fn notes_of_both_survive() {
    let with_notes = |revision, uid| Loaded {
        notes: Arc::new(notes(uid, revision)),
        ..at(revision, "a")
    };
    let (database, file) = (
        Fake::with("database", with_notes(6, "one")),
        Fake::with("file", with_notes(5, "two")),
    );
    let start = choose(Some(&database), Some(&file), DATABASE_LIMIT).await;
    let found = start.loaded.unwrap();
    assert!(found.notes.has_failed("one") && found.notes.has_failed("two"));
    assert!(found.notes.all_told().all(|(_, told)| told.revision == 6));
    // Neither holds both.
    assert!(!start.is_database_current && !start.is_file_current);
}

#[tokio::test(start_paused = true)]
async fn at_the_same_revision_the_one_with_secrets_is_taken() {
    let full = loaded(7, [with_secret("slam", 7, "canary")]);
    let without = Loaded {
        documents: vec![crate::copy::Vault::default().seal(&full.documents[0]).unwrap()],
        ..full.clone()
    };
    let (database, file) = (Fake::with("database", without), Fake::with("file", full));
    let start = choose(Some(&database), Some(&file), DATABASE_LIMIT).await;
    assert!(start.is_from_file && !start.loaded.unwrap().lacks_secrets());
}
