//! `blaze topics`.

use serde::Deserialize;
use serde_json::Value;

use super::{heading, typed};
use crate::args::FlowAddress;
use crate::exit::CliError;
use crate::output::{self, Align, bytes, number};

/// What `GET /v1/topics` answers, as far as the table shows it.
#[derive(Debug, Deserialize)]
pub(super) struct Topics {
    pub(super) topics: Vec<Topic>,
}

#[derive(Debug, Deserialize)]
pub(super) struct Topic {
    pub(super) topic: String,
    state: String,
    rate_hz: Option<f64>,
    bytes_per_s: Option<f64>,
    #[serde(default)]
    advertised: Vec<Lease>,
    #[serde(default)]
    requested: Vec<Lease>,
}

#[derive(Debug, Deserialize)]
struct Lease {
    #[serde(default, deserialize_with = "super::text_or_null")]
    layer: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    node: String,
    #[serde(default, deserialize_with = "super::text_or_null")]
    service: String,
    max_rate_hz: Option<f64>,
    /// Those behind what another flow tells of a scope.
    #[serde(default)]
    services: Vec<Named>,
    #[serde(default)]
    more_services: u32,
}

#[derive(Debug, Deserialize)]
struct Named {
    service: String,
}

impl Lease {
    fn text(&self) -> String {
        let mut text = self.layer.clone();
        for part in [&self.node, &self.service] {
            if !part.is_empty() {
                text.push('/');
                text.push_str(part);
            }
        }
        if !self.services.is_empty() {
            let mut names: Vec<&str> =
                self.services.iter().map(|named| named.service.as_str()).collect();
            names.dedup();
            text.push_str(&format!("/{}", names.join("+")));
        }
        if self.more_services > 0 {
            text.push_str(&format!(" and {} more", self.more_services));
        }
        if let Some(rate) = self.max_rate_hz {
            text.push_str(&format!(" (≤ {rate} Hz)"));
        }
        text
    }
}

pub(super) fn table(
    flow: &FlowAddress,
    value: &Value,
    width: Option<u16>,
) -> Result<String, CliError> {
    let answer: Topics = typed(flow, value)?;
    let mut text = heading(value);
    if answer.topics.is_empty() {
        text.push_str("No topics: no service here or elsewhere has advertised or requested one.\n");
        return Ok(text);
    }
    // In a terminal a cell may have several lines; elsewhere a row is one line, for grep and awk.
    let separator = if width.is_some() { "\n" } else { "," };
    let list = |leases: &[Lease]| match leases {
        [] => "-".to_owned(),
        leases => leases.iter().map(Lease::text).collect::<Vec<_>>().join(separator),
    };
    text.push_str(&output::table(
        &answer.topics,
        width,
        &[
            ("TOPIC", Align::Left, &|topic| topic.topic.clone()),
            ("STATE", Align::Left, &|topic| topic.state.clone()),
            ("RATE/Hz", Align::Right, &|topic| number(topic.rate_hz, 1)),
            ("BYTES/s", Align::Right, &|topic| {
                topic.bytes_per_s.map_or_else(|| "-".to_owned(), bytes)
            }),
            ("PUBLISHED BY", Align::Left, &|topic| list(&topic.advertised)),
            ("REQUESTED BY", Align::Left, &|topic| list(&topic.requested)),
        ],
    ));
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn flow() -> FlowAddress {
        "127.0.0.1:9101".parse().unwrap()
    }

    #[test]
    fn topics_are_a_table() {
        let value = json!({"flow": "edge/robot-1", "epoch": 1, "time": 0, "topics": [
            {"topic": "imu/data", "state": "flowing", "rate_hz": 49.93, "bytes_per_s": 16450,
             "advertised": [{
                 "layer": "edge",
                 "node": "robot-1",
                 "service": "imu-driver",
                 "instance": "0",
             }],
             "requested": [{"layer": "fog", "node": "fog-1", "service": "dashboard",
                 "max_rate_hz": 10},
                           {"layer": "cloud", "node": "", "service": "", "more_services": 2,
                 "services": [{"node": "", "service": "dashboard"},
                              {"node": "", "service": "recorder"}]}]},
            {"topic": "odom", "state": "no_request", "rate_hz": null}]});
        assert_eq!(
            table(&flow(), &value, None).unwrap(),
            "flow edge/robot-1\n\
             TOPIC     STATE       RATE/Hz   BYTES/s  PUBLISHED BY             REQUESTED BY\n\
             imu/data  flowing        49.9  16.1 KiB  edge/robot-1/imu-driver  fog/fog-1/dashboard (≤ 10 Hz),cloud/dashboard+recorder and 2 more\n\
             odom      no_request        -         -  -                        -\n"
        );
    }

    #[test]
    fn no_topics_are_a_sentence() {
        let text = table(&flow(), &json!({"flow": "edge/robot-1", "topics": []}), None).unwrap();
        assert!(text.contains("No topics"), "{text}");
    }

    #[test]
    fn a_foreign_answer_is_an_error() {
        let error = table(&flow(), &json!({"topics": 3}), None).unwrap_err();
        assert!(error.to_string().contains("not as a flow does"), "{error}");
    }
}
