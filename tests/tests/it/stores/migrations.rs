//! Migrations of a database: killed at every point, by several at once, and from the first schema.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_config::store::migrate::{Action, Migration, Migrations, Step};
use blaze_config::store::{Archive as _, CommitLog as _, MongoStore, Op, StoreError, TokenStore as _, Upkeep as _};
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_tests::servers::{drop_mongo_database, mongo_command, mongo_insert, shared_mongo, unique_name};
use serde_json::{Value, json};

use super::support::{Ledger, check, record, write_through};

const SCHEMA_1: &str = include_str!("fixtures/schema1.mongodb.jsonl");
/// Set for the process that is to die, with where.
const VICTIM_DATABASE: &str = "BLAZE_TEST_MIGRATES_DATABASE";
const VICTIM_DIES: &str = "BLAZE_TEST_DIES_AT";
const COMMITS: u64 = 300;
const MARK: &str = "migrated";

/// A database that goes with the test.
struct Database {
    uri: String,
    name: String,
}

impl Database {
    fn new() -> Self {
        Self {
            uri: shared_mongo().unwrap(),
            name: unique_name("migrate"),
        }
    }

    async fn open(&self, migrations: &Migrations) -> Result<MongoStore, StoreError> {
        MongoStore::open_with(&self.uri, &self.name, migrations).await
    }

    async fn pending(&self, migrations: &Migrations) -> Vec<String> {
        MongoStore::plan(&self.uri, &self.name, migrations)
            .await
            .unwrap()
            .pending
    }
}

impl Drop for Database {
    fn drop(&mut self) {
        // What stays goes with the server.
        let _ = drop_mongo_database(&self.uri, &self.name);
    }
}

/// A migration for tests: a collection, a rewriting of all documents, an index.
fn further() -> Migration {
    let command = |name: &'static str, text: &'static str| Step {
        name: Cow::Borrowed(name),
        action: Action::Command(Cow::Borrowed(text)),
    };
    Migration {
        number: 2,
        name: Cow::Borrowed("test"),
        min_version: 1,
        sqlite: Vec::new(),
        mongodb: vec![
            command("before", r#"{"create":"further"}"#),
            Step {
                name: Cow::Borrowed("mark"),
                action: Action::Rewrite {
                    text: Cow::Borrowed("mark"),
                    function: mark,
                },
            },
            command(
                "after",
                r#"{"createIndexes":"further","indexes":[{"key":{"a":1},"name":"a"}]}"#,
            ),
        ],
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

/// Migrates in a process of its own, which dies where it is told.
fn migrate_and_die(database: &Database, at: &str) {
    let output = Command::new(std::env::current_exe().unwrap())
        .args([
            "--ignored",
            "--exact",
            "--nocapture",
            "stores::migrations::migrates_and_dies",
        ])
        .env("BLAZE_TEST_MONGODB_URI", &database.uri)
        .env(VICTIM_DATABASE, &database.name)
        .env(VICTIM_DIES, at)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        text.contains("migrating"),
        "{at}: {text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(!output.status.success(), "{at}: {text}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "started by a_migration_that_is_killed_goes_on, which needs its death"]
async fn migrates_and_dies() {
    let Some(database) = std::env::var_os(VICTIM_DATABASE) else {
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
    let uri = shared_mongo().unwrap();
    MongoStore::open_with(&uri, &database.to_string_lossy(), &migrations)
        .await
        .unwrap()
        .close()
        .await;
}

/// A lease whose holder was killed runs out; tests do not wait for that.
async fn end_lease(database: &Database) {
    let now_free = json!({ "update": "meta", "updates": [
        { "q": { "_id": "lease" }, "u": { "$set": { "until": { "$date": { "$numberLong": "0" } } } } },
    ] });
    blaze_tests::servers::mongo_command(&database.uri, &database.name, &now_free).unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_migration_that_is_killed_goes_on() {
    let database = Database::new();
    let own = Migrations::default();
    let all = database.pending(&own).await;
    // Of a new database, too: after each step.
    for label in &all {
        migrate_and_die(&database, label);
        end_lease(&database).await;
    }
    assert_eq!(database.pending(&own).await, Vec::<String>::new());
    let store = database.open(&own).await.unwrap();
    let mut ledger = Ledger::new();
    for _ in 0..COMMITS {
        write_through(&store, &mut ledger).await;
    }
    let migrations = Migrations::default().and([further()]);
    let mut pending = 3;
    for (at, done) in [
        ("0002 test/before", 1),
        ("1", 0),
        ("350", 0),
        ("0002 test/mark", 1),
        ("0002 test/after", 1),
    ] {
        migrate_and_die(&database, at);
        end_lease(&database).await;
        pending -= done;
        assert_eq!(database.pending(&migrations).await.len(), pending, "{at}");
    }
    // The process of before went on all the time, and still does.
    write_through(&store, &mut ledger).await;
    check(&store, &ledger).await;
    let snapshot = database.open(&migrations).await.unwrap().load().await.unwrap();
    let marked = snapshot
        .documents
        .iter()
        .filter(|document| document.annotations.contains_key(MARK))
        .count();
    assert_eq!(
        marked,
        usize::try_from(COMMITS).unwrap(),
        "all but the two of the last commit"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_that_start_at_once_migrate_once() {
    let database = Database::new();
    let migrations = Migrations::default().and([further()]);
    let (a, b, c) = tokio::join!(
        database.open(&migrations),
        database.open(&migrations),
        database.open(&migrations)
    );
    let stores = [a.unwrap(), b.unwrap(), c.unwrap()];
    let mut ids = Vec::new();
    for store in &stores {
        let snapshot = store.load().await.unwrap();
        assert_eq!((snapshot.revision, snapshot.floor), (0, 0));
        ids.push(snapshot.store_id);
    }
    ids.dedup();
    assert_eq!(ids.len(), 1, "{ids:?}");
    stores[0].commit(&[record(1, "first")]).await.unwrap();
    assert_eq!(stores[2].head().await.unwrap(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_that_is_too_old_refuses_to_start() {
    let database = Database::new();
    let mut newer = further();
    newer.min_version = 2;
    database
        .open(&Migrations::default().and([newer]))
        .await
        .unwrap()
        .close()
        .await;
    let error = database.open(&Migrations::default()).await.err().unwrap();
    assert!(
        matches!(&error, StoreError::Refused(text) if text.contains("newer blaze-config")),
        "{error}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_of_schema_1_is_read_and_migrated() {
    let database = Database::new();
    // Collections and indexes as the migration makes them.
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../migrations/0001_first.mongodb");
    let files = std::fs::read_dir(folder).unwrap();
    let files: BTreeSet<_> = files.map(|file| file.unwrap().path()).collect();
    for file in files {
        let command: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
        mongo_command(&database.uri, &database.name, &command).unwrap();
    }
    for line in SCHEMA_1.lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let table = line["collection"].as_str().unwrap();
        mongo_insert(&database.uri, &database.name, table, &line["document"]).unwrap();
    }
    assert_eq!(
        database.pending(&Migrations::default()).await,
        Vec::<String>::new(),
        "its checksum is the released one"
    );
    for migrations in [Migrations::default(), Migrations::default().and([further()])] {
        let store = database.open(&migrations).await.unwrap();
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
        let key: Key = "Node/robot-1".parse().unwrap();
        let history = store.versions(&key, None, 10).await.unwrap();
        assert_eq!(
            history.iter().map(|version| version.change.op).collect::<Vec<_>>(),
            [Op::Delete, Op::Create]
        );
        assert_eq!(store.commits_after(2, 10).await.unwrap().commits.len(), 3);
        assert_eq!(store.documents_at(2, 5).await.unwrap().len(), 3);
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
