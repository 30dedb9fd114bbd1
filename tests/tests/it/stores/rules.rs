//! The rules for all stores, on the MongoDB that all tests share and on files.

use std::sync::Arc;

use async_trait::async_trait;
use blaze_config::store::{Archive as _, CommitLog as _, FullStore, MongoStore, SqliteStore};
use blaze_conformance::store::Fixture;
use blaze_domain::node_file::MongoSection;
use blaze_runtime::Supervisor;
use blaze_tests::servers::{drop_mongo_database, mongo_command, shared_mongo, unique_name};
use parking_lot::Mutex;
use tempfile::TempDir;

use super::support::record;

/// Databases of one test, dropped with it.
struct Databases {
    uri: String,
    /// Records below the floor are removed at once, and not some minutes later.
    in_a_hurry: bool,
    made: Mutex<Vec<String>>,
}

impl Databases {
    fn new(in_a_hurry: bool) -> Self {
        Self { in_a_hurry, uri: shared_mongo().unwrap(), made: Mutex::new(Vec::new()) }
    }
}

#[async_trait]
impl Fixture for Databases {
    async fn open(&self, name: &str) -> Arc<dyn FullStore> {
        let database = format!("rules_{name}");
        self.made.lock().push(database.clone());
        let store = MongoStore::open(&MongoSection::of(&self.uri, &database)).await.unwrap();
        Arc::new(if self.in_a_hurry { store.in_a_hurry() } else { store })
    }

    fn is_shared(&self) -> bool {
        true
    }
}

impl Drop for Databases {
    fn drop(&mut self) {
        for database in self.made.get_mut() {
            // What stays goes with the server.
            let _ = drop_mongo_database(&self.uri, database);
        }
    }
}

/// Files of one test.
struct Files {
    folder: TempDir,
    supervisor: Supervisor,
}

impl Files {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), supervisor: Supervisor::new("test") }
    }
}

#[async_trait]
impl Fixture for Files {
    async fn open(&self, name: &str) -> Arc<dyn FullStore> {
        let path = self.folder.path().join(format!("{name}.db"));
        Arc::new(SqliteStore::open(&path, &self.supervisor).await.unwrap())
    }

    fn is_shared(&self) -> bool {
        false
    }
}

mod on_files {
    blaze_conformance::store_conformance_tests!(async { super::Files::new() });
}

mod usually {
    blaze_conformance::store_conformance_tests!(async { super::Databases::new(false) });
}

mod removing_at_once {
    blaze_conformance::store_conformance_tests!(async { super::Databases::new(true) });
}

/// What a process remembers of its own writing is not taken for what the log has.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn documents_follow_the_log_when_it_was_set_back() {
    let databases = Databases::new(false);
    let mut found = Vec::new();
    for written in [2, 3] {
        let name = unique_name("set-back");
        databases.made.lock().push(name.clone());
        let store =
            MongoStore::open(&MongoSection::of(&databases.uri, &name)).await.unwrap().in_a_hurry();
        store.tidy().await.unwrap();
        for revision in 1..=written {
            let record = record(revision, &format!("batch-{revision}"));
            store.commit(&[record]).await.unwrap();
        }
        // As a majority does that was lost, or a snapshot of the disk.
        let gone = serde_json::json!({
            "delete": "events",
            "deletes": [{ "q": { "_id": 3 }, "limit": 1 }],
        });
        mongo_command(&databases.uri, &name, &gone).unwrap();
        store.tidy().await.unwrap();
        let other = MongoStore::open(&MongoSection::of(&databases.uri, &name)).await.unwrap();
        let loaded = other.load().await.unwrap();
        found.push((loaded.revision, loaded.documents.len()));
    }
    assert_eq!(found[0], found[1]);
    assert_eq!(found[0].0, 2);
}

/// What was trimmed is gone from the log too, but for its newest record; not before it is safe.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_below_the_floor_are_removed() {
    let databases = Databases::new(false);
    for (in_a_hurry, after_six, after_nine) in [(false, 9, 9), (true, 3, 1)] {
        let name = unique_name("removed");
        databases.made.lock().push(name.clone());
        let store = MongoStore::open(&MongoSection::of(&databases.uri, &name)).await.unwrap();
        let store = if in_a_hurry { store.in_a_hurry() } else { store };
        for revision in 1..=9 {
            let record = record(revision, &format!("batch-{revision}"));
            store.commit(&[record]).await.unwrap();
        }
        for (floor, left) in [(6, after_six), (9, after_nine)] {
            store.trim(floor, 1).await.unwrap();
            store.tidy().await.unwrap();
            assert_eq!(store.records().await.unwrap(), left, "{in_a_hurry} {floor}");
        }
        assert_eq!(store.head().await.unwrap(), 9);
        store.commit(&[record(10, "batch-10")]).await.unwrap();
        assert_eq!(store.load().await.unwrap().documents.len(), 11);
    }
}
