//! `blaze latency`: what the monitor of a node knows of a topic; with `--subscribe` the command
//! measures by itself.

use std::path::PathBuf;

use blaze_domain::FlowId;
use clap::Args;
use serde::Deserialize;
use serde_json::Value;

use super::ping::parse_node;
use super::{MonitorTarget, Quantiles, typed};
use crate::admin::closest;
use crate::config::text::printable;
use crate::exit::{CliError, Exit};
use crate::http::get_of_monitor;
use crate::local::{self, LocalTopic};
use crate::output::{self, Align, Format, number, terminal_width};

/// Options of `blaze latency`.
#[derive(Debug, Args)]
pub struct LatencyOptions {
    /// Topic, and with --subscribe the broker.
    #[command(flatten)]
    pub target: LocalTopic,
    /// Only messages that this node publishes
    #[arg(long, value_name = "LAYER/NODE", value_parser = parse_node)]
    pub from: Option<FlowId>,
    /// Subscribe to the topic and measure each message, once a second
    #[arg(long)]
    pub subscribe: bool,
    /// End after this many figures; one a second
    #[arg(long, value_name = "N", requires = "subscribe",
        value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Write raw samples to this file: time, from, sequence, latency_ms, error_ms, method
    #[arg(long, value_name = "FILE", requires = "subscribe")]
    pub csv: Option<PathBuf>,
    /// Which monitor to ask.
    #[command(flatten)]
    pub monitor: MonitorTarget,
}

/// `GET /v1/latency`.
#[derive(Debug, Deserialize)]
pub(crate) struct Latency {
    topics: Vec<Row>,
}

/// A topic from one node.
#[derive(Debug, Deserialize)]
struct Row {
    topic: String,
    from: Option<String>,
    method: Option<String>,
    messages: u64,
    latency_ms: Quantiles,
    error_ms: Option<f64>,
    #[serde(default)]
    unknown: u64,
    lost: Option<u64>,
    #[serde(default)]
    hops: Vec<Hop>,
}

impl Row {
    fn from(&self) -> String {
        self.from.as_deref().map_or_else(|| "several nodes".to_owned(), printable)
    }
}

#[derive(Debug, Deserialize)]
struct Hop {
    #[serde(rename = "where")]
    place: String,
    p50_ms: Option<f64>,
    p99_ms: Option<f64>,
}

/// Shows what the monitor knows, or measures.
///
/// # Errors
/// [`CliError`]: no monitor; with `--subscribe` no broker, no flow, a file that cannot be written.
pub async fn run(options: &LatencyOptions, format: Format) -> Result<Exit, CliError> {
    if options.subscribe {
        return local::latency(options, format).await;
    }
    let monitor = &options.monitor.monitor;
    let mut value = get_of_monitor(monitor, "/v1/latency").await?;
    let known: Latency = typed(monitor, &value)?;
    let topic = options.target.topic.as_str();
    keep(&mut value, topic, options.from.as_ref());
    let shown: Latency = typed(monitor, &value)?;
    let is_there = !shown.topics.is_empty();
    if is_there || format != Format::Table {
        let text = output::format_object(&value, format, |_| Ok(table(&shown, terminal_width())))?;
        output::print(&text)?;
    }
    if !is_there {
        eprintln!("blaze: {}", not_measured(topic, &known));
    }
    Ok(if is_there { Exit::Done } else { Exit::NotFound })
}

/// Leaves only the rows of a topic, and of a node if one is named.
fn keep(value: &mut Value, topic: &str, from: Option<&FlowId>) {
    if let Some(rows) = value.get_mut("topics").and_then(Value::as_array_mut) {
        rows.retain(|row| {
            let is_from = |from: &FlowId| row["from"].as_str().is_some_and(|f| from.is_written(f));
            row["topic"] == topic && from.is_none_or(is_from)
        });
    }
}

fn not_measured(topic: &str, known: &Latency) -> String {
    let meant = closest(topic, known.topics.iter().map(|row| row.topic.as_str()));
    let meant = meant.map(|meant| format!(" Did you mean {}?", printable(meant)));
    format!(
        "the monitor has no latency of {topic}.{}\n  Add it to monitor.latency_topics of the node \
         file, or measure it now with --subscribe. `blaze why {topic}` says whether it flows.",
        meant.unwrap_or_default()
    )
}

/// Rows as a table; below them the parts of each latency.
pub(crate) fn table(latency: &Latency, width: Option<u16>) -> String {
    let mut text = output::table(
        &latency.topics,
        width,
        &[
            ("FROM", Align::Left, &Row::from),
            ("MESSAGES", Align::Right, &|row| row.messages.to_string()),
            ("p50/ms", Align::Right, &|row| number(row.latency_ms.p50, 2)),
            ("p99/ms", Align::Right, &|row| number(row.latency_ms.p99, 2)),
            ("±/ms", Align::Right, &|row| number(row.error_ms, 3)),
            ("BY", Align::Left, &|row| row.method.clone().unwrap_or_else(|| "-".to_owned())),
            ("UNKNOWN", Align::Right, &|row| row.unknown.to_string()),
            ("LOST", Align::Right, &|row| {
                row.lost.map_or_else(|| "-".to_owned(), |lost| lost.to_string())
            }),
        ],
    );
    for row in latency.topics.iter().filter(|row| !row.hops.is_empty()) {
        let hops: Vec<String> = row.hops.iter().map(hop).collect();
        text.push_str(&format!("{}, p50 and p99 in ms: {}\n", row.from(), hops.join(" + ")));
    }
    text
}

fn hop(hop: &Hop) -> String {
    format!("{} {}/{}", printable(&hop.place), number(hop.p50_ms, 2), number(hop.p99_ms, 2))
}

#[cfg(test)]
#[path = "latency_tests.rs"]
mod tests;
