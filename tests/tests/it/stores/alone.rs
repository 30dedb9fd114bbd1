//! A process that is alone may answer reads from memory, and knows at every moment whether it is.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use blaze_config::store::{CommitLog as _, MongoStore, Upkeep as _};

use super::support::{record, server, store};

/// Long enough for several exchanges with the others.
const SOON: Duration = Duration::from_secs(10);

async fn becomes(store: &MongoStore, wanted: Option<u64>) {
    let begin = Instant::now();
    while store.alone() != wanted {
        assert!(begin.elapsed() < SOON, "{:?}, not {wanted:?}", store.alone());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_alone_knows_it() {
    let server = server();
    let first = store(&server).await;
    becomes(&first, Some(0)).await;
    first.commit(&[record(1, "a")]).await.unwrap();
    let second = store(&server).await;
    assert_eq!(second.alone(), None);
    becomes(&first, None).await;
    second.commit(&[record(2, "b")]).await.unwrap();
    assert_eq!(second.alone(), None);
    // Who leaves in order is not waited for.
    second.close().await;
    assert!(second.head().await.is_err() && second.alone().is_none());
    becomes(&first, Some(2)).await;
    // Whoever does not is reckoned with for two minutes.
    drop(store(&server).await);
    let third = store(&server).await;
    becomes(&first, None).await;
    third.close().await;
    for _ in 0..50 {
        assert_eq!(first.alone(), None);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(first.head().await.unwrap(), 2);
}

/// What others wrote is never missing from a memory that its process takes for the newest.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_missing_from_the_memory_of_one_that_is_alone() {
    let server = server();
    let reader = Arc::new(store(&server).await);
    let (acknowledged, ended) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
    let reading = {
        let (reader, acknowledged, ended) =
            (Arc::clone(&reader), Arc::clone(&acknowledged), Arc::clone(&ended));
        std::thread::spawn(move || {
            let (mut alone, mut asked) = (0_u64, 0_u64);
            while !ended.load(Ordering::SeqCst) {
                let before = acknowledged.load(Ordering::SeqCst);
                match reader.alone() {
                    Some(above) => {
                        assert!(above >= before, "{before} was acknowledged, and {above} is read");
                        alone += 1;
                    }
                    None => asked += 1,
                }
                std::thread::sleep(Duration::from_micros(100));
            }
            (alone, asked)
        })
    };
    for round in 1..=4_u64 {
        becomes(&reader, Some(acknowledged.load(Ordering::SeqCst))).await;
        // It comes while the other one reads from memory, and writes as soon as it can.
        let writer = store(&server).await;
        let head = writer.head().await.unwrap();
        assert_eq!(head, 2 * (round - 1));
        for revision in [head + 1, head + 2] {
            writer.commit(&[record(revision, &format!("w{revision}"))]).await.unwrap();
            acknowledged.store(revision, Ordering::SeqCst);
        }
        writer.close().await;
    }
    becomes(&reader, Some(8)).await;
    ended.store(true, Ordering::SeqCst);
    let (alone, asked) = reading.join().unwrap();
    assert!(alone > 100 && asked > 100, "{alone} alone, {asked} not");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_the_database_nobody_is_alone_for_long() {
    let server = server();
    let only = store(&server).await;
    becomes(&only, Some(0)).await;
    server.freeze().unwrap();
    becomes(&only, None).await;
    server.thaw().unwrap();
    becomes(&only, Some(0)).await;
    server.kill().unwrap();
    becomes(&only, None).await;
    server.restart().unwrap();
    becomes(&only, Some(0)).await;
}
