//! `blaze top`: what each lane carries beside what it was allocated, or nodes, topics, bridges,
//! again and again.

use std::time::Duration;

use clap::Args;
use serde::Deserialize;
use serde_json::Value;

use super::{bridges, heading, nodes, topics, typed};
use crate::args::{FlowAddress, FlowTarget, parse_seconds};
use crate::config::ServerOptions;
use crate::config::client::Client;
use crate::exit::{CliError, Exit};
use crate::http::get_json;
use crate::output::{self, Align, Format, bytes, number, terminal_width};

/// Options of `blaze top`.
#[derive(Debug, Args)]
pub struct TopOptions {
    /// What to show; without it: the lanes of a flow
    #[arg(value_enum)]
    pub view: Option<View>,
    /// Which flow to ask.
    #[command(flatten)]
    pub target: FlowTarget,
    /// Seconds between two looks
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = parse_seconds)]
    pub interval: f64,
    /// End after this many looks
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Which main service to ask for the nodes.
    #[command(flatten)]
    pub server: ServerOptions,
}

impl TopOptions {
    fn interval(&self) -> Duration {
        Duration::from_secs_f64(self.interval)
    }
}

/// What `blaze top` shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum View {
    /// All nodes of the system, from the main service
    Nodes,
    /// Topics that a flow knows
    Topics,
    /// Bridges of a flow
    Bridges,
}

#[derive(Debug, Deserialize)]
struct Allocation {
    limit_mbps: f64,
    budget_bytes_per_s: f64,
    measured_bytes_per_s: Option<f64>,
    wire_factor: Option<f64>,
    feasible: Option<bool>,
    topics: Vec<Topic>,
    links: Vec<Link>,
}

#[derive(Debug, Deserialize)]
struct Topic {
    topic: String,
    class: String,
    size_bytes: f64,
    advertised_hz: f64,
    compression: Option<Compression>,
    lanes: Vec<Lane>,
}

#[derive(Debug, Deserialize)]
struct Compression {
    ratio: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct Lane {
    layer: String,
    allocated_hz: Option<f64>,
    actual_hz: f64,
    #[serde(default)]
    exceeds_advertised: bool,
    skipped: u64,
    #[serde(default)]
    queued: u64,
    wait_ms: Option<Percentiles>,
}

#[derive(Debug, Deserialize)]
struct Percentiles {
    p99: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct Link {
    layer: String,
    limit_bytes_per_s: Option<f64>,
    measured_bytes_per_s: Option<f64>,
    wire_bytes_per_s: f64,
}

/// Prints until it is interrupted, or `--count` times. On a terminal each look replaces the one
/// before; with `-o json` each is one line.
///
/// # Errors
/// What [`get_json`] says, or an answer that is not as the contract says.
pub(super) async fn run(options: &TopOptions, format: Format) -> Result<Exit, CliError> {
    let flow = &options.target.flow;
    let width = terminal_width;
    match options.view {
        None => {
            let look = || get_json(flow, "/v1/allocation");
            looks(options, format, look, |value| table(flow, value, width())).await
        }
        Some(View::Topics) => {
            let look = || get_json(flow, "/v1/topics");
            looks(options, format, look, |value| topics::table(flow, value, width())).await
        }
        Some(View::Bridges) => {
            let look = || get_json(flow, "/v1/bridges");
            looks(options, format, look, |value| bridges::table(flow, value, width())).await
        }
        Some(View::Nodes) => {
            let client = Client::of(&options.server)?;
            let look = || client.fleet(options.interval());
            looks(options, format, look, |value| Ok(nodes::table(value, width()))).await
        }
    }
}

async fn looks<F: Future<Output = Result<Value, CliError>>>(
    options: &TopOptions,
    format: Format,
    look: impl Fn() -> F,
    table: impl Fn(&Value) -> Result<String, CliError>,
) -> Result<Exit, CliError> {
    let mut looks = 0;
    loop {
        let value = tokio::select! {
            value = look() => value?,
            _ = tokio::signal::ctrl_c() => return Ok(Exit::Done),
        };
        output::print_look(&value, format, &table)?;
        looks += 1;
        if options.count.is_some_and(|count| looks >= count) {
            return Ok(Exit::Done);
        }
        tokio::select! {
            () = tokio::time::sleep(options.interval()) => {}
            _ = tokio::signal::ctrl_c() => return Ok(Exit::Done),
        }
    }
}

fn table(flow: &FlowAddress, value: &Value, width: Option<u16>) -> Result<String, CliError> {
    let answer: Allocation = typed(flow, value)?;
    let mut text = heading(value);
    text.push_str(&format!(
        "limit {} Mbit/s of 1024² bit = {}/s on the wire, wire factor {}{}{}\n",
        answer.limit_mbps,
        bytes(answer.budget_bytes_per_s),
        number(answer.wire_factor, 3),
        answer
            .measured_bytes_per_s
            .map(|measured| format!(", measured {}/s", bytes(measured)))
            .unwrap_or_default(),
        if answer.feasible == Some(false) { ", NOT feasible" } else { "" },
    ));
    if answer.topics.is_empty() {
        text.push_str(
            "Nothing leaves on the inter scope. `blaze why TOPIC --to LAYER` says what \
            is missing.\n",
        );
    } else {
        text.push_str(&lanes(&answer.topics, width));
    }
    let exceeds = |topic: &&Topic| topic.lanes.iter().any(|lane| lane.exceeds_advertised);
    for topic in answer.topics.iter().filter(exceeds) {
        text.push_str(&format!(
            "{}: more is published than was advertised, and is skipped; let it advertise its true \
             rate\n",
            topic.topic
        ));
    }
    for link in &answer.links {
        // Its own, or that of all links where that is less.
        let limit = link.limit_bytes_per_s.unwrap_or(f64::INFINITY).min(answer.budget_bytes_per_s);
        let measured = link
            .measured_bytes_per_s
            .map(|measured| format!(", measured {}/s", bytes(measured)))
            .unwrap_or_default();
        text.push_str(&format!(
            "link to {}: {}/s of {}/s, {:.1} %{measured}\n",
            link.layer,
            bytes(link.wire_bytes_per_s),
            bytes(limit),
            100.0 * link.wire_bytes_per_s / limit.max(1.0),
        ));
    }
    Ok(text)
}

fn lanes(topics: &[Topic], width: Option<u16>) -> String {
    let lanes: Vec<(&Topic, &Lane)> =
        topics.iter().flat_map(|topic| topic.lanes.iter().map(move |lane| (topic, lane))).collect();
    let ratio =
        |topic: &Topic| topic.compression.as_ref().and_then(|compression| compression.ratio);
    output::table(
        &lanes,
        width,
        &[
            ("TOPIC", Align::Left, &|(topic, _)| topic.topic.clone()),
            ("CLASS", Align::Left, &|(topic, _)| topic.class.clone()),
            ("BYTES", Align::Right, &|(topic, _)| number(Some(topic.size_bytes), 0)),
            ("LZ4", Align::Right, &|(topic, _)| {
                ratio(topic)
                    .map_or_else(|| "-".to_owned(), |ratio| format!("{:.0} %", 100.0 * ratio))
            }),
            ("TO", Align::Left, &|(_, lane)| lane.layer.clone()),
            ("ADVERTISED/Hz", Align::Right, &|(topic, _)| number(Some(topic.advertised_hz), 2)),
            ("PLANNED/Hz", Align::Right, &|(_, lane)| number(lane.allocated_hz, 2)),
            ("ACTUAL/Hz", Align::Right, &|(_, lane)| number(Some(lane.actual_hz), 2)),
            ("SKIPPED", Align::Right, &|(_, lane)| lane.skipped.to_string()),
            ("QUEUED", Align::Right, &|(_, lane)| lane.queued.to_string()),
            ("p99/ms", Align::Right, &|(_, lane)| {
                number(lane.wait_ms.as_ref().and_then(|wait| wait.p99), 2)
            }),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn planned_and_actual_stand_side_by_side() {
        let value = json!({
            "flow": "edge/robot-1", "limit_mbps": 40, "budget_bytes_per_s": 5_242_880,
            "measured_bytes_per_s": null,
            "wire_factor": 1.0912, "feasible": true,
            "topics": [{"topic": "camera/image_raw", "class": "large", "size_bytes": 921_600,
                "advertised_hz": 30.0, "lanes": [
                {"layer": "fog", "allocated_hz": 4.85, "actual_hz": 4.8, "skipped": 252,
                    "queued": 1, "wait_ms": {"p50": 1.0, "p99": 190.5}}]}],
            "links": [{"layer": "fog", "limit_bytes_per_s": null, "wire_bytes_per_s": 5_137_000.0}],
        });
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert_eq!(
            table(&flow, &value, None).unwrap(),
            "flow edge/robot-1\n\
             limit 40 Mbit/s of 1024² bit = 5.0 MiB/s on the wire, wire factor 1.091\n\
             TOPIC             CLASS   BYTES  LZ4  TO   ADVERTISED/Hz  PLANNED/Hz  ACTUAL/Hz  SKIPPED  QUEUED  p99/ms\n\
             camera/image_raw  large  921600    -  fog          30.00        4.85       4.80      252       1  190.50\n\
             link to fog: 4.9 MiB/s of 5.0 MiB/s, 98.0 %\n"
        );
    }

    #[test]
    fn whoever_publishes_more_than_it_says_is_named() {
        let lane = |exceeds: bool| {
            json!({
                "layer": "fog",
                "allocated_hz": 10,
                "actual_hz": 10,
                "exceeds_advertised": exceeds,
                "skipped": 40,
            })
        };
        let topic = |name: &str, exceeds: bool| {
            json!({
                "topic": name,
                "class": "standard",
                "size_bytes": 100,
                "advertised_hz": 10,
                "lanes": [lane(exceeds)],
            })
        };
        let value = json!({
            "flow": "edge/robot-1", "limit_mbps": 40, "budget_bytes_per_s": 5_242_880,
            "wire_factor": null,
            "topics": [topic("imu", true), topic("odom", false)], "links": [],
        });
        let flow = "127.0.0.1:9101".parse().unwrap();
        let text = table(&flow, &value, None).unwrap();
        assert!(
            text.contains("\nimu: more is published") && !text.contains("odom: more"),
            "{text}"
        );
    }

    #[test]
    fn a_flow_that_sends_nothing_says_so() {
        let value = json!({
            "flow": "fog/fog-1",
            "limit_mbps": 160,
            "budget_bytes_per_s": 1,
            "topics": [],
            "links": [],
        });
        let flow = "127.0.0.1:9101".parse().unwrap();
        assert!(table(&flow, &value, None).unwrap().contains("Nothing leaves"));
    }
}
