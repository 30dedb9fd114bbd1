//! Bridges to and from ROS 2, and copies as JSON.

use super::*;
use crate::plan::network::{Natives, Servers};

fn to_ros2(from: Scope, natives: Natives) -> Bridge {
    Bridge { lane: LaneSpec { natives, ..lane_spec() }, ..bridge(from, Target::Ros2) }
}

fn flows(names: &[&str]) -> Vec<FlowId> {
    names.iter().map(|name| name.parse().unwrap()).collect()
}

#[test]
fn what_another_flow_of_the_network_writes_there_is_left_out() {
    let natives = Natives { here: flows(&["edge/robot-2"]), elsewhere: Vec::new() };
    let mut bench = Bench::new(vec![to_ros2(Scope::Layer, natives)]);
    let from = |sequence, node, hops| Content::Frame(frame(1, sequence, node, hops, 1));
    let batch = vec![
        from(1, "robot-2", 1),
        from(2, "robot-3", 1),
        from(3, "robot-2", 0),
        from(4, "robot-2", 2),
    ];
    bench.take(Scope::Layer, batch);
    assert_eq!(bench.written(), [2, 3, 4], "only what its own flow wrote to the layer");
    assert!(bench.drops().is_empty(), "it is not for this bridge");

    let natives = Natives { here: Vec::new(), elsewhere: flows(&["fog/fog-1"]) };
    let mut bench = Bench::new(vec![to_ros2(Scope::Inter, natives)]);
    bench.deliver(from_fog(1, 0));
    bench.deliver(message(["fog", "fog-2", ""], 4, 2, 0, 0).with_hops_and_age(1, 0));
    assert_eq!(bench.written(), [2]);
}

#[test]
fn a_message_for_one_flow_is_written_by_that_flow_and_stays_in_its_layer() {
    let bridges =
        || vec![to_ros2(Scope::Node, Natives::default()), bridge(Scope::Node, to_cloud())];
    for (to, written, sent) in
        [("", 1, 1), ("edge/robot-1", 1, 0), ("edge/robot-2", 0, 0), ("cloud/cloud-1", 0, 1)]
    {
        let mut bench = Bench::new(bridges());
        let plain = frame(1, 1, "robot-1", 0, 1);
        let origin = plain.origin();
        let header = Header {
            to: to.to_owned(),
            encoding: plain.encoding().to_owned(),
            ..Header::new("imu/data", origin, plain.writer(), 1, WALL)
        };
        let message = Frame::new(&header, Bytes::new()).unwrap();
        bench.take(Scope::Node, vec![Content::Frame(message)]);
        assert_eq!((bench.written().len(), bench.submitted().len()), (written, sent), "{to:?}");
    }
}

#[test]
fn a_request_goes_to_one_server_and_stays_with_it() {
    let to_cloud = || vec![bridge(Scope::Ros2, to_cloud())];
    let mut bench = Bench::new(to_cloud());
    let info = |here: &[&str], elsewhere: &[&str]| TopicInfo {
        servers: Servers { here: flows(here), elsewhere: flows(elsewhere) },
        ..TopicInfo::default()
    };
    let ask = |bench: &mut Bench, sequence| {
        let before = bench.link.submitted.len();
        bench.take(Scope::Ros2, vec![Content::Frame(frame(1, sequence, "robot-1", 0, 1))]);
        bench.link.submitted.len() - before
    };
    bench.apply(to_cloud(), info(&[], &["cloud/cloud-1"]));
    assert_eq!(ask(&mut bench, 1), 1);
    bench.apply(to_cloud(), info(&["edge/robot-2"], &["cloud/cloud-1"]));
    assert_eq!(ask(&mut bench, 2), 1, "where it has gone before");
    bench.apply(to_cloud(), info(&["edge/robot-2"], &[]));
    assert_eq!(ask(&mut bench, 3), 0, "that has no server any more");
    bench.apply(to_cloud(), info(&["edge/robot-2"], &["cloud/cloud-1"]));
    assert_eq!(ask(&mut bench, 4), 0);
}

#[test]
fn what_ros2_nodes_publish_is_of_this_flow() {
    let to_node = bridge(Scope::Ros2, Target::Node(Form::Framed));
    let mut bench = Bench::new(vec![to_node, bridge(Scope::Ros2, to_cloud())]);
    let batch = vec![
        Content::Frame(frame(1, 1, "robot-1", 0, 1)),
        Content::Frame(frame(1, 2, "robot-2", 0, 1)),
        Content::Frame(frame(1, 3, "robot-1", 1, 1)),
    ];
    bench.take(Scope::Ros2, batch);
    assert_eq!((bench.written(), bench.submitted()), (vec![1], vec![1]));
    assert_eq!(bench.drops(), [(DropReason::Echo, 1), (DropReason::ForeignOrigin, 1)]);
}

#[test]
fn of_what_the_layer_publishes_one_flow_makes_the_copy() {
    let copy = bridge(Scope::Layer, Target::Layer { json: true });
    let mut bench = Bench::new(vec![copy]);
    bench.take(Scope::Layer, vec![Content::Frame(frame(1, 1, "robot-2", 1, 1))]);
    let path = bench.core.path(bench.topic);
    assert_eq!(path.bridges[0].stats.taken.messages, 0, "the flow that wrote it made the copy");
}
