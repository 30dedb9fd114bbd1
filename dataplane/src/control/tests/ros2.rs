//! Two layers on one ROS 2 network.

use std::net::Ipv4Addr;

use blaze_domain::control::LeaseKind;
use blaze_domain::{Reliability, TopicName, WhyCode, WriterId};

use super::*;
use crate::registry::FoundEndpoint;
use crate::types::{MessageType, TopicTypes, Wanted};
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

/// The types that a topic's bridges were last told of.
fn types(bench: &mut Bench) -> TopicTypes {
    let of_plan = |output| match output {
        Output::Plan { info, .. } => Some(info.types),
        _ => None,
    };
    bench.wanted(of_plan).pop().unwrap()
}

#[test]
fn json_becomes_what_readers_ask_for_if_the_publisher_names_no_other_type() {
    let mut bench = Bench::inside();
    bench.core.set_ros2_network(bench.now, Some(HERE));
    let topic: TopicName = "chatter".parse().unwrap();
    let find = |bench: &mut Bench, readers: &[(&str, &str)]| {
        let readers = (1..).zip(readers).map(|(n, (name, hash))| FoundEndpoint {
            guid: WriterId([n; 16]),
            type_name: (*name).to_owned(),
            type_hash: (*hash).to_owned(),
            ..reader()
        });
        let found = BTreeMap::from([(topic.clone(), readers.collect())]);
        bench.core.set_found(bench.now, found);
        // Another hash alone is no reason to plan at once.
        (0..20).for_each(|_| bench.step(300));
        types(bench).wanted
    };
    let advertise = |bench: &mut Bench, type_name: &str| {
        let mut message = lease("advertise", "chatter");
        message["type"] = json!(type_name);
        message["ttl_s"] = json!(0);
        bench.send(Scope::Node, &message);
    };
    let ty = |name: &str, hash: &str| {
        Wanted::Type(MessageType { name: name.to_owned(), hash: hash.to_owned() })
    };
    advertise(&mut bench, "");
    assert_eq!(find(&mut bench, &[("a/msg/A", "")]), ty("a/msg/A", ""));
    assert_eq!(find(&mut bench, &[("a/msg/A", ""), ("a/msg/A", "H")]), ty("a/msg/A", "H"));
    let mismatch = |wanted| match wanted {
        Wanted::Mismatch(detail) => detail,
        other => panic!("{other:?}"),
    };
    let two = [("a/msg/A", ""), ("a/msg/B", "")];
    let name_one = "readers ask for a/msg/A, a/msg/B: name one as `type` of the publisher";
    assert_eq!(mismatch(find(&mut bench, &two)), name_one);
    advertise(&mut bench, "a/msg/B");
    assert_eq!(find(&mut bench, &two), ty("a/msg/B", ""));
    let other = "a/msg/B is published, readers ask for a/msg/A";
    assert_eq!(mismatch(find(&mut bench, &[("a/msg/A", "")])), other);
    assert_eq!(find(&mut bench, &[]), Wanted::Nothing);
}

#[test]
fn a_conversion_that_fails_is_an_event() {
    let mut bench = Bench::ready();
    let failure = ConvertFailure {
        pointer: "/x".to_owned(),
        ..ConvertFailure::new(WhyCode::ConvertError, "expected a number, found text")
    };
    bench.core.convert_failed(0, "chatter".parse().unwrap(), &failure);
    bench.collect();
    let events = bench.wanted(|output| match output {
        Output::Publish { scope, channel, body } if channel == ChannelName::events() => {
            Some((scope, serde_json::from_slice::<Value>(&body).unwrap()))
        }
        _ => None,
    });
    assert_eq!(events.iter().map(|(scope, _)| *scope).collect::<Vec<_>>(), Scope::LOCAL[..2]);
    let (_, event) = &events[0];
    assert_eq!((&event["event"], &event["topic"]), (&json!("convert_failed"), &json!("chatter")));
    assert_eq!(event["code"], "convert_error");
    assert_eq!(event["detail"], "/x: expected a number, found text");
}
