//! Topics as several flows know them, merged.

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::LayerName;
use serde::Deserialize;
use serde_json::{Value, json};

use super::limits::TOPIC_PLACES;

/// Where something is published or requested: layer, node, service.
pub type Place = (String, String, String);

/// A topic: who publishes it and who asks for it.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Places of publishers.
    pub publishers: BTreeSet<Place>,
    /// Places of requesters.
    pub requesters: BTreeSet<Place>,
}

/// Topics by name.
pub type Topics = BTreeMap<String, Topic>;

#[derive(Deserialize)]
struct Answer {
    #[serde(default)]
    topics: Vec<Row>,
}

#[derive(Deserialize)]
struct Row {
    topic: String,
    #[serde(default)]
    advertised: Vec<Lease>,
    #[serde(default)]
    requested: Vec<Lease>,
}

#[derive(Deserialize)]
struct Lease {
    layer: String,
    node: String,
    service: String,
}

/// Takes in what one flow answers to `/v1/topics`. A token that is bound to a layer sees the places
/// of that layer alone, and topics that have one.
pub fn merge(topics: &mut Topics, answer: &str, prefix: &str, bound: Option<&LayerName>) {
    let Ok(answer) = serde_json::from_str::<Answer>(answer) else { return };
    let sees = |lease: &Lease| bound.is_none_or(|layer| layer.as_str() == lease.layer);
    let places = |leases: Vec<Lease>| {
        leases.into_iter().filter(sees).map(|lease| (lease.layer, lease.node, lease.service))
    };
    for row in answer.topics.into_iter().filter(|row| row.topic.starts_with(prefix)) {
        let (mut publishers, mut requesters) =
            (places(row.advertised).peekable(), places(row.requested).peekable());
        if bound.is_some() && publishers.peek().is_none() && requesters.peek().is_none() {
            continue;
        }
        let topic = topics.entry(row.topic).or_default();
        topic.publishers.extend(publishers);
        topic.requesters.extend(requesters);
    }
}

/// One item of the list.
#[must_use]
pub fn item(name: &str, topic: &Topic) -> Value {
    let places = |places: &BTreeSet<Place>| -> Vec<Value> {
        let first = places.iter().take(TOPIC_PLACES);
        first.map(|(l, n, s)| json!({ "layer": l, "node": n, "service": s })).collect()
    };
    json!({
        "topic": name,
        "publishers": places(&topic.publishers),
        "requesters": places(&topic.requesters),
        "publishers_total": topic.publishers.len(),
        "requesters_total": topic.requesters.len(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(topics: &[(&str, &str, &str)]) -> String {
        let rows: Vec<Value> = topics
            .iter()
            .map(|(topic, from, to)| {
                json!({
                    "topic": topic, "state": "flowing",
                    "advertised": [{ "layer": from, "node": "n", "service": "a", "rate_hz": 50 }],
                    "requested": [{ "layer": to, "node": "m", "service": "b" }],
                })
            })
            .collect();
        json!({ "flow": "edge/n", "topics": rows }).to_string()
    }

    #[test]
    fn answers_of_several_flows_become_one_list() {
        let mut topics = Topics::new();
        merge(
            &mut topics,
            &answer(&[("imu/data", "edge", "cloud"), ("map", "fog", "fog")]),
            "",
            None,
        );
        merge(&mut topics, &answer(&[("imu/data", "edge", "fog")]), "", None);
        merge(&mut topics, "no JSON", "", None);
        let imu = item("imu/data", &topics["imu/data"]);
        assert_eq!(imu["publishers"], json!([{ "layer": "edge", "node": "n", "service": "a" }]));
        assert_eq!((&imu["publishers_total"], &imu["requesters_total"]), (&json!(1), &json!(2)));
        assert_eq!(topics.len(), 2);

        let mut some = Topics::new();
        merge(
            &mut some,
            &answer(&[("imu/data", "edge", "cloud"), ("map", "fog", "fog")]),
            "im",
            None,
        );
        assert_eq!(some.keys().collect::<Vec<_>>(), ["imu/data"]);
    }

    #[test]
    fn a_bound_token_sees_its_layer_alone() {
        let (mut topics, edge) = (Topics::new(), "edge".parse().unwrap());
        let told = answer(&[("imu/data", "edge", "cloud"), ("map", "fog", "fog")]);
        merge(&mut topics, &told, "", Some(&edge));
        assert_eq!(topics.len(), 1);
        assert!(topics["imu/data"].requesters.is_empty());
    }

    #[test]
    fn twenty_places_are_named() {
        let topic = Topic {
            publishers: (0..30).map(|n| ("edge".into(), format!("n{n:02}"), "a".into())).collect(),
            ..Topic::default()
        };
        let item = item("t", &topic);
        assert_eq!(item["publishers"].as_array().unwrap().len(), 20);
        assert_eq!(item["publishers_total"], 30);
    }
}
