//! What the engine shows: the body of `/v1/ping`, and its metrics.

use std::time::Duration;

use blaze_domain::{FlowId, LayerName, NodeName};
use serde::Serialize;

use super::engine::Engine;
use super::estimate::{Now, Source};
use super::nodes::Series;
use crate::metric::{Histogram, Metric, metrics};

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

metrics! {
    LATENCY Gauge "blaze_ping_latency_seconds" ["to_layer", "to_node"] "seconds"
        "Time on one way to the node in the last ping."
    SENT Counter "blaze_ping_sent_total" ["to_layer", "to_node"] "1"
        "Pings sent to the node."
    LOST Counter "blaze_ping_lost_total" ["to_layer", "to_node"] "1"
        "Pings without an answer of the node in 5 s."
    LAYER_LATENCY Histogram "blaze_ping_layer_latency_seconds" ["to_layer"] "seconds"
        "Time on one way to the nodes of the layer."
    OFFSET Gauge "blaze_clock_offset_seconds" ["to_layer", "to_node"] "seconds"
        "Clock of the node minus the clock here."
    OFFSET_ERROR Gauge "blaze_clock_offset_error_seconds" ["to_layer", "to_node"] "seconds"
        "Largest error of the offset to the node's clock."
    IGNORED Counter "blaze_ping_ignored_total" ["reason"] "1"
        "Messages of pings, answers and nodes that were ignored."
}

/// One value of a metric.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// The metric.
    pub metric: &'static Metric,
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
            metric: &LAYER_LATENCY,
            labels: vec![("to_layer", layer.to_string())],
            value: Value::Histogram(histogram.clone()),
        });
        let ignored = self.ignored.iter().map(|(reason, count)| Reading {
            metric: &IGNORED,
            labels: vec![("reason", reason.as_str().to_owned())],
            value: Value::Number(count as f64),
        });
        nodes.chain(layers).chain(ignored)
    }

    fn node_readings(&self, node: &FlowId, series: &Series, now: Now) -> Vec<Reading> {
        let offset = self.offset(node, now);
        let values = [
            (&LATENCY, series.latencies.back().copied()),
            (&SENT, Some(series.sent as f64)),
            (&LOST, Some(series.lost as f64)),
            (&OFFSET, offset.map(|offset| offset.offset_s)),
            (&OFFSET_ERROR, offset.map(|offset| offset.error_s)),
        ];
        let labels = vec![("to_layer", node.layer.to_string()), ("to_node", node.node.to_string())];
        let readings = values.into_iter().filter_map(|(metric, value)| {
            Some(Reading { metric, labels: labels.clone(), value: Value::Number(value?) })
        });
        readings.collect()
    }
}
