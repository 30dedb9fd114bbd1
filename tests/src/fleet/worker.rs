//! A worker in this process: what `blaze-worker` puts together from a node file, without the
//! process around it.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, Role, open_layer, open_node};
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile};
use blaze_domain::{InstanceName, LayerName, NodeName, Scope};
use blaze_runtime::Supervisor;
use blaze_worker::running::{RunningWorker, WorkerOptions};
use blaze_worker::settings::{LocalBroker, WorkerSettings};
use serde_json::{Value, json};

/// For its tasks to end.
const END: Duration = Duration::from_secs(10);

/// What a worker is started with.
#[derive(Debug, Clone)]
pub struct WorkerSpec {
    /// Its layer, of kind edge.
    pub layer: String,
    /// Its node.
    pub node: String,
    /// Section `brokers` of its node file.
    pub brokers: Value,
    /// `config.server`.
    pub server: String,
    /// Where its copy is kept, the last-known-good file; `None`: nowhere.
    pub folder: Option<PathBuf>,
}

impl WorkerSpec {
    /// One on a memory broker of its own, without copies.
    #[must_use]
    pub fn on_memory(layer: &str, node: &str, server: &str) -> Self {
        Self {
            layer: layer.to_owned(),
            node: node.to_owned(),
            brokers: json!({ "node": { "memory": {} } }),
            server: server.to_owned(),
            folder: None,
        }
    }

    /// The same on a Redis, with a prefix of its own.
    #[must_use]
    pub fn on_redis(self, url: &str) -> Self {
        let prefix = format!("{}:", self.node);
        Self { brokers: json!({ "node": { "redis": { "url": url, "prefix": prefix } } }), ..self }
    }

    /// The same on the Kafka of its layer, with a prefix of its own: each worker is then the only
    /// one of its topics.
    #[must_use]
    pub fn on_kafka(self, bootstrap: &str) -> Self {
        let prefix = format!("{}.", self.node);
        Self {
            brokers: json!({ "layer": { "kafka": { "bootstrap": [bootstrap],
                "prefix": prefix } } }),
            ..self
        }
    }

    /// The same with copies in a folder.
    #[must_use]
    pub fn kept_in(self, folder: PathBuf) -> Self {
        Self { folder: Some(folder), ..self }
    }

    /// The node file that says so.
    #[must_use]
    pub fn node_file(&self) -> Value {
        json!({
            "layer": { "name": self.layer, "kind": "edge" },
            "node": { "name": self.node },
            "brokers": self.brokers,
            "config": { "server": self.server },
        })
    }
}

/// How a worker stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Standing {
    /// There is a stream from the main service.
    pub connected: bool,
    /// It is certain that what is served is the newest.
    pub in_sync: bool,
    /// Revision of what is served.
    pub revision: u64,
    /// Digest of what is here.
    pub digest: String,
}

/// A running worker. It ends when it is dropped, as a process does that is killed: copies keep what
/// was written.
pub struct Worker {
    running: RunningWorker,
    supervisor: Supervisor,
    place: Place,
    layer: LayerName,
    node: NodeName,
}

/// Where services are.
struct Place {
    /// The server of a memory broker.
    hub: MemoryHub,
    section: LocalBroker,
}

impl Place {
    /// A client of its own.
    fn open(&self, role: &Role) -> anyhow::Result<Arc<dyn Broker>> {
        Ok(match &self.section {
            LocalBroker::Node(NodeBroker::Memory) | LocalBroker::Layer(LayerBroker::Memory) => {
                Arc::new(self.hub.broker())
            }
            LocalBroker::Node(section) => open_node(section, role)?,
            LocalBroker::Layer(section) => open_layer(section, role)?,
        })
    }
}

impl Worker {
    /// Starts one.
    ///
    /// # Errors
    /// What the node file must not say, or a folder that cannot be used.
    pub async fn start(spec: &WorkerSpec) -> anyhow::Result<Self> {
        let faults = |faults: Vec<blaze_domain::node_file::Fault>| {
            let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
            anyhow::anyhow!(lines.join("; "))
        };
        let (file, _) = NodeFile::read(&spec.node_file()).map_err(faults)?;
        let settings = WorkerSettings::of(&file).map_err(faults)?;
        let place =
            Place { hub: MemoryHub::new(spec.node.as_str()), section: settings.broker.clone() };
        let broker = place.open(&Role::Worker)?;
        let keys = settings.keys.as_ref().map(RedisKeys::open).transpose()?.map(Arc::new);
        let (layer, node) = (settings.site.layer.clone(), settings.node.clone());
        let options = WorkerOptions {
            worker_id: format!("{node}-{:08x}", rand::random::<u32>()),
            settings,
            broker,
            keys,
            folder: spec.folder.clone(),
            // Of its prefix each is the only one.
            lease: None,
            instance: InstanceName::first(),
        };
        let supervisor = Supervisor::new(node.to_string());
        let running = RunningWorker::start(options, &supervisor).await?;
        Ok(Self { running, supervisor, place, layer, node })
    }

    /// The worker itself.
    #[must_use]
    pub fn running(&self) -> &RunningWorker {
        &self.running
    }

    /// A connection of a service to the broker that it serves.
    ///
    /// # Errors
    /// When there can be none.
    pub fn open_broker(&self) -> anyhow::Result<Arc<dyn Broker>> {
        self.place.open(&Role::Service)
    }

    /// Its layer.
    #[must_use]
    pub fn layer(&self) -> &LayerName {
        &self.layer
    }

    /// Its node.
    #[must_use]
    pub fn node(&self) -> &NodeName {
        &self.node
    }

    /// How far its broker reaches.
    #[must_use]
    pub fn scope(&self) -> Scope {
        match &self.place.section {
            LocalBroker::Node(_) => Scope::Node,
            LocalBroker::Layer(_) => Scope::Layer,
        }
    }

    /// How it stands now.
    ///
    /// # Errors
    /// When it has ended.
    pub async fn standing(&self) -> anyhow::Result<Standing> {
        let status = self.running.status().await;
        let status = status.with_context(|| match self.supervisor.failure() {
            Some(reason) => format!("the worker of {} failed: {reason}", self.node),
            None => format!("the worker of {} has ended", self.node),
        })?;
        Ok(Standing {
            connected: status.json["connected"] == true,
            in_sync: status.in_sync,
            revision: status.revision,
            digest: status.json["digest"].as_str().unwrap_or_default().to_owned(),
        })
    }

    /// Ends it in order: copies hold what was stored.
    pub async fn stop(self) {
        self.running.drain().await;
        self.supervisor.shutdown(END).await;
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.supervisor.stopping_token().cancel();
        self.supervisor.shutdown_token().cancel();
    }
}
