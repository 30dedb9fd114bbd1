//! A main service as a process, which may be killed and started again on the same ports.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context as _;
use serde_json::json;

use super::Api;
use crate::process::Process;
use crate::servers::free_port;

/// A start on a machine that does much else.
const START: Duration = Duration::from_secs(60);

/// Where documents are kept.
#[derive(Debug, Clone)]
pub enum MainStore {
    /// A file in the folder of the main service.
    Sqlite,
    /// A database on a server.
    Mongo {
        /// Of the server.
        uri: String,
        /// On it.
        database: String,
    },
}

/// A main service without tokens. It is killed when dropped.
pub struct MainService {
    node_file: PathBuf,
    process: Option<Process>,
    rest: SocketAddr,
    grpc: SocketAddr,
}

impl MainService {
    /// Starts one with its files in a folder; ready on return. Blocks the thread.
    ///
    /// # Errors
    /// When it is not built or does not start.
    pub fn start(folder: &Path, store: &MainStore) -> anyhow::Result<Self> {
        let local = |port: u16| SocketAddr::from(([127, 0, 0, 1], port));
        let (rest, grpc) = (local(free_port()?), local(free_port()?));
        let store = match store {
            MainStore::Sqlite => json!({ "sqlite": { "path": folder.join("main.db") } }),
            MainStore::Mongo { uri, database } => {
                json!({ "mongodb": { "uri": uri, "database": database } })
            }
        };
        let file = json!({
            "log": { "level": "warn" },
            "control_plane": {
                "rest": { "listen": rest }, "grpc": { "listen": grpc },
                "admin": { "listen": "127.0.0.1:0" }, "store": store,
            },
        });
        let node_file = folder.join("main.yaml");
        // JSON is YAML.
        std::fs::write(&node_file, file.to_string())?;
        let mut main = Self { node_file, process: None, rest, grpc };
        main.start_again()?;
        Ok(main)
    }

    /// Starts it again on the same store and ports; ready on return. Blocks the thread.
    ///
    /// # Errors
    /// When it does not start.
    pub fn start_again(&mut self) -> anyhow::Result<()> {
        self.kill()?;
        let node_file = self.node_file.to_str().context("the folder has a name in UTF-8")?;
        let process = Process::start("blaze-config", &["--dev", "--config", node_file], None)?;
        process.ready_at("rest", START)?;
        self.process = Some(process);
        Ok(())
    }

    /// SIGKILL, and its end.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        match self.process.take() {
            Some(mut process) => process.kill(),
            None => Ok(()),
        }
    }

    /// Its REST interface.
    #[must_use]
    pub fn rest(&self) -> SocketAddr {
        self.rest
    }

    /// What goes into `config.server` of a worker.
    #[must_use]
    pub fn server(&self) -> String {
        format!("http://{}", self.grpc)
    }

    /// A client of its REST interface.
    ///
    /// # Errors
    /// When none can be made.
    pub fn api(&self) -> anyhow::Result<Api> {
        Api::new(self.rest)
    }

    /// The process; `None` after [`MainService::kill`].
    #[must_use]
    pub fn process(&self) -> Option<&Process> {
        self.process.as_ref()
    }
}
