//! Calls of services: both flows on the way of one.

use blaze_domain::media::{CALL, CALL_FAULT, CALL_REPLY};

use super::*;
use crate::lane::calls::CallAnswer;
use crate::types::{MessageType, TopicTypes, Wanted};

const STRING: &str = "std_msgs/msg/String";
const ME: &str = "edge/robot-1";

fn call(layer: &str, node: &str, sequence: u64, encoding: &str, payload: &'static str) -> Frame {
    let origin = Origin { layer: layer.into(), node: node.into(), ..Origin::default() };
    let header = Header {
        encoding: encoding.to_owned(),
        to: if layer == "edge" { "cloud/cloud-1" } else { ME }.to_owned(),
        ..Header::new("add/_request", origin, WriterId([1; 16]), sequence, WALL)
    };
    Frame::new(&header, Bytes::from_static(payload.as_bytes())).unwrap()
}

fn reply(from: [&str; 2], to: &str, sequence: u64, encoding: &str) -> Frame {
    let origin = Origin { layer: from[0].into(), node: from[1].into(), ..Origin::default() };
    let header = Header {
        related: Some((WriterId([1; 16]), sequence)),
        to: to.to_owned(),
        encoding: encoding.to_owned(),
        ..Header::new("add/_reply", origin, WriterId([2; 16]), sequence, WALL)
    };
    Frame::new(&header, Bytes::from_static(b"{}")).unwrap()
}

#[test]
fn replies_to_calls_of_this_flow_are_taken_out_once() {
    let mut bench = Bench::new(Vec::new());
    bench.add("add/_request", vec![bridge(Scope::Node, to_cloud())]);
    bench.add("add/_reply", vec![bridge(Scope::Inter, Target::Node(Form::Framed))]);
    for sequence in 1..=2 {
        let request = call("edge", "robot-1", sequence, CALL, "{}");
        bench.core.send_call(bench.now, WALL, request, &mut bench.link);
    }
    assert_eq!(bench.submitted(), [1, 2]);
    assert_eq!(bench.core.call_news(), (false, false));
    let from_cloud = |sequence, to| reply(["cloud", "cloud-1"], to, sequence, CALL_REPLY);
    bench.deliver(from_cloud(1, ME));
    bench.deliver(from_cloud(1, ME));
    bench.deliver(from_cloud(2, "edge/robot-2"));
    bench.deliver(reply(["cloud", "cloud-1"], ME, 3, "application/json"));
    assert_eq!(bench.core.call_news(), (true, false));
    let arrived: Vec<u64> = bench.core.take_arrived().iter().map(Frame::sequence).collect();
    assert_eq!(arrived, [1]);
    assert_eq!(bench.written(), [2, 3], "what is another's, and what is no reply to a call");
}

#[test]
fn own_servers_answer_calls_with_json_and_other_requests_with_cdr() {
    let mut bench = Bench::new(Vec::new());
    let requests = bench.add("add/_request", Vec::new());
    let replies = bench.add("add/_reply", vec![bridge(Scope::Ros2, to_cloud())]);
    let ty = MessageType { name: STRING.to_owned(), hash: String::new() };
    let types = TopicTypes { published: None, wanted: Wanted::Type(ty) };
    bench.topic = requests;
    let info = TopicInfo { types, ..TopicInfo::default() };
    bench.apply(vec![bridge(Scope::Inter, Target::Ros2)], info);
    let from_cloud =
        |sequence, encoding, payload| call("cloud", "cloud-1", sequence, encoding, payload);
    bench.deliver(from_cloud(1, CALL, r#"{"data":"a"}"#));
    bench.deliver(from_cloud(2, "application/json", r#"{"data":"b"}"#));
    bench.deliver(from_cloud(3, CALL, r#"{"data":7}"#));
    bench.deliver(from_cloud(4, "application/json", r#"{"data":7}"#));
    assert_eq!(bench.written(), [1, 2]);
    assert_eq!(bench.core.call_news(), (false, true));
    let answers = bench.core.take_call_answers();
    let [CallAnswer::Failed { request, failure }] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!(request.sequence(), 3);
    assert_eq!(failure.pointer, "/data");

    let cdr = format!("application/cdr; type={STRING}");
    for sequence in 1..=2 {
        let reply = reply(["edge", "robot-1"], "cloud/cloud-1", sequence, &cdr);
        bench.take_on(replies, Scope::Ros2, vec![Content::Frame(reply)]);
    }
    assert_eq!(bench.submitted(), [2], "not that of the call");
    let answers = bench.core.take_call_answers();
    let [CallAnswer::Reply(answer)] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!(answer.sequence(), 1);
    for (sequence, encoding) in [(1, CALL_REPLY), (3, CALL_FAULT)] {
        let answer = reply(["edge", "robot-1"], "cloud/cloud-1", sequence, encoding);
        bench.core.answer_call(bench.now, answer, &mut bench.link);
    }
    assert_eq!(bench.submitted(), [2, 1, 3]);
    assert_eq!(bench.core.call_news(), (false, false));
}
