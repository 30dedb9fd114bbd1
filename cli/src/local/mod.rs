//! `blaze pub`, `echo`, `hz`, `call` and `latency --subscribe`: the command line as a service on the local broker of a node
//! file.
//!
//! ```text
//! node file ─► broker of the node scope, else of the layer scope ─┬► ServiceManager ─► publish, subscribe
//!                                                                 └► call ─► control message, answer
//! ```

mod call;
mod echo;
mod hz;
mod latency;
mod meter;
mod publish;
mod types;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::{Broker, BrokerKind, Health, OpenError, Role, open_layer, open_node};
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile};
use blaze_domain::{InstanceName, Reliability, Scope, ServiceName, TopicName};
use blaze_runtime::config::Sources;
use blaze_sdk::{
    FlowError, Lease, Message, MetricsEndpoint, Request, ServiceManager, ServiceOptions,
    SubscribeOptions, Subscription,
};
use clap::Args;

use crate::args::parse_topic;
use crate::exit::CliError;
use crate::node_file;

pub use call::{CallOptions, run as call};
pub use echo::{EchoOptions, run as echo};
pub use hz::{HzOptions, run as hz};
pub(crate) use latency::run as latency;
pub use publish::{PublishOptions, run as publish};

/// How long a broker may take to answer.
const CONNECT_WITHIN: Duration = Duration::from_secs(5);
/// How long a flow may take to answer.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);

/// Whether messages that are lost are sent again.
fn reliability(reliable: bool) -> Reliability {
    match reliable {
        true => Reliability::Reliable,
        false => Reliability::BestEffort,
    }
}

/// Which broker, and which topic.
#[derive(Debug, Args)]
pub struct LocalTopic {
    /// The topic, for example imu/data
    #[arg(value_parser = parse_topic)]
    pub topic: TopicName,
    /// Node file that names the broker; else BLAZE_CONFIG, ./blaze.yaml, /etc/blaze/blaze.yaml
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

impl LocalTopic {
    /// The node file.
    fn node_file(&self) -> Result<NodeFile, CliError> {
        let sources = Sources::of_process(self.config.clone(), Vec::new());
        node_file::read(&sources).map_err(CliError::Invalid)
    }
}

/// The command line as a service, and the broker that it uses.
struct LocalService {
    manager: ServiceManager,
    broker: Arc<dyn Broker>,
}

impl LocalService {
    /// Connects, and starts a service `blaze-<command>` whose instance is the process.
    async fn start(file: &NodeFile, command: &str) -> Result<Self, CliError> {
        let id = file
            .flow_id()
            .ok_or_else(|| CliError::Invalid("the node file names no layer and node".to_owned()))?;
        let (broker, scope) = open(file)?;
        wait_until_up(&broker).await?;
        let fault = |what: &str, error: &dyn std::fmt::Display| {
            CliError::Failed(format!("{what}: {error}"))
        };
        let service: ServiceName =
            format!("blaze-{command}").parse().map_err(|e| fault("service", &e))?;
        let instance: InstanceName =
            format!("p{}", std::process::id()).parse().map_err(|e| fault("instance", &e))?;
        let options = ServiceOptions {
            instance,
            control_timeout: ANSWER_WITHIN,
            metrics: MetricsEndpoint::Off,
            ..ServiceOptions::new(id.layer, service, Arc::clone(&broker), scope)
        };
        let manager = ServiceManager::start(options.on_node(id.node))
            .await
            .map_err(|e| fault("the service does not start", &e))?;
        Ok(Self { manager, broker })
    }

    /// Subscribes to the topic and requests it.
    async fn listen(
        &self,
        options: SubscribeOptions,
        request: Request,
        take: impl Fn(Message) + Send + Sync + 'static,
    ) -> Result<(Subscription, Lease), CliError> {
        let topic = request.topic.clone();
        let subscribed = self.manager.broker().subscribe(&topic, options, take).await;
        let subscription =
            subscribed.map_err(|error| CliError::Failed(format!("subscribe {topic}: {error}")))?;
        let requested = self.manager.flow().request(request).await;
        let lease = requested
            .map_err(|error| lease_error("request", &topic, self.broker.kind(), &error))?;
        Ok((subscription, lease))
    }

    /// Withdraws what was leased, delivers what was taken and disconnects.
    async fn end(self) {
        self.manager.shutdown().await;
        self.broker.close().await;
    }
}

fn open(file: &NodeFile) -> Result<(Arc<dyn Broker>, Scope), CliError> {
    let role = Role::Service;
    match (&file.brokers.node, &file.brokers.layer) {
        (Some(NodeBroker::Memory), _) | (None, Some(LayerBroker::Memory)) => {
            Err(CliError::Usage(format!(
                "brokers: {}. Name redis, kafka or dds in the node file.",
                OpenError::InProcess
            )))
        }
        (Some(node), _) => {
            Ok((open_node(node, &role).map_err(|e| refused("node", &e))?, Scope::Node))
        }
        (None, Some(layer)) => {
            Ok((open_layer(layer, &role).map_err(|e| refused("layer", &e))?, Scope::Layer))
        }
        (None, None) => Err(CliError::Usage(
            "the node file names neither brokers.node nor brokers.layer: there is no local broker"
                .to_owned(),
        )),
    }
}

fn refused(scope: &str, error: &OpenError) -> CliError {
    match error {
        OpenError::Setting { .. } => CliError::Invalid(format!("brokers.{scope}.{error}")),
        OpenError::NotBuilt { .. } | OpenError::InProcess => {
            CliError::Usage(format!("brokers.{scope}: {error}"))
        }
    }
}

async fn wait_until_up(broker: &Arc<dyn Broker>) -> Result<(), CliError> {
    let mut status = broker.status();
    let up = status.wait_for(|status| status.health == Health::Up);
    match tokio::time::timeout(CONNECT_WITHIN, up).await {
        Ok(Ok(_)) => Ok(()),
        Ok(Err(_)) | Err(_) => {
            let detail = broker.status().borrow().detail.clone();
            Err(CliError::NoBroker {
                kind: broker.kind().to_string(),
                waited_s: CONNECT_WITHIN.as_secs(),
                detail,
            })
        }
    }
}

/// What the flow said no to; with the exit code that the contract gives each kind.
fn lease_error(what: &str, topic: &TopicName, kind: BrokerKind, error: &FlowError) -> CliError {
    match error {
        FlowError::NoAnswer { .. } => CliError::NoBroker {
            kind: format!("flow on {kind}"),
            waited_s: ANSWER_WITHIN.as_secs(),
            detail: format!(
                "{what} {topic}: {error}. Is blaze-flow running on this broker? See its /readyz."
            ),
        },
        FlowError::Refused { .. } | FlowError::Invalid { .. } => {
            CliError::Invalid(format!("{what} {topic}: {error}"))
        }
        _ => CliError::Failed(format!("{what} {topic}: {error}")),
    }
}
