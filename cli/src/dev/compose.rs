//! What `blaze dev` is put together of, and in which order it begins and ends.
//!
//! ```text
//! broker ─► main service ─► documents ─► worker ─► flow, which follows BlazeConfig ─► monitor ─► ready
//! end: monitor ─► flow drained ─► worker's copies ─► requests of the main service, its store ─► broker
//! ```

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Role, open_node};
use blaze_config::running::{Addresses, RunningMain};
use blaze_domain::FlowId;
use blaze_domain::node_file::{NodeBroker, NodeFile};
use blaze_flow::flow::service::FlowService;
use blaze_flow::flow::settings::FlowSettings;
use blaze_flow::flow::{Beginning, Epochs, FlowOptions, RunningFlow};
use blaze_monitor::running::RunningMonitor;
use blaze_runtime::Supervisor;
use blaze_runtime::logs::{self, LogFormat};
use blaze_runtime::supervisor::{ShutdownPhase, ShutdownSteps};
use serde_json::json;

use super::options::{DevBroker, DevOptions};
use super::redis;
use crate::config::files::Source;
use crate::config::seed;
use crate::embedded::{Worker, follow, instance, start_main, start_monitor};
use crate::exit::CliError;

/// How long worker and flow may take.
const READY: Duration = Duration::from_secs(30);

/// Everything that runs.
pub(super) struct Dev {
    main: RunningMain,
    addresses: Addresses,
    worker: Arc<Worker>,
    flow: Arc<RunningFlow>,
    service: FlowService,
    monitor: RunningMonitor,
    /// URL of the Redis; `None`: memory.
    redis: Option<String>,
}

/// Starts everything and waits until it is ready.
pub(super) async fn start(
    options: &DevOptions,
    sources: &[Source],
    supervisor: &Supervisor,
) -> Result<Dev, CliError> {
    // Faults of the options are told before anything runs.
    let (file, _) = options.node_file(None, None)?;
    instance()?;
    let log = logs::init(file.log.level.as_str(), LogFormat::Text);
    let log = log.map_err(|error| CliError::Failed(error.to_string()))?;
    if let Some(folder) = &options.data {
        make_folder(folder)?;
    }
    let redis = broker_of(options, supervisor).await?;
    let section = file.control_plane.clone();
    let (main, addresses) = start_main(section, options.data.is_none(), supervisor).await?;
    let revision = documents(options, sources, addresses.rest).await?;

    let (file, tree) = options.node_file(redis.as_deref(), Some(addresses.grpc))?;
    let brokers = Brokers::of(&file, options);
    let folder = options.data.as_ref().map(|folder| folder.join("worker"));
    let worker =
        Worker::start(&file, brokers.open(&Role::Worker)?, folder, true, supervisor).await?;
    let flow = Arc::new(start_flow(&file, &brokers, options.data.as_deref(), supervisor).await?);
    let service = follow(&flow, &tree, file.cache_redis(), Some(log), supervisor, |_| {}).await?;
    let mut of_monitor = file.clone();
    of_monitor.admin.worker = worker.admin.unwrap_or(file.admin.worker);
    let broker = brokers.open(&Role::Service)?;
    let monitor = start_monitor(of_monitor, flow.admin(), broker, supervisor).await?;
    worker.has(revision, READY).await?;
    tokio::time::timeout(READY, flow.ready()).await.map_err(|_| {
        let (waited, admin) = (READY.as_secs(), flow.admin());
        CliError::Failed(format!(
            "the flow was not ready within {waited} s; see http://{admin}/readyz"
        ))
    })?;
    Ok(Dev { main, addresses, worker: Arc::new(worker), flow, service, monitor, redis })
}

/// URL of the Redis, which is started where that is asked for; `None`: memory.
async fn broker_of(
    options: &DevOptions,
    supervisor: &Supervisor,
) -> Result<Option<String>, CliError> {
    match &options.broker {
        Some(DevBroker::Memory) => Ok(None),
        Some(DevBroker::Redis(url)) => Ok(Some(url.clone())),
        Some(DevBroker::OwnRedis) => match redis::start(supervisor).await? {
            Some(url) => Ok(Some(url)),
            None => Err(CliError::Usage(
                "--broker redis: there is no redis-server in PATH. Install it (Debian, Ubuntu: \
                 `apt install redis-server`), or give --broker redis://HOST:PORT of one that runs, \
                 or --broker memory."
                    .to_owned(),
            )),
        },
        None => {
            let started = redis::start(supervisor).await?;
            if started.is_none() {
                eprintln!(
                    "blaze: there is no redis-server in PATH, so the broker is inside this \
                     process: services of other processes cannot reach it. Give --broker \
                     redis://HOST:PORT."
                );
            }
            Ok(started)
        }
    }
}

/// Layer and node, unless they are there, and what `-f` says. Gives the revision after it.
async fn documents(
    options: &DevOptions,
    sources: &[Source],
    rest: SocketAddr,
) -> Result<u64, CliError> {
    let own = [
        json!({ "kind": "Layer", "name": options.layer, "spec": { "kind": options.kind() } }),
        json!({ "kind": "Node", "name": options.node, "spec": { "layer": options.layer } }),
    ];
    seed::apply(rest, &own, sources).await
}

fn make_folder(folder: &Path) -> Result<(), CliError> {
    use std::os::unix::fs::DirBuilderExt as _;
    let made = std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder);
    made.map_err(|error| CliError::Failed(format!("--data {}: {error}", folder.display())))
}

/// Opens clients of the node's broker.
struct Brokers {
    section: Option<NodeBroker>,
    hub: MemoryHub,
}

impl Brokers {
    fn of(file: &NodeFile, options: &DevOptions) -> Self {
        Self {
            section: file.brokers.node.clone().filter(|section| *section != NodeBroker::Memory),
            hub: MemoryHub::new(options.node.to_string()),
        }
    }

    fn open(&self, role: &Role) -> Result<Arc<dyn Broker>, CliError> {
        match &self.section {
            None => Ok(Arc::new(self.hub.broker())),
            Some(section) => open_node(section, role)
                .map_err(|error| CliError::Failed(format!("brokers.node: {error}"))),
        }
    }
}

async fn start_flow(
    file: &NodeFile,
    brokers: &Brokers,
    folder: Option<&Path>,
    supervisor: &Supervisor,
) -> Result<RunningFlow, CliError> {
    let failed = |error: String| CliError::Failed(format!("the flow does not start: {error}"));
    let settings =
        FlowSettings::try_from(file).map_err(|error| CliError::Usage(error.to_string()))?;
    let epochs = Epochs::begin(&settings.me, folder);
    let role = Role::Flow { flow: FlowId::clone(&settings.me), epoch: epochs.first() };
    let options =
        FlowOptions { settings, node: Some(brokers.open(&role)?), layer: None, state_dir: None };
    let beginning = Beginning { epochs, layer_prefix: String::new() };
    let flow = blaze_flow::flow::start_with(options, beginning, supervisor.child("flow")).await;
    flow.map_err(|error| failed(format!("{error:#}")))
}

impl Dev {
    /// Names and addresses of everything.
    pub(super) fn places(&self) -> Vec<(&'static str, String)> {
        let Addresses { rest, grpc, admin } = self.addresses;
        let mut places = vec![
            ("rest", rest.to_string()),
            ("grpc", grpc.to_string()),
            ("admin", admin.to_string()),
        ];
        places.extend(self.worker.admin.map(|worker| ("worker", worker.to_string())));
        places.push(("flow", self.flow.admin().to_string()));
        places.push(("monitor", self.monitor.admin().to_string()));
        places.push(("broker", self.redis.clone().unwrap_or_else(|| "memory".to_owned())));
        places
    }

    /// What one may do now.
    pub(super) fn to_try(&self, options: &DevOptions) -> String {
        let (rest, flow, node) = (self.addresses.rest, self.flow.admin(), &options.node);
        let server = format!("http://{rest}");
        let service = json!({
            "kind": "Service",
            "name": "slam",
            "spec": { "config": { "camera": { "rate_hz": 10 } } },
        });
        let services = match &self.redis {
            Some(url) => format!(
                "  redis-cli -u {url} subscribe blaze/config/changed/slam   # what your service hears\n  redis-cli -u {url} get blaze:config:slam                 # what it finds when it starts\n"
            ),
            None => String::new(),
        };
        format!(
            "Layer {} and node {node} are there; no token is needed. What to try:\n  echo '{service}' | blaze apply --server {server} -f -\n{services}  curl -s '{server}/api/v1/effective?service=slam&node={node}'\n  blaze topics --flow {flow}\nCtrl-C ends it.\n",
            options.layer
        )
    }

    /// Ends everything in order.
    pub(super) async fn shutdown(self, supervisor: &Supervisor, deadline: Duration) {
        let Self { main, worker, flow, service, monitor, .. } = self;
        let readiness = flow.readiness().clone();
        let steps = ShutdownSteps::new(deadline)
            .on(ShutdownPhase::NotReady, "flow", async move { readiness.stop() })
            .on(ShutdownPhase::Drain, "flow", async move {
                monitor.stop().await;
                service.stop().await;
                flow.drain().await;
            })
            .on(ShutdownPhase::Drain, "worker", async move { worker.drain().await });
        supervisor.shutdown_with(main.shutdown_steps(steps)).await;
    }
}
