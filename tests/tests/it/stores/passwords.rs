//! A password that is replaced while it is in use.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use blaze_config::store::{self, Change, CommitError, CommitRecord, FullStore};
use blaze_domain::node_file::{MongoSection, StoreSection};
use blaze_runtime::Supervisor;
use blaze_tests::servers::{MongoServer, mongo_command};
use blaze_tests::within;
use blaze_worker::lease::{Lease, MongoLease};
use serde_json::json;
use tokio::time::{Instant, sleep};

use super::support::{record, server};

const SOON: Duration = Duration::from_secs(20);
/// Of three documents, each of which may have 16 MiB.
const LARGE: usize = 5 * 1024 * 1024;

/// What uses the database, with a password in a file.
struct Users {
    store: Arc<dyn FullStore>,
    lease: MongoLease,
    revision: u64,
}

impl Users {
    async fn open(server: &MongoServer, file: PathBuf, supervisor: &Supervisor) -> Self {
        let uri = server.uri().replace("mongodb://", "mongodb://blaze@");
        let section = MongoSection { password_file: Some(file), ..MongoSection::of(&uri, "main") };
        let store = StoreSection::MongoDb(section.clone());
        let store = store::open(&store, supervisor).await.unwrap();
        let lease = MongoLease::new(section, "edge".parse().unwrap(), "me".to_owned());
        Self { store, lease, revision: 0 }
    }

    /// Both write; the store also what is too large for one record, which takes a session.
    async fn write(&mut self) -> Result<(), String> {
        for bytes in [1, LARGE] {
            let next = self.revision + 1;
            match self.store.commit(&[sized(next, bytes)]).await {
                Ok(()) => self.revision = next,
                Err(CommitError::Conflict) => {
                    self.revision = self.store.head().await.map_err(|error| error.to_string())?;
                    return Err("a conflict".to_owned());
                }
                Err(error) => return Err(error.to_string()),
            }
        }
        let held = self.lease.hold(SOON, None).await?;
        held.is_held.then_some(()).ok_or_else(|| "not held".to_owned())
    }

    async fn write_soon(&mut self) {
        let begin = Instant::now();
        while let Err(error) = self.write().await {
            assert!(begin.elapsed() < within(SOON), "{error}");
            sleep(Duration::from_millis(100)).await;
        }
    }
}

fn sized(revision: u64, bytes: usize) -> CommitRecord {
    let mut record = record(revision, &format!("b{revision}"));
    let commit = Arc::make_mut(&mut record.commit);
    let own = commit.changes.last().unwrap().clone();
    for number in 0..2 {
        let mut document = (*own.document).clone();
        document.key = format!("Node/n{revision}-{number}").parse().unwrap();
        commit.changes.push(Change { document: Arc::new(document), ..own.clone() });
    }
    for change in &mut commit.changes[1..] {
        let document = Arc::make_mut(&mut change.document);
        document.spec = Arc::new(json!({ "layer": "edge", "config": { "t": "x".repeat(bytes) } }));
    }
    record
}

fn set(server: &MongoServer, what: &str, password: &str) {
    let command = match what {
        "createUser" => json!({ what: "blaze", "pwd": password, "roles": ["root"] }),
        _ => json!({ what: "blaze", "pwd": password }),
    };
    mongo_command(&server.uri(), "admin", &command).unwrap();
}

fn write(file: &Path, password: &str) {
    let new = file.with_extension("new");
    std::fs::write(&new, format!("{password}\n")).unwrap();
    std::fs::rename(new, file).unwrap();
}

/// Has the server end the connections of before, and waits until both have logged in anew.
async fn reconnects(users: &mut Users, server: &MongoServer) {
    server.restart().unwrap();
    users.write_soon().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_password_that_is_replaced_on_server_and_in_its_file_is_used() {
    let (server, folder) = (server(), tempfile::tempdir().unwrap());
    let (file, supervisor) = (folder.path().join("password"), Supervisor::new("test"));
    set(&server, "createUser", "one");
    write(&file, "one");
    let mut users = Users::open(&server, file.clone(), &supervisor).await;
    users.write_soon().await;
    // The server first.
    set(&server, "updateUser", "two");
    write(&file, "two");
    reconnects(&mut users, &server).await;
    // The file first: until the server takes it, the connections of before serve.
    write(&file, "three");
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(3) {
        users.write().await.unwrap();
        sleep(Duration::from_millis(100)).await;
    }
    set(&server, "updateUser", "three");
    reconnects(&mut users, &server).await;
    // A file that is just being written is none.
    std::fs::write(&file, "").unwrap();
    reconnects(&mut users, &server).await;
    users.store.close().await;
}
