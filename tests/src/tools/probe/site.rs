//! Where the service lives: beside a flow of its own, or on a broker of somebody else's.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Health, open_layer, open_node};
use blaze_domain::node_file::{BandwidthSection, Chunking, FlowSection, KafkaBroker, NodeBroker, RedisBroker};
use blaze_domain::{FlowId, LayerKind, LayerName, NodeName, Scope};
use blaze_flow::flow::settings::{FlowSettings, InterSettings, LiveSettings};
use blaze_flow::flow::{FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_runtime::Supervisor;
use blaze_sdk::{ServiceManager, ServiceOptions};

use super::{Options, Role};

/// How long a flow may take to be ready, and a server to answer.
const START: Duration = Duration::from_secs(30);

pub(crate) struct Site {
    pub(crate) service: ServiceManager,
    pub(crate) node: NodeName,
    /// Admin port of the flow of its own; port 0 when there is none.
    pub(crate) admin: SocketAddr,
    broker: Arc<dyn Broker>,
    flow: Option<RunningFlow>,
    supervisor: Supervisor,
}

impl Site {
    pub(crate) async fn start(options: &Options) -> anyhow::Result<Self> {
        match options.listen {
            Some(listen) => Self::with_flow(options, listen).await,
            None => Self::on_server(options).await,
        }
    }

    async fn with_flow(options: &Options, listen: Ipv4Addr) -> anyhow::Result<Self> {
        let supervisor = Supervisor::new("probe");
        let hub = MemoryHub::new("probe");
        let flow = start_flow(options, listen, &hub, &supervisor).await?;
        let id = flow.id().clone();
        let broker: Arc<dyn Broker> = Arc::new(hub.broker());
        Ok(Self {
            service: start_service(options, id.layer, id.node.clone(), &broker, Scope::Layer).await?,
            node: id.node,
            admin: flow.admin(),
            broker,
            flow: Some(flow),
            supervisor,
        })
    }

    async fn on_server(options: &Options) -> anyhow::Result<Self> {
        let role = blaze_brokers::Role::Service;
        let (broker, scope) = match (&options.redis, &options.kafka) {
            (Some(url), _) => {
                let section = RedisBroker {
                    url: url.clone().into(),
                    prefix: options.prefix.clone(),
                    user: None,
                    password_file: None,
                    tls: None,
                };
                (open_node(&NodeBroker::Redis(section), &role)?, Scope::Node)
            }
            (None, Some(bootstrap)) => {
                let section = KafkaBroker {
                    bootstrap: vec![bootstrap.clone()],
                    prefix: options.prefix.clone(),
                    properties: BTreeMap::new(),
                };
                let section = blaze_domain::node_file::LayerBroker::Kafka(section);
                (open_layer(&section, &role)?, Scope::Layer)
            }
            (None, None) => anyhow::bail!("no broker is named"),
        };
        let mut status = broker.status();
        tokio::time::timeout(START, status.wait_for(|status| status.health == Health::Up))
            .await
            .context("the broker does not answer")??;
        let layer = options.layer.clone().context("--layer is missing")?;
        let node = options.node.clone().context("--node is missing")?;
        Ok(Self {
            service: start_service(options, layer, node.clone(), &broker, scope).await?,
            node,
            admin: (Ipv4Addr::LOCALHOST, 0).into(),
            broker,
            flow: None,
            supervisor: Supervisor::new("probe"),
        })
    }

    /// Withdraws what was leased, delivers what was taken, and stops.
    pub(crate) async fn end(self) {
        self.service.shutdown().await;
        match self.flow {
            Some(flow) => flow.shutdown().await,
            None => self.broker.close().await,
        }
        self.supervisor.shutdown(Duration::from_secs(1)).await;
    }
}

async fn start_service(
    options: &Options,
    layer: LayerName,
    node: NodeName,
    broker: &Arc<dyn Broker>,
    scope: Scope,
) -> anyhow::Result<ServiceManager> {
    let service = ServiceOptions::new(layer, options.service.clone(), Arc::clone(broker), scope);
    Ok(ServiceManager::start(service.on_node(node)).await?)
}

async fn start_flow(
    options: &Options,
    listen: Ipv4Addr,
    hub: &MemoryHub,
    supervisor: &Supervisor,
) -> anyhow::Result<RunningFlow> {
    let (layer, kind, node) = match options.role {
        Role::Publish => ("edge", LayerKind::Edge, "probe-1"),
        Role::Listen => ("cloud", LayerKind::Cloud, "probe-2"),
    };
    let settings = FlowSettings {
        gateway: blaze_domain::node_file::AutoBool::Auto,
        me: FlowId::new(layer.parse()?, node.parse()?),
        kind,
        admin: (Ipv4Addr::LOCALHOST, 0).into(),
        inter: Some(InterSettings {
            domain: options.domain,
            listen,
            peers: options.peer.into_iter().collect(),
            peer_slots: 4,
            mtu: 1500,
            chunking: Chunking::Auto,
        }),
        live: LiveSettings::from(&FlowSection {
            bandwidth: BandwidthSection {
                limit_mbps: options.limit_mbps,
                ..BandwidthSection::default()
            },
            ..FlowSection::default()
        }),
    };
    let flow = FlowOptions {
        settings,
        node: None,
        layer: Some(LayerBroker {
            broker: Arc::new(hub.broker()),
            id: LayerScopeId::private(),
        }),
        state_dir: None,
    };
    let flow = blaze_flow::flow::start(flow, supervisor.child(node)).await?;
    tokio::time::timeout(START, flow.ready())
        .await
        .context("the flow is not ready after 30 s")?;
    Ok(flow)
}
