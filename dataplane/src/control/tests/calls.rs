//! Calls of services on a robot by services of the fog.

use blaze_domain::control::ErrorCode;
use blaze_domain::media::{CALL, CALL_FAULT, CALL_REPLY};
use blaze_domain::{Origin, WriterId};
use blaze_proto::link::link_control::{Advertise, RouteState};
use blaze_proto::{Frame, Header};

use super::*;

const ROBOT: &str = "edge/robot-1";

/// The robot has a server of `add`; `knows`: it sends replies to this flow.
fn robot(bench: &mut Bench, knows: bool) {
    let hello = Hello {
        ros2_network: 7,
        ros2_address: "127.0.0.1".to_owned(),
        registry_version: 1,
        ..hello_of(&ROBOT.parse().unwrap(), Kind::Edge)
    };
    let route = RouteState {
        to_layer: "fog".to_owned(),
        receiver: "fog/fog-1".to_owned(),
        step: "bridge".to_owned(),
        ok: true,
        code: "ok".to_owned(),
        next_offset: 0,
    };
    let entries = vec![
        Entry {
            topic: "add/_request".to_owned(),
            ros2_request: Some(Request::default()),
            ..Entry::default()
        },
        Entry {
            topic: "add/_reply".to_owned(),
            ros2_advertise: Some(Advertise::default()),
            route_state: knows.then_some(route).into_iter().collect(),
            ..Entry::default()
        },
    ];
    bench.link_says(hello, 1, entries);
}

fn call(service: &str, id: &str, timeout_ms: u64) -> Value {
    json!({"op": "call", "topic": service, "service": "planner", "id": id,
        "reply_to": "blaze/reply/planner", "request": {"a": 1}, "timeout_ms": timeout_ms})
}

/// Requests that were sent since the last call, and answers.
fn done(bench: &mut Bench) -> (Vec<Frame>, Vec<Value>) {
    let mut sent = Vec::new();
    let answers = bench.wanted(|output| match output {
        Output::Call { request } => {
            sent.push(request);
            None
        }
        Output::Publish { channel, body, .. } if channel.as_str().starts_with("blaze/reply") => {
            Some(serde_json::from_slice(&body).unwrap())
        }
        _ => None,
    });
    (sent, answers)
}

/// Works for so long, as a flow does whose brokers read all that they are to read.
fn work(bench: &mut Bench, ms: u64) -> (Vec<Frame>, Vec<Value>) {
    for _ in 0..ms / 20 {
        bench.step(20);
        bench.core.send_calls(bench.now, 5, |_| true);
        bench.collect();
    }
    done(bench)
}

fn codes(answers: &[Value]) -> Vec<&str> {
    answers.iter().map(|answer| answer["error"]["code"].as_str().unwrap_or("ok")).collect()
}

fn reply(request: &Frame, encoding: &str, payload: &str) -> Frame {
    let origin = Origin { layer: "edge".into(), node: "robot-1".into(), ..Origin::default() };
    let header = Header {
        related: Some((request.writer(), request.sequence())),
        to: "fog/fog-1".to_owned(),
        encoding: encoding.to_owned(),
        ..Header::new("add/_reply", origin, WriterId([9; 16]), 1, 5)
    };
    Frame::new(&header, Bytes::from(payload.to_owned())).unwrap()
}

#[test]
fn a_call_is_sent_when_its_ways_stand_and_its_reply_is_the_answer() {
    let mut bench = Bench::inside();
    robot(&mut bench, false);
    bench.step(300);
    bench.send(Scope::Node, &call("add", "7", 5_000));
    let (sent, answers) = work(&mut bench, 500);
    assert!(sent.is_empty() && answers.is_empty(), "the robot does not know yet who calls");
    assert_eq!(bench.bridges("add/_request"), ["node>inter"]);
    assert_eq!(bench.bridges("add/_reply"), ["inter>node"]);
    assert_eq!(bench.core.pending_calls(), 1);
    // Not every flow says so: after a while it goes all the same.
    let (sent, _) = work(&mut bench, 2_000);
    let [request] = &sent[..] else { panic!("{sent:?}") };
    assert_eq!((request.topic(), request.to(), request.encoding()), ("add/_request", ROBOT, CALL));
    assert_eq!(&request.payload()[..], br#"{"a":1}"#);
    assert_eq!((request.origin_service(), request.hops()), ("planner", 0));
    assert!((1..5_000).contains(&request.lifespan_ms()), "nobody executes it too late");
    bench.core.call_reply(&reply(request, CALL_REPLY, r#"{"sum":3}"#));
    bench.core.call_reply(&reply(request, CALL_REPLY, r#"{"sum":4}"#));
    let (again, answers) = work(&mut bench, 300);
    assert_eq!(answers, [json!({"id": "7", "ok": true, "flow": ROBOT, "reply": {"sum": 3}})]);
    assert!(again.is_empty(), "it is sent once");

    // The way stands now. Another caller has a writer of its own.
    bench.send(Scope::Node, &call("add", "8", 5_000));
    let mut other = call("add", "9", 5_000);
    other["instance"] = "1".into();
    bench.send(Scope::Layer, &other);
    let (sent, _) = work(&mut bench, 300);
    assert_eq!(sent.len(), 2);
    assert_eq!(sent[0].writer(), request.writer());
    assert!(sent[1].writer() != request.writer() && sent[0].sequence() > request.sequence());
    let fault = r#"{"code":"convert_error","pointer":"/request/a","detail":"found text"}"#;
    bench.core.call_reply(&reply(&sent[1], CALL_FAULT, fault));
    bench.core.call_reply(&reply(&sent[0], CALL_REPLY, "no JSON"));
    let (_, answers) = work(&mut bench, 300);
    assert_eq!(codes(&answers), ["convert_error", "convert_error"]);
    assert_eq!(answers[0]["error"]["pointer"], "/request/a");
    let counted: Vec<_> = bench.core.call_outcomes().clone().into_iter().collect();
    assert_eq!(counted, [("convert_error", 2), ("ok", 1)]);

    (0..70).for_each(|_| bench.step(1_000));
    assert_eq!(bench.bridges("add/_request"), [""; 0], "nobody has called it for a minute");
}

#[test]
fn a_call_ends_without_a_server_and_when_its_time_is_over() {
    let mut bench = Bench::inside();
    bench.send(Scope::Node, &call("nobody", "1", 600_000));
    assert!(work(&mut bench, 500).1.is_empty(), "a server may be known in a moment");
    assert_eq!(codes(&work(&mut bench, 700).1), ["no_server"]);
    robot(&mut bench, true);
    bench.step(300);
    bench.send(Scope::Node, &call("add", "2", 1_000));
    let (sent, answers) = work(&mut bench, 900);
    assert_eq!((sent.len(), answers.len()), (1, 0));
    assert_eq!(codes(&work(&mut bench, 200).1), ["timeout"]);
    bench.core.call_reply(&reply(&sent[0], CALL_REPLY, "{}"));
    assert!(work(&mut bench, 100).1.is_empty(), "too late");
    assert_eq!(bench.core.pending_calls(), 0);
}

#[test]
fn calls_are_bounded_and_held_to_the_rules() {
    let mut bench = Bench::inside();
    for number in 0..257 {
        bench.send(Scope::Node, &call("nobody", &number.to_string(), 5_000));
    }
    let (_, answers) = done(&mut bench);
    assert_eq!(codes(&answers), [ErrorCode::TooManyCalls.as_str()]);
    assert_eq!(answers[0]["id"], "256");
    assert_eq!(work(&mut bench, 1_200).1.len(), 256);

    // Of more callers of one service than are remembered the oldest gives way, not all of them.
    robot(&mut bench, true);
    bench.step(300);
    for number in 0..257 {
        let mut call = call("add", "1", 5_000);
        call["service"] = format!("planner-{number}").into();
        bench.send(Scope::Node, &call);
        for request in work(&mut bench, 60).0 {
            bench.core.call_reply(&reply(&request, CALL_REPLY, "{}"));
        }
    }
    let own = bench.core.world().own().unwrap();
    let replies = own.topics.get("add/_reply").and_then(|entry| entry.node.request.as_ref());
    assert!(replies.unwrap().more_services > 0);
    assert_eq!(codes(&work(&mut bench, 60).1), ["ok"]);

    let rules = [json!({"match": "add/**", "advertise": {"allow": ["*/*/other"]}})];
    bench.core.set_access(bench.now, 0, access(&json!(rules)));
    bench.send(Scope::Node, &call("add", "1", 5_000));
    let mut elsewhere = call("add", "2", 5_000);
    elsewhere["node"] = "fog-2".into();
    bench.send(Scope::Node, &elsewhere);
    bench.send(Scope::Node, &call(&"a".repeat(195), "3", 5_000));
    let (_, answers) = done(&mut bench);
    assert_eq!(codes(&answers), ["access_denied", "source_mismatch", "invalid_topic"]);
    assert_eq!(bench.core.pending_calls(), 0);
}
