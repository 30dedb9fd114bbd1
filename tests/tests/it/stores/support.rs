//! What the tests share: commits, and a writer that remembers what it was told.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_config::store::{Change, Commit, CommitError, CommitLog, CommitRecord, MongoStore, Op};
use blaze_domain::config::{Document, Timestamp};
use blaze_domain::node_file::MongoSection;
use blaze_tests::servers::{MongoOptions, MongoServer, unique_name};
use serde_json::json;

pub(crate) fn server() -> MongoServer {
    MongoServer::start(MongoOptions::default()).unwrap()
}

pub(crate) async fn store(server: &MongoServer) -> MongoStore {
    MongoStore::open(&MongoSection::of(&server.uri(), "blaze_test")).await.unwrap()
}

/// A commit of a document that everybody changes, and of one that it makes.
pub(crate) fn record(revision: u64, batch: &str) -> CommitRecord {
    let shared = document("Node/shared", revision);
    let own = document(&format!("Node/n{revision}"), revision);
    let changes = vec![
        change(Op::Update, shared, (revision > 1).then(|| revision - 1)),
        change(Op::Create, own, None),
    ];
    let commit = Commit {
        revision,
        batch: batch.to_owned(),
        time: Timestamp::from_millis(1_795_244_400_000),
        subject: "ops".to_owned(),
        request_id: batch.to_owned(),
        changes,
    };
    CommitRecord { commit: Arc::new(commit), audit: Vec::new(), idempotency: None }
}

fn change(op: Op, document: Document, previous: Option<u64>) -> Change {
    Change { op, document: Arc::new(document), previous, paths: Vec::new() }
}

fn document(key: &str, revision: u64) -> Document {
    Document {
        key: key.parse().unwrap(),
        uid: format!("uid-{revision}"),
        revision,
        create_time: Timestamp::from_millis(0),
        update_time: Timestamp::from_millis(0),
        updated_by: "ops".to_owned(),
        labels: [].into(),
        annotations: [].into(),
        spec: Arc::new(json!({ "layer": "edge", "config": { "revision": revision } })),
        status: None,
    }
}

/// What a writer was told of one commit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Told {
    Yes,
    No,
    Unknown,
}

/// What a writer was told, by batch.
pub(crate) type Ledger = BTreeMap<String, Told>;

/// Tries to write one commit behind the newest.
async fn write_one(store: &(impl CommitLog + ?Sized), ledger: &mut Ledger) -> Option<Told> {
    let head = store.head().await.ok()?;
    let batch = unique_name("batch");
    let told = match store.commit(&[record(head + 1, &batch)]).await {
        Ok(()) => Told::Yes,
        Err(CommitError::Conflict | CommitError::NotWritten(_)) => Told::No,
        Err(CommitError::Unknown(_)) => Told::Unknown,
    };
    ledger.insert(batch, told);
    Some(told)
}

/// Writes until a commit is acknowledged. How long that took.
pub(crate) async fn write_through(
    store: &(impl CommitLog + ?Sized),
    ledger: &mut Ledger,
) -> Duration {
    let begin = Instant::now();
    while write_one(store, ledger).await != Some(Told::Yes) {
        assert!(begin.elapsed() < Duration::from_secs(60), "nothing can be written");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    begin.elapsed()
}

/// What was told is what is there: yes is in the log, no is not, unknown may be; nothing else is in
/// it, and no revision is missing. Documents and log say the same.
pub(crate) async fn check(store: &(impl CommitLog + ?Sized), ledger: &Ledger) {
    let mut commits: Vec<Commit> = Vec::new();
    loop {
        let from = commits.last().map_or(0, |commit| commit.revision);
        let batch = store.commits_after(from, 500).await.unwrap();
        if batch.commits.is_empty() {
            break;
        }
        commits.extend(batch.commits);
    }
    let there: BTreeMap<&str, u64> =
        commits.iter().map(|commit| (commit.batch.as_str(), commit.revision)).collect();
    assert_eq!(there.len(), commits.len(), "a batch is there twice");
    for (batch, told) in ledger {
        match told {
            Told::Yes => {
                assert!(there.contains_key(batch.as_str()), "{batch} was acknowledged and is lost");
            }
            Told::No => {
                assert!(!there.contains_key(batch.as_str()), "{batch} was refused and is there");
            }
            Told::Unknown => {}
        }
    }
    for batch in there.keys() {
        assert!(ledger.contains_key(*batch), "nobody wrote {batch}");
    }
    let snapshot = store.load().await.unwrap();
    let head = commits.last().map_or(0, |commit| commit.revision);
    assert_eq!(snapshot.revision, head);
    assert_eq!(snapshot.documents.len(), if head == 0 { 0 } else { commits.len() + 1 });
    for found in &snapshot.documents {
        assert_eq!(found.spec["config"]["revision"], json!(found.revision));
    }
}
