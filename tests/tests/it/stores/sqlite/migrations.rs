//! Migrations of a file: killed at every point, they go on where they were.

use std::borrow::Cow;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_config::store::migrate::{Action, Migration, Migrations, Step};
use blaze_config::store::{
    Archive as _, AuditQuery, Change, Commit, CommitLog as _, CommitRecord, Op, SqliteStore, TokenStore as _,
    Upkeep as _,
};
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_runtime::supervisor::Supervisor;
use serde_json::json;

const SCHEMA_1: &str = include_str!("../fixtures/schema1.sql");
/// Set for the process that is to die, with where.
const VICTIM_FILE: &str = "BLAZE_TEST_MIGRATES_FILE";
const VICTIM_DIES: &str = "BLAZE_TEST_DIES_AT";
const DOCUMENTS: u64 = 10_000;
const MARK: &str = "migrated";

/// A migration for tests: a table, a rewriting of all documents, another table.
fn further() -> Migration {
    let table = |name: &'static str| Step {
        name: Cow::Borrowed(name),
        action: Action::Sql(Cow::Owned(format!(
            "CREATE TABLE {name} (id INTEGER PRIMARY KEY) STRICT"
        ))),
    };
    Migration {
        number: 2,
        name: Cow::Borrowed("test"),
        min_version: 1,
        sqlite: vec![
            table("before"),
            Step {
                name: Cow::Borrowed("mark"),
                action: Action::Rewrite {
                    text: Cow::Borrowed("mark"),
                    function: mark,
                },
            },
            table("after"),
        ],
        mongodb: Vec::new(),
    }
}

/// How many documents the process may mark before it dies.
static LEFT: AtomicU64 = AtomicU64::new(u64::MAX);

fn mark(document: &Document) -> Option<Document> {
    if document.annotations.contains_key(MARK) {
        return None;
    }
    if LEFT.fetch_sub(1, Ordering::Relaxed) == 0 {
        std::process::abort();
    }
    let mut new = document.clone();
    new.annotations.insert(MARK.to_owned(), "yes".to_owned());
    Some(new)
}

fn document(number: u64) -> Document {
    Document {
        key: format!("Node/n{number}").parse().unwrap(),
        uid: format!("uid-{number}"),
        revision: 1,
        create_time: Timestamp::from_millis(1_795_244_400_000),
        update_time: Timestamp::from_millis(1_795_244_400_000),
        updated_by: "ops".to_owned(),
        labels: [].into(),
        annotations: [].into(),
        spec: Arc::new(json!({ "layer": "edge", "config": { "number": number } })),
        status: None,
    }
}

async fn fill(path: &Path) {
    let store = SqliteStore::open(path, &Supervisor::new("fill")).await.unwrap();
    let changes = (0..DOCUMENTS).map(|number| Change {
        op: Op::Create,
        document: Arc::new(document(number)),
        previous: None,
        paths: Vec::new(),
    });
    let commit = Commit {
        revision: 1,
        batch: "fill".to_owned(),
        time: Timestamp::from_millis(1_795_244_400_000),
        subject: "ops".to_owned(),
        request_id: "fill".to_owned(),
        changes: changes.collect(),
    };
    let record = CommitRecord {
        commit: Arc::new(commit),
        audit: Vec::new(),
        idempotency: None,
    };
    store.commit(&[record]).await.unwrap();
    store.close().await;
}

/// Migrates in a process of its own, which dies where it is told.
fn migrate_and_die(path: &Path, at: &str) {
    let output = Command::new(std::env::current_exe().unwrap())
        .args([
            "--ignored",
            "--exact",
            "--nocapture",
            "stores::sqlite::migrations::migrates_and_dies",
        ])
        .env(VICTIM_FILE, path)
        .env(VICTIM_DIES, at)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    assert!(
        !output.status.success(),
        "{at}: {}",
        String::from_utf8_lossy(&output.stdout)
    );
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        text.contains("migrating"),
        "{at}: {text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "started by a_migration_that_is_killed_goes_on, which needs its death"]
async fn migrates_and_dies() {
    let Some(path) = std::env::var_os(VICTIM_FILE) else {
        return;
    };
    let at = std::env::var_os(VICTIM_DIES).unwrap_or_default().into_string().unwrap();
    println!("\nmigrating");
    if let Ok(documents) = at.parse() {
        LEFT.store(documents, Ordering::Relaxed);
    }
    let migrations = Migrations::default()
        .and([further()])
        .after_step(Arc::new(move |label: &str| {
            if label == at {
                std::process::abort();
            }
        }));
    let store = SqliteStore::open_with(Path::new(&path), &migrations, &Supervisor::new("victim")).await;
    store.unwrap().close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_migration_that_is_killed_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("store.db");
    // Of a new file, too.
    migrate_and_die(&path, "0001 first/tables");
    fill(&path).await;
    let migrations = Migrations::default().and([further()]);
    let mut pending = SqliteStore::plan(&path, &migrations).await.unwrap().pending.len();
    assert_eq!(pending, 3);
    // After each step, and within the rewriting of documents (10,000 and as many versions).
    for (at, done) in [
        ("0002 test/before", 1),
        ("1", 0),
        ("5000", 0),
        ("11000", 0),
        ("0002 test/mark", 1),
        ("0002 test/after", 1),
    ] {
        migrate_and_die(&path, at);
        pending -= done;
        assert_eq!(
            SqliteStore::plan(&path, &migrations).await.unwrap().pending.len(),
            pending,
            "{at}"
        );
    }
    let store = SqliteStore::open_with(&path, &migrations, &Supervisor::new("last"))
        .await
        .unwrap();
    let snapshot = store.load().await.unwrap();
    assert_eq!((snapshot.revision, snapshot.documents.len()), (1, 10_000));
    for found in &snapshot.documents {
        let number: u64 = found.key.name().as_str().trim_start_matches('n').parse().unwrap();
        let expected = mark(&document(number)).unwrap();
        assert_eq!(*found, expected);
    }
    let versions = store.commits_after(0, 10).await.unwrap().commits;
    assert!(
        versions[0]
            .changes
            .iter()
            .all(|change| change.document.annotations.contains_key(MARK))
    );
    // A program of before can go on with it, as `min_version` did not rise.
    store.close().await;
    SqliteStore::open(&path, &Supervisor::new("before"))
        .await
        .unwrap()
        .close()
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_of_schema_1_is_read_and_migrated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("store.db");
    rusqlite::Connection::open(&path)
        .unwrap()
        .execute_batch(SCHEMA_1)
        .unwrap();
    let plan = SqliteStore::plan(&path, &Migrations::default()).await.unwrap();
    assert_eq!(
        (plan.version, plan.pending.len()),
        (1, plan.target as usize - 1),
        "its checksum is that of the released one"
    );
    for migrations in [Migrations::default(), Migrations::default().and([further()])] {
        let store = SqliteStore::open_with(&path, &migrations, &Supervisor::new("test"))
            .await
            .unwrap();
        let snapshot = store.load().await.unwrap();
        assert_eq!((snapshot.revision, snapshot.floor), (5, 2));
        assert_eq!(snapshot.store_id, "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11");
        let mut keys: Vec<String> = snapshot
            .documents
            .iter()
            .map(|document| document.key.to_string())
            .collect();
        keys.sort();
        assert_eq!(keys, ["Instance/slam/0", "Layer/edge", "Service/slam"]);
        let slam = snapshot
            .documents
            .iter()
            .find(|document| document.key.to_string() == "Service/slam")
            .unwrap();
        assert_eq!(slam.spec["config"]["camera"]["rate_hz"], json!(15));
        assert_eq!(slam.labels["site"], "lab");
        let key: Key = "Node/robot-1".parse().unwrap();
        let history = store.versions(&key, None, 10).await.unwrap();
        assert_eq!(
            history.iter().map(|version| version.change.op).collect::<Vec<_>>(),
            [Op::Delete, Op::Create]
        );
        assert_eq!(store.commits_after(2, 10).await.unwrap().commits.len(), 3);
        let before = store.documents_at(2, 5).await.unwrap();
        assert_eq!(before.len(), 3);
        let held: Vec<String> = before
            .iter()
            .filter(|(_, document)| document.is_some())
            .map(|(key, _)| key.to_string())
            .collect();
        assert_eq!(held, ["Node/robot-1"]);
        let query = AuditQuery {
            limit: 10,
            ..AuditQuery::default()
        };
        assert_eq!(store.audit(&query).await.unwrap().len(), 2);
        assert_eq!(store.tokens(Timestamp::from_millis(0)).await.unwrap().len(), 1);
        assert!(
            store
                .idempotency("request", Timestamp::from_millis(0))
                .await
                .unwrap()
                .is_some()
        );
        store.close().await;
    }
}
