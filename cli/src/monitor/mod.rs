//! Commands that ask the monitor of a node: pings, latency of messages, problems.
//!
//! ```text
//! ping, latency, problems ──► admin port of blaze-monitor ──► output, CSV
//! problems --server ────────► REST of the main service
//! latency --subscribe ──────► local: a service on the local broker; clocks from /v1/ping
//! ```

mod csv;
mod latency;
mod limits;
mod ping;
mod problems;

use clap::Args;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::admin::typed_of;
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::http::Program;

pub(crate) use csv::{CsvFile, millis};
pub(crate) use latency::{Latency, table as latency_table};
pub use latency::{LatencyOptions, run as latency};
pub(crate) use ping::{Matrix, Row as PingRow, matrix};
pub use ping::{PingOptions, run as ping};
pub use problems::{ProblemsOptions, run as problems};

/// Default port of a monitor.
const PORT: u16 = 9103;

/// Which monitor to ask.
#[derive(Debug, Args)]
pub struct MonitorTarget {
    /// Admin port of the monitor
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:9103",
        value_parser = parse_address)]
    pub monitor: FlowAddress,
}

fn parse_address(text: &str) -> Result<FlowAddress, String> {
    FlowAddress::parse(text, PORT)
}

/// Quantiles in milliseconds, absent where there is no value yet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
pub(crate) struct Quantiles {
    /// The last value.
    pub(crate) last: Option<f64>,
    /// Median.
    pub(crate) p50: Option<f64>,
    /// 99th percentile.
    pub(crate) p99: Option<f64>,
}

/// Reads an answer of a monitor.
fn typed<T: DeserializeOwned>(monitor: &FlowAddress, value: &Value) -> Result<T, CliError> {
    typed_of(Program::Monitor, monitor, value)
}
