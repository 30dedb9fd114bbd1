//! A service which publishes or listens, and counts. Tests run several of them on one machine, also
//! in network namespaces; since they share a clock, the latencies are true.

mod ear;
mod source;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::{Broker, Health, open_layer, open_node};
use blaze_domain::node_file::{KafkaBroker, LayerBroker, NodeBroker, RedisBroker};
use blaze_domain::{LayerName, NodeName, Reliability, Scope, ServiceName, TopicName};
use blaze_runtime::logs::{self, LogFormat};
use blaze_sdk::{ServiceManager, ServiceOptions};
use clap::{Parser, ValueEnum};

/// How long a server may take to answer.
const START: Duration = Duration::from_secs(30);
/// From this size on a topic is large.
pub(crate) const LARGE_BYTES: usize = 65_536;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    Publish,
    Listen,
}

/// Publishes or listens, and counts. SIGUSR1 ends the publishing; it stays until it is ended itself
/// or its time is over.
#[derive(Debug, Clone, Parser)]
pub(crate) struct Options {
    pub(crate) role: Role,
    /// URL of the Redis of a node scope
    #[arg(long, required_unless_present = "kafka")]
    pub(crate) redis: Option<String>,
    /// HOST:PORT of the Kafka of a layer scope
    #[arg(long, conflicts_with = "redis")]
    pub(crate) kafka: Option<String>,
    /// Before all names on that server
    #[arg(long, default_value = "")]
    pub(crate) prefix: String,
    #[arg(long)]
    pub(crate) layer: LayerName,
    #[arg(long)]
    pub(crate) node: NodeName,
    #[arg(long, default_value = "probe")]
    pub(crate) service: ServiceName,
    /// `NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS[,@FILE]`; without a file of payloads they
    /// are noise
    #[arg(long, required = true)]
    pub(crate) topic: Vec<Topic>,
    /// Seconds
    #[arg(long, default_value_t = 60)]
    pub(crate) duration: u64,
}

#[derive(Debug, Clone)]
pub(crate) struct Topic {
    pub(crate) name: TopicName,
    pub(crate) reliability: Reliability,
    pub(crate) hz: f64,
    pub(crate) bytes: usize,
    pub(crate) lifespan: Duration,
    pub(crate) payload: Payload,
}

/// What is in a payload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Payload {
    /// Nothing that could be compressed.
    Noise,
    /// The parts of this file, each as long as a payload, one after another.
    File(PathBuf),
}

impl FromStr for Topic {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let parts: Vec<&str> = text.split(',').collect();
        let (parts, payload) = match parts[..] {
            [ref terms @ .., file] if file.starts_with('@') => {
                (terms, Payload::File(file[1..].into()))
            }
            ref terms => (terms, Payload::Noise),
        };
        let [name, reliability, hz, bytes, lifespan] = *parts else {
            anyhow::bail!(
                "{text}: NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS[,@FILE] is expected"
            )
        };
        Ok(Self {
            name: name.parse()?,
            reliability: match reliability {
                "reliable" => Reliability::Reliable,
                "best_effort" => Reliability::BestEffort,
                other => anyhow::bail!("{other}: reliable or best_effort is expected"),
            },
            hz: hz.parse()?,
            bytes: bytes.parse()?,
            lifespan: Duration::from_millis(lifespan.parse()?),
            payload,
        })
    }
}

#[tokio::main]
pub(crate) async fn run(options: &Options) -> anyhow::Result<()> {
    let _logs = logs::init("warn", LogFormat::Text)?;
    let broker = open(options)?;
    let mut status = broker.status();
    tokio::time::timeout(START, status.wait_for(|status| status.health == Health::Up))
        .await
        .context("the broker does not answer")??;
    let scope = if options.redis.is_some() { Scope::Node } else { Scope::Layer };
    let service = ServiceOptions::new(
        options.layer.clone(),
        options.service.clone(),
        Arc::clone(&broker),
        scope,
    );
    let service = ServiceManager::start(service.on_node(options.node.clone())).await?;
    eprintln!("ready node={} ", options.node);
    match options.role {
        Role::Publish => source::publish(&service, options).await?,
        Role::Listen => ear::listen(&service, options).await?,
    }
    // Withdraws what was leased, and delivers what was taken.
    service.shutdown().await;
    broker.close().await;
    Ok(())
}

fn open(options: &Options) -> anyhow::Result<Arc<dyn Broker>> {
    let (role, prefix) = (blaze_brokers::Role::Service, options.prefix.clone());
    let broker = match (&options.redis, &options.kafka) {
        (Some(url), _) => {
            let section = RedisBroker {
                url: url.clone().into(),
                prefix,
                user: None,
                password_file: None,
                tls: None,
            };
            open_node(&NodeBroker::Redis(section), &role)?
        }
        (None, Some(bootstrap)) => {
            let section = KafkaBroker {
                bootstrap: vec![bootstrap.clone()],
                prefix,
                password_file: None,
                properties: BTreeMap::new(),
            };
            open_layer(&LayerBroker::Kafka(section), &role)?
        }
        (None, None) => anyhow::bail!("no broker is named"),
    };
    Ok(broker)
}
