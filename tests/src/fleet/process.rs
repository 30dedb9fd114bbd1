//! A worker as a process of its own.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use serde_json::Value;

use crate::admin::Admin;
use crate::process::Process;

use super::WorkerSpec;

/// A start on a machine that does much else.
const START: Duration = Duration::from_secs(60);

/// A running `blaze-worker`; it is killed when dropped.
pub struct WorkerProcess {
    process: Process,
    admin: Admin,
}

impl WorkerProcess {
    /// Starts one, with its node file and copies in a folder; ready on return, and so it needs a
    /// main service or a copy. Blocks the thread.
    ///
    /// # Errors
    /// When it is not built or does not start.
    pub fn start(folder: &Path, spec: &WorkerSpec) -> anyhow::Result<Self> {
        let mut file = spec.node_file();
        let name = spec.node.as_str();
        file["log"] = serde_json::json!({ "level": "warn" });
        file["admin"] = serde_json::json!({ "worker": "127.0.0.1:0" });
        file["worker"] = serde_json::json!({ "state_dir": folder.join(name) });
        let path = folder.join(format!("{name}.yaml"));
        std::fs::write(&path, file.to_string())?;
        let path = path.to_str().context("the folder has a name in UTF-8")?;
        let process = Process::start("blaze-worker", &["--config", path], None)?;
        let address = process.ready_at("admin", START)?;
        Ok(Self { process, admin: Admin { address, namespace: None } })
    }

    /// `/v1/status`. Blocks the thread.
    ///
    /// # Errors
    /// When it does not answer.
    pub fn status(&self) -> anyhow::Result<Value> {
        self.admin.json("/v1/status")
    }

    /// Its admin port.
    #[must_use]
    pub fn admin(&self) -> &Admin {
        &self.admin
    }

    /// The process.
    #[must_use]
    pub fn process(&self) -> &Process {
        &self.process
    }
}
