//! The server is killed and stands still.

use std::time::{Duration, Instant};

use blaze_config::store::{CommitError, CommitLog as _, MongoStore, StoreError};
use blaze_tests::within;

use super::support::{Ledger, Told, check, record, server, store, write_through};

/// The store is to show within two seconds that it is lost.
const SHOWS: Duration = Duration::from_millis(2_500);

async fn head_is_unavailable(store: &MongoStore) {
    let begin = Instant::now();
    let error = store.head().await.unwrap_err();
    assert!(matches!(error, StoreError::Unavailable(_)), "{error}");
    assert!(begin.elapsed() < within(SHOWS), "{:?}", begin.elapsed());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_server_shows_at_once_and_comes_back() {
    let server = server();
    let (store, other) = (store(&server).await, store(&server).await);
    let mut ledger = Ledger::new();
    write_through(&store, &mut ledger).await;
    for _ in 0..3 {
        server.kill().unwrap();
        head_is_unavailable(&store).await;
        let begin = Instant::now();
        let error = store.commit(&[record(store_head(&ledger) + 1, "lost")]).await.unwrap_err();
        assert!(matches!(error, CommitError::NotWritten(StoreError::Unavailable(_))), "{error}");
        assert!(begin.elapsed() < Duration::from_secs(11), "{:?}", begin.elapsed());
        server.restart().unwrap();
        println!("written {:?} after the restart", write_through(&store, &mut ledger).await);
        // Who follows hears of it again.
        let head = store.head().await.unwrap();
        let begin = Instant::now();
        while other.head().await.is_ok_and(|seen| seen < head) {
            other.foreign_commit().await;
        }
        let (written, noticed) = tokio::join!(write_through(&store, &mut ledger), async {
            while other.head().await.unwrap() <= head {
                other.foreign_commit().await;
            }
        });
        println!("written in {written:?}, noticed in {:?}", begin.elapsed());
        assert!(begin.elapsed() < Duration::from_secs(10));
        let () = noticed;
    }
    check(&store, &ledger).await;
}

fn store_head(ledger: &Ledger) -> u64 {
    u64::try_from(ledger.values().filter(|told| **told == Told::Yes).count()).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_stands_still_is_unavailable_and_goes_on() {
    let server = server();
    let store = store(&server).await;
    let mut ledger = Ledger::new();
    for _ in 0..2 {
        write_through(&store, &mut ledger).await;
        server.freeze().unwrap();
        head_is_unavailable(&store).await;
        let begin = Instant::now();
        let told = store
            .commit(&[record(store_head(&ledger) + 1, &format!("frozen-{}", ledger.len()))])
            .await;
        println!("{told:?} after {:?}", begin.elapsed());
        assert!(told.is_err());
        if matches!(told, Err(CommitError::Unknown(_))) {
            ledger.insert(format!("frozen-{}", ledger.len()), Told::Unknown);
        }
        assert!(begin.elapsed() < Duration::from_secs(20), "{:?}", begin.elapsed());
        server.thaw().unwrap();
        println!("written {:?} after it goes on", write_through(&store, &mut ledger).await);
    }
    check(&store, &ledger).await;
}

/// A server that stands still long enough for its connections to be given up still reads what was
/// sent before.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_sent_to_a_server_that_stands_still_is_not_refused() {
    let server = server();
    let store = store(&server).await;
    let mut ledger = Ledger::new();
    for round in 0..if blaze_tests::long() { 10 } else { 2 } {
        write_through(&store, &mut ledger).await;
        let revision = store_head(&ledger) + 1;
        let batch = format!("sent-{round}");
        server.freeze().unwrap();
        let group = [record(revision, &batch)];
        let (told, ()) = tokio::join!(store.commit(&group), async {
            // Longer than the driver waits for a sign of life (3 s), shorter than a commit is tried
            // (10 s).
            tokio::time::sleep(Duration::from_millis(3_500 + 400 * round)).await;
            server.thaw().unwrap();
        });
        println!("{told:?}");
        match told {
            Ok(()) => ledger.insert(batch, Told::Yes),
            Err(CommitError::Unknown(_)) => ledger.insert(batch, Told::Unknown),
            Err(CommitError::Conflict | CommitError::NotWritten(_)) => {
                ledger.insert(batch, Told::No)
            }
        };
        // What may have been written has to be looked at before memory counts.
        if ledger.values().any(|told| *told == Told::Unknown) {
            assert!(store.alone().is_none_or(|above| above >= revision));
            return check_with_unknown(&store, &mut ledger).await;
        }
    }
    write_through(&store, &mut ledger).await;
    check(&store, &ledger).await;
}

async fn check_with_unknown(store: &MongoStore, ledger: &mut Ledger) {
    write_through(store, ledger).await;
    check(store, ledger).await;
}
