//! Processes that write are killed. What they leave open on the server holds up nobody for long.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use blaze_config::store::{CommitLog as _, MongoStore};
use blaze_tests::servers::abandon_mongo_transaction;
use serde_json::json;

use super::support::{Ledger, Told, check, server, store, write_one, write_through};

/// Set for the process that is to die, with the URI of the server.
const VICTIM: &str = "BLAZE_TEST_WRITES_TO";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_writer_holds_up_nobody_and_lost_nothing() {
    let server = server();
    let store = store(&server).await;
    let mut ledger = Ledger::new();
    let rounds = if blaze_tests::long() { 30 } else { 8 };
    let mut longest = Duration::ZERO;
    for round in 0..rounds {
        let uri = server.uri();
        let written = tokio::task::spawn_blocking(move || write_until_killed(&uri, 40 + round * 7))
            .await
            .unwrap();
        println!("round {round}: {} lines", written.len());
        ledger.extend(written);
        longest = longest.max(write_through(&store, &mut ledger).await);
    }
    println!("at the longest, writing went on after {longest:?}");
    assert!(longest < Duration::from_secs(5), "{longest:?}");
    check(&store, &ledger).await;
}

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
        abandon_mongo_transaction(&server.uri(), "blaze_test", "blaze-config/blaze_test", &insert).unwrap();
        // Both are held up, and one of them ends it.
        let mut of_other = Ledger::new();
        let (one, two) = tokio::join!(write_through(&store, &mut ledger), write_through(&other, &mut of_other));
        ledger.extend(of_other);
        println!("written after {one:?} and {two:?}");
        assert!(one.max(two) < Duration::from_secs(5), "{one:?} {two:?}");
        assert!(one.max(two) > Duration::from_millis(300), "nobody was held up");
    }
    // That of another program is left alone.
    let next = store.head().await.unwrap() + 1;
    let insert = json!({ "insert": "events", "documents": [{ "_id": { "$numberLong": next.to_string() } }] });
    abandon_mongo_transaction(&server.uri(), "blaze_test", "somebody else", &insert).unwrap();
    let held = tokio::time::timeout(Duration::from_secs(2), write_through(&store, &mut Ledger::new())).await;
    assert!(held.is_err(), "{held:?}");
}

/// Runs a writer until it has told of so many commits, and kills it. The last one may be told of in part, or not at all:
/// so what it began counts as unknown until it says more.
fn write_until_killed(uri: &str, count: usize) -> Ledger {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args([
            "--ignored",
            "--exact",
            "--nocapture",
            "stores::killed::writes_until_it_is_killed",
        ])
        .env(VICTIM, uri)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut ledger = Ledger::new();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    while ledger.len() < count {
        let line = lines.next().unwrap().unwrap();
        note(&line, &mut ledger);
    }
    // Not on a condition: it is to hit any point of a commit.
    std::thread::sleep(Duration::from_micros(u64::try_from(count % 13).unwrap() * 400));
    child.kill().unwrap();
    child.wait().unwrap();
    // What was in the pipe.
    for line in lines.map_while(Result::ok) {
        note(&line, &mut ledger);
    }
    ledger
}

fn note(line: &str, ledger: &mut Ledger) {
    let told = match line.split_once(' ') {
        Some(("begins", batch)) => (batch, Told::Unknown),
        Some(("yes", batch)) => (batch, Told::Yes),
        Some(("no", batch)) => (batch, Told::No),
        Some(("unknown", batch)) => (batch, Told::Unknown),
        _ => return,
    };
    ledger.insert(told.0.to_owned(), told.1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "started by a_killed_writer_holds_up_nobody_and_lost_nothing, which needs its death"]
async fn writes_until_it_is_killed() {
    let Some(uri) = std::env::var_os(VICTIM) else { return };
    let store = MongoStore::open(&uri.to_string_lossy(), "blaze_test").await.unwrap();
    println!();
    loop {
        let mut ledger = Ledger::new();
        write_one(&store, &mut ledger).await;
        for (batch, told) in ledger {
            let word = match told {
                Told::Yes => "yes",
                Told::No => "no",
                Told::Unknown => "unknown",
            };
            println!("{word} {batch}");
        }
    }
}
