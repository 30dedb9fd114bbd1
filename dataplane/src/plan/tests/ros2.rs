//! ROS 2 networks, and copies as JSON: one row per rule.

use blaze_domain::{FlowId, Scope, WhyCode};

use super::worlds::{ask, id, list, offer, rows, topic, ways, world};
use crate::plan::{PlanRules, Survey, Target, TopicPlan, network, plan_topic};
use crate::world::World;

fn plan_of(world: &World, flow: &str) -> TopicPlan {
    let world = World { me: id(flow), ..world.clone() };
    plan_topic(&world, &topic(), &PlanRules::default(), None)
}

fn ways_of(lines: &[&str]) -> Vec<String> {
    let world = world(lines);
    ways(&plan_of(&world, &world.me.to_string()))
}

/// Rows: a rule | flows | bridges of the first one.
const RULES: &str = "
    a pair on one network needs no bridge | e/a net1 ros2+ ros2- |
    nor where several flows are on it | e/a@1 net1 ros2+ ros2-, e/b@1 net1 ros2+ ros2- |
    a node to the network of its flow | e/a net1 node+ ros2- | node>ros2
    a writer to the node of its flow | e/a net1 ros2+ node- | ros2>node
    a writer to the node as JSON | e/a net1 ros2+ node-j | ros2>json
    a writer to the layer | e/a@1 net1 ros2+ layer- | ros2>layer
    a writer to the layer as JSON alone | e/a@1 net1 ros2+ layer-j | ros2>layer-json
    a writer to another layer | e/a net1 ros2+, c/b node- | ros2>c/b
    what the layer publishes to the network | e/a@1 net1 layer+ ros2- | layer>ros2
    what other layers publish to the network | e/a net1 ros2-, c/b node+ | inter>ros2
    one network to another, at its writer | e/a@1 net1 ros2+, e/b@1 net2 ros2- | ros2>layer
    one network to another, at its reader | e/b@1 net2 ros2-, e/a@1 net1 ros2+ | layer>ros2
    the same network in another layer is another one | e/a net1 ros2+, c/b net1 ros2- | ros2>c/b
    one copy per layer | e/a net1 ros2+, c/b@1 net1 ros2- node- layer- | ros2>c/b
    its receiver | c/b@1 net1 ros2- node- layer-, e/a node+ | inter>node, inter>layer, inter>ros2
    a flow without a network has no part in it | e/a ros2+ ros2- node- node+ |
    JSON on one node | e/a node+ node-j | node>json
    JSON from the layer | e/a@1 layer+ node-j | layer>json
    JSON from another layer | c/b node-j, e/a node+ | inter>json
    JSON on one layer | e/a@1 layer+ layer-j | layer>layer-json
    JSON from a node to its layer | e/a@1 node+ layer-j | node>layer-json
    JSON from another layer to the layer | c/b@1 layer-j, e/a node+ | inter>layer-json
";

#[test]
fn bridges_of_each_rule() {
    for [rule, lines, expected] in rows(RULES) {
        assert_eq!(ways_of(&list(lines)), list(expected), "{rule}: {lines}");
    }
}

/// The flows that have this bridge.
fn who(world: &World, from: Scope, to: &Target) -> Vec<FlowId> {
    let has = |flow: &&FlowId| {
        let bridges = plan_of(world, &flow.to_string()).bridges;
        bridges.iter().any(|bridge| (bridge.from, &bridge.to) == (from, to))
    };
    world.flows.keys().filter(has).cloned().collect()
}

#[test]
fn of_several_flows_on_a_network_one_writes_what_comes_from_elsewhere() {
    let group = ["e/a@1 net1 ros2- node+", "e/b@1 net1 ros2- node+"];
    let outside = world(&[&group[..], &["c/x node+"]].concat());
    assert_eq!(who(&outside, Scope::Node, &Target::Ros2), [id("e/a"), id("e/b")]);
    let writer = who(&outside, Scope::Inter, &Target::Ros2);
    assert_eq!(writer.len(), 1);
    assert_eq!(ways(&plan_of(&outside, "c/x")), [format!("node>{}", writer[0])]);
    assert!(who(&outside, Scope::Node, &Target::Layer { json: false }).is_empty());

    // A third flow of the layer, on none: the same one reads the layer, and leaves out what the
    // others write to the network themselves.
    let beside = world(&[&group[..], &["e/c@1 node+"]].concat());
    assert_eq!(who(&beside, Scope::Layer, &Target::Ros2), writer);
    let plan = plan_of(&beside, &writer[0].to_string());
    let to_ros2 = plan.bridges.iter().find(|bridge| bridge.from == Scope::Layer).unwrap();
    let left_out = |hops, node: &str| to_ros2.lane.natives.write(Scope::Layer, hops, "e", node);
    assert!(left_out(1, "a") && left_out(1, "b"), "written by their own flows");
    assert!(!left_out(1, "c") && !left_out(0, "a"), "a service of the layer may name any node");
    assert!(!left_out(2, "a"), "what other flows brought in was not born here");
}

#[test]
fn flows_without_a_common_broker_share_a_network_too() {
    let world = world(&["e/a net1 ros2- node+", "e/b net1 ros2- node-", "c/x node+"]);
    assert_eq!(who(&world, Scope::Inter, &Target::Ros2).len(), 1);
    let from_a = plan_of(&world, "e/a");
    assert_eq!(ways(&from_a)[..1], ["node>ros2"]);
    assert!(ways(&from_a).contains(&"node>e/b".to_owned()), "for its node, not for the network");
    let writer = who(&world, Scope::Inter, &Target::Ros2).remove(0);
    let other = if writer == id("e/a") { "b" } else { "a" };
    let plan = plan_of(&world, &writer.to_string());
    let to_ros2 = plan
        .bridges
        .iter()
        .find(|bridge| (bridge.from, &bridge.to) == (Scope::Inter, &Target::Ros2))
        .unwrap();
    assert!(to_ros2.lane.natives.write(Scope::Inter, 1, "e", other), "its own flow writes it");
}

#[test]
fn requests_to_services_go_to_the_flow_of_their_server() {
    let lines = ["e/a@1 net1 node+", "e/b@1 net1 ros2-", "e/c@1 net1 ros2-"];
    let mut world = world(&lines);
    assert_eq!(ways(&plan_of(&world, "e/b")).len() + ways(&plan_of(&world, "e/c")).len(), 0);
    let name: blaze_domain::TopicName = "add/_request".parse().unwrap();
    for view in world.flows.values_mut() {
        let entry = view.topics.remove(&topic()).unwrap();
        view.topics.insert(name.clone(), entry);
    }
    let plan = |flow: &str| {
        let world = World { me: id(flow), ..world.clone() };
        plan_topic(&world, &name, &PlanRules::default(), None)
    };
    assert_eq!(ways(&plan("e/a")), ["node>layer"]);
    for flow in ["e/b", "e/c"] {
        let plan = plan(flow);
        assert_eq!(ways(&plan), ["layer>ros2"], "each writes what names it");
        assert!(!plan.bridges[0].lane.natives.write(Scope::Layer, 1, "e", "a"));
    }
}

/// The same world, in which all is said of another topic.
fn renamed(world: &World, name: &str) -> World {
    let mut world = world.clone();
    for view in world.flows.values_mut() {
        if let Some(entry) = view.topics.remove(&topic()) {
            view.topics.insert(name.parse().unwrap(), entry);
        }
    }
    world
}

#[test]
fn a_network_with_a_server_of_its_own_asks_no_other_one() {
    let plan = |lines: &[&str], flow: &str| {
        let world = World { me: id(flow), ..renamed(&world(lines), "add/_request") };
        ways(&plan_topic(&world, &"add/_request".parse().unwrap(), &PlanRules::default(), None))
    };
    let away = ["e/a net1 ros2+", "c/b net2 ros2-"];
    assert_eq!(plan(&away, "e/a"), ["ros2>c/b"]);
    assert_eq!(plan(&["e/a net1 ros2+ ros2-", "c/b net2 ros2-"], "e/a"), [""; 0]);
    let beside = ["e/a@1 net1 ros2+", "e/x@1 net1 ros2-", "c/b net2 ros2-"];
    assert_eq!(plan(&beside, "e/a"), [""; 0], "another flow of the network has the server");
}

#[test]
fn requests_may_go_to_all_flows_with_a_server() {
    let servers = |lines: &[&str], name: &str| {
        let world = renamed(&world(lines), name);
        let servers = network::servers(&Survey::new(&world), &name.parse().unwrap());
        (servers.here, servers.elsewhere)
    };
    let lines = ["e/a net1 ros2+", "e/b net3 ros2-", "c/b net2 ros2-", "c/x net4 ros2- down"];
    let expected = (vec![id("e/b")], vec![id("c/b")]);
    assert_eq!(servers(&lines, "add/_request"), expected);
    assert_eq!(servers(&lines, "add/_reply"), (Vec::new(), Vec::new()));
}

#[test]
fn what_others_offer_in_a_type_shows_on_the_network_once() {
    let shown = |lines: &[&str], types: &[(&str, &str, &str)]| -> Vec<FlowId> {
        let mut world = world(lines);
        for (flow, scope, type_name) in types {
            offer(&mut world, flow, scope).type_name = (*type_name).to_owned();
        }
        let shows = |me: &&FlowId| {
            let world = World { me: (*me).clone(), ..world.clone() };
            network::shown(&Survey::new(&world), &topic()).is_some()
        };
        world.flows.keys().filter(shows).cloned().collect()
    };
    let (a, t) = ([id("e/a")], "p/msg/T");
    assert_eq!(shown(&["c/b net2 ros2+", "e/a net1"], &[("c/b", "ros2", t)]), a);
    assert_eq!(shown(&["c/b node+", "e/a net1"], &[("c/b", "node", t)]), a);
    assert_eq!(shown(&["c/b node+", "e/a net1"], &[]), [], "without a type");
    assert_eq!(shown(&["e/a net1 node+", "e/b net1"], &[("e/a", "node", t)]), a, "its own");
    assert_eq!(shown(&["e/a net1 ros2+", "e/b net1"], &[("e/a", "ros2", t)]), [], "it is there");
    let two = ["c/b node+", "e/a net1", "e/b net1"];
    assert_eq!(shown(&two, &[("c/b", "node", t)]).len(), 1, "one flow of the network shows it");
}

#[test]
fn a_server_elsewhere_shows_where_there_is_none() {
    let shown = |lines: &[&str], name: &str| -> Vec<FlowId> {
        let mut world = world(lines);
        for line in lines {
            let flow = line.split([' ', '@']).next().unwrap();
            if line.contains("ros2-") {
                ask(&mut world, flow, "ros2").type_name = "p/srv/T_Request".to_owned();
            }
            if line.contains("ros2+") {
                offer(&mut world, flow, "ros2").type_name = "p/srv/T_Response".to_owned();
            }
        }
        let world = renamed(&world, name);
        let shows = |me: &&FlowId| {
            let world = World { me: (*me).clone(), ..world.clone() };
            network::shown(&Survey::new(&world), &name.parse().unwrap()).is_some()
        };
        world.flows.keys().filter(shows).cloned().collect()
    };
    let both = [id("e/a"), id("e/b")];
    for (name, server, client) in
        [("add/_request", "ros2-", "ros2+"), ("add/_reply", "ros2+", "ros2-")]
    {
        let at_server = format!("c/b net2 {server}");
        let clients = [format!("e/a@1 net1 {client}"), "e/b@1 net1".to_owned()];
        let lines = [&*at_server, &*clients[0], &*clients[1]];
        assert_eq!(shown(&lines, name), both, "{name}");
        let own = format!("e/b@1 net1 {server}");
        assert_eq!(shown(&[&*at_server, "e/a@1 net1", &*own], name), [], "it has one: {name}");
        assert_eq!(shown(&lines[1..], name), [], "a client alone: {name}");
        let down = format!("{at_server} down");
        assert_eq!(shown(&[&*down, "e/a@1 net1"], name), [], "its flow has gone: {name}");
    }
}

#[test]
fn a_message_meets_readers_of_its_type_alone() {
    for (hashes, connected) in
        [(["", ""], true), (["h1", ""], true), (["h1", "h1"], true), (["h1", "h2"], false)]
    {
        let mut world = world(&["e/a net1 ros2+", "c/b net1 ros2-"]);
        let one = offer(&mut world, "e/a", "ros2");
        (one.type_name, one.type_hash) = ("p/msg/A".to_owned(), hashes[0].to_owned());
        let other = ask(&mut world, "c/b", "ros2");
        (other.type_name, other.type_hash) = ("p/msg/A".to_owned(), hashes[1].to_owned());
        let plan = plan_of(&world, "e/a");
        assert_eq!(plan.bridges.len(), usize::from(connected), "{hashes:?}");
        let mismatch = plan.blocked.iter().any(|blocked| blocked.code == WhyCode::TypeMismatch);
        assert_eq!(mismatch, !connected);
        ask(&mut world, "c/b", "ros2").type_name = "p/msg/B".to_owned();
        assert!(plan_of(&world, "e/a").bridges.is_empty());
    }
}
