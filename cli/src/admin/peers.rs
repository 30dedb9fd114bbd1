//! `blaze peers`.

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{Align, number, render_table};

#[derive(Debug, Deserialize)]
struct Peers {
    peers: Vec<Peer>,
}

#[derive(Debug, Deserialize)]
struct Peer {
    flow: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    kind: String,
    state: String,
    #[serde(default)]
    last_heard_ms: Option<f64>,
    #[serde(default)]
    rtt_ms: Option<f64>,
    #[serde(default)]
    clock_offset_ms: Option<f64>,
    #[serde(default)]
    clock_error_ms: Option<f64>,
    #[serde(default)]
    loss: Option<f64>,
    #[serde(default)]
    address: Option<String>,
}

pub(super) fn table(flow: &FlowAddress, value: &Value, width: Option<u16>) -> Result<String, CliError> {
    let answer: Peers = typed(flow, value)?;
    let mut text = heading(value);
    if answer.peers.is_empty() {
        text.push_str("No peers: no other flow has been heard. Check brokers.inter: domain, listen and peers.\n");
        return Ok(text);
    }
    let columns = [
        ("FLOW", Align::Left),
        ("KIND", Align::Left),
        ("STATE", Align::Left),
        ("ADDRESS", Align::Left),
        ("HEARD/ms", Align::Right),
        ("RTT/ms", Align::Right),
        ("LOSS/%", Align::Right),
        ("CLOCK/ms", Align::Right),
    ];
    let rows = answer.peers.iter().map(row).collect();
    text.push_str(&render_table(&columns, rows, width));
    Ok(text)
}

fn row(peer: &Peer) -> Vec<String> {
    let clock = match (peer.clock_offset_ms, peer.clock_error_ms) {
        (Some(offset), Some(error)) => format!("{offset:+.2} ±{error:.2}"),
        (offset, _) => number(offset, 2),
    };
    vec![
        peer.flow.clone(),
        peer.kind.clone(),
        peer.state.clone(),
        peer.address.clone().unwrap_or_else(|| "-".to_owned()),
        number(peer.last_heard_ms, 0),
        number(peer.rtt_ms, 2),
        number(peer.loss.map(|share| share * 100.0), 2),
        clock,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn peers_are_a_table() {
        let value = json!({"flow": "edge/robot-1", "peers": [
            {"flow": "fog/fog-1", "layer": "fog", "kind": "fog", "epoch": 7, "version": 3, "state": "up",
             "last_heard_ms": 120, "rtt_ms": 0.4, "clock_offset_ms": -0.01, "clock_error_ms": 0.2, "loss": 0.015,
             "address": "10.0.3.1"},
            {"flow": "cloud/cloud-1", "kind": null, "rtt_ms": null, "state": "down"}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert_eq!(
            table(&flow, &value, None).unwrap(),
            "flow edge/robot-1\n\
             FLOW           KIND  STATE  ADDRESS   HEARD/ms  RTT/ms  LOSS/%     CLOCK/ms\n\
             fog/fog-1      fog   up     10.0.3.1       120    0.40    1.50  -0.01 ±0.20\n\
             cloud/cloud-1        down   -                -       -       -            -\n"
        );
    }
}
