//! One counter that many raise at once: what the counter says is how often somebody was told that it did.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};
use tokio::task::JoinSet;

use super::client::{Client, Must, Told, Via};
use super::count;
use super::stage::{Stage, within};

const WRITERS: usize = 32;
const NAME: &str = "counter";

/// What the writers were told in vain.
#[derive(Debug, Default)]
struct Refusals {
    stale: AtomicUsize,
    missing: AtomicUsize,
    /// Given up by the service: the other process was first again and again.
    no: AtomicUsize,
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_increment_of_32_writers_through_two_processes_is_lost_or_counted_twice() {
    let stage = Stage::mongo();
    let mains = [stage.start("one"), stage.start("two")];
    let token = stage.admin_token();
    let rest = Client::new(Via::Rest, &mains[0], &token);
    let clients = [rest.clone(), rest.at(Via::Grpc, &mains[1])];
    let first = match rest.put(NAME, &json!({ "n": 0 }), Must::BeAbsent).await {
        Told::Yes(revision) => revision,
        other => panic!("{other:?}"),
    };
    let goal = count(10_000, 200);
    let limit = Duration::from_secs(if blaze_tests::long() { 1800 } else { 60 });
    let (done, refusals) = (Arc::new(AtomicUsize::new(0)), Arc::new(Refusals::default()));
    let begin = Instant::now();
    let mut writing = JoinSet::new();
    for index in 0..WRITERS {
        // The connection of gRPC is shared, as a service would; those of REST are as many as are needed.
        let client = clients[index % 2].clone();
        let (done, refusals) = (Arc::clone(&done), Arc::clone(&refusals));
        writing.spawn(async move {
            while done.load(Ordering::Relaxed) < goal {
                raise(&client, &done, &refusals).await;
            }
        });
    }
    within("the writers", limit, writing.join_all()).await;
    let successes = done.load(Ordering::Relaxed);
    println!("{successes} successes in {:?}, {refusals:?}", begin.elapsed());
    for client in &clients {
        let (revision, config) = client.get(NAME).await.unwrap().unwrap();
        assert_eq!(config, json!({ "n": successes }), "{:?}", client.via);
        assert_eq!(revision, first + successes as u64, "nothing else was committed");
    }
    assert!(successes >= goal);
    // Without them the writers would not have met.
    assert!(refusals.stale.load(Ordering::Relaxed) > 0 && refusals.missing.load(Ordering::Relaxed) > 0);
    statuses(&clients[0], first).await;
}

/// Reads, and writes one more if nobody was faster.
async fn raise(client: &Client, done: &AtomicUsize, refusals: &Refusals) {
    let (revision, config) = client.get(NAME).await.unwrap().unwrap();
    let number = config["n"].as_u64().unwrap();
    let next = json!({ "n": number + 1 });
    if number % 16 == 8 {
        refused(client, &next, Must::Nothing, "precondition_required").await;
        refused(client, &next, Must::BeAbsent, "precondition_failed").await;
        refused(client, &next, Must::HaveRevision(revision - 1), "precondition_failed").await;
        refusals.missing.fetch_add(1, Ordering::Relaxed);
    }
    match client.put(NAME, &next, Must::HaveRevision(revision)).await {
        Told::Yes(written) => {
            assert!(written > revision);
            done.fetch_add(1, Ordering::Relaxed);
        }
        Told::Refused(code) => {
            assert_eq!(code, "precondition_failed");
            refusals.stale.fetch_add(1, Ordering::Relaxed);
        }
        Told::No(_) => {
            refusals.no.fetch_add(1, Ordering::Relaxed);
        }
        Told::Unknown(reason) => panic!("nothing broke, and yet: {reason}"),
    }
}

async fn refused(client: &Client, config: &Value, must: Must, code: &str) {
    match client.put(NAME, config, must).await {
        Told::Refused(found) => assert_eq!(found, code, "{must:?}"),
        Told::No(_) => {}
        other @ (Told::Yes(_) | Told::Unknown(_)) => panic!("{must:?}: {other:?}"),
    }
}

/// The same refusals as numbers of HTTP.
async fn statuses(client: &Client, stale: u64) {
    let (path, body) = (format!("/api/v1/services/{NAME}"), json!({ "spec": {} }));
    for (must, status) in [(None, 428), (Some(stale), 412)] {
        for method in [Method::PUT, Method::PATCH, Method::DELETE] {
            let headers: Vec<(&str, String)> = must
                .map(|revision| ("if-match", format!("\"{revision}\"")))
                .into_iter()
                .collect();
            let answer = client
                .rest
                .send(client.main.at().rest, method.clone(), &path, &headers, Some(&body))
                .await;
            let answer = answer.unwrap();
            assert_eq!(answer.status, status, "{method} {}", answer.text);
            assert!(
                answer.body["revision"].as_u64() > Some(stale),
                "it tells what it is now: {}",
                answer.text
            );
        }
    }
}
