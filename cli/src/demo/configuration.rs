//! BlazeConfig in the demo: a main service in memory, a worker on the broker of each node, and the
//! two that follow it: the service `analytics`, and the flow of robot-1.
//!
//! ```text
//! PUT ─► REST ─► main service ─► worker of fog-1   ─► node broker ─► analytics: callback
//!                             └► worker of robot-1 ─► node broker ─► blaze-flow: new limit ─► fewer pictures
//! ```

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::Broker;
use blaze_config::running::RunningMain;
use blaze_domain::node_file::{ControlPlaneSection, NodeBroker};
use blaze_flow::flow::RunningFlow;
use blaze_flow::flow::service::{FlowService, NAME};
use blaze_runtime::Supervisor;
use blaze_runtime::config::Verdict;
use blaze_runtime::supervisor::ShutdownSteps;
use serde_json::{Value, json};
use tokio::sync::watch;

use super::analytics::{Analytics, CalledBack, DEFAULT_WINDOW, WINDOW};
use super::changes::{Taken, Wanted};
use super::options::DemoNode;
use super::roles::{MOVING_SERVICE, PUBLISHING_NODE};
use crate::config::seed;
use crate::embedded::{Worker, follow, start_main};
use crate::exit::{CliError, lines};

/// How long workers may take to have what the demo begins with.
const READY: Duration = Duration::from_secs(15);
/// How long a change may take to its callback.
const CALLBACK: Duration = Duration::from_secs(5);

/// A node, as far as its worker has to do with it.
pub(super) struct Place {
    pub(super) node: DemoNode,
    /// Its node file.
    pub(super) file: Value,
    /// The section of its node broker, for the keys there.
    pub(super) broker_section: NodeBroker,
    /// What its services talk to.
    pub(super) broker: Arc<dyn Broker>,
}

/// Everything of BlazeConfig that runs here.
pub(super) struct Configuration {
    main: RunningMain,
    rest: SocketAddr,
    workers: Vec<Worker>,
    flow: FlowService,
    limit_taken: watch::Receiver<Option<CalledBack>>,
    supervisor: Supervisor,
}

impl Configuration {
    /// Starts it. The flow is that of robot-1.
    pub(super) async fn start(
        places: Vec<Place>,
        flow: &Arc<RunningFlow>,
        supervisor: Supervisor,
    ) -> Result<Self, CliError> {
        let (main, addresses) = start_main(section(), true, &supervisor).await?;
        let revision = seed::apply(addresses.rest, &documents(), &[]).await?;
        let mut workers = Vec::new();
        let mut following = None;
        for place in places {
            let mut tree = place.file;
            tree["config"] = json!({ "server": format!("http://{}", addresses.grpc) });
            let read = blaze_domain::node_file::NodeFile::read(&tree);
            let (mut file, _) = read.map_err(|faults| CliError::Failed(lines(&faults)))?;
            file.brokers.node = Some(place.broker_section);
            workers.push(
                Worker::start(&file, Arc::clone(&place.broker), None, false, &supervisor).await?,
            );
            if place.node == PUBLISHING_NODE {
                let (tell, taken) = watch::channel(None);
                let judged = move |verdict: &Verdict| {
                    if verdict.faults.is_none() {
                        tell.send_replace(Some(CalledBack {
                            revision: verdict.overlay.revision,
                            at: Instant::now(),
                        }));
                    }
                };
                let service =
                    follow(flow, &tree, file.cache_redis(), None, &supervisor, judged).await?;
                following = Some((service, taken));
            }
        }
        let (flow, limit_taken) = following.ok_or_else(|| {
            CliError::Failed(format!("{} does not run here", PUBLISHING_NODE.name()))
        })?;
        for worker in &workers {
            worker.has(revision, READY).await?;
        }
        Ok(Self { main, rest: addresses.rest, workers, flow, limit_taken, supervisor })
    }

    /// REST of the main service.
    pub(super) fn rest(&self) -> SocketAddr {
        self.rest
    }

    /// Makes a change over REST, and waits until whom it concerns has been called back.
    pub(super) async fn change(
        &self,
        wanted: &Wanted,
        analytics: Option<&Analytics>,
    ) -> Result<Taken, String> {
        let (document, mut called_back) = match wanted {
            Wanted::Window(window) => {
                let analytics =
                    analytics.ok_or_else(|| format!("{MOVING_SERVICE} does not run"))?;
                (service(*window), analytics.called_back())
            }
            Wanted::Limit(limit_mbps) => (robot(*limit_mbps), self.limit_taken.clone()),
        };
        let client = seed::client(self.rest).map_err(|error| error.to_string())?;
        let sent = Instant::now();
        let revision =
            seed::replace(&client, &document).await.map_err(|error| error.to_string())?;
        let accepted = sent.elapsed();
        let is_it = |last: &Option<CalledBack>| last.is_some_and(|last| last.revision >= revision);
        let waited = tokio::time::timeout(CALLBACK, called_back.wait_for(is_it)).await;
        let back = waited.ok().and_then(|back| *back.ok()?);
        let back = back.ok_or_else(|| {
            let limit = CALLBACK.as_secs();
            format!("revision {revision} did not come to whom it concerns within {limit} s")
        })?;
        Ok(Taken { revision, accepted, called_back: back.at.saturating_duration_since(sent) })
    }

    /// Ends everything but the brokers. Services that follow it have ended before.
    pub(super) async fn shutdown(self, deadline: Duration) {
        self.flow.stop().await;
        for worker in &self.workers {
            worker.drain().await;
        }
        let steps = self.main.shutdown_steps(ShutdownSteps::new(deadline));
        self.supervisor.shutdown_with(steps).await;
    }
}

/// A main service on any free ports.
fn section() -> ControlPlaneSection {
    let any = SocketAddr::from(([127, 0, 0, 1], 0));
    let mut section = ControlPlaneSection::default();
    section.rest.listen = any;
    section.grpc.listen = any;
    section.admin.listen = any;
    section
}

/// What the demo begins with.
fn documents() -> Vec<Value> {
    let layers = ["edge", "fog", "cloud"]
        .map(|layer| json!({ "kind": "Layer", "name": layer, "spec": { "kind": layer } }));
    let others = DemoNode::ALL.into_iter().filter(|node| *node != PUBLISHING_NODE);
    let nodes = others.map(
        |node| json!({ "kind": "Node", "name": node.name(), "spec": { "layer": node.layer() } }),
    );
    let mut all = layers.to_vec();
    all.extend(nodes);
    all.extend([robot(None), service(DEFAULT_WINDOW)]);
    all
}

fn service(window: u32) -> Value {
    json!({ "kind": "Service", "name": MOVING_SERVICE, "spec": { "config": { WINDOW: window } } })
}

/// The robot, whose flow has a limit of its own or none.
fn robot(limit_mbps: Option<f64>) -> Value {
    let mut spec = json!({ "layer": PUBLISHING_NODE.layer(), "type": "mobile" });
    if let Some(limit_mbps) = limit_mbps {
        spec["overrides"] =
            json!({ NAME: { "flow": { "bandwidth": { "limit_mbps": limit_mbps } } } });
    }
    json!({ "kind": "Node", "name": PUBLISHING_NODE.name(), "spec": spec })
}
