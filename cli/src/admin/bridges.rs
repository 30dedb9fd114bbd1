//! `blaze bridges`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{self, Align, number};

/// What `GET /v1/bridges` answers.
#[derive(Debug, Clone, Deserialize)]
pub struct Bridges {
    /// `layer/node` of the flow that answers.
    #[serde(default, deserialize_with = "super::text_or_null")]
    pub flow: String,
    /// Its bridges.
    pub bridges: Vec<Bridge>,
    #[serde(default)]
    not_owner: Vec<Elsewhere>,
    balance: Option<Balance>,
    /// What it dropped before a bridge took it; the topic is empty where it is not known.
    #[serde(default)]
    pub dropped_before_bridges: Vec<DroppedBefore>,
}

/// Messages of a topic that a flow dropped before a bridge took them.
#[derive(Debug, Clone, Deserialize)]
pub struct DroppedBefore {
    /// The topic.
    pub topic: String,
    /// Messages by reason.
    pub dropped: BTreeMap<String, u64>,
}

/// A topic of the layer that another flow carries out of it.
#[derive(Debug, Clone, Deserialize)]
struct Elsewhere {
    topic: String,
    owner: String,
}

/// How much the flow carries, and what it gave to other flows of its layer.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
struct Balance {
    out_bytes_per_s: u64,
    in_bytes_per_s: u64,
    moves: BTreeMap<String, u64>,
    last_move: Option<LastMove>,
}

#[derive(Debug, Clone, Deserialize)]
struct LastMove {
    topic: String,
    to: Option<String>,
    reason: String,
    #[serde(default)]
    ago_s: f64,
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
    load_bytes_per_s: Option<f64>,
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
    pub layer: Option<String>,
    /// Destination flow, where there is one.
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
    p50: Option<f64>,
    p99: Option<f64>,
}

pub(super) fn table(
    flow: &FlowAddress,
    value: &Value,
    width: Option<u16>,
) -> Result<String, CliError> {
    let answer: Bridges = typed(flow, value)?;
    let mut text = heading(value);
    if answer.bridges.is_empty() {
        text.push_str(
            "No bridges: nothing that is published here is asked for elsewhere. `blaze why TOPIC` \
             says what is missing.\n",
        );
        text.push_str(&group_text(&answer));
        return Ok(text);
    }
    let millis = |bridge: &Bridge, part: fn(Percentiles) -> Option<f64>| {
        number(bridge.latency_ms.and_then(part), 2)
    };
    text.push_str(&output::table(
        &answer.bridges,
        width,
        &[
            ("TOPIC", Align::Left, &|bridge| bridge.topic.clone()),
            ("FROM", Align::Left, &|bridge| bridge.from.label()),
            ("TO", Align::Left, &to_text),
            ("STATE", Align::Left, &|bridge| bridge.state.clone()),
            ("IN", Align::Right, &|bridge| bridge.input.messages.to_string()),
            ("OUT", Align::Right, &|bridge| bridge.output.messages.to_string()),
            ("KiB/s", Align::Right, &|bridge| {
                bridge.load_bytes_per_s.map_or_else(|| number(None, 1), kib)
            }),
            ("QUEUED", Align::Right, &|bridge| bridge.queued.to_string()),
            ("p50/ms", Align::Right, &|bridge| millis(bridge, |latency| latency.p50)),
            ("p99/ms", Align::Right, &|bridge| millis(bridge, |latency| latency.p99)),
            ("DROPPED", Align::Left, &|bridge| dropped_text(&bridge.dropped)),
        ],
    ));
    for bridge in answer.bridges.iter().filter(|bridge| !bridge.detail.is_empty()) {
        text.push_str(&format!("{} {}: {}\n", bridge.topic, bridge.state, bridge.detail));
    }
    text.push_str(&group_text(&answer));
    Ok(text)
}

/// What the flow carries among those of its layer, and what no bridge took; nothing where it shares
/// its layer with nobody and dropped nothing.
fn group_text(answer: &Bridges) -> String {
    let mut text = String::new();
    for elsewhere in &answer.not_owner {
        text.push_str(&format!(
            "{} is carried out of the layer by {}\n",
            elsewhere.topic, elsewhere.owner
        ));
    }
    for row in &answer.dropped_before_bridges {
        let topic = if row.topic.is_empty() { "unknown topics" } else { &row.topic };
        text.push_str(&format!(
            "dropped before any bridge: {topic}: {}\n",
            dropped_text(&row.dropped)
        ));
    }
    let Some(balance) = &answer.balance else { return text };
    if answer.not_owner.is_empty() && balance.moves.values().all(|count| *count == 0) {
        return text;
    }
    text.push_str(&format!(
        "load: {} KiB/s out, {} KiB/s in; topics that went to other flows: {}\n",
        kib(balance.out_bytes_per_s as f64),
        kib(balance.in_bytes_per_s as f64),
        dropped_text(&balance.moves),
    ));
    if let Some(last) = &balance.last_move {
        let to = last.to.as_deref().unwrap_or("the one that hashing chose");
        text.push_str(&format!(
            "last: {} to {to}, {:.0} s ago ({})\n",
            last.topic, last.ago_s, last.reason
        ));
    }
    text
}

fn kib(bytes_per_s: f64) -> String {
    number(Some(bytes_per_s / 1024.0), 1)
}

fn to_text(bridge: &Bridge) -> String {
    let mut to = bridge.to.label();
    if let Some(layer) = bridge.to.layer.as_ref().filter(|_| bridge.to.scope == "inter") {
        to = format!("{to} {layer}");
    }
    if let Some(flow) = &bridge.to.flow {
        to = format!("{to} ({flow})");
    }
    to
}

/// Drops in words: `lifespan 3, queue_full 1`; a dash for none.
pub(crate) fn dropped_text(dropped: &BTreeMap<String, u64>) -> String {
    let parts: Vec<String> = dropped
        .iter()
        .filter(|(_, count)| **count > 0)
        .map(|(reason, count)| format!("{reason} {count}"))
        .collect();
    if parts.is_empty() { "-".to_owned() } else { parts.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn bridges_are_a_table() {
        let value = json!({"flow": "edge/robot-1", "bridges": [
            {"id": "imu/data|node>inter|cloud", "topic": "imu/data",
                "from": {"scope": "node", "broker": "memory"},
             "to": {
                 "scope": "inter",
                 "broker": "dds",
                 "layer": "cloud",
                 "flow": "cloud/cloud-1",
             }, "state": "up",
             "since_s": 3, "in": {"messages": 100, "bytes": 1}, "out": {"messages": 97, "bytes": 1},
             "queued": 1,
             "load_bytes_per_s": 16896,
             "dropped": {"queue_full": 0, "lifespan": 2},
             "latency_ms": {"p50": 0.51, "p99": null}}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert_eq!(
            table(&flow, &value, None).unwrap(),
            "flow edge/robot-1\n\
             TOPIC     FROM         TO                               STATE   IN  OUT  KiB/s  QUEUED  p50/ms  p99/ms  DROPPED\n\
             imu/data  node:memory  inter:dds cloud (cloud/cloud-1)  up     100   97   16.5       1    0.51       -  lifespan 2\n"
        );
    }

    #[test]
    fn who_carries_what_of_a_layer_is_said_below() {
        let value = json!({"flow": "cloud/cloud-1", "bridges": [],
            "not_owner": [{"topic": "cmd/vel", "owner": "cloud/cloud-2"}],
            "balance": {"out_bytes_per_s": 102_400, "in_bytes_per_s": 0,
                "moves": {"load": 1, "settled": 0, "taken_back": 0},
                        "last_move": {"topic": "map", "to": "cloud/cloud-2", "reason": "load",
                            "ago_s": 12.4}}});
        let flow = "127.0.0.1:9101".parse().unwrap();
        let text = table(&flow, &value, None).unwrap();
        assert!(
            text.ends_with(
                "cmd/vel is carried out of the layer by cloud/cloud-2\n\
                 load: 100.0 KiB/s out, 0.0 KiB/s in; topics that went to other flows: load 1\n\
                 last: map to cloud/cloud-2, 12 s ago (load)\n"
            ),
            "{text}"
        );
    }

    #[test]
    fn a_failed_bridge_says_why() {
        let value = json!({"flow": "fog/fog-1", "bridges": [
            {"topic": "imu/data", "from": {"scope": "node", "broker": "redis"},
                "to": {"scope": "layer", "broker": "kafka"},
             "state": "failed", "detail": "no such name"}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        let text = table(&flow, &value, None).unwrap();
        assert!(text.ends_with("imu/data failed: no such name\n"), "{text}");
    }
}
