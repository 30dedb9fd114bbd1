//! The programs of BlazeConfig within this process: a main service without tokens, workers on the
//! brokers of its nodes, and flows that follow what it says.
//!
//! ```text
//! node file ─► main service: REST, gRPC on loopback ◄── worker (one per node) ─► its broker ─► services
//!                  ▲
//!                  └── Admin: the same REST that everybody has
//! ```

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Broker;
use blaze_brokers::redis::RedisKeys;
use blaze_config::process::Setup;
use blaze_config::running::{Addresses, RunningMain};
use blaze_domain::node_file::{AdminSection, ControlPlaneSection, NodeFile, RedisBroker};
use blaze_domain::{InstanceName, Scope};
use blaze_flow::flow::RunningFlow;
use blaze_flow::flow::node_file::Followed;
use blaze_flow::flow::service::FlowService;
use blaze_monitor::node::Roots;
use blaze_monitor::running::{MonitorOptions, RunningMonitor};
use blaze_runtime::config::Verdict;
use blaze_runtime::logs::LogHandle;
use blaze_runtime::{Readiness, Supervisor, environment};
use blaze_worker::admin::Shown;
use blaze_worker::running::{RunningWorker, WorkerOptions};
use blaze_worker::settings::WorkerSettings;
use serde_json::Value;
use tokio::net::TcpListener;
use tokio::time::sleep;

use crate::exit::{CliError, lines};

/// Between two looks at a worker.
const LOOK: Duration = Duration::from_millis(10);

/// Starts a main service that asks for no tokens, and waits until it serves.
///
/// # Errors
/// [`CliError::Usage`] for what `blaze-config --dev` refuses, [`CliError::Failed`] for a port or a
/// store that cannot be used.
pub(crate) async fn start_main(
    section: ControlPlaneSection,
    in_memory: bool,
    supervisor: &Supervisor,
) -> Result<(RunningMain, Addresses), CliError> {
    let setup = Setup { section, dev: true, in_memory };
    setup.check().map_err(|faults| CliError::Usage(faults.join("\n  ")))?;
    let main = RunningMain::start(supervisor, setup)
        .await
        .map_err(|error| CliError::Failed(format!("the main service does not start: {error:#}")))?;
    let addresses = tokio::select! {
        addresses = main.ready() => addresses,
        reason = supervisor.failed() => {
            return Err(CliError::Failed(format!("the main service does not start: {reason}")));
        }
    };
    Ok((main, addresses))
}

/// Makes a flow a service that follows BlazeConfig over its node file, as the program `blaze-flow`
/// is. `cache` is where its sign of life goes; `judged` hears what became of what BlazeConfig says.
///
/// # Errors
/// [`CliError::Usage`]: a node file that is none for a flow, or an instance that the environment names and that can be none.
pub(crate) async fn follow(
    flow: &Arc<RunningFlow>,
    node_file: &Value,
    cache: Option<&RedisBroker>,
    log: Option<LogHandle>,
    supervisor: &Supervisor,
    judged: impl FnMut(&Verdict) + Send + 'static,
) -> Result<FlowService, CliError> {
    let id = flow.id();
    let refused = |error: String| {
        CliError::Usage(format!("the flow {id} cannot follow BlazeConfig: {error}"))
    };
    let followed = Followed::of_tree(&format!("node file of {id}"), node_file, log);
    let followed = followed.map_err(|faults| refused(lines(&faults)))?;
    let service = FlowService::follow(flow, followed, cache.cloned(), supervisor, judged).await;
    let service = service.map_err(|error| refused(error.to_string()))?;
    service.ok_or_else(|| refused("it has no broker of its node or layer".to_owned()))
}

/// Starts the monitor of a node whose flow is in this process, on the broker of its services. Where
/// its default port is taken, as by another `blaze dev`, it takes any.
///
/// # Errors
/// [`CliError::Failed`]: a port that cannot be used.
pub(crate) async fn start_monitor(
    mut file: NodeFile,
    flow: SocketAddr,
    broker: Arc<dyn Broker>,
    supervisor: &Supervisor,
) -> Result<RunningMonitor, CliError> {
    file.admin.flow = flow;
    let is_default = file.admin.monitor == AdminSection::default().monitor;
    if is_default && TcpListener::bind(file.admin.monitor).await.is_err() {
        file.admin.monitor.set_port(0);
    }
    let address = file.admin.monitor;
    let broker = Some((Scope::Node, broker));
    let options = MonitorOptions { file, roots: Roots::default(), broker };
    let monitor = RunningMonitor::start(options, supervisor).await;
    monitor.map_err(|error| {
        CliError::Failed(format!("the monitor does not start on {address}: {error:#}"))
    })
}

/// Which instance of its programs this process is.
///
/// # Errors
/// [`CliError::Usage`]: what the environment says can be none.
pub(crate) fn instance() -> Result<InstanceName, CliError> {
    let named = environment::parsed("BLAZE_INSTANCE")
        .map_err(|fault| CliError::Usage(fault.to_string()))?;
    Ok(named.unwrap_or_else(InstanceName::first))
}

/// A worker that runs, and where it is asked.
pub(crate) struct Worker {
    pub(crate) running: Arc<RunningWorker>,
    /// `None`: on no port.
    pub(crate) admin: Option<SocketAddr>,
    readiness: Readiness,
}

impl Worker {
    /// Starts the worker of a node on a broker of it. Its copies are kept in `folder`, if there is
    /// one; it is asked on the admin port of the node file, if `is_asked`.
    ///
    /// # Errors
    /// [`CliError::Failed`]: a port or a folder that cannot be used.
    pub(crate) async fn start(
        file: &NodeFile,
        broker: Arc<dyn Broker>,
        folder: Option<PathBuf>,
        is_asked: bool,
        supervisor: &Supervisor,
    ) -> Result<Self, CliError> {
        let failed =
            |error: String| CliError::Failed(format!("the worker does not start: {error}"));
        let settings =
            WorkerSettings::of(file).map_err(|faults| CliError::Invalid(lines(&faults)))?;
        let keys = settings.keys.as_ref().map(RedisKeys::open).transpose();
        let keys = keys.map_err(|error| failed(error.to_string()))?.map(Arc::new);
        let (shown, readiness) = (Shown::default(), Readiness::new());
        let admin = match is_asked {
            true => {
                let served = shown
                    .serve(file.admin.worker, settings.scope(), readiness.clone(), supervisor)
                    .await;
                Some(served.map_err(|error| failed(format!("{}: {error}", file.admin.worker)))?)
            }
            false => None,
        };
        let options = WorkerOptions {
            worker_id: format!("{}-{}", settings.node, std::process::id()),
            settings,
            broker,
            keys,
            folder,
            // On the broker of a node there is one worker.
            lease: None,
            instance: instance()?,
        };
        let running = RunningWorker::start(options, supervisor).await;
        let running = Arc::new(running.map_err(|error| failed(format!("{error:#}")))?);
        shown.set(Arc::clone(&running));
        Ok(Self { running, admin, readiness })
    }

    /// Waits until it serves what the main service has at a revision.
    ///
    /// # Errors
    /// [`CliError::Failed`] when it does not within `limit`: what it waits for.
    pub(crate) async fn has(&self, revision: u64, limit: Duration) -> Result<(), CliError> {
        let start = Instant::now();
        loop {
            let status = self.running.status().await;
            if status.as_ref().is_some_and(|status| status.in_sync && status.revision >= revision) {
                return Ok(());
            }
            if start.elapsed() > limit {
                let reason = status.and_then(|status| status.reason);
                let reason = reason.unwrap_or_else(|| "it is not in sync yet".to_owned());
                let limit = limit.as_secs();
                return Err(CliError::Failed(format!(
                    "the worker has not got the configuration within {limit} s: {reason}"
                )));
            }
            sleep(LOOK).await;
        }
    }

    /// Leaves everything as the next life wants to find it.
    pub(crate) async fn drain(&self) {
        self.readiness.stop();
        self.running.drain().await;
    }
}
