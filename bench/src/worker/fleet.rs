//! The main service, a broker, workers, and a service beside each.

use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::fleet::{Api, Listener, MainService, MainStore, Worker, WorkerSpec, wait_equal};
use blaze_tests::process::{Usage, usage};
use blaze_tests::servers::{KafkaOptions, KafkaServer, RedisKind, RedisOptions, RedisServer};
use clap::ValueEnum;
use futures::future::try_join_all;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::task::block_in_place;

/// The layer that all are of.
pub(crate) const LAYER: &str = "edge";
/// The service that is changed.
pub(crate) const SERVICE: &str = "slam";
/// For a fleet to begin with.
const START: Duration = Duration::from_secs(120);

/// What services are on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BrokerKind {
    /// Of each node; all on one server, each with a prefix.
    Redis,
    /// Of the layer; all on one broker, each worker with a prefix.
    Kafka,
}

impl BrokerKind {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Redis => "redis",
            Self::Kafka => "kafka",
        }
    }

    pub(crate) fn usual_counts(self) -> &'static [usize] {
        match self {
            Self::Redis => &[1, 50, 200],
            Self::Kafka => &[1, 10],
        }
    }
}

/// A broker of this run alone.
enum BrokerServer {
    Redis(RedisServer),
    Kafka(KafkaServer),
}

impl BrokerServer {
    fn start(kind: BrokerKind) -> anyhow::Result<Self> {
        Ok(match kind {
            BrokerKind::Redis => {
                Self::Redis(RedisServer::start(RedisKind::Redis, RedisOptions::default())?)
            }
            BrokerKind::Kafka => Self::Kafka(KafkaServer::start(KafkaOptions::default())?),
        })
    }

    fn of(&self, spec: WorkerSpec) -> WorkerSpec {
        match self {
            Self::Redis(server) => spec.on_redis(&server.url()),
            Self::Kafka(server) => spec.on_kafka(&server.bootstrap()),
        }
    }
}

/// All of it. Fields are dropped in this order: services before their workers, workers before what
/// they are connected to.
pub(crate) struct Fleet {
    pub(crate) listeners: Vec<Listener>,
    pub(crate) workers: Vec<Worker>,
    pub(crate) main: MainService,
    pub(crate) api: Api,
    server: Option<BrokerServer>,
    /// Of this process, without any worker.
    before: Usage,
    folder: TempDir,
}

/// Name of the n-th node.
pub(crate) fn node(number: usize) -> String {
    format!("robot-{number}")
}

impl Fleet {
    /// A main service with a layer of so many nodes and some services, without a worker yet.
    /// Without a broker, each worker has one in memory.
    pub(crate) async fn new(
        parent: &Path,
        broker: Option<BrokerKind>,
        nodes: usize,
        services: usize,
    ) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir_in(parent)?;
        let main = block_in_place(|| MainService::start(folder.path(), &MainStore::Sqlite))?;
        let api = main.api()?;
        let mut documents = vec![
            json!({ "kind": "Layer", "name": LAYER, "spec": { "kind": "edge" } }),
            json!({ "kind": "Service", "name": SERVICE, "spec": { "config": config(0) } }),
        ];
        documents.extend((0..nodes).map(
            |number| json!({ "kind": "Node", "name": node(number), "spec": { "layer": LAYER } }),
        ));
        documents.extend((0..services).map(|number| {
            json!({
                "kind": "Service",
                "name": format!("other-{number}"),
                "spec": { "config": config(number) },
            })
        }));
        api.apply(&documents).await?;
        Ok(Self {
            listeners: Vec::new(),
            workers: Vec::new(),
            main,
            api,
            server: broker.map(|kind| block_in_place(|| BrokerServer::start(kind))).transpose()?,
            before: usage(std::process::id()).context("this process runs")?,
            folder,
        })
    }

    /// Starts workers, one on each of the first nodes, and waits until all have what the main
    /// service has.
    pub(crate) async fn start_workers(&mut self, count: usize) -> anyhow::Result<()> {
        for number in self.workers.len()..count {
            let node = node(number);
            let spec = WorkerSpec::on_memory(LAYER, &node, &self.main.server())
                .kept_in(self.folder.path().join(&node));
            let spec = self.server.iter().fold(spec, |spec, server| server.of(spec));
            self.workers.push(Worker::start(&spec).await?);
        }
        wait_equal(&self.api, &self.workers, START).await?;
        Ok(())
    }

    /// Starts the service that is changed beside each worker.
    pub(crate) async fn start_listeners(&mut self) -> anyhow::Result<()> {
        let starts = self.workers.iter().map(|worker| Listener::start(worker, SERVICE, "0", START));
        self.listeners = try_join_all(starts).await?;
        Ok(())
    }

    /// What this process has taken since there was no worker, for each of them.
    pub(crate) fn taken_per_worker(&self) -> anyhow::Result<Taken> {
        let now = usage(std::process::id()).context("this process runs")?;
        let each = |now: u64, before: u64| {
            now.saturating_sub(before) as f64 / self.workers.len().max(1) as f64
        };
        Ok(Taken {
            resident_kib: each(now.resident_kib, self.before.resident_kib),
            threads: each(now.threads, self.before.threads),
            descriptors: each(now.descriptors, self.before.descriptors),
        })
    }

    /// Of the main service.
    pub(crate) fn main_process(&self) -> anyhow::Result<u32> {
        Ok(self.main.process().context("the main service runs")?.id())
    }
}

/// What one worker takes of the process that it is in.
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub(crate) struct Taken {
    pub(crate) resident_kib: f64,
    pub(crate) threads: f64,
    pub(crate) descriptors: f64,
}

/// 300 bytes of JSON, about.
pub(crate) fn config(number: usize) -> Value {
    json!({
        "camera": { "rate_hz": 30, "exposure_us": 8000 + number, "gain": 1.5, "format": "mono8" },
        "map": {
            "resolution_m": 0.05,
            "size_m": [100, 100],
            "frame": "world",
            "publish_period_ms": 500,
        },
        "matcher": {
            "kind": "loop-closing",
            "window": 20,
            "threshold": 0.82,
            "threads": 2,
            "descriptors": "orb",
        },
    })
}
