//! A service which publishes or listens, and counts: what `blaze demo` does not play. Either it brings a flow of its own
//! in the same process (`--listen`), or it is an ordinary service on a broker that has one (`--redis`, `--kafka`). Tests run
//! several of them on one machine in network namespaces; since they share a clock, the latencies are true.

mod ear;
mod site;
mod source;

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use blaze_domain::{LayerName, NodeName, Reliability, ServiceName, TopicName};
use blaze_runtime::logs::{self, LogFormat};
use clap::{Parser, ValueEnum};

use self::site::Site;

/// From this size on a topic is large.
pub(crate) const LARGE_BYTES: usize = 65_536;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    /// With a flow of its own: edge/probe-1
    Publish,
    /// With a flow of its own: cloud/probe-2
    Listen,
}

/// Publishes or listens, and counts. SIGUSR1 ends the publishing; it stays until it is ended itself or its time is over.
#[derive(Debug, Clone, Parser)]
pub(crate) struct Options {
    pub(crate) role: Role,
    /// With a flow of its own: address of the one interface that is used
    #[arg(long, required_unless_present_any = ["redis", "kafka"])]
    pub(crate) listen: Option<Ipv4Addr>,
    /// The other host
    #[arg(long)]
    pub(crate) peer: Option<Ipv4Addr>,
    #[arg(long, default_value_t = 0)]
    pub(crate) domain: u16,
    #[arg(long, default_value_t = 160.0)]
    pub(crate) limit_mbps: f64,
    /// On the Redis of a node scope instead: its URL
    #[arg(long, conflicts_with_all = ["listen", "kafka"], requires = "layer", requires = "node")]
    pub(crate) redis: Option<String>,
    /// On the Kafka of a layer scope instead: HOST:PORT
    #[arg(long, conflicts_with = "listen", requires = "layer", requires = "node")]
    pub(crate) kafka: Option<String>,
    /// Before all names on that server
    #[arg(long, default_value = "", conflicts_with = "listen")]
    pub(crate) prefix: String,
    /// Layer of the flow
    #[arg(long)]
    pub(crate) layer: Option<LayerName>,
    /// Node of the service
    #[arg(long)]
    pub(crate) node: Option<NodeName>,
    #[arg(long, default_value = "probe")]
    pub(crate) service: ServiceName,
    /// `NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS[,@FILE]`; without a file of payloads they are noise
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
            [ref terms @ .., file] if file.starts_with('@') => (terms, Payload::File(file[1..].into())),
            ref terms => (terms, Payload::Noise),
        };
        let [name, reliability, hz, bytes, lifespan] = *parts else {
            anyhow::bail!("{text}: NAME,reliable|best_effort,HZ,BYTES,LIFESPAN_MS[,@FILE] is expected")
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
    let site = Site::start(options).await?;
    eprintln!("ready node={} admin={}", site.node, site.admin);
    match options.role {
        Role::Publish => source::publish(&site.service, options).await?,
        Role::Listen => ear::listen(&site.service, options).await?,
    }
    site.end().await;
    Ok(())
}
