//! Migrations of both kinds of stores: killed at every point they go on where they were, by several
//! at once, and from the first schema.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use blaze_config::store::migrate::{Action, Migration, Migrations, Step};
use blaze_config::store::{AuditQuery, FullStore, MongoStore, Op, SqliteStore, StoreError};
use blaze_domain::config::{Document, Key, Timestamp};
use blaze_domain::node_file::MongoSection;
use blaze_runtime::Supervisor;
use blaze_tests::servers::{
    drop_mongo_database, mongo_command, mongo_insert, shared_mongo, unique_name,
};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::support::{Ledger, check, record, write_through};

const SQL_1: &str = include_str!("fixtures/schema1.sql");
const MONGO_1: &str = include_str!("fixtures/schema1.mongodb.jsonl");
/// Set for the process that is to die: what it migrates, and where it dies.
const VICTIM: &str = "BLAZE_TEST_MIGRATES";
const VICTIM_DIES: &str = "BLAZE_TEST_DIES_AT";
const COMMITS: u64 = 300;
const MARK: &str = "migrated";

/// A store that goes with the test.
struct Home {
    /// Path of a file, or name of a database on the server that all tests share.
    place: String,
    folder: Option<TempDir>,
}

async fn open(place: &str, migrations: &Migrations) -> Result<Arc<dyn FullStore>, StoreError> {
    if place.contains('/') {
        let store =
            SqliteStore::open_with(Path::new(place), migrations, &Supervisor::new("test")).await?;
        return Ok(Arc::new(store));
    }
    let store =
        MongoStore::open_with(&MongoSection::of(&shared_mongo().unwrap(), place), migrations)
            .await?;
    Ok(Arc::new(store))
}

impl Home {
    fn file() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self { place: folder.path().join("store.db").display().to_string(), folder: Some(folder) }
    }

    fn database() -> Self {
        Self { place: unique_name("migrate"), folder: None }
    }

    fn is_file(&self) -> bool {
        self.folder.is_some()
    }

    async fn open(&self, migrations: &Migrations) -> Result<Arc<dyn FullStore>, StoreError> {
        open(&self.place, migrations).await
    }

    async fn pending(&self, migrations: &Migrations) -> Vec<String> {
        let plan = match self.is_file() {
            true => SqliteStore::plan(Path::new(&self.place), migrations).await,
            false => {
                MongoStore::plan(
                    &MongoSection::of(&shared_mongo().unwrap(), &self.place),
                    migrations,
                )
                .await
            }
        };
        plan.unwrap().pending
    }

    fn command(&self, command: &Value) {
        mongo_command(&shared_mongo().unwrap(), &self.place, command).unwrap();
    }

    /// Migrates in a process of its own, which dies where it is told.
    fn migrate_and_die(&self, at: &str) {
        let mut victim = Command::new(std::env::current_exe().unwrap());
        victim.args([
            "--ignored",
            "--exact",
            "--nocapture",
            "stores::migrations::migrates_and_dies",
        ]);
        victim.env(VICTIM, &self.place).env(VICTIM_DIES, at).stdin(Stdio::null());
        if !self.is_file() {
            victim.env("BLAZE_TEST_MONGODB_URI", shared_mongo().unwrap());
        }
        let output = victim.output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        let faults = String::from_utf8_lossy(&output.stderr);
        assert!(text.contains("migrating") && !output.status.success(), "{at}: {text}{faults}");
        if !self.is_file() {
            // A lease whose holder was killed runs out; tests do not wait for that.
            self.command(&json!({ "update": "meta", "updates": [
                {
                    "q": { "_id": "lease" },
                    "u": { "$set": { "until": { "$date": { "$numberLong": "0" } } } },
                },
            ] }));
        }
    }
}

impl Drop for Home {
    fn drop(&mut self) {
        if !self.is_file() {
            // What stays goes with the server.
            let _ = drop_mongo_database(&shared_mongo().unwrap(), &self.place);
        }
    }
}

/// A migration for tests: a table, a rewriting of all documents, another table.
fn further() -> Migration {
    let step = |name: &'static str, action: Action| Step { name: Cow::Borrowed(name), action };
    let rewrite = || Action::Rewrite { text: Cow::Borrowed("mark"), function: mark };
    let sql = |text: &'static str| Action::Sql(Cow::Borrowed(text));
    let command = |text: &'static str| Action::Command(Cow::Borrowed(text));
    Migration {
        number: 2,
        name: Cow::Borrowed("test"),
        min_version: 1,
        sqlite: vec![
            step("before", sql("CREATE TABLE before (id INTEGER PRIMARY KEY) STRICT")),
            step("mark", rewrite()),
            step("after", sql("CREATE TABLE after (id INTEGER PRIMARY KEY) STRICT")),
        ],
        mongodb: vec![
            step("before", command(r#"{"create":"further"}"#)),
            step("mark", rewrite()),
            step(
                "after",
                command(r#"{"createIndexes":"further","indexes":[{"key":{"a":1},"name":"a"}]}"#),
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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "started by the tests of migrations that are killed, which need its death"]
async fn migrates_and_dies() {
    let Some(place) = std::env::var_os(VICTIM) else { return };
    let place = place.into_string().unwrap();
    let at = std::env::var_os(VICTIM_DIES).unwrap_or_default().into_string().unwrap();
    println!("\nmigrating");
    if let Ok(documents) = at.parse() {
        LEFT.store(documents, Ordering::Relaxed);
    }
    let migrations =
        Migrations::default().and([further()]).after_step(Arc::new(move |label: &str| {
            if label == at {
                std::process::abort();
            }
        }));
    open(&place, &migrations).await.unwrap().close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_migration_of_a_file_that_is_killed_goes_on() {
    goes_on_when_killed(Home::file()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_migration_of_a_database_that_is_killed_goes_on() {
    goes_on_when_killed(Home::database()).await;
}

async fn goes_on_when_killed(home: Home) {
    let own = Migrations::default();
    // Of a new store, too: after each step.
    for label in &home.pending(&own).await {
        home.migrate_and_die(label);
    }
    assert_eq!(home.pending(&own).await, Vec::<String>::new());
    let mut before = home.open(&own).await.unwrap();
    let mut ledger = Ledger::new();
    for _ in 0..COMMITS {
        write_through(&*before, &mut ledger).await;
    }
    if home.is_file() {
        before.close().await;
    }
    let migrations = Migrations::default().and([further()]);
    let mut pending = 3;
    // After each step, and within the rewriting of documents and versions.
    for (at, done) in [
        ("0002 test/before", 1),
        ("1", 0),
        ("350", 0),
        ("0002 test/mark", 1),
        ("0002 test/after", 1),
    ] {
        home.migrate_and_die(at);
        pending -= done;
        assert_eq!(home.pending(&migrations).await.len(), pending, "{at}");
    }
    // A program of before goes on, as `min_version` did not rise; on a database it was there all
    // the time.
    if home.is_file() {
        before = home.open(&own).await.unwrap();
    }
    write_through(&*before, &mut ledger).await;
    check(&*before, &ledger).await;
    before.close().await;
    let snapshot = home.open(&migrations).await.unwrap().load().await.unwrap();
    let is_marked = |document: &&Document| document.annotations.contains_key(MARK);
    let marked = snapshot.documents.iter().filter(is_marked).count();
    let all_but_the_last_two = usize::try_from(COMMITS).unwrap();
    assert_eq!(marked, all_but_the_last_two);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_that_start_at_once_migrate_once() {
    let home = Home::database();
    let migrations = Migrations::default().and([further()]);
    let (a, b, c) =
        tokio::join!(home.open(&migrations), home.open(&migrations), home.open(&migrations));
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
async fn a_file_of_schema_1_is_read_and_migrated() {
    let home = Home::file();
    let connection = rusqlite::Connection::open(&home.place).unwrap();
    connection.execute_batch(SQL_1).unwrap();
    drop(connection);
    schema_1_is_read_and_migrated(&home).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_of_schema_1_is_read_and_migrated() {
    let home = Home::database();
    // Collections and indexes as the migration makes them.
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../migrations/0001_first.mongodb");
    let files = std::fs::read_dir(folder).unwrap();
    let files: BTreeSet<_> = files.map(|file| file.unwrap().path()).collect();
    for file in files {
        home.command(&serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap());
    }
    for line in MONGO_1.lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let table = line["collection"].as_str().unwrap();
        mongo_insert(&shared_mongo().unwrap(), &home.place, table, &line["document"]).unwrap();
    }
    schema_1_is_read_and_migrated(&home).await;
}

async fn schema_1_is_read_and_migrated(home: &Home) {
    assert_eq!(
        home.pending(&Migrations::default()).await,
        Vec::<String>::new(),
        "its checksum is the released one"
    );
    for migrations in [Migrations::default(), Migrations::default().and([further()])] {
        let store = home.open(&migrations).await.unwrap();
        let snapshot = store.load().await.unwrap();
        assert_eq!((snapshot.revision, snapshot.floor), (5, 2));
        assert_eq!(snapshot.store_id, "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11");
        let documents = snapshot.documents.iter();
        let mut keys: Vec<String> =
            documents.clone().map(|document| document.key.to_string()).collect();
        keys.sort();
        assert_eq!(keys, ["Instance/slam/0", "Layer/edge", "Service/slam"]);
        let slam = documents.clone().find(|document| document.key.to_string() == "Service/slam");
        let slam = slam.unwrap();
        assert_eq!(slam.spec["config"]["camera"]["rate_hz"], json!(15));
        assert_eq!(slam.labels["site"], "lab");
        let key: Key = "Node/robot-1".parse().unwrap();
        let history = store.versions(&key, None, 10).await.unwrap();
        let ops: Vec<Op> = history.iter().map(|version| version.change.op).collect();
        assert_eq!(ops, [Op::Delete, Op::Create]);
        assert_eq!(store.commits_after(2, 10).await.unwrap().commits.len(), 3);
        let before = store.documents_at(2, 5).await.unwrap();
        assert_eq!(before.len(), 3);
        let held = before.iter().filter(|(_, document)| document.is_some());
        let held: Vec<String> = held.map(|(key, _)| key.to_string()).collect();
        assert_eq!(held, ["Node/robot-1"]);
        if home.is_file() {
            // A database gives no entry that is older than it keeps them.
            let query = AuditQuery { limit: 10, ..AuditQuery::default() };
            assert_eq!(store.audit(&query).await.unwrap().len(), 2);
        }
        let begin = Timestamp::from_millis(0);
        assert_eq!(store.tokens(begin).await.unwrap().len(), 1);
        assert!(store.idempotency("request", begin).await.unwrap().is_some());
        store.close().await;
    }
}
