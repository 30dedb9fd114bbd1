//! A store, and processes of the main service on it.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::admin::Admin;
use blaze_tests::process::{self, Process};
use blaze_tests::servers::{MongoOptions, MongoServer, unique_name};
use blaze_tests::wait;
use parking_lot::{Mutex, RwLock};
use serde_json::{Value, json};
use tempfile::TempDir;

/// A start on a machine that does much else; measured below a second.
const START: Duration = Duration::from_secs(60);

/// Where documents are kept.
pub(crate) enum Store {
    /// A file in the stage's folder.
    Sqlite,
    /// A server of this test alone, and a database of it.
    Mongo { server: Box<MongoServer>, database: String },
}

/// What all processes of one test have in common: keys and a store.
pub(crate) struct Stage {
    pub(crate) folder: TempDir,
    pub(crate) store: Store,
    /// The key that signs, HS256, id `k1`.
    pub(crate) secret: Vec<u8>,
}

/// Addresses of a process; others after each start.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Addresses {
    pub(crate) rest: SocketAddr,
    pub(crate) grpc: SocketAddr,
    pub(crate) admin: SocketAddr,
}

/// One main service.
pub(crate) struct Main {
    name: String,
    node_file: PathBuf,
    process: Mutex<Option<Process>>,
    addresses: RwLock<Addresses>,
}

impl Stage {
    pub(crate) fn sqlite() -> Self {
        Self::new(Store::Sqlite)
    }

    pub(crate) fn mongo() -> Self {
        let server = Box::new(MongoServer::start(MongoOptions::default()).unwrap());
        let database = unique_name("main");
        Self::new(Store::Mongo { server, database })
    }

    fn new(store: Store) -> Self {
        let folder = TempDir::new().unwrap();
        let secret = blaze_auth::generate_key(blaze_auth::Algorithm::Hs256).unwrap();
        let secret = secret.private.trim_end().as_bytes().to_vec();
        let stage = Self { folder, store, secret };
        stage.write("jwt.key", &stage.secret);
        stage.write("enc.key", blaze_auth::generate_encryption_key().unwrap().as_bytes());
        stage
    }

    /// Another store of the same kind (its server, if any, too is another one) with the same keys.
    pub(crate) fn elsewhere(&self) -> Self {
        let other = match self.store {
            Store::Sqlite => Self::sqlite(),
            Store::Mongo { .. } => Self::mongo(),
        };
        for name in ["jwt.key", "enc.key"] {
            std::fs::copy(self.path(name), other.path(name)).unwrap();
        }
        Self { secret: self.secret.clone(), ..other }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// The server behind the store; only on MongoDB.
    pub(crate) fn server(&self) -> &MongoServer {
        match &self.store {
            Store::Mongo { server, .. } => server,
            Store::Sqlite => panic!("SQLite has no server"),
        }
    }

    /// Whether another process may work on the same store.
    pub(crate) fn is_shared(&self) -> bool {
        matches!(self.store, Store::Mongo { .. })
    }

    /// A process on this store, ready.
    pub(crate) fn start(&self, name: &str) -> Arc<Main> {
        self.launch(name, "warn", None)
    }

    /// A process that logs all that it can; all of that goes to a file, which is named.
    pub(crate) fn start_talkative(&self, name: &str) -> (Arc<Main>, PathBuf) {
        let log = self.path(&format!("{name}.log"));
        (self.launch(name, "trace", Some(&log)), log)
    }

    fn launch(&self, name: &str, level: &str, log: Option<&Path>) -> Arc<Main> {
        let node_file = self.node_file(name, level);
        let (process, addresses) = launch(&node_file, log).unwrap();
        Arc::new(Main {
            name: name.to_owned(),
            node_file,
            process: Mutex::new(Some(process)),
            addresses: RwLock::new(addresses),
        })
    }

    /// Runs a command of the program that ends by itself; what it said on stderr.
    pub(crate) fn command(&self, arguments: &[&str]) -> anyhow::Result<String> {
        let node_file = self.node_file("command", "warn");
        let output = Command::new(process::binary("blaze-config")?)
            .arg("--config")
            .arg(node_file)
            .args(arguments)
            .output()?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        anyhow::ensure!(output.status.success(), "blaze-config {arguments:?}: {said}");
        Ok(said)
    }

    /// JSON is YAML.
    fn node_file(&self, name: &str, level: &str) -> PathBuf {
        let path = self.path(&format!("{name}.yaml"));
        let file = json!({
            "log": { "level": level },
            "control_plane": {
                "rest": { "listen": "127.0.0.1:0" },
                "grpc": { "listen": "127.0.0.1:0" },
                "admin": { "listen": "127.0.0.1:0" },
                "store": self.store_section(),
                "auth": { "keys": [{ "id": "k1", "alg": "HS256", "file": self.path("jwt.key"),
                    "sign": true }] },
                "encryption": { "keys": [{ "id": "e1", "file": self.path("enc.key") }] },
                // Tests open more watches of one subject than anybody may.
                "limits": { "watches_per_subject": 10_000 },
            },
        });
        std::fs::write(&path, serde_json::to_string_pretty(&file).unwrap()).unwrap();
        path
    }

    fn store_section(&self) -> Value {
        match &self.store {
            Store::Sqlite => json!({ "sqlite": { "path": self.path("config.db") } }),
            Store::Mongo { server, database } => {
                json!({ "mongodb": { "uri": server.uri(), "database": database } })
            }
        }
    }
}

impl Main {
    pub(crate) fn at(&self) -> Addresses {
        *self.addresses.read()
    }

    /// SIGKILL, and its end.
    pub(crate) fn kill(&self) {
        if let Some(mut process) = self.process.lock().take() {
            process.kill().unwrap();
        }
    }

    /// SIGTERM, and its exit code. Blocks the thread.
    pub(crate) fn stop(&self) -> Option<i32> {
        let mut process = self.process.lock().take().expect("it runs");
        process.terminate(Duration::from_secs(20)).unwrap()
    }

    /// Starts it again on the same store, with other ports; ready on return. Blocks the thread.
    pub(crate) fn start_again(&self) {
        let (process, addresses) = launch(&self.node_file, None).unwrap();
        *self.addresses.write() = addresses;
        *self.process.lock() = Some(process);
    }

    /// The admin port.
    pub(crate) fn admin(&self) -> Admin {
        Admin { address: self.at().admin, namespace: None }
    }

    /// What it printed on stdout since its last start.
    pub(crate) fn printed(&self) -> String {
        let process = self.process.lock();
        process.as_ref().map(|process| process.stdout().join("\n")).unwrap_or_default()
    }

    /// Resident memory in bytes.
    pub(crate) fn resident_bytes(&self) -> u64 {
        let process = self.process.lock();
        process.as_ref().and_then(Process::resident_bytes).unwrap_or_default()
    }
}

impl std::fmt::Debug for Main {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {:?}", self.name, self.at())
    }
}

fn launch(node_file: &Path, log: Option<&Path>) -> anyhow::Result<(Process, Addresses)> {
    let node_file = node_file.to_str().context("the folder has a name in UTF-8")?;
    let arguments = ["--config", node_file];
    let process = match log {
        Some(log) => Process::start_logged("blaze-config", &arguments, log)?,
        None => Process::start("blaze-config", &arguments, None)?,
    };
    let line = wait::until_some(
        "the ready line",
        START,
        || process.stdout().into_iter().find(|line| line.starts_with("ready ")),
        || process.tail(),
    )?;
    let address = |name: &str| -> anyhow::Result<SocketAddr> {
        let start = format!("{name}=");
        let word = line.split(' ').find_map(|word| word.strip_prefix(&start));
        Ok(word.with_context(|| format!("no {name} in {line:?}"))?.parse()?)
    };
    let addresses =
        Addresses { rest: address("rest")?, grpc: address("grpc")?, admin: address("admin")? };
    Ok((process, addresses))
}

/// The runtime of a test asks blocking helpers from threads of their own.
pub(crate) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    tokio::task::spawn_blocking(work).await.unwrap()
}

/// An answer in time, or a failed test.
pub(crate) async fn within<T>(what: &str, limit: Duration, work: impl Future<Output = T>) -> T {
    let done = tokio::time::timeout(limit, work).await;
    done.unwrap_or_else(|_| panic!("{what}: not within {limit:?}"))
}

/// Microseconds since the first call: one clock for writers and watchers of this process.
pub(crate) fn micros() -> u64 {
    static START_OF_TEST: OnceLock<std::time::Instant> = OnceLock::new();
    let start = START_OF_TEST.get_or_init(std::time::Instant::now);
    u64::try_from(start.elapsed().as_micros()).unwrap()
}
