//! What the flows of the demo say of themselves: by which bridges a topic travels, and what they
//! dropped.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use blaze_domain::DropReason;
use tokio::time::timeout;

use crate::admin::{Bridge, Bridges, DroppedBefore, typed};
use crate::args::FlowAddress;
use crate::http::get_json;

use super::options::DemoNode;

/// A flow of this process that does not answer within this time is left out once.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);

/// Bridges of the flows of this process.
#[derive(Debug, Clone, Default)]
pub struct FlowView {
    bridges: Vec<(DemoNode, Bridge)>,
    /// What the flows dropped before a bridge took it.
    dropped_before: Vec<(DemoNode, DroppedBefore)>,
}

/// How a topic travels from its publisher to a consumer.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Path {
    /// Scopes in order, `scope:broker`.
    pub route: Vec<String>,
    /// Nodes whose flows carry it, without order.
    pub nodes: BTreeSet<DemoNode>,
    /// What the bridges on the way dropped since they were made, and the flows on the way before
    /// their bridges took it, by reason.
    pub dropped: BTreeMap<String, u64>,
}

/// Where messages can be.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Spot {
    /// On the node scope of a node.
    Node(DemoNode),
    /// On the layer scope of a layer.
    Layer(String),
    /// On the way to a layer.
    Inter(String),
}

impl FlowView {
    /// Asks the flows of this process.
    pub async fn ask(admins: &[(DemoNode, SocketAddr)]) -> Self {
        let mut view = Self::default();
        for (node, address) in admins {
            let address = FlowAddress::from(*address);
            let Ok(Ok(value)) = timeout(ANSWER_TIMEOUT, get_json(&address, "/v1/bridges")).await
            else {
                continue;
            };
            if let Ok(answer) = typed::<Bridges>(&address, &value) {
                view.bridges.extend(answer.bridges.into_iter().map(|bridge| (*node, bridge)));
                let dropped = answer.dropped_before_bridges.into_iter();
                view.dropped_before.extend(dropped.map(|dropped| (*node, dropped)));
            }
        }
        view
    }

    /// Bridges of a topic that carry, for people: `robot-1 node→inter/cloud`.
    #[must_use]
    pub fn bridges_of(&self, topic: &str) -> BTreeSet<String> {
        let carries =
            |(_, bridge): &&(DemoNode, Bridge)| bridge.topic == topic && bridge.state == "up";
        let describe = |(node, bridge): &(DemoNode, Bridge)| {
            let to = match (bridge.to.scope.as_str(), &bridge.to.layer) {
                ("inter", Some(layer)) => format!("inter/{layer}"),
                (scope, _) => scope.to_owned(),
            };
            format!("{} {}→{to}", node.name(), bridge.from.scope)
        };
        self.bridges.iter().filter(carries).map(describe).collect()
    }

    /// The shortest way of a topic; if its beginning is in another process, the part that is here.
    #[must_use]
    pub fn path(&self, topic: &str, from: &Spot, to: &Spot) -> Option<Path> {
        let edges: Vec<Edge<'_>> = self
            .bridges
            .iter()
            .filter(|(_, bridge)| bridge.topic == topic && bridge.state != "failed")
            .filter_map(|(node, bridge)| Edge::new(*node, bridge))
            .collect();
        let layer = match to {
            Spot::Node(node) => node.layer().to_owned(),
            Spot::Layer(layer) | Spot::Inter(layer) => layer.clone(),
        };
        let mut path =
            search(&edges, from, to).or_else(|| search(&edges, &Spot::Inter(layer), to))?;
        // A message whose first part is missing has no topic: it may be one of this.
        let may_be_of_topic = |row: &DroppedBefore, reason: &str| {
            row.topic == topic
                || (row.topic.is_empty() && reason == DropReason::ReassemblyTimeout.as_str())
        };
        for (node, row) in &self.dropped_before {
            for (reason, count) in &row.dropped {
                if path.nodes.contains(node) && may_be_of_topic(row, reason) {
                    *path.dropped.entry(reason.clone()).or_default() += count;
                }
            }
        }
        Some(path)
    }
}

struct Edge<'a> {
    node: DemoNode,
    from: Spot,
    to: Spot,
    bridge: &'a Bridge,
}

impl<'a> Edge<'a> {
    fn new(node: DemoNode, bridge: &'a Bridge) -> Option<Self> {
        let spot = |scope: &str, layer: Option<&String>| match scope {
            "node" => Some(Spot::Node(node)),
            "layer" => Some(Spot::Layer(node.layer().to_owned())),
            "inter" => Some(Spot::Inter(layer.cloned().unwrap_or_else(|| node.layer().to_owned()))),
            _ => None,
        };
        Some(Self {
            node,
            from: spot(&bridge.from.scope, None)?,
            to: spot(&bridge.to.scope, bridge.to.layer.as_ref())?,
            bridge,
        })
    }
}

/// Breadth first, so that the way with the fewest bridges is found.
fn search(edges: &[Edge<'_>], from: &Spot, to: &Spot) -> Option<Path> {
    let mut reached: BTreeMap<&Spot, Option<usize>> = BTreeMap::from([(from, None)]);
    let mut open = VecDeque::from([from]);
    while let Some(spot) = open.pop_front() {
        if spot == to {
            return Some(trace(edges, &reached, to));
        }
        for (index, edge) in edges.iter().enumerate().filter(|(_, edge)| edge.from == *spot) {
            if !reached.contains_key(&edge.to) {
                reached.insert(&edge.to, Some(index));
                open.push_back(&edge.to);
            }
        }
    }
    None
}

fn trace(edges: &[Edge<'_>], reached: &BTreeMap<&Spot, Option<usize>>, to: &Spot) -> Path {
    let mut path = Path::default();
    let mut spot = to;
    while let Some(edge) = reached.get(spot).copied().flatten().and_then(|index| edges.get(index)) {
        if path.route.is_empty() {
            path.route.push(edge.bridge.to.label());
        }
        path.route.push(edge.bridge.from.label());
        path.nodes.insert(edge.node);
        for (reason, count) in &edge.bridge.dropped {
            *path.dropped.entry(reason.clone()).or_default() += count;
        }
        spot = &edge.from;
    }
    path.route.reverse();
    path
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize as _;
    use serde_json::{Value, json};

    fn view(bridges: &[(DemoNode, Value)]) -> FlowView {
        FlowView {
            bridges: bridges
                .iter()
                .map(|(node, bridge)| (*node, Bridge::deserialize(bridge).unwrap()))
                .collect(),
            dropped_before: Vec::new(),
        }
    }

    fn bridge(from: &str, to: &str, layer: &str, dropped: &Value) -> Value {
        let end = |label: &str| {
            let (scope, broker) = label.split_once(':').unwrap();
            json!({"scope": scope, "broker": broker})
        };
        let mut to = end(to);
        to["layer"] = json!(layer);
        json!({"topic": "imu/data", "from": end(from), "to": to, "state": "up", "dropped": dropped})
    }

    fn demo() -> FlowView {
        use DemoNode::{Cloud1, Edge2, Robot1};
        let bridges = [
            (Robot1, "node:memory", "layer:memory", "edge", json!({})),
            (Robot1, "node:memory", "inter:dds", "fog", json!({"rate_limit": 3})),
            (Robot1, "node:memory", "inter:dds", "cloud", json!({"rate_limit": 7})),
            (Edge2, "layer:memory", "node:memory", "edge", json!({"echo": 1})),
            (Cloud1, "inter:dds", "layer:memory", "cloud", json!({"rate_limit": 1, "lifespan": 2})),
        ];
        view(
            &bridges
                .map(|(node, from, to, layer, dropped)| (node, bridge(from, to, layer, &dropped))),
        )
    }

    #[test]
    fn paths_are_followed_over_flows() {
        let robot = Spot::Node(DemoNode::Robot1);
        let cloud = demo().path("imu/data", &robot, &Spot::Layer("cloud".to_owned())).unwrap();
        assert_eq!(cloud.route, ["node:memory", "inter:dds", "layer:memory"]);
        assert_eq!(
            cloud.dropped,
            BTreeMap::from([("lifespan".to_owned(), 2), ("rate_limit".to_owned(), 8)])
        );
        let edge = demo().path("imu/data", &robot, &Spot::Node(DemoNode::Edge2)).unwrap();
        assert_eq!(edge.route, ["node:memory", "layer:memory", "node:memory"]);
        assert_eq!(
            demo().bridges_of("imu/data").into_iter().collect::<Vec<_>>(),
            [
                "cloud-1 inter→layer",
                "edge-2 layer→node",
                "robot-1 node→inter/cloud",
                "robot-1 node→inter/fog",
                "robot-1 node→layer",
            ]
        );
    }

    #[test]
    fn what_the_receiving_flow_drops_before_its_bridge_counts() {
        let mut view = demo();
        let row = |topic: &str, dropped: Value| {
            DroppedBefore::deserialize(json!({"topic": topic, "dropped": dropped})).unwrap()
        };
        view.dropped_before = vec![
            (DemoNode::Cloud1, row("imu/data", json!({"lifespan": 4}))),
            // Without its first part it has no name.
            (DemoNode::Cloud1, row("", json!({"reassembly_timeout": 1, "no_destination": 9}))),
            (DemoNode::Cloud1, row("odom", json!({"lifespan": 90}))),
            // Not on the way.
            (DemoNode::Edge2, row("imu/data", json!({"lifespan": 90}))),
        ];
        let robot = Spot::Node(DemoNode::Robot1);
        let cloud = view.path("imu/data", &robot, &Spot::Layer("cloud".to_owned())).unwrap();
        let expected = [("lifespan", 6), ("rate_limit", 8), ("reassembly_timeout", 1)];
        assert_eq!(cloud.dropped, expected.map(|(reason, n)| (reason.to_owned(), n)).into());
    }

    #[test]
    fn a_missing_bridge_is_no_path() {
        let robot = Spot::Node(DemoNode::Robot1);
        assert_eq!(demo().path("imu/data", &robot, &Spot::Layer("fog".to_owned())), None);
        assert_eq!(demo().path("odom", &robot, &Spot::Layer("cloud".to_owned())), None);
    }

    #[test]
    fn the_part_of_this_process_is_shown_alone() {
        let here =
            view(&[(DemoNode::Cloud1, bridge("inter:dds", "layer:memory", "cloud", &json!({})))]);
        let path = here
            .path("imu/data", &Spot::Node(DemoNode::Robot1), &Spot::Layer("cloud".to_owned()))
            .unwrap();
        assert_eq!(path.route, ["inter:dds", "layer:memory"]);
    }
}
