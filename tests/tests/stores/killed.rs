//! Processes that write are killed. What they leave open on the server holds up nobody for long.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use blaze_config::store::MongoStore;

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
        let written = tokio::task::spawn_blocking(move || write_until_killed(&uri, 40 + round * 7)).await.unwrap();
        println!("round {round}: {} lines", written.len());
        ledger.extend(written);
        longest = longest.max(write_through(&store, &mut ledger).await);
    }
    println!("at the longest, writing went on after {longest:?}");
    assert!(longest < Duration::from_secs(5), "{longest:?}");
    check(&store, &ledger).await;
}

/// Runs a writer until it has told of so many commits, and kills it. The last one may be told of in part, or not at all:
/// so what it began counts as unknown until it says more.
fn write_until_killed(uri: &str, count: usize) -> Ledger {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "--nocapture", "killed::writes_until_it_is_killed"])
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
