//! Which copy is taken at the start.

use std::sync::atomic::Ordering;

use serde_json::json;
use tokio::sync::Semaphore;

use super::*;
use crate::copy::fake::Fake;
use crate::copy::samples::{loaded, notes, service};

fn at(revision: u64, name: &str) -> Loaded {
    loaded(revision, [service(name, revision, json!({}))])
}

/// Copies whose content is unknown.
fn unread(start: &Start) -> Vec<String> {
    let unread = start.targets.iter().filter(|target| !target.is_read);
    unread.map(|target| target.copy.describe()).collect()
}

fn hanging(held: Loaded) -> Arc<dyn LocalCopy> {
    let fake = Fake { permits: Semaphore::new(0), ..Fake::new("database") };
    *fake.held.lock() = Some(held);
    Arc::new(fake)
}

#[tokio::test(start_paused = true)]
async fn the_higher_revision_of_one_store_is_taken() {
    for (in_database, in_file, from) in [(5, 4, "database"), (5, 6, "file"), (5, 5, "file")] {
        let database = Fake::with("database", at(in_database, "a"));
        let file = Fake::with("file", at(in_file, "a"));
        let start = choose(Some(file), Some(database)).await;
        assert_eq!((start.from.as_deref(), unread(&start)), (Some(from), vec![]));
        let written = start.targets.iter().map(|target| target.written.as_ref().unwrap().revision);
        assert_eq!(written.collect::<Vec<_>>(), [in_file, in_database]);
        assert_eq!(start.loaded.unwrap().position.revision, in_database.max(in_file));
    }
}

#[tokio::test(start_paused = true)]
async fn a_database_that_does_not_answer_costs_one_second() {
    let (database, file) = (hanging(at(9, "a")), Fake::with("file", at(5, "a")));
    let began = tokio::time::Instant::now();
    let start = choose(Some(file), Some(database)).await;
    assert_eq!(began.elapsed().as_secs(), DATABASE_LIMIT.as_secs());
    assert_eq!(start.loaded.as_ref().unwrap().position.revision, 5);
    assert_eq!(
        (start.from.as_deref(), unread(&start)),
        (Some("file"), vec!["database".to_owned()])
    );
}

#[tokio::test(start_paused = true)]
async fn without_a_file_a_slow_database_is_waited_for() {
    let slow = Arc::new(Fake { permits: Semaphore::new(0), ..Fake::new("database") });
    *slow.held.lock() = Some(at(9, "a"));
    let database: Arc<dyn LocalCopy> = Arc::clone(&slow) as Arc<dyn LocalCopy>;
    let file: Arc<dyn LocalCopy> = Arc::new(Fake::new("file"));
    let late = async {
        tokio::time::sleep(DATABASE_LIMIT * 3).await;
        slow.permits.add_permits(1);
    };
    let (start, ()) = tokio::join!(choose(Some(file), Some(Arc::clone(&database))), late);
    assert_eq!(start.loaded.unwrap().position.revision, 9);
    let began = tokio::time::Instant::now();
    let start = choose(None, Some(database)).await;
    assert!(start.loaded.is_none() && start.from.is_none());
    assert_eq!(began.elapsed().as_secs(), (DATABASE_LIMIT * PATIENT).as_secs());
}

#[tokio::test(start_paused = true)]
async fn a_copy_that_cannot_be_read_is_told_and_the_other_one_is_taken() {
    let broken = Fake::new("broken");
    broken.is_away.store(true, Ordering::Relaxed);
    let broken: Arc<dyn LocalCopy> = Arc::new(broken);
    let good = Fake::with("good", at(5, "a"));
    for (file, database) in [(&good, &broken), (&broken, &good)] {
        let start = choose(Some(Arc::clone(file)), Some(Arc::clone(database))).await;
        assert_eq!(
            (start.from.as_deref(), unread(&start)),
            (Some("good"), vec!["broken".to_owned()])
        );
    }
    assert!(choose(None, None).await.loaded.is_none());
}

#[tokio::test(start_paused = true)]
async fn notes_of_both_survive() {
    let with_notes =
        |revision, uid| Loaded { notes: Arc::new(notes(uid, revision)), ..at(revision, "a") };
    for newer in [4, 6] {
        let database = Fake::with("database", with_notes(newer, "one"));
        let file = Fake::with("file", with_notes(5, "two"));
        let start = choose(Some(file), Some(database)).await;
        let found = start.loaded.as_ref().unwrap();
        assert!(["one", "two"].iter().all(|uid| found.notes.failed.contains(&(*uid).to_owned())));
        assert_eq!(found.notes.floor, newer.max(5));
        assert!(start.targets.iter().all(|target| target.written.is_none()), "both are behind");
    }
}
