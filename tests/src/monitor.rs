//! `blaze-monitor` as a process of its own, beside a flow.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context as _;
use serde_json::Value;

use crate::admin::Admin;
use crate::flow::{FlowProcess, FlowSpec};
use crate::process::Process;
use crate::wait;

/// Where a monitor must say `ready`, on a busy machine.
const START: Duration = Duration::from_secs(30);

/// A running `blaze-monitor`; it is killed when dropped.
pub struct MonitorProcess {
    process: Process,
    admin: Admin,
    /// Its node file.
    pub file: PathBuf,
    _folder: tempfile::TempDir,
}

impl MonitorProcess {
    /// Starts the monitor of a flow's node with its node file and `more` lines, and waits until it
    /// is ready.
    ///
    /// # Errors
    /// When it is not built, or not ready in time.
    pub fn beside(flow: &FlowProcess, more: &str) -> anyhow::Result<Self> {
        Self::start(&flow.spec, &[("admin.flow", &flow.admin().address.to_string())], more)
    }

    /// The same of a node whose flow does not run; `overrides` are keys of the node file.
    ///
    /// # Errors
    /// As [`MonitorProcess::beside`].
    pub fn start(spec: &FlowSpec, overrides: &[(&str, &str)], more: &str) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("blaze.yaml");
        std::fs::write(&file, spec.to_yaml(folder.path()) + more)?;
        let path = file.to_str().context("the folder has no name in UTF-8")?.to_owned();
        let sets: Vec<String> =
            overrides.iter().map(|(key, value)| format!("{key}={value}")).collect();
        let mut arguments = vec!["--config", &path, "--set", "admin.monitor=127.0.0.1:0"];
        sets.iter().for_each(|set| arguments.extend(["--set", set]));
        let namespace = spec.host.as_ref().map(|host| host.namespace.clone());
        let process = Process::start("blaze-monitor", &arguments, namespace.as_deref())?;
        let address = process.ready_at("admin", START)?;
        Ok(Self { process, admin: Admin { address, namespace }, file, _folder: folder })
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

    /// Codes of the problems that it names now, with the names of their subjects.
    #[must_use]
    pub fn problems(&self) -> Vec<(String, String)> {
        let health = self.admin.json("/v1/health").unwrap_or_default();
        let of_services = health["services"].as_array().into_iter().flatten();
        let problems = of_services.flat_map(|service| service["problems"].as_array());
        let rows = problems.chain(health["problems"].as_array()).flatten();
        let text = |row: &Value, key: &str| row[key].as_str().unwrap_or_default().to_owned();
        rows.map(|row| (text(row, "code"), text(row, "name"))).collect()
    }

    /// Waits until a problem is there, or is over.
    ///
    /// # Errors
    /// When it is not so in time.
    pub fn wait_problem(
        &self,
        code: &str,
        is_there: bool,
        deadline: Duration,
    ) -> anyhow::Result<()> {
        let what = format!("problem {code} is {}", if is_there { "there" } else { "over" });
        let holds = || self.problems().iter().any(|(found, _)| found == code) == is_there;
        let last = || format!("{:?}\n{}", self.problems(), self.process.tail());
        wait::until(&what, deadline, holds, last).map(drop)
    }
}
