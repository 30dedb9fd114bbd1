//! What the engine shows: the body of `/v1/ping`, and its metrics.

use std::time::Duration;

use blaze_domain::{FlowId, LayerName, NodeName};
use serde::Serialize;

use super::engine::Engine;
use super::estimate::{Now, Source};
use super::limits::BUCKETS;
use super::nodes::Series;

/// Body of `/v1/ping`, without the names of the node and the time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PingView {
    /// Mean time between two pings of a node, in seconds; 0: off.
    pub period_s: f64,
    /// Nodes that are asked.
    pub nodes: Vec<NodeView>,
}

/// One node of `/v1/ping`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NodeView {
    /// Its layer.
    pub layer: LayerName,
    /// Its name.
    pub node: NodeName,
    /// Time on one way.
    pub latency_ms: LatencyView,
    /// Pings sent.
    pub sent: u64,
    /// Pings without an answer in 5 s.
    pub lost: u64,
    /// Its clock minus the one here, in milliseconds.
    pub clock_offset_ms: Option<f64>,
    /// The true offset is not farther away than this, in milliseconds.
    pub clock_error_ms: Option<f64>,
    /// Where the offset is from.
    pub clock_source: Option<Source>,
    /// Time since its last answer, in seconds.
    pub last_ago_s: Option<f64>,
}

/// Latency in milliseconds; absent before the first answer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencyView {
    /// Of the last answer.
    pub last: Option<f64>,
    /// Median of the last 64.
    pub p50: Option<f64>,
    /// 99 % of the last 64 are not above it.
    pub p99: Option<f64>,
}

/// Kind of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetricKind {
    /// Grows only.
    Counter,
    /// Goes up and down.
    Gauge,
    /// Counts by upper bounds.
    Histogram,
}

/// What a metric is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Metric {
    /// Full name.
    pub name: &'static str,
    /// Its kind.
    pub kind: MetricKind,
    /// One sentence for `# HELP`.
    pub help: &'static str,
    /// Names of its labels, in order.
    pub labels: &'static [&'static str],
}

const fn of_node(name: &'static str, kind: MetricKind, help: &'static str) -> Metric {
    Metric { name, kind, help, labels: &["to_layer", "to_node"] }
}

const LATENCY: &str = "blaze_ping_latency_seconds";
const SENT: &str = "blaze_ping_sent_total";
const LOST: &str = "blaze_ping_lost_total";
const LAYER_LATENCY: &str = "blaze_ping_layer_latency_seconds";
const OFFSET: &str = "blaze_clock_offset_seconds";
const OFFSET_ERROR: &str = "blaze_clock_offset_error_seconds";
const IGNORED: &str = "blaze_ping_ignored_total";

/// Metrics of pings.
pub const METRICS: [Metric; 7] = [
    of_node(LATENCY, MetricKind::Gauge, "Time on one way to the node in the last ping."),
    of_node(SENT, MetricKind::Counter, "Pings sent to the node."),
    of_node(LOST, MetricKind::Counter, "Pings without an answer of the node in 5 s."),
    Metric {
        name: LAYER_LATENCY,
        kind: MetricKind::Histogram,
        help: "Time on one way to the nodes of the layer.",
        labels: &["to_layer"],
    },
    of_node(OFFSET, MetricKind::Gauge, "Clock of the node minus the clock here."),
    of_node(OFFSET_ERROR, MetricKind::Gauge, "Largest error of the offset to the node's clock."),
    Metric {
        name: IGNORED,
        kind: MetricKind::Counter,
        help: "Messages of pings, answers and nodes that were ignored.",
        labels: &["reason"],
    },
];

/// One value of a metric.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// Name of the metric.
    pub metric: &'static str,
    /// Labels in the order of the table.
    pub labels: Vec<(&'static str, String)>,
    /// Its value.
    pub value: Value,
}

/// Value of a metric.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Of a counter or a gauge.
    Number(f64),
    /// Of a histogram.
    Histogram(Histogram),
}

/// Latencies counted by upper bounds, in seconds.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Histogram {
    /// Per bound, and those above all bounds.
    counts: [u64; BUCKETS.len() + 1],
    sum: f64,
}

impl Histogram {
    pub(super) fn observe(&mut self, seconds: f64) {
        let slot = BUCKETS.iter().take_while(|bound| seconds > **bound).count();
        if let Some(count) = self.counts.get_mut(slot) {
            *count += 1;
        }
        self.sum += seconds;
    }

    /// Upper bounds in seconds, each with the number of values up to it.
    pub fn buckets(&self) -> impl Iterator<Item = (f64, u64)> {
        let sums = self.counts.iter().scan(0, |sum, count| {
            *sum += count;
            Some(*sum)
        });
        BUCKETS.into_iter().zip(sums)
    }

    /// Number of values.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Sum of the values, in seconds.
    #[must_use]
    pub fn sum(&self) -> f64 {
        self.sum
    }
}

impl Engine {
    /// The body of `/v1/ping`.
    #[must_use]
    pub fn view(&self, now: Now) -> PingView {
        let period = if self.nodes.is_off() { Duration::ZERO } else { self.nodes.period() };
        let nodes = self.nodes.asked().map(|(node, series)| self.node_view(node, series, now));
        PingView { period_s: period.as_secs_f64(), nodes: nodes.collect() }
    }

    fn node_view(&self, node: &FlowId, series: &Series, now: Now) -> NodeView {
        let ms = |seconds: f64| seconds * 1e3;
        let offset = self.offset(node, now);
        let ago = series.answered.map(|at| now.monotonic.saturating_sub(at));
        NodeView {
            layer: node.layer.clone(),
            node: node.node.clone(),
            latency_ms: LatencyView {
                last: series.latencies.back().copied().map(ms),
                p50: series.quantile(0.5).map(ms),
                p99: series.quantile(0.99).map(ms),
            },
            sent: series.sent,
            lost: series.lost,
            clock_offset_ms: offset.map(|offset| ms(offset.offset_s)),
            clock_error_ms: offset.map(|offset| ms(offset.error_s)),
            clock_source: offset.map(|offset| offset.source),
            last_ago_s: ago.map(|ago| ago.as_secs_f64()),
        }
    }

    /// All values of the metrics of [`METRICS`].
    pub fn metrics(&self, now: Now) -> impl Iterator<Item = Reading> {
        let nodes = self.nodes.asked();
        let nodes = nodes.flat_map(move |(node, series)| self.node_readings(node, series, now));
        let layers = self.layers.iter().map(|(layer, histogram)| Reading {
            metric: LAYER_LATENCY,
            labels: vec![("to_layer", layer.to_string())],
            value: Value::Histogram(histogram.clone()),
        });
        let ignored = self.ignored.iter().map(|(reason, count)| Reading {
            metric: IGNORED,
            labels: vec![("reason", reason.as_str().to_owned())],
            value: Value::Number(count as f64),
        });
        nodes.chain(layers).chain(ignored)
    }

    fn node_readings(&self, node: &FlowId, series: &Series, now: Now) -> Vec<Reading> {
        let offset = self.offset(node, now);
        let values = [
            (LATENCY, series.latencies.back().copied()),
            (SENT, Some(series.sent as f64)),
            (LOST, Some(series.lost as f64)),
            (OFFSET, offset.map(|offset| offset.offset_s)),
            (OFFSET_ERROR, offset.map(|offset| offset.error_s)),
        ];
        let labels = vec![("to_layer", node.layer.to_string()), ("to_node", node.node.to_string())];
        let readings = values.into_iter().filter_map(|(metric, value)| {
            Some(Reading { metric, labels: labels.clone(), value: Value::Number(value?) })
        });
        readings.collect()
    }
}
