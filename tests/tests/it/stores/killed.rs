//! What a killed process leaves open on the server holds up nobody for long.

use std::time::Duration;

use blaze_config::store::CommitLog as _;
use blaze_tests::servers::abandon_mongo_transaction;
use serde_json::json;

use super::support::{Ledger, server, store, write_through};

/// The server would end such a transaction only after a minute.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_transaction_that_nobody_works_on_is_ended() {
    let server = server();
    let (store, other) = (store(&server).await, store(&server).await);
    let mut ledger = Ledger::new();
    write_through(&store, &mut ledger).await;
    for _ in 0..3 {
        let next = store.head().await.unwrap() + 1;
        let event = json!({ "_id": { "$numberLong": next.to_string() }, "batch": "abandoned" });
        let insert = json!({ "insert": "events", "documents": [event] });
        abandon_mongo_transaction(&server.uri(), "blaze_test", "blaze-config/blaze_test", &insert)
            .unwrap();
        // Both are held up, and one of them ends it.
        let mut of_other = Ledger::new();
        let (one, two) =
            tokio::join!(write_through(&store, &mut ledger), write_through(&other, &mut of_other));
        ledger.extend(of_other);
        println!("written after {one:?} and {two:?}");
        assert!(one.max(two) < Duration::from_secs(5), "{one:?} {two:?}");
        assert!(one.max(two) > Duration::from_millis(300), "nobody was held up");
    }
    // That of another program is left alone.
    let next = store.head().await.unwrap() + 1;
    let insert = json!({
        "insert": "events",
        "documents": [{ "_id": { "$numberLong": next.to_string() } }],
    });
    abandon_mongo_transaction(&server.uri(), "blaze_test", "somebody else", &insert).unwrap();
    let held =
        tokio::time::timeout(Duration::from_secs(2), write_through(&store, &mut Ledger::new()))
            .await;
    assert!(held.is_err(), "{held:?}");
}
