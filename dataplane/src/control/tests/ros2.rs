//! Two layers on one ROS 2 network.

use std::net::Ipv4Addr;

use blaze_domain::control::LeaseKind;
use blaze_domain::{Reliability, WriterId};

use super::*;
use crate::registry::FoundEndpoint;
use crate::world::{Ros2Network, Ros2NetworkId};

const HERE: Ros2Network = Ros2Network { id: Ros2NetworkId(7), address: Ipv4Addr::LOCALHOST };

fn reader() -> FoundEndpoint {
    FoundEndpoint {
        guid: WriterId([1; 16]),
        kind: LeaseKind::Request,
        type_name: "std_msgs/msg/String".to_owned(),
        type_hash: String::new(),
        reliability: Reliability::Reliable,
        durability: blaze_domain::Durability::Volatile,
        lifespan_ms: 0,
        node: "/listener".to_owned(),
        locators: vec![Ipv4Addr::LOCALHOST],
    }
}

/// A flow of the cloud that is on a network, in this life.
fn cloud(network: u64, epoch: u64) -> Hello {
    Hello {
        ros2_network: network,
        ros2_address: "127.0.0.1".to_owned(),
        registry_version: 1,
        epoch,
        ..hello_of(&"cloud/c".parse().unwrap(), Kind::Cloud)
    }
}

#[test]
fn of_two_layers_on_one_network_the_later_one_uses_it_no_longer() {
    let mut bench = Bench::inside();
    bench.core.set_ros2_network(bench.now, Some(HERE));
    let found = BTreeMap::from([("chatter".parse().unwrap(), vec![reader()])]);
    bench.core.set_found(bench.now, found);
    bench.send(Scope::Node, &lease("advertise", "chatter"));
    bench.step(300);
    assert_eq!(bench.bridges("chatter"), ["node>ros2"]);
    assert!(bench.wants(|output| matches!(output, Output::Ros2(Some(HERE)))));

    // Another network, or a later life.
    bench.link_says(cloud(8, 1), 1, Vec::new());
    bench.step(300);
    assert_eq!(bench.core.ros2_holder(), None);
    // Its participant was found on this one all the same: of equal lives the smaller name stays.
    bench.outputs.clear();
    let found = BTreeSet::from(["/blaze/cloud_c".to_owned()]);
    bench.core.set_ros2_nodes(bench.now, found);
    bench.step(300);
    assert_eq!(bench.core.ros2_holder().unwrap().to_string(), "cloud/c");
    assert_eq!(bench.bridges("chatter"), [""; 0]);
    assert!(bench.wants(|output| matches!(output, Output::Ros2(None))));
    assert_eq!(bench.core.state(), FlowState::Ready, "which holds up nothing else");

    bench.link_says(cloud(8, 2), 1, Vec::new());
    bench.step(300);
    assert_eq!(bench.core.ros2_holder(), None, "its new life is the later one");
    assert_eq!(bench.bridges("chatter"), ["node>ros2"]);
}
