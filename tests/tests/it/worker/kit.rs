//! Robots that each have a Redis of their own, and service processes on them.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::Subscription;
use blaze_brokers::redis::RedisKeys;
use blaze_domain::config::merge::merge_patch;
use blaze_tests::process::Process;
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use blaze_tests::wait;
use serde_json::{Value, json};

use super::stage::{PATIENCE, Service, Stage, Worker, addresses, next, section};

/// A node with a Redis, and the file of its worker.
pub(crate) struct Robot {
    pub(crate) node: &'static str,
    pub(crate) redis: RedisServer,
    file: Value,
}

impl Robot {
    pub(crate) fn new(stage: &Stage, node: &'static str) -> Self {
        let redis = RedisServer::start(RedisKind::Redis, RedisOptions::default()).unwrap();
        let brokers = json!({ "node": { "redis": { "url": redis.url() } } });
        let file = stage.node_file(node, &brokers, &json!({}));
        Self { node, redis, file }
    }

    /// The same with something else in the node file.
    pub(crate) fn with(mut self, change: &Value) -> Self {
        merge_patch(&mut self.file, change);
        self
    }

    /// Its worker, ready; after a start on the same copies as before.
    pub(crate) fn worker(&self, stage: &Stage) -> Worker {
        self.worker_unready(stage).ready()
    }

    /// Its worker, which may have nothing to serve yet.
    pub(crate) fn worker_unready(&self, stage: &Stage) -> Starting {
        let file = stage.write(&format!("{}.yaml", self.node), &self.file);
        Starting(Process::start("blaze-worker", &["--config", &file], None).unwrap())
    }

    /// Its worker, which writes all its logs to a file.
    pub(crate) fn worker_logged(&self, stage: &Stage, log: &Path) -> Worker {
        let file = stage.write(&format!("{}.yaml", self.node), &self.file);
        Starting(Process::start_logged("blaze-worker", &["--config", &file], log).unwrap()).ready()
    }

    /// A service that knows only the broker.
    pub(crate) async fn service(&self) -> Service {
        Service::on(&self.redis).await
    }

    pub(crate) fn keys(&self) -> RedisKeys {
        RedisKeys::open(&section(&self.redis)).unwrap()
    }

    /// The value of a key; `None`: it is not there.
    pub(crate) async fn key(&self, name: &str) -> Option<Value> {
        let value = self.keys().get(name).await.unwrap()?;
        Some(serde_json::from_slice(&value).unwrap())
    }

    /// A process that is a service of this robot.
    pub(crate) fn run(&self, service: &str, instance: &str, further: &[&str]) -> ServiceProcess {
        let url = self.redis.url();
        let mut arguments = vec!["--redis", &url, "--layer", "edge", "--node", self.node];
        arguments.extend(["--service", service, "--instance", instance]);
        arguments.extend(further);
        ServiceProcess(Process::tool("service", &arguments, None).unwrap())
    }
}

/// A worker that has started and may not be ready.
pub(crate) struct Starting(Process);

impl Starting {
    pub(crate) fn of(process: Process) -> Self {
        Self(process)
    }

    /// Its admin port listens; its broker may not be there.
    pub(crate) fn listening(self) -> Worker {
        const SAID: &str = "admin listening on ";
        let said = || {
            let lines = self.0.stderr().into_iter();
            lines.filter_map(|line| line.split(SAID).nth(1)?.trim().parse().ok()).next()
        };
        let admin = wait::until_some("the admin port", PATIENCE, said, || self.0.tail()).unwrap();
        Worker { process: self.0, admin }
    }

    pub(crate) fn ready(self) -> Worker {
        let addresses = addresses(&self.0).unwrap();
        let admin = *addresses.get("admin").context("no admin").unwrap();
        Worker { process: self.0, admin }
    }
}

/// A process that uses the SDK, and says on stdout what it gets.
pub(crate) struct ServiceProcess(Process);

impl ServiceProcess {
    /// What its configuration has been so far, in order.
    pub(crate) fn seen(&self) -> Vec<Value> {
        let lines = self.0.stdout().into_iter();
        lines.filter_map(|line| serde_json::from_str(line.strip_prefix("config ")?).ok()).collect()
    }

    /// Waits until its last configuration satisfies.
    pub(crate) fn until(&self, what: &str, is_good: impl Fn(&Value) -> bool) -> Value {
        self.within(what, PATIENCE, is_good)
    }

    pub(crate) fn within(
        &self,
        what: &str,
        limit: Duration,
        is_good: impl Fn(&Value) -> bool,
    ) -> Value {
        let last = || self.seen().pop().filter(|last| is_good(last));
        wait::until_some(what, limit, last, || self.0.tail()).unwrap()
    }

    pub(crate) fn kill(mut self) {
        self.0.kill().unwrap();
    }
}

impl Worker {
    /// Waits until all copies have what the worker has.
    pub(crate) async fn has_kept_all(&self, copies: usize) {
        // An answer of the engine: what was asked of it before is done, and its notes are owed or
        // written.
        self.status().await;
        let start = tokio::time::Instant::now();
        loop {
            let metrics = self.text("/metrics").await;
            let current =
                metrics.lines().filter(|line| line.starts_with("blaze_worker_copy_current{"));
            if current.filter(|line| line.ends_with(" 1")).count() == copies {
                return;
            }
            assert!(start.elapsed() < PATIENCE, "{metrics}\n{}", self.tail());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub(crate) fn id(&self) -> u32 {
        self.process.id()
    }
}

/// The next notice that satisfies; those before it are passed over.
pub(crate) async fn next_that(
    notices: &mut Subscription,
    is_good: impl Fn(&Value) -> bool,
) -> Value {
    loop {
        let notice = next(notices).await;
        if is_good(&notice) {
            return notice;
        }
    }
}

/// All that a file or folder holds, as text.
pub(crate) fn content(path: &Path) -> String {
    if path.is_dir() {
        let entries = std::fs::read_dir(path).unwrap();
        return entries.map(|entry| content(&entry.unwrap().path())).collect();
    }
    String::from_utf8_lossy(&std::fs::read(path).unwrap()).into_owned()
}
