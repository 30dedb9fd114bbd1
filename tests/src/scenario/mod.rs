//! Scenarios as data: who runs where, over which network, what breaks when, and what must hold.
//!
//! ```text
//! Scenario ─► run ─► Topology, servers, blaze-flow and blaze-probe processes, faults on their time ─► Report ─► check
//! ```
//!
//! A new scenario is a new value of [`Scenario`]; the runner is for all of them.

pub mod budget;
pub mod parts;
mod report;
mod run;

use std::time::Duration;

use crate::network::Plan;
use crate::process::Usage;
use crate::wan::{Change, Ways};

pub use report::{FlowReport, Report, Route};
pub use run::{Running, Since, run};

/// A run of processes on a network.
#[derive(Debug, Clone, PartialEq)]
pub struct Scenario {
    /// For the report.
    pub name: &'static str,
    /// Hosts and links.
    pub network: Plan,
    /// Servers.
    pub brokers: Vec<Broker>,
    /// Flows; they share one inter scope.
    pub flows: Vec<Flow>,
    /// Who publishes. A topic has one publisher in a scenario.
    pub publishers: Vec<Service>,
    /// Who listens.
    pub consumers: Vec<Service>,
    /// What happens when, counted from the moment when every consumer has received something of
    /// every topic.
    pub faults: Vec<(Duration, Fault)>,
    /// How long is published from that moment on.
    pub duration: Duration,
    /// How long the last messages may take to arrive before they count as lost.
    pub settle: Duration,
    /// What must hold in the end.
    pub expect: Vec<Expect>,
}

/// A server.
#[derive(Debug, Clone, PartialEq)]
pub struct Broker {
    /// For the rows below.
    pub name: &'static str,
    /// Host that it runs on.
    pub host: &'static str,
    /// Which one.
    pub kind: BrokerKind,
}

/// Which server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BrokerKind {
    /// Redis, for a node scope.
    Redis,
    /// Kafka, for a layer scope.
    Kafka,
}

/// A `blaze-flow` process.
#[derive(Debug, Clone, PartialEq)]
pub struct Flow {
    /// Layer.
    pub layer: &'static str,
    /// Node, unique; names the flow in the rows below.
    pub node: &'static str,
    /// Host that it runs on.
    pub host: &'static str,
    /// Names of servers: Redis is its node scope, Kafka its layer scope.
    pub brokers: Vec<&'static str>,
    /// DDS domain of its layer scope, on its host's network.
    pub layer_domain: Option<u16>,
    /// Hosts of flows that it is told of.
    pub peers: Vec<&'static str>,
    /// `flow.bandwidth.limit_mbps`
    pub limit_mbps: f64,
    /// More keys of `flow.bandwidth`.
    pub bandwidth: &'static str,
    /// More keys of `flow`.
    pub keys: &'static str,
}

/// A `blaze-probe` process, on the host of its flow.
#[derive(Debug, Clone, PartialEq)]
pub struct Service {
    /// Name, unique among those that do the same.
    pub name: &'static str,
    /// Node of the flow that it belongs to.
    pub flow: &'static str,
    /// The flow's server that it uses.
    pub broker: &'static str,
    /// What it publishes or requests.
    pub streams: Vec<Stream>,
}

/// A topic.
#[derive(Debug, Clone, PartialEq)]
pub struct Stream {
    /// Its name.
    pub topic: &'static str,
    /// Else best effort.
    pub reliable: bool,
    /// Messages per second.
    pub hz: f64,
    /// Payload of each.
    pub bytes: usize,
    /// Zero = for ever.
    pub lifespan: Duration,
    /// A file with payloads that are published in turn; without it they are noise, which cannot be
    /// compressed.
    pub payloads: Option<&'static str>,
}

/// What breaks, or is mended.
#[derive(Debug, Clone, PartialEq)]
pub enum Fault {
    /// Cuts the link between two hosts. Forward is from the first to the second.
    Cut(&'static str, &'static str, Ways),
    /// Ends a cut.
    Heal(&'static str, &'static str, Ways),
    /// Changes a link's quality.
    Set(&'static str, &'static str, Ways, Vec<Change>),
    /// Kills a flow, by its node, with -9.
    KillFlow(&'static str),
    /// Starts a killed flow again.
    StartFlow(&'static str),
    /// Kills a server and starts it again at once, with what it keeps on disk.
    RestartBroker(&'static str),
    /// Stops a server: connections stay, answers do not come.
    FreezeBroker(&'static str),
    /// Lets a stopped server go on.
    ThawBroker(&'static str),
}

/// What must hold for a topic at a consumer.
#[derive(Debug, Clone, PartialEq)]
pub enum Expect {
    /// From the first message received to the last one published: each once and in order.
    Whole(&'static str, &'static str),
    /// None twice and in order; of those from the first received to the last published at most this
    /// share is lost.
    LostAtMost(&'static str, &'static str, f64),
    /// This many at least.
    Received(&'static str, &'static str, u64),
    /// The last message published came: the route is whole in the end, whatever happened on the
    /// way.
    Alive(&'static str, &'static str),
    /// In every flow every bridge has, in the end, `in = out + dropped + queued`.
    Balanced,
    /// No flow holds more in the end than a fifth of the time after the begin, but for this.
    Growth(Usage),
}
