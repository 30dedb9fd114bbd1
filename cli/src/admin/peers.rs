//! `blaze peers`.

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{self, Align, number};

#[derive(Debug, Deserialize)]
struct Peers {
    peers: Vec<Peer>,
    #[serde(default)]
    replicas: Vec<Replica>,
}

/// Another flow of the layer.
#[derive(Debug, Deserialize)]
struct Replica {
    flow: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    state: String,
    #[serde(default)]
    settled: bool,
    last_heard_ms: Option<f64>,
    #[serde(default)]
    carries: u64,
    load: Option<Load>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Load {
    out_bytes_per_s: f64,
    in_bytes_per_s: f64,
}

#[derive(Debug, Deserialize)]
struct Peer {
    flow: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    kind: String,
    state: String,
    last_heard_ms: Option<f64>,
    rtt_ms: Option<f64>,
    clock_offset_ms: Option<f64>,
    clock_error_ms: Option<f64>,
    loss: Option<f64>,
    address: Option<String>,
}

pub(super) fn table(
    flow: &FlowAddress,
    value: &Value,
    width: Option<u16>,
) -> Result<String, CliError> {
    let answer: Peers = typed(flow, value)?;
    let mut text = heading(value);
    if answer.peers.is_empty() {
        text.push_str(
            "No peers: no other flow has been heard. Check brokers.inter: domain, listen \
            and peers.\n",
        );
        text.push_str(&replicas(&answer.replicas, width));
        return Ok(text);
    }
    text.push_str(&output::table(
        &answer.peers,
        width,
        &[
            ("FLOW", Align::Left, &|peer| peer.flow.clone()),
            ("KIND", Align::Left, &|peer| peer.kind.clone()),
            ("STATE", Align::Left, &|peer| peer.state.clone()),
            ("ADDRESS", Align::Left, &|peer| {
                peer.address.clone().unwrap_or_else(|| "-".to_owned())
            }),
            ("HEARD/ms", Align::Right, &|peer| number(peer.last_heard_ms, 0)),
            ("RTT/ms", Align::Right, &|peer| number(peer.rtt_ms, 2)),
            ("LOSS/%", Align::Right, &|peer| number(peer.loss.map(|share| share * 100.0), 2)),
            ("CLOCK/ms", Align::Right, &clock),
        ],
    ));
    text.push_str(&replicas(&answer.replicas, width));
    Ok(text)
}

/// The other flows of the layer, below a line of their own; nothing where there are none.
fn replicas(replicas: &[Replica], width: Option<u16>) -> String {
    if replicas.is_empty() {
        return String::new();
    }
    let kib = |replica: &Replica, of: fn(&Load) -> f64| {
        number(replica.load.as_ref().map(|load| of(load) / 1024.0), 1)
    };
    let state = |replica: &Replica| match replica.settled {
        true => "settled".to_owned(),
        false => replica.state.clone(),
    };
    let table = output::table(
        replicas,
        width,
        &[
            ("REPLICA", Align::Left, &|replica| replica.flow.clone()),
            ("STATE", Align::Left, &state),
            ("HEARD/ms", Align::Right, &|replica| number(replica.last_heard_ms, 0)),
            ("CARRIES", Align::Right, &|replica| replica.carries.to_string()),
            ("OUT KiB/s", Align::Right, &|replica| kib(replica, |load| load.out_bytes_per_s)),
            ("IN KiB/s", Align::Right, &|replica| kib(replica, |load| load.in_bytes_per_s)),
        ],
    );
    format!("\n{table}")
}

fn clock(peer: &Peer) -> String {
    match (peer.clock_offset_ms, peer.clock_error_ms) {
        (Some(offset), Some(error)) => format!("{offset:+.2} ±{error:.2}"),
        (offset, _) => number(offset, 2),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn peers_are_a_table() {
        let value = json!({"flow": "edge/robot-1", "peers": [
            {"flow": "fog/fog-1", "layer": "fog", "kind": "fog", "epoch": 7, "version": 3,
                "state": "up",
             "last_heard_ms": 120, "rtt_ms": 0.4, "clock_offset_ms": -0.01, "clock_error_ms": 0.2,
             "loss": 0.015,
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

    #[test]
    fn other_flows_of_the_layer_have_a_table_of_their_own() {
        let value = json!({"flow": "cloud/cloud-1", "peers": [], "replicas": [
            {"flow": "cloud/cloud-2", "epoch": 7, "state": "ready", "settled": true,
                "last_heard_ms": 120, "in_step": true,
             "carries": 3, "load": {"out_bytes_per_s": 102_400, "in_bytes_per_s": 512,
                 "limit_bytes_per_s": null}},
            {"flow": "cloud/cloud-3", "state": "starting", "settled": false, "last_heard_ms": 20,
                "load": null}]});
        let flow = "127.0.0.1:9101".parse().unwrap();
        let text = table(&flow, &value, None).unwrap();
        assert!(
            text.ends_with(
                "\n\
                 REPLICA        STATE     HEARD/ms  CARRIES  OUT KiB/s  IN KiB/s\n\
                 cloud/cloud-2  settled        120        3      100.0       0.5\n\
                 cloud/cloud-3  starting        20        0          -         -\n"
            ),
            "{text}"
        );
    }
}
