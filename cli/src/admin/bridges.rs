//! `blaze bridges`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{Align, number, render_table};

/// What `GET /v1/bridges` answers.
#[derive(Debug, Clone, Deserialize)]
pub struct Bridges {
    /// `layer/node` of the flow that answers.
    #[serde(default, deserialize_with = "super::text_or_null")]
    pub flow: String,
    /// Its bridges.
    pub bridges: Vec<Bridge>,
}

/// One bridge: a topic taken from one scope and written to another.
#[derive(Debug, Clone, Deserialize)]
pub struct Bridge {
    /// The topic.
    pub topic: String,
    /// Where it is taken.
    pub from: Place,
    /// Where it is written.
    pub to: Place,
    /// `starting`, `up`, `draining` or `failed`.
    pub state: String,
    /// What came in.
    #[serde(default, rename = "in")]
    pub input: Count,
    /// What went out.
    #[serde(default, rename = "out")]
    pub output: Count,
    /// Messages that wait.
    #[serde(default)]
    pub queued: u64,
    /// Messages dropped, by reason.
    #[serde(default)]
    pub dropped: BTreeMap<String, u64>,
    /// Why it failed, if it did.
    #[serde(default, deserialize_with = "super::text_or_null")]
    pub detail: String,
    #[serde(default)]
    latency_ms: Option<Percentiles>,
}

/// One end of a bridge.
#[derive(Debug, Clone, Deserialize)]
pub struct Place {
    /// `node`, `layer` or `inter`.
    pub scope: String,
    /// Message system: `memory`, `dds`, …
    #[serde(default, deserialize_with = "super::text_or_null")]
    pub broker: String,
    /// Destination layer, where `scope` is `inter`.
    #[serde(default)]
    pub layer: Option<String>,
    /// Destination flow, where there is one.
    #[serde(default)]
    pub flow: Option<String>,
}

impl Place {
    /// `scope:broker`.
    #[must_use]
    pub fn label(&self) -> String {
        if self.broker.is_empty() {
            self.scope.clone()
        } else {
            format!("{}:{}", self.scope, self.broker)
        }
    }
}

/// Messages and bytes.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
pub struct Count {
    /// Messages.
    pub messages: u64,
    /// Bytes.
    #[serde(default)]
    pub bytes: u64,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct Percentiles {
    #[serde(default)]
    p50: Option<f64>,
    #[serde(default)]
    p99: Option<f64>,
}

pub(super) fn table(flow: &FlowAddress, value: &Value, width: Option<u16>) -> Result<String, CliError> {
    let answer: Bridges = typed(flow, value)?;
    let mut text = heading(value);
    if answer.bridges.is_empty() {
        text.push_str(
            "No bridges: nothing that is published here is asked for elsewhere. `blaze why TOPIC` says what is missing.\n",
        );
        return Ok(text);
    }
    let columns = [
        ("TOPIC", Align::Left),
        ("FROM", Align::Left),
        ("TO", Align::Left),
        ("STATE", Align::Left),
        ("IN", Align::Right),
        ("OUT", Align::Right),
        ("QUEUED", Align::Right),
        ("p50/ms", Align::Right),
        ("p99/ms", Align::Right),
        ("DROPPED", Align::Left),
    ];
    let rows = answer.bridges.iter().map(row).collect();
    text.push_str(&render_table(&columns, rows, width));
    for bridge in answer.bridges.iter().filter(|bridge| !bridge.detail.is_empty()) {
        text.push_str(&format!("{} {}: {}\n", bridge.topic, bridge.state, bridge.detail));
    }
    Ok(text)
}

fn row(bridge: &Bridge) -> Vec<String> {
    let mut to = bridge.to.label();
    if let Some(layer) = bridge.to.layer.as_ref().filter(|_| bridge.to.scope == "inter") {
        to = format!("{to} {layer}");
    }
    if let Some(flow) = &bridge.to.flow {
        to = format!("{to} ({flow})");
    }
    vec![
        bridge.topic.clone(),
        bridge.from.label(),
        to,
        bridge.state.clone(),
        bridge.input.messages.to_string(),
        bridge.output.messages.to_string(),
        bridge.queued.to_string(),
        number(bridge.latency_ms.and_then(|latency| latency.p50), 2),
        number(bridge.latency_ms.and_then(|latency| latency.p99), 2),
        dropped_text(&bridge.dropped),
    ]
}

/// Drops in words: `lifespan 3, queue_full 1`; a dash for none.
pub(crate) fn dropped_text(dropped: &BTreeMap<String, u64>) -> String {
    let parts: Vec<String> = dropped
        .iter()
        .filter(|(_, count)| **count > 0)
        .map(|(reason, count)| format!("{reason} {count}"))
        .collect();
    if parts.is_empty() {
        "-".to_owned()
    } else {
        parts.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn bridges_are_a_table() {
        let value = json!({"flow": "edge/robot-1", "bridges": [
            {"id": "imu/data|node>inter|cloud", "topic": "imu/data", "from": {"scope": "node", "broker": "memory"},
             "to": {"scope": "inter", "broker": "dds", "layer": "cloud", "flow": "cloud/cloud-1"}, "state": "up",
             "since_s": 3, "in": {"messages": 100, "bytes": 1}, "out": {"messages": 97, "bytes": 1}, "queued": 1,
             "dropped": {"queue_full": 0, "lifespan": 2}, "latency_ms": {"p50": 0.51, "p99": null}}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert_eq!(
            table(&flow, &value, None).unwrap(),
            "flow edge/robot-1\n\
             TOPIC     FROM         TO                               STATE   IN  OUT  QUEUED  p50/ms  p99/ms  DROPPED\n\
             imu/data  node:memory  inter:dds cloud (cloud/cloud-1)  up     100   97       1    0.51       -  lifespan 2\n"
        );
    }

    #[test]
    fn a_failed_bridge_says_why() {
        let value = json!({"flow": "fog/fog-1", "bridges": [
            {"topic": "imu/data", "from": {"scope": "node", "broker": "redis"}, "to": {"scope": "layer", "broker": "kafka"},
             "state": "failed", "detail": "no such name"}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        let text = table(&flow, &value, None).unwrap();
        assert!(text.ends_with("imu/data failed: no such name\n"), "{text}");
    }
}
