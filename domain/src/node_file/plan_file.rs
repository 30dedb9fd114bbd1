//! The file of `blaze plan`: flows and what they are to send, before anything runs.
//!
//! It is read with the same strictness as a node file, and its `bandwidth` is the section of one.

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde_json::Value;

use super::flow::BandwidthSection;
use super::readers::{number, parsed, path, whole};
use super::walk::{Node, Report, Section};
use super::{Fault, MAX_BYTES};
use crate::MAX_RATE_HZ;
use crate::identity::FlowId;
use crate::names::{LayerName, NodeName, TopicName};
use crate::qos::word_enum;

/// Most publishers of a topic on one flow.
const MAX_WRITERS: u32 = 10_000;

/// Flows with their topics.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanFile {
    /// The flows, in the order of the file.
    pub flows: Vec<PlannedFlow>,
}

/// One flow.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedFlow {
    /// Who it is, and what it may send.
    pub source: FlowSource,
    /// What it sends on the inter scope.
    pub topics: Vec<PlannedTopic>,
}

/// Where the budget of a flow comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum FlowSource {
    /// A node file; a relative path begins where the plan is.
    NodeFile(PathBuf),
    /// The plan itself.
    Inline {
        /// Layer and node.
        flow: FlowId,
        /// What it may send.
        bandwidth: Box<BandwidthSection>,
    },
}

/// One topic of a flow.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedTopic {
    /// The topic.
    pub topic: TopicName,
    /// Messages per second of each publisher, in Hz.
    pub rate_hz: f64,
    /// Largest payload as sent, after compression, in bytes.
    pub bytes: u32,
    /// Publishers of the topic on this flow.
    pub writers: u32,
    /// Whether it is large.
    pub class: PlannedClass,
    /// Where it goes.
    pub lanes: Vec<PlannedLane>,
}

/// One destination of a topic.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedLane {
    /// The layer.
    pub layer: LayerName,
    /// Highest rate that anybody there asks for, in Hz.
    pub max_rate_hz: Option<f64>,
}

word_enum!(
    /// Whether a topic counts as large.
    PlannedClass {
        /// As its size says.
        Auto = "auto",
        /// It does not.
        Standard = "standard",
        /// It does.
        Large = "large",
    }
);

impl PlanFile {
    /// Reads the tree of a plan.
    ///
    /// # Errors
    /// Every fault of the tree.
    pub fn read(tree: &Value) -> Result<Self, Vec<Fault>> {
        let report = Report::default();
        let root = Node::root(tree, &report);
        let flows = root
            .section(|s| s.need("flows", |node| node.list(|flow| flow.section(flow_of).flatten())));
        let faults = report.faults.take();
        match flows.flatten() {
            Some(flows) if faults.is_empty() => Ok(Self { flows }),
            _ => Err(faults),
        }
    }
}

fn flow_of(s: &mut Section<'_>) -> Option<PlannedFlow> {
    let node_file = s.opt("node_file", path);
    let layer: Option<LayerName> = s.opt("layer", parsed);
    let node: Option<NodeName> = s.opt("node", parsed);
    let given_bandwidth = s.opt("bandwidth", |node| Some(node.clone())).is_some();
    let bandwidth = s.sub_or_empty("bandwidth", BandwidthSection::section);
    let topics = s.need("topics", topics)?;
    let source = match (node_file, layer, node) {
        (Some(file), None, None) if !given_bandwidth => FlowSource::NodeFile(file),
        (Some(_), _, _) => {
            return s
                .node
                .fault("holds node_file and what a node file says; only one of both is allowed");
        }
        (None, Some(layer), Some(node)) => {
            FlowSource::Inline { flow: FlowId::new(layer, node), bandwidth: Box::new(bandwidth) }
        }
        (None, _, _) => return s.node.fault("needs node_file, or layer and node"),
    };
    Some(PlannedFlow { source, topics })
}

fn topics(node: &Node<'_>) -> Option<Vec<PlannedTopic>> {
    let topics = node.list(|topic| topic.section(topic_of).flatten())?;
    let mut seen = BTreeSet::new();
    if let Some(twice) = topics.iter().find(|topic| !seen.insert(&topic.topic)) {
        return node.fault(format!("holds {} twice; give it writers instead", twice.topic));
    }
    Some(topics)
}

fn topic_of(s: &mut Section<'_>) -> Option<PlannedTopic> {
    let topic = s.need("topic", parsed);
    let rate_hz = s.need("rate_hz", number(0.0, MAX_RATE_HZ));
    let bytes = s.need("bytes", whole(0, MAX_BYTES));
    let writers = s.or("writers", whole(1, MAX_WRITERS), 1);
    let class = s.or("class", parsed, PlannedClass::Auto);
    let lanes = s.need("lanes", lanes);
    Some(PlannedTopic {
        topic: topic?,
        rate_hz: rate_hz?,
        bytes: bytes?,
        writers,
        class,
        lanes: lanes?,
    })
}

fn lanes(node: &Node<'_>) -> Option<Vec<PlannedLane>> {
    let lanes = node.list(|lane| lane.section(lane_of).flatten())?;
    let mut seen = BTreeSet::new();
    if let Some(twice) = lanes.iter().find(|lane| !seen.insert(&lane.layer)) {
        return node.fault(format!("holds {} twice; a layer gets one copy", twice.layer));
    }
    Some(lanes)
}

fn lane_of(s: &mut Section<'_>) -> Option<PlannedLane> {
    let layer = s.need("layer", parsed);
    let max_rate_hz = s.opt("max_rate_hz", number(0.001, MAX_RATE_HZ));
    Some(PlannedLane { layer: layer?, max_rate_hz })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn faults(tree: &Value) -> Vec<String> {
        let faults = PlanFile::read(tree).unwrap_err();
        faults.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_plan_is_read() {
        let plan = PlanFile::read(&json!({"flows": [
            {"node_file": "robot-1.yaml", "topics": []},
            {"layer": "edge", "node": "robot-2", "bandwidth": {"limit_mbps": 40}, "topics": [
                {
                    "topic": "camera/front",
                    "rate_hz": 30,
                    "bytes": 921_600,
                    "lanes": [{"layer": "fog"}, {"layer": "cloud", "max_rate_hz": 5}],
                },
            ]},
        ]}))
        .unwrap();
        assert_eq!(plan.flows[0].source, FlowSource::NodeFile("robot-1.yaml".into()));
        let FlowSource::Inline { flow, bandwidth } = &plan.flows[1].source else {
            panic!("{plan:?}");
        };
        assert_eq!((flow.to_string().as_str(), bandwidth.limit_mbps), ("edge/robot-2", 40.0));
        let topic = &plan.flows[1].topics[0];
        assert_eq!((topic.writers, topic.class, topic.lanes.len()), (1, PlannedClass::Auto, 2));
        assert_eq!(topic.lanes[1].max_rate_hz, Some(5.0));
    }

    #[test]
    fn each_fault_is_named_with_its_place() {
        assert_eq!(faults(&json!({})), ["flows: is required"]);
        let flow = |flow: Value| json!({"flows": [flow]});
        assert_eq!(
            faults(&flow(json!({"layer": "edge", "topics": []}))),
            ["flows[0]: needs node_file, or layer and node"]
        );
        assert_eq!(
            faults(&flow(json!({"node_file": "a.yaml", "bandwidth": {}, "topics": []}))),
            ["flows[0]: holds node_file and what a node file says; only one of both is allowed"]
        );
        let topic = json!({
            "topic": "imu",
            "rate_hz": -1,
            "byte": 3,
            "bytes": 1,
            "lanes": [{"layer": "fog", "max_rate_hz": 0}],
        });
        let found = faults(&flow(json!({"layer": "edge", "node": "a", "topics": [topic]})));
        assert_eq!(
            found,
            [
                "flows[0].topics[0].rate_hz: -1 is not between 0 and 1000000",
                "flows[0].topics[0].lanes[0].max_rate_hz: 0 is not between 0.001 and 1000000",
                "flows[0].topics[0].byte: unknown key; did you mean bytes?",
            ]
        );
        let imu = json!({"topic": "imu", "rate_hz": 1, "bytes": 1, "lanes": []});
        let twice =
            faults(&flow(json!({"layer": "edge", "node": "a", "topics": [imu.clone(), imu]})));
        assert_eq!(twice, ["flows[0].topics: holds imu twice; give it writers instead"]);
        let lanes =
            json!([{"layer": "fog"}, {"layer": "cloud"}, {"layer": "fog", "max_rate_hz": 1}]);
        let imu = json!({"topic": "imu", "rate_hz": 1, "bytes": 1, "lanes": lanes});
        let twice = faults(&flow(json!({"layer": "edge", "node": "a", "topics": [imu]})));
        assert_eq!(twice, ["flows[0].topics[0].lanes: holds fog twice; a layer gets one copy"]);
    }
}
