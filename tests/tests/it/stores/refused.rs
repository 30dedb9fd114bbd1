//! What cannot be used says what to do.

use std::time::{Duration, Instant};

use blaze_config::store::{MongoStore, StoreError};
use blaze_domain::node_file::MongoSection;
use blaze_tests::servers::{MongoOptions, MongoServer};
use blaze_tests::within;

async fn refusal(uri: &str, database: &str) -> StoreError {
    MongoStore::open(&MongoSection::of(uri, database)).await.err().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_without_transactions_is_refused() {
    let options = MongoOptions { alone: true, ..MongoOptions::default() };
    let server = MongoServer::start(options).unwrap();
    let error = refusal(&server.uri(), "blaze").await;
    assert!(matches!(&error, StoreError::Refused(text) if text.contains("--replSet")), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_not_there_shows_within_three_seconds() {
    let begin = Instant::now();
    let error = refusal("mongodb://127.0.0.1:1/?replicaSet=rs0", "blaze").await;
    assert!(matches!(error, StoreError::Unavailable(_)), "{error}");
    assert!(begin.elapsed() < within(Duration::from_secs(3)), "{:?}", begin.elapsed());
}
