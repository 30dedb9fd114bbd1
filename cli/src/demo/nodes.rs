//! The nodes of the demo: a flow each, on brokers within the process or on real servers.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::Scope;
use blaze_domain::node_file::NodeFile;
use blaze_flow::flow::settings::FlowSettings;
use blaze_flow::flow::{Beginning, Epochs, FlowOptions, RunningFlow};
use blaze_monitor::running::RunningMonitor;
use blaze_runtime::Supervisor;
use blaze_runtime::config::Sources;
use futures::future::join_all;
use serde_json::Value;

use super::brokers::{BrokerSource, NodeBrokers};
use super::domain_id::{self, DEFAULT_DOMAIN, ReservedDomain};
use super::options::{DemoNode, DemoOptions};
use super::roles::{PUBLISHING_NODE, ROS2_NODE};
use crate::embedded::start_monitor;
use crate::exit::CliError;
use crate::node_file;

/// How long a node may take to be ready.
const READY_TIMEOUT: Duration = Duration::from_secs(30);

/// A node that runs.
pub(super) struct RunningNode {
    pub(super) node: DemoNode,
    /// Its node file.
    pub(super) file: Value,
    /// `flow.bandwidth.limit_mbps` in it.
    pub(super) limit_mbps: f64,
    pub(super) brokers: NodeBrokers,
    pub(super) flow: Arc<RunningFlow>,
    monitor: RunningMonitor,
    pub(super) supervisor: Supervisor,
}

/// The nodes of this process.
pub(super) struct Nodes {
    pub(super) running: Vec<RunningNode>,
    /// Keeps other demos off the domain.
    _domain: Option<ReservedDomain>,
}

/// Starts the nodes that the options name.
///
/// # Errors
/// [`CliError::Usage`] for options that make no sense, [`CliError::Failed`] for what could not be
/// started.
pub(super) async fn start_nodes(
    options: &DemoOptions,
    supervisor: &Supervisor,
) -> Result<Nodes, CliError> {
    let listen = match options.listen {
        Some(IpAddr::V4(address)) => address,
        Some(IpAddr::V6(_)) | None => Ipv4Addr::LOCALHOST,
    };
    if !domain_id::is_local(listen) {
        return Err(CliError::Usage(format!(
            "--listen {listen}: no interface of this host has this address."
        )));
    }
    let reserved =
        if options.is_complete() { domain_id::reserve(listen, options.ros2) } else { None };
    let domain = match &reserved {
        Some(reserved) => reserved.domain,
        None if options.is_complete() => {
            return Err(CliError::Failed(
                "every DDS domain from 20 to 100 is in use on this host".to_owned(),
            ));
        }
        None => DEFAULT_DOMAIN,
    };
    // Settings of all nodes first: a faulty --set is told before anything runs.
    let settings: Vec<(DemoNode, (FlowSettings, NodeFile, Value))> = options
        .nodes()
        .into_iter()
        .map(|node| Ok((node, settings_of(node, options, listen, domain)?)))
        .collect::<Result<_, CliError>>()?;
    let mut source = BrokerSource::new(options.brokers)?;
    let mut running = Vec::new();
    for (node, (settings, of_monitor, file)) in settings {
        let limit_mbps = settings.live.bandwidth.limit_mbps;
        let epochs = Epochs::begin(&settings.me, None);
        let brokers = source.of(node, &settings.me, epochs.first())?;
        let beginning = Beginning { epochs, layer_prefix: brokers.layer_prefix.clone() };
        let flow_options = FlowOptions {
            settings,
            node: Some(Arc::clone(&brokers.flow_node)),
            layer: Some(brokers.flow_layer.clone()),
            state_dir: None,
        };
        let of_node = supervisor.child(node.name());
        let flow =
            blaze_flow::flow::start_with(flow_options, beginning, of_node.clone()).await.map_err(
                |error| CliError::Failed(format!("{} does not start: {error:#}", node.name())),
            )?;
        let broker = Arc::clone(brokers.of_services(Scope::Node));
        let monitor = start_monitor(of_monitor, flow.admin(), broker, &of_node).await?;
        running.push(RunningNode {
            node,
            file,
            limit_mbps,
            brokers,
            flow: Arc::new(flow),
            monitor,
            supervisor: of_node,
        });
    }
    Ok(Nodes { running, _domain: reserved })
}

/// What a node of the demo has in its node file, with the user's `--set` on top.
fn settings_of(
    node: DemoNode,
    options: &DemoOptions,
    listen: Ipv4Addr,
    domain: u16,
) -> Result<(FlowSettings, NodeFile, Value), CliError> {
    let peers: Vec<String> = options.peer.iter().map(|peer| format!("\"{peer}\"")).collect();
    let (layer, name, peers) = (node.layer(), node.name(), peers.join(", "));
    let own = [
        ("layer", format!("{{ name: {layer}, kind: {layer} }}")),
        ("node", format!("{{ name: {name} }}")),
        ("brokers.node", "{ memory: {} }".to_owned()),
        ("brokers.layer", "{ memory: {} }".to_owned()),
        (
            "brokers.inter",
            format!("{{ dds: {{ domain: {domain}, listen: \"{listen}\", peers: [{peers}] }} }}"),
        ),
        ("admin.flow", "\"127.0.0.1:0\"".to_owned()),
        ("admin.monitor", "\"127.0.0.1:0\"".to_owned()),
    ];
    let ros2 = options.ros2.filter(|_| node == ROS2_NODE);
    let ros2 =
        ros2.map(|domain| ("brokers.plugins", format!("[{{ ros2: {{ domain: {domain} }} }}]")));
    let sources = Sources {
        overrides: own
            .into_iter()
            .chain(ros2)
            .map(|(key, value)| (key.to_owned(), value))
            .chain(options.set.iter().map(|setting| (setting.key.clone(), setting.value.clone())))
            .collect(),
        file_may_be_absent: true,
        ..Sources::default()
    };
    let (file, tree) = node_file::read_with_tree(&sources)
        .map_err(|faults| CliError::Usage(format!("--set: {faults}")))?;
    let settings = FlowSettings::try_from(&file)
        .map_err(|error| CliError::Usage(format!("--set: {error}")))?;
    Ok((settings, file, tree))
}

/// Waits until all of them are ready, and says where they are asked.
///
/// # Errors
/// [`CliError::Failed`] for one that is not in time.
pub(super) async fn wait_ready(nodes: &Nodes, ros2: Option<u16>) -> Result<(), CliError> {
    for running in &nodes.running {
        let name = running.node.name();
        tokio::time::timeout(READY_TIMEOUT, running.flow.ready()).await.map_err(|_| {
            let waited = READY_TIMEOUT.as_secs();
            CliError::Failed(format!(
                "{name} was not ready within {waited} s; see http://{}/readyz",
                running.flow.admin()
            ))
        })?;
        let ros2 = ros2.filter(|_| running.node == ROS2_NODE);
        let ros2 = ros2.map(|domain| format!(" ros2={domain}")).unwrap_or_default();
        let (admin, monitor) = (running.flow.admin(), running.monitor.admin());
        eprintln!("ready node={name} admin={admin} monitor={monitor}{ros2}");
    }
    Ok(())
}

impl Nodes {
    /// The node that publishes, if it runs here.
    pub(super) fn robot(&self) -> Option<&RunningNode> {
        self.running.iter().find(|running| running.node == PUBLISHING_NODE)
    }

    /// Drains the flows, then closes their brokers.
    pub(super) async fn shutdown(self) {
        join_all(self.running.into_iter().map(|running| async move {
            running.monitor.stop().await;
            running.flow.drain().await;
            running.supervisor.shutdown(Duration::from_secs(1)).await;
            running.brokers.close().await;
        }))
        .await;
    }
}
