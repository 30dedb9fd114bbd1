//! `blaze ping`: the row of the matrix, or pings to one node.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use blaze_domain::FlowId;
use blaze_domain::control::rfc3339_millis;
use clap::Args;
use serde::Deserialize;
use serde_json::json;

use super::limits::{PING_COUNT, PING_GRACE, PING_INTERVAL};
use super::{CsvFile, MonitorTarget, Quantiles, millis, typed};
use crate::args::FlowAddress;
use crate::config::parse_duration;
use crate::config::text::count;
use crate::exit::{CliError, Exit};
use crate::http::{get_of_monitor, post_to_monitor};
use crate::output::{self, Align, Format, number, terminal_width};

/// Columns of `--csv`.
const HEADING: [&str; 6] = ["time", "to", "latency_ms", "offset_ms", "error_ms", "lost"];

/// Options of `blaze ping`.
#[derive(Debug, Args)]
pub struct PingOptions {
    /// Ping this node now; without it: what the monitor knows of all nodes that it pings
    #[arg(value_name = "LAYER/NODE", value_parser = parse_node)]
    pub to: Option<FlowId>,
    /// Pings, 1 to 100
    #[arg(long, value_name = "N", default_value_t = 4, requires = "to",
        value_parser = clap::value_parser!(u32).range(PING_COUNT))]
    pub count: u32,
    /// Time between two pings, 50ms to 60s
    #[arg(long, value_name = "TIME", default_value = "200ms", requires = "to",
        value_parser = parse_interval)]
    pub interval: Duration,
    /// Write raw samples to this file: time, to, latency_ms, offset_ms, error_ms, lost
    #[arg(long, value_name = "FILE", requires = "to")]
    pub csv: Option<PathBuf>,
    /// Which monitor to ask.
    #[command(flatten)]
    pub target: MonitorTarget,
}

pub(super) fn parse_node(text: &str) -> Result<FlowId, String> {
    text.parse().map_err(|error| format!("{text:?} is no LAYER/NODE, such as fog/fog-1: {error}"))
}

fn parse_interval(text: &str) -> Result<Duration, String> {
    match parse_duration(text)? {
        interval if PING_INTERVAL.contains(&interval) => Ok(interval),
        _ => Err("it is 50 ms to 60 s".to_owned()),
    }
}

/// `GET /v1/ping`.
#[derive(Debug, Deserialize)]
pub(crate) struct Matrix {
    /// Layer of the monitor.
    pub(crate) layer: String,
    /// Its node.
    pub(crate) node: String,
    period_s: f64,
    /// Nodes that it pings.
    pub(crate) nodes: Vec<Row>,
}

/// One node of it.
#[derive(Debug, Deserialize)]
pub(crate) struct Row {
    layer: String,
    node: String,
    /// Time on one way.
    pub(crate) latency_ms: Quantiles,
    sent: u64,
    lost: u64,
    /// Its clock minus that of the monitor.
    pub(crate) clock_offset_ms: Option<f64>,
    /// Bound of the error of it.
    pub(crate) clock_error_ms: Option<f64>,
    clock_source: Option<String>,
    last_ago_s: Option<f64>,
}

impl Row {
    /// `layer/node`.
    pub(crate) fn name(&self) -> String {
        format!("{}/{}", self.layer, self.node)
    }
}

/// The matrix of a monitor.
///
/// # Errors
/// What [`get_of_monitor`] says, or an answer that is not as the contract says.
pub(crate) async fn matrix(monitor: &FlowAddress) -> Result<Matrix, CliError> {
    typed(monitor, &get_of_monitor(monitor, "/v1/ping").await?)
}

/// `POST /v1/ping`.
#[derive(Debug, Deserialize)]
struct Pings {
    samples: Vec<Sample>,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
struct Sample {
    latency_ms: Option<f64>,
    offset_ms: Option<f64>,
    error_ms: Option<f64>,
    #[serde(default)]
    lost: bool,
}

/// Shows the matrix, or pings a node: done if one ping was answered, else failed.
///
/// # Errors
/// [`CliError`]: no monitor, a node that it does not know, a file that cannot be written.
pub async fn run(options: &PingOptions, format: Format) -> Result<Exit, CliError> {
    match &options.to {
        Some(to) => ping(options, to, format).await,
        None => show_matrix(&options.target.monitor, format).await,
    }
}

async fn show_matrix(monitor: &FlowAddress, format: Format) -> Result<Exit, CliError> {
    let value = get_of_monitor(monitor, "/v1/ping").await?;
    let text = output::format_object(&value, format, |value| {
        Ok(matrix_table(&typed(monitor, value)?, terminal_width()))
    })?;
    output::print(&text)?;
    Ok(Exit::Done)
}

fn matrix_table(matrix: &Matrix, width: Option<u16>) -> String {
    let mut text = format!("monitor {}/{}", matrix.layer, matrix.node);
    match matrix.period_s {
        0.0 => text.push_str(", pings are off (monitor.ping_period_s)\n"),
        period => text.push_str(&format!(", a ping every {period:.0} s\n")),
    }
    if matrix.nodes.is_empty() {
        text.push_str(
            "No other node is known: a monitor pings those that run one, too, where a flow carries \
             blaze/ping/LAYER. `blaze peers` shows the flows.\n",
        );
        return text;
    }
    text.push_str(&output::table(
        &matrix.nodes,
        width,
        &[
            ("NODE", Align::Left, &Row::name),
            ("LAST/ms", Align::Right, &|row| number(row.latency_ms.last, 2)),
            ("p50/ms", Align::Right, &|row| number(row.latency_ms.p50, 2)),
            ("p99/ms", Align::Right, &|row| number(row.latency_ms.p99, 2)),
            ("SENT", Align::Right, &|row| row.sent.to_string()),
            ("LOST", Align::Right, &|row| row.lost.to_string()),
            ("CLOCK/ms", Align::Right, &|row| number(row.clock_offset_ms, 3)),
            ("±/ms", Align::Right, &|row| number(row.clock_error_ms, 3)),
            ("BY", Align::Left, &|row| row.clock_source.clone().unwrap_or_else(|| "-".to_owned())),
            ("ANSWERED", Align::Right, &|row| {
                row.last_ago_s.map_or_else(|| "-".to_owned(), |ago| format!("{ago:.0} s ago"))
            }),
        ],
    ));
    text
}

async fn ping(options: &PingOptions, to: &FlowId, format: Format) -> Result<Exit, CliError> {
    let csv = options.csv.as_deref();
    // Before the pings: it would be a pity about them.
    let file = csv.map(|path: &Path| CsvFile::create(path, &HEADING)).transpose()?;
    let monitor = &options.target.monitor;
    let interval_ms = u64::try_from(options.interval.as_millis()).unwrap_or(u64::MAX);
    let body = json!({"to": to, "count": options.count, "interval_ms": interval_ms});
    let within = options.interval.saturating_mul(options.count) + PING_GRACE;
    let begin = unix_ms();
    let answer = post_to_monitor(monitor, "/v1/ping", &body, within).await;
    let value = answer.map_err(|error| with_advice(error, monitor))?;
    let pings: Pings = typed(monitor, &value)?;
    if let Some(mut file) = file {
        for line in csv_lines(to, begin, interval_ms, &pings.samples) {
            file.line(&line)?;
        }
        file.flush()?;
    }
    let text = output::format_object(&value, format, |_| {
        Ok(samples_table(to, &pings.samples, terminal_width()))
    })?;
    output::print(&text)?;
    let is_answered = pings.samples.iter().any(|sample| !sample.lost);
    Ok(if is_answered { Exit::Done } else { Exit::Failed })
}

fn with_advice(error: CliError, monitor: &FlowAddress) -> CliError {
    match &error {
        CliError::Refused { status: 404, .. } => error.advised(format!(
            "`blaze ping --monitor {monitor}` lists the nodes that it knows; the other node needs \
             a blaze-monitor, too."
        )),
        CliError::Refused { status: 409, .. } => error.advised("Try again when it is done."),
        _ => error,
    }
}

/// Lines of `--csv`; the time is when the ping was due.
fn csv_lines(
    to: &FlowId,
    begin_ms: u64,
    interval_ms: u64,
    samples: &[Sample],
) -> impl Iterator<Item = String> {
    let due = move |index: usize| begin_ms.saturating_add(interval_ms.saturating_mul(index as u64));
    samples.iter().enumerate().map(move |(index, sample)| {
        format!(
            "{},{to},{},{},{},{}",
            rfc3339_millis(due(index)),
            millis(sample.latency_ms),
            millis(sample.offset_ms),
            millis(sample.error_ms),
            sample.lost
        )
    })
}

fn samples_table(to: &FlowId, samples: &[Sample], width: Option<u16>) -> String {
    let numbered: Vec<(usize, &Sample)> = samples.iter().enumerate().collect();
    let mut text = output::table(
        &numbered,
        width,
        &[
            ("PING", Align::Right, &|(index, _)| (index + 1).to_string()),
            ("LATENCY/ms", Align::Right, &|(_, sample)| match sample.lost {
                true => "lost".to_owned(),
                false => number(sample.latency_ms, 2),
            }),
            ("CLOCK/ms", Align::Right, &|(_, sample)| number(sample.offset_ms, 3)),
            ("±/ms", Align::Right, &|(_, sample)| number(sample.error_ms, 3)),
        ],
    );
    let mut latencies: Vec<f64> = samples.iter().filter_map(|sample| sample.latency_ms).collect();
    latencies.sort_unstable_by(f64::total_cmp);
    text.push_str(&format!(
        "{to}: {}, {} lost, latency min {} p50 {} max {} ms\n",
        count(samples.len(), "ping"),
        samples.iter().filter(|sample| sample.lost).count(),
        number(latencies.first().copied(), 2),
        number(latencies.get(latencies.len() / 2).copied(), 2),
        number(latencies.last().copied(), 2),
    ));
    text
}

fn unix_ms() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
#[path = "ping_tests.rs"]
mod tests;
