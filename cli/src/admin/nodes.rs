//! `blaze top nodes`: all nodes of the system, worst first.

use serde_json::Value;

use crate::config::text::{cell, joined, member};
use crate::output::{self, Align, number};

/// A node of the picture: name and members.
type Node<'v> = (&'v String, &'v Value);

/// States, worst first.
const STATES: [&str; 4] = ["down", "degraded", "unknown", "ok"];

pub(super) fn table(fleet: &Value, width: Option<u16>) -> String {
    let mut text = layers(fleet);
    let mut nodes: Vec<Node<'_>> =
        fleet.get("nodes").and_then(Value::as_object).into_iter().flatten().collect();
    if nodes.is_empty() {
        text.push_str("No nodes. `blaze node join NAME --layer LAYER` registers one.\n");
        return text;
    }
    nodes.sort_by_cached_key(|(name, node)| (rank(node), member(node, "layer"), (*name).clone()));
    let digits = |node: &Value, name: &str, decimals| number(float(node, name), decimals);
    text.push_str(&output::table(
        &nodes,
        width,
        &[
            ("NODE", Align::Left, &|(name, node)| format!("{}/{name}", member(node, "layer"))),
            ("STATE", Align::Left, &|(_, node)| cell(node.get("state"))),
            ("PROBLEMS", Align::Right, &|(_, node)| cell(node.get("problems"))),
            ("SILENT/s", Align::Right, &|(_, node)| cell(node.get("age_s"))),
            ("CPU", Align::Right, &|(_, node)| percent(float(node, "cpu_ratio"))),
            ("MEMORY", Align::Right, &|(_, node)| percent(float(node, "memory_ratio"))),
            ("°C", Align::Right, &|(_, node)| digits(node, "celsius", 0)),
            ("TOPICS", Align::Right, &|(_, node)| cell(node.get("topics"))),
            ("IN/Hz", Align::Right, &|(_, node)| digits(node, "in_hz", 1)),
            ("OUT/Hz", Align::Right, &|(_, node)| digits(node, "out_hz", 1)),
            ("DROPPED/Hz", Align::Right, &|(_, node)| digits(node, "dropped_hz", 1)),
            ("IN SYNC", Align::Left, &|(_, node)| match node["in_sync"].as_bool() {
                Some(true) => "yes".to_owned(),
                Some(false) => "no".to_owned(),
                None => "-".to_owned(),
            }),
        ],
    ));
    text
}

/// `layers: edge ok, cloud down`, and the main services whose nodes are missing.
fn layers(fleet: &Value) -> String {
    let layers = fleet.get("layers").and_then(Value::as_object).into_iter().flatten();
    let states: Vec<String> =
        layers.map(|(name, layer)| format!("{name} {}", cell(layer.get("state")))).collect();
    let mut text = format!("layers: {}\n", joined(&states, ", "));
    let missing = cell(fleet.get("missing").filter(|missing| **missing != Value::Array(vec![])));
    if missing != "-" {
        text.push_str(&format!("not asked, because they do not answer: {missing}\n"));
    }
    text
}

fn rank(node: &Value) -> usize {
    let state = member(node, "state");
    STATES.iter().position(|known| *known == state).unwrap_or(0)
}

fn float(node: &Value, name: &str) -> Option<f64> {
    node.get(name)?.as_f64()
}

fn percent(ratio: Option<f64>) -> String {
    ratio.map_or_else(|| "-".to_owned(), |ratio| format!("{:.0} %", 100.0 * ratio))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_worst_node_is_first_and_what_is_not_known_a_dash() {
        let fleet = json!({"revision": 4, "missing": ["config-2"], "links": {},
            "layers": {"edge": {"kind": "edge", "state": "degraded"}, "fog": {"state": "ok"}},
            "nodes": {
                "fog-1": {"layer": "fog", "state": "ok", "age_s": 0, "cpu_ratio": 0.125,
                    "memory_ratio": 0.5, "celsius": 61.5, "topics": 12, "in_hz": 130,
                    "out_hz": 129.6, "dropped_hz": 0, "problems": 0, "in_sync": true},
                "robot-1": {"layer": "edge", "state": "down", "age_s": 61, "problems": 1}}});
        assert_eq!(
            table(&fleet, None),
            "layers: edge degraded, fog ok\n\
             not asked, because they do not answer: config-2\n\
             NODE          STATE  PROBLEMS  SILENT/s   CPU  MEMORY  °C  TOPICS  IN/Hz  OUT/Hz  DROPPED/Hz  IN SYNC\n\
             edge/robot-1  down          1        61     -       -   -       -      -       -           -  -\n\
             fog/fog-1     ok            0         0  12 %    50 %  62      12  130.0   129.6         0.0  yes\n"
        );
    }

    #[test]
    fn no_nodes_are_a_sentence_and_oddities_no_failure() {
        assert!(table(&json!({"nodes": {}, "missing": []}), None).ends_with("registers one.\n"));
        let _ = table(&json!({"nodes": {"a": 7, "b": {"state": 3}}, "layers": [1]}), Some(20));
    }
}
