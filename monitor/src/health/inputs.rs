//! What health is evaluated from: plain values that others read and fill in.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::config::ServiceState;
use blaze_domain::{FlowId, Priority, WhyCode};
use serde::Deserialize;

/// One point in time by both clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// By the monotonic clock: all durations.
    pub at: Instant,
    /// By the wall clock, in ms since 1970: shown only.
    pub unix_ms: u64,
}

/// All that health is evaluated from. What is absent is no problem.
#[derive(Debug, Clone, Default)]
pub struct Inputs {
    /// Values of the node.
    pub vitals: Vitals,
    /// The flows that the node file names.
    pub flows: Vec<FlowInput>,
    /// The worker, if the node has one.
    pub worker: Option<ProgramInput>,
    /// All signs of life of services; `None` if they could not be read.
    pub services: Option<Vec<ServiceInput>>,
}

/// Values of the node; `None` and empty where it lacks one.
#[derive(Debug, Clone, Default)]
pub struct Vitals {
    /// Mount points with the free share of their file system, 0 to 1.
    pub disks: Vec<(String, f64)>,
    /// Share of the memory that is available, 0 to 1.
    pub memory_available: Option<f64>,
    /// The hottest sensor, in °C.
    pub hottest: Option<(String, f64)>,
    /// Maximum error of the clock in seconds, as the kernel states it.
    pub clock_error_s: Option<f64>,
    /// Clock offsets to other nodes.
    pub offsets: Vec<OffsetInput>,
    /// Counter of datagrams dropped for lack of buffer.
    pub udp_buffer_errors: Option<u64>,
    /// Counter of the seconds during which the cgroup was throttled.
    pub throttled_s: Option<f64>,
}

/// The clock of another node against this one.
#[derive(Debug, Clone)]
pub struct OffsetInput {
    /// The other node.
    pub node: FlowId,
    /// Its clock minus ours, in seconds.
    pub offset_s: f64,
    /// Bound of the error of `offset_s`, in seconds.
    pub error_s: f64,
}

/// A flow or a worker, as its `/readyz` shows it.
#[derive(Debug, Clone, Default)]
pub struct ProgramInput {
    /// Its name, such as `edge/robot-1`.
    pub name: String,
    /// Whether its admin port answers.
    pub is_reachable: bool,
    /// Whether it is ready.
    pub is_ready: bool,
    /// Checks that fail, or why its port does not answer.
    pub detail: String,
    /// Fault of its configuration, with which it goes on as before.
    pub config_fault: Option<String>,
}

/// A flow.
#[derive(Debug, Clone, Default)]
pub struct FlowInput {
    /// The program.
    pub program: ProgramInput,
    /// Its `/v1/summary`, if it answered.
    pub summary: Option<Summary>,
    /// Its topics.
    pub topics: Vec<TopicInput>,
}

/// `/v1/summary` of a flow, as far as health needs it.
#[derive(Debug, Clone, Deserialize)]
pub struct Summary {
    /// Whether the limits suffice for what is published.
    #[serde(default = "yes")]
    pub feasible: bool,
    /// Links to other flows.
    #[serde(default)]
    pub links: Vec<Link>,
}

impl Default for Summary {
    fn default() -> Self {
        Self { feasible: true, links: Vec::new() }
    }
}

/// A link to another flow.
#[derive(Debug, Clone, Deserialize)]
pub struct Link {
    /// The other flow.
    pub flow: FlowId,
    /// `up`, `suspect` or `down`.
    pub state: String,
    /// Round trip in ms, once measured.
    #[serde(default)]
    pub rtt_ms: Option<f64>,
    /// Share of samples lost of late, 0 to 1.
    #[serde(default)]
    pub loss: f64,
    /// What the other flow receives, in bytes per second.
    #[serde(default)]
    pub wire_bytes_per_s: f64,
    /// Limit of the link to its layer, in bytes per second; 0: none.
    #[serde(default)]
    pub limit_bytes_per_s: f64,
}

/// A topic of a flow, from its `/v1/topics`, `/v1/bridges` and, where it is blocked, `/v1/why`.
#[derive(Debug, Clone)]
pub struct TopicInput {
    /// The topic.
    pub topic: String,
    /// Whether it is advertised anywhere.
    pub is_advertised: bool,
    /// Whether it is requested anywhere.
    pub is_requested: bool,
    /// Verdict of `why`; `ok` where it flows.
    pub code: WhyCode,
    /// Detail of the step that failed.
    pub detail: String,
    /// Advertised rate in Hz of a publisher of this node.
    pub advertised_hz: Option<f64>,
    /// Measured rate in Hz.
    pub rate_hz: Option<f64>,
    /// Its class.
    pub priority: Priority,
    /// Counters of dropped messages by reason, of all its bridges.
    pub dropped: BTreeMap<String, u64>,
}

/// The configuration of a service against the one that its worker delivered.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum ConfigState {
    /// It has none, or its worker does not know.
    #[default]
    Unknown,
    /// It runs with the newest.
    Current,
    /// It runs with an older one.
    Stale {
        /// Revision that it runs with.
        has: u64,
        /// Revision that was delivered.
        delivered: u64,
    },
    /// It rejected the newest, for this reason.
    Rejected(String),
}

/// The sign of life of one instance of a service.
#[derive(Debug, Clone)]
pub struct ServiceInput {
    /// The service.
    pub service: String,
    /// The instance, usually `0`.
    pub instance: String,
    /// Its state by its own report.
    pub state: ServiceState,
    /// How long the record still lives if it is not renewed.
    pub expires_in: Duration,
    /// Its configuration.
    pub config: ConfigState,
}

impl ServiceInput {
    /// `service/instance`: the name in problems and metrics.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{}/{}", self.service, self.instance)
    }
}

fn yes() -> bool {
    true
}
