//! Short ways to write a world.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;

use blaze_domain::node_file::AccessRules;
use blaze_domain::{Durability, FlowId, LayerKind, Reliability, TopicName};
use serde_json::{Value, json};

use crate::plan::{Bridge, Form, Target, TopicPlan};
use crate::testing::access;
use crate::world::{
    Advertise, Carrying, FlowState, FlowView, LayerScopeId, OriginFilter, Part, Reach, Request,
    Role, Ros2Network, Ros2NetworkId, ScopeEntry, Source, TopicEntry, World,
};

pub(crate) fn topic() -> TopicName {
    "imu/data".parse().unwrap()
}

pub(crate) fn id(text: &str) -> FlowId {
    text.parse().unwrap()
}

pub(crate) fn advertise() -> Advertise {
    Advertise {
        rate_hz: Some(50.0),
        max_bytes: Some(400),
        encoding: "application/json".to_owned(),
        type_name: String::new(),
        type_hash: String::new(),
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 1,
        priority: None,
        lifespan_ms: 0,
        sources: vec![Source { node: String::new(), service: "driver".to_owned() }],
        more_sources: false,
    }
}

pub(crate) fn request() -> Request {
    Request {
        max_rate_hz: None,
        lifespan_ms: 0,
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 1,
        priority: None,
        from: Vec::new(),
        type_name: String::new(),
        type_hash: String::new(),
        services: vec![Source { node: String::new(), service: "dashboard".to_owned() }],
        more_services: 0,
        framed: true,
        bare: false,
        json: false,
    }
}

/// A request that is served as JSON alone.
fn json_request() -> Request {
    Request { framed: false, json: true, ..request() }
}

/// A ROS 2 network on loopback.
pub(crate) fn network(id: u64) -> Ros2Network {
    Ros2Network { id: Ros2NetworkId(id), address: Ipv4Addr::LOCALHOST }
}

/// The rules of a node file with this one for all topics: `{"request": {"deny": ["cloud"]}}`.
pub(crate) fn rules(mut rule: Value) -> AccessRules {
    rule["match"] = "**".into();
    access(&json!([rule]))
}

/// A filter written `layer/node/service`, where `*` is any.
pub(crate) fn filter(text: &str) -> OriginFilter {
    let part = |n: usize| text.split('/').nth(n).filter(|part| *part != "*").map(str::to_owned);
    OriginFilter { layer: part(0), node: part(1), service: part(2) }
}

pub(crate) fn flow(layer_scope: Option<u64>) -> FlowView {
    FlowView {
        state: FlowState::Ready,
        node_scope: true,
        layer_scope: layer_scope.map(LayerScopeId),
        ..FlowView::new(LayerKind::Edge, 1)
    }
}

/// A world written as one line per flow: `edge/a@1 node+ layer-`: `@1` is its layer broker, `+` an
/// advertisement on that scope, `-` a request, `-b` a request for bare payloads, `-j` for JSON;
/// `net1` its ROS 2 network; `down`, `suspect`,
/// `starting`, `draining` and `settled` as they read; `away`: its layer broker does not answer it;
/// `many`: it sends to more flows than it names; `carries` and `handed` say who carries the topic
/// out of the layer, `>c/b` whom it is sent to. The first flow is `me`.
pub(crate) fn world(lines: &[&str]) -> World {
    let mut flows = BTreeMap::new();
    let mut me = None;
    for line in lines {
        let mut words = line.split(' ');
        let name = words.next().unwrap();
        let (name, broker) = match name.split_once('@') {
            Some((name, broker)) => (name, Some(broker.parse().unwrap())),
            None => (name, None),
        };
        let mut view = flow(broker);
        let mut entry = TopicEntry::default();
        let mut part = Part::default();
        for word in words {
            match word {
                "down" => view.reach = Reach::Down,
                "suspect" => view.reach = Reach::Suspect,
                "starting" => view.state = FlowState::Starting,
                "draining" => view.state = FlowState::Draining,
                "settled" => view.settled = true,
                "away" => view.layer_away = true,
                "many" => part.more_receivers = true,
                "member" => view.role = Role::Member,
                "new" => view.role = Role::NewGateway,
                "leaving" => view.role = Role::Leaving,
                "carries" => part.carrying = Carrying::Carries,
                "handed" => part.carrying = Carrying::HandedOver([7].into()),
                word if word.starts_with('>') => part.receivers.push(id(&word[1..])),
                "node+" => entry.node.advertise = Some(advertise()),
                "layer+" => entry.layer.advertise = Some(advertise()),
                "node-" => entry.node.request = Some(request()),
                "layer-" => entry.layer.request = Some(request()),
                "ros2+" => entry.ros2.advertise = Some(advertise()),
                "ros2-" => entry.ros2.request = Some(request()),
                "node-j" => entry.node.request = Some(json_request()),
                "layer-j" => entry.layer.request = Some(json_request()),
                word if word.starts_with("net") => {
                    view.ros2 = Some(network(word[3..].parse().unwrap()));
                }
                "node-b" => {
                    entry.node.request = Some(Request { framed: false, bare: true, ..request() });
                }
                other => panic!("{other}"),
            }
        }
        view.topics.insert(topic(), entry);
        if part != Part::default() {
            view.parts.insert(topic(), part);
        }
        me.get_or_insert_with(|| id(name));
        flows.insert(id(name), view);
    }
    World { me: me.unwrap(), flows, access: AccessRules::default() }
}

/// What a flow says of the topic on one scope.
pub(crate) fn entry<'a>(world: &'a mut World, flow: &str, scope: &str) -> &'a mut ScopeEntry {
    let entry = world.flows.get_mut(&id(flow)).unwrap().topics.entry(topic()).or_default();
    match scope {
        "node" => &mut entry.node,
        "ros2" => &mut entry.ros2,
        _ => &mut entry.layer,
    }
}

pub(crate) fn offer<'a>(world: &'a mut World, flow: &str, scope: &str) -> &'a mut Advertise {
    entry(world, flow, scope).advertise.as_mut().unwrap()
}

pub(crate) fn ask<'a>(world: &'a mut World, flow: &str, scope: &str) -> &'a mut Request {
    entry(world, flow, scope).request.as_mut().unwrap()
}

/// `node>layer`, `inter>bare`, `node>cloud/c`: the bridges of a plan.
pub(crate) fn ways(plan: &TopicPlan) -> Vec<String> {
    let way = |bridge: &Bridge| match &bridge.to {
        Target::Node(Form::Framed) => format!("{}>node", bridge.from),
        Target::Node(Form::Bare) => format!("{}>bare", bridge.from),
        Target::Node(Form::Json) => format!("{}>json", bridge.from),
        Target::Layer { json: false } => format!("{}>layer", bridge.from),
        Target::Layer { json: true } => format!("{}>layer-json", bridge.from),
        Target::Ros2 => format!("{}>ros2", bridge.from),
        Target::Inter { layer, receiver } => {
            assert_eq!(*layer, receiver.layer);
            format!("{}>{receiver}", bridge.from)
        }
    };
    plan.bridges.iter().map(way).collect()
}

/// The rows of a table: one per line, with `|` between its cells.
pub(crate) fn rows<const CELLS: usize>(table: &str) -> impl Iterator<Item = [&str; CELLS]> {
    let lines = table.lines().filter(|line| !line.trim().is_empty());
    lines.map(|line| {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        cells.try_into().expect(line)
    })
}

/// The items of a cell, with commas between them.
pub(crate) fn list(cell: &str) -> Vec<&str> {
    cell.split(", ").filter(|item| !item.is_empty()).collect()
}
