use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::control::{LeaseKind, MAX_CONTROL_BYTES};
use crate::qos::Priority;

fn one(value: &Value) -> ParsedObject {
    let mut objects = parse_payload(value.to_string().as_bytes()).unwrap();
    assert_eq!(objects.len(), 1);
    objects.remove(0)
}

fn message(value: &Value) -> ControlMessage {
    one(value).message.unwrap()
}

/// A good object of that `op` with one field replaced.
fn with(op: &str, key: &str, value: &Value) -> Value {
    let mut object = json!({"op": op, "topic": "imu/data", "service": "driver"});
    object[key] = value.clone();
    object
}

#[test]
fn the_examples_of_the_contract_parse() {
    let payload = br#"[{"op":"advertise","topic":"imu/data","service":"imu-driver","rate_hz":50,"max_bytes":400,"encoding":"application/json","priority":"state"},
        {"op":"request","topic":"imu/data","service":"logger","max_rate_hz":10,"lifespan_ms":500,"id":"7","reply_to":"blaze/reply/logger-0"},
        {"op":"withdraw","topic":"imu/data","service":"imu-driver"}]"#;
    let objects = parse_payload(payload).unwrap();
    let [advertise, request, withdraw] = objects.as_slice() else { panic!("{objects:?}") };
    let topic: TopicName = "imu/data".parse().unwrap();
    let mut expected = AdvertiseMessage::new(topic.clone(), "imu-driver".parse().unwrap());
    expected.rate_hz = Some(50.0);
    expected.max_bytes = Some(400);
    expected.quality.encoding = Some("application/json".into());
    expected.quality.priority = Some(Priority::State);
    assert_eq!(advertise.message, Ok(ControlMessage::Advertise(expected)));
    let mut expected = RequestMessage::new(topic.clone(), "logger".parse().unwrap());
    expected.max_rate_hz = Some(10.0);
    expected.quality.lifespan_ms = 500;
    expected.common.id = Some("7".into());
    expected.common.reply_to = Some("blaze/reply/logger-0".parse().unwrap());
    assert_eq!(request.message, Ok(ControlMessage::Request(expected)));
    assert_eq!(request.id.as_deref(), Some("7"));
    let expected = WithdrawMessage::new(topic, "imu-driver".parse().unwrap());
    assert_eq!(withdraw.message, Ok(ControlMessage::Withdraw(expected)));
    assert_eq!(withdraw.pointer, "/2");
}

#[test]
fn defaults_are_those_of_the_contract() {
    let ControlMessage::Advertise(advertise) =
        message(&with("advertise", "unknown_field", &json!([{}])))
    else {
        panic!("not an advertise")
    };
    assert_eq!(advertise.common.instance.as_str(), "0");
    assert_eq!((advertise.common.layer, advertise.common.node), (None, None));
    assert_eq!((advertise.common.epoch, advertise.ttl_s), (0, 15));
    assert_eq!((advertise.rate_hz, advertise.max_bytes), (None, None));
    let quality = advertise.quality;
    assert_eq!((quality.encoding, quality.priority), (None, None));
    assert_eq!((quality.type_name, quality.type_hash), (String::new(), String::new()));
    assert_eq!(
        (quality.reliability, quality.durability),
        (Reliability::BestEffort, Durability::Volatile)
    );
    assert_eq!((quality.depth, quality.lifespan_ms), (1, 0));
    let ControlMessage::Request(request) = message(&with("request", "max_rate_hz", &Value::Null))
    else {
        panic!("not a request")
    };
    assert_eq!((request.max_rate_hz, request.bare, request.ttl_s), (None, false, 15));
    assert!(request.from.is_any());
    let ControlMessage::Withdraw(withdraw) = message(&with("withdraw", "kind", &json!("request")))
    else {
        panic!("not a withdraw")
    };
    assert_eq!(withdraw.kind, Some(LeaseKind::Request));
}

#[test]
fn every_value_in_range_is_taken() {
    for (op, key, value) in [
        ("advertise", "ttl_s", json!(0)),
        ("advertise", "ttl_s", json!(1)),
        ("advertise", "ttl_s", json!(86_400)),
        ("advertise", "ttl_s", json!(15.0)),
        ("advertise", "epoch", json!(u64::MAX)),
        ("advertise", "rate_hz", json!(0.001)),
        ("advertise", "max_bytes", json!(0)),
        ("advertise", "depth", json!(65_535)),
        ("advertise", "lifespan_ms", json!(u32::MAX)),
        ("advertise", "reliability", json!("reliable")),
        ("advertise", "durability", json!("transient_local")),
        ("advertise", "priority", json!("control")),
        ("advertise", "instance", json!("7")),
        ("advertise", "layer", json!("edge")),
        ("advertise", "node", json!("robot-1")),
        ("advertise", "encoding", json!("application/cdr; type=sensor_msgs/msg/Imu")),
        ("advertise", "type", json!("sensor_msgs/msg/Imu")),
        ("advertise", "type_hash", json!(format!("RIHS01_{}", "a".repeat(64)))),
        ("advertise", "bare", json!("of no meaning here")),
        ("request", "bare", json!(true)),
        ("request", "from", json!({})),
        ("request", "from", json!({"layer": "edge", "node": "robot-7", "service": "imu"})),
        ("request", "rate_hz", json!("of no meaning here")),
        ("withdraw", "ttl_s", json!("of no meaning here")),
        ("withdraw", "kind", json!("advertise")),
        ("withdraw", "id", json!("")),
    ] {
        let object = one(&with(op, key, &value));
        assert!(object.message.is_ok(), "{op} {key} {value}: {:?}", object.message);
    }
}

#[test]
fn every_fault_has_its_code_and_place() {
    let bad = ErrorCode::InvalidValue;
    let mut table = vec![
        ("advertise", "op", json!("subscribe"), ErrorCode::UnknownOp, "/op"),
        ("advertise", "op", Value::Null, ErrorCode::UnknownOp, "/op"),
        ("advertise", "op", json!(5), ErrorCode::UnknownOp, "/op"),
        ("advertise", "topic", Value::Null, ErrorCode::InvalidTopic, "/topic"),
        ("advertise", "topic", json!(""), ErrorCode::InvalidTopic, "/topic"),
        ("advertise", "topic", json!("/imu"), ErrorCode::InvalidTopic, "/topic"),
        ("advertise", "topic", json!("a b"), ErrorCode::InvalidTopic, "/topic"),
        ("advertise", "topic", json!("t".repeat(201)), ErrorCode::InvalidTopic, "/topic"),
        ("advertise", "topic", json!(5), bad, "/topic"),
        ("advertise", "topic", json!("blaze"), ErrorCode::ReservedTopic, "/topic"),
        ("request", "topic", json!("blaze/ping/edge"), ErrorCode::ReservedTopic, "/topic"),
        ("request", "topic", json!("blaze/flow/control"), ErrorCode::ReservedTopic, "/topic"),
        ("request", "from", json!("edge"), bad, "/from"),
        ("request", "from", json!({"layer": "Edge"}), bad, "/from/layer"),
        ("request", "from", json!({"node": 1}), bad, "/from/node"),
        ("request", "from", json!({"service": ""}), bad, "/from/service"),
        ("request", "bare", json!(1), bad, "/bare"),
        ("request", "json", json!("yes"), bad, "/json"),
        ("request", "max_rate_hz", json!(0), bad, "/max_rate_hz"),
        ("withdraw", "kind", json!("both"), bad, "/kind"),
        ("withdraw", "kind", json!(1), bad, "/kind"),
    ];
    for (key, values) in [
        ("service", vec![Value::Null, json!(1), json!("A"), json!("a".repeat(64))]),
        ("instance", vec![json!(0), json!(""), json!("-a")]),
        ("layer", vec![json!(["edge"]), json!("Edge")]),
        ("node", vec![json!({}), json!("")]),
        ("epoch", vec![json!(-1), json!("1"), json!(1.5), json!(1e30)]),
        ("ttl_s", vec![json!(86_401), json!(-1), json!("15"), json!(0.5), json!(true)]),
        ("id", vec![json!(7), json!("i".repeat(257)), json!("a\nb")]),
        (
            "reply_to",
            vec![
                json!(1),
                json!("imu/data"),
                json!("blaze/reply/"),
                json!("blaze/reply/a b"),
                json!("blaze/reply"),
            ],
        ),
        ("rate_hz", vec![json!(0), json!(-1), json!("50"), json!([])]),
        ("max_bytes", vec![json!(-1), json!("400"), json!(0.5)]),
        ("encoding", vec![json!(1), json!("e".repeat(201)), json!("a\u{0}")]),
        ("type", vec![json!(1), json!("t".repeat(201))]),
        ("type_hash", vec![json!(false), json!("h".repeat(201))]),
        ("reliability", vec![json!("sure"), json!(1)]),
        ("durability", vec![json!("persistent"), json!(null_text())]),
        ("depth", vec![json!(0), json!(65_536), json!("1")]),
        ("priority", vec![json!("urgent"), json!(1)]),
        ("lifespan_ms", vec![json!(-1), json!(4_294_967_296_u64), json!("500")]),
    ] {
        for value in values {
            table.push(("advertise", key, value, bad, ""));
        }
    }
    for (op, key, value, code, pointer) in table {
        let pointer = if pointer.is_empty() { format!("/{key}") } else { pointer.to_owned() };
        let faulty = with(op, key, &value);
        let error = one(&faulty).message.unwrap_err();
        assert_eq!((error.code, error.pointer.as_str()), (code, pointer.as_str()), "{faulty}");
        assert!(!error.detail.is_empty());
        // In an array the index comes first, and the others are not spoilt.
        let good = with("advertise", "rate_hz", &json!(1));
        let objects = parse_payload(json!([good, faulty, good]).to_string().as_bytes()).unwrap();
        let found: Vec<_> =
            objects.iter().map(|object| object.message.clone().map(|_| ())).collect();
        let error = objects[1].message.clone().unwrap_err();
        assert_eq!((error.code, error.pointer.as_str()), (code, format!("/1{pointer}").as_str()));
        assert!(found[0].is_ok() && found[2].is_ok());
    }
}

fn null_text() -> String {
    "volatile\u{0}".into()
}

#[test]
fn calls_need_somebody_who_gets_the_reply() {
    let call = json!({"op": "call", "topic": "add_two_ints", "service": "planner", "id": "7",
        "reply_to": "blaze/reply/planner", "request": {"a": 1}});
    let ControlMessage::Call(read) = message(&call) else { panic!("not a call") };
    assert_eq!((read.timeout_ms, &read.request["a"]), (5_000, &json!(1)));
    for (key, value) in [
        ("id", Value::Null),
        ("reply_to", Value::Null),
        ("request", Value::Null),
        ("request", json!([1])),
        ("timeout_ms", json!(0)),
        ("timeout_ms", json!(600_001)),
    ] {
        let mut faulty = call.clone();
        faulty[key] = value;
        let error = one(&faulty).message.unwrap_err();
        assert_eq!((error.code, error.pointer), (ErrorCode::InvalidValue, format!("/{key}")));
    }
}

#[test]
fn a_call_that_is_too_large_can_be_answered() {
    let call = |bytes: usize| {
        let text = "x".repeat(bytes);
        json!({"op": "call", "topic": "set_map", "service": "planner", "id": "7",
            "reply_to": "blaze/reply/planner", "request": {"data": text}})
        .to_string()
    };
    let [object] = &parse_payload(call(MAX_CONTROL_BYTES).as_bytes()).unwrap()[..] else {
        panic!("one object")
    };
    let error = object.message.as_ref().unwrap_err();
    assert_eq!((error.code, error.pointer.as_str()), (ErrorCode::TooLarge, "/request"));
    assert_eq!(object.id.as_deref(), Some("7"));
    assert_eq!(object.reply_to.as_ref().unwrap().as_str(), "blaze/reply/planner");
    let absurd = parse_payload(call(2 * MAX_LARGE_CALL_BYTES).as_bytes());
    assert_eq!(absurd.unwrap_err().code, ErrorCode::InvalidValue, "nobody reads that much");
}

#[test]
fn faulty_objects_can_still_be_answered() {
    let object = one(&json!({"op": "fly", "topic": "a", "id": "7", "reply_to": "blaze/reply/x"}));
    assert_eq!(object.id.as_deref(), Some("7"));
    assert_eq!(object.reply_to.unwrap().as_str(), "blaze/reply/x");
    assert_eq!(object.topic.unwrap().as_str(), "a");
    let object = one(&json!({"op": "advertise", "topic": 1, "id": 7, "reply_to": "blaze/reply/x"}));
    assert_eq!((object.id, object.reply_to.is_some()), (None, true));
    assert_eq!(object.message.unwrap_err().pointer, "/id");
    let object = one(&json!({"op": "fly", "id": "7", "reply_to": "nowhere"}));
    assert_eq!((object.id.as_deref(), object.reply_to), (Some("7"), None));
    assert_eq!(object.message.unwrap_err().pointer, "/reply_to");
}

#[test]
fn payloads_that_are_none_are_refused_as_a_whole() {
    let good = r#"{"op":"advertise","topic":"a","service":"s"}"#;
    let many = |count: usize| format!("[{}]", vec![good; count].join(","));
    for (payload, code) in [
        (Vec::new(), ErrorCode::InvalidJson),
        (b"{".to_vec(), ErrorCode::InvalidJson),
        (b"\xff\xfe".to_vec(), ErrorCode::InvalidJson),
        (b"{\"op\":\"\xff\"}".to_vec(), ErrorCode::InvalidJson),
        (format!("{good} {good}").into_bytes(), ErrorCode::InvalidJson),
        (format!("[{good},]").into_bytes(), ErrorCode::InvalidJson),
        (format!("[{good}] x").into_bytes(), ErrorCode::InvalidJson),
        (b"5".to_vec(), ErrorCode::InvalidValue),
        (b"null".to_vec(), ErrorCode::InvalidValue),
        (b"\"advertise\"".to_vec(), ErrorCode::InvalidValue),
        (many(201).into_bytes(), ErrorCode::InvalidValue),
        (vec![b' '; MAX_CONTROL_BYTES + 1], ErrorCode::InvalidValue),
        (vec![b'['; MAX_CONTROL_BYTES], ErrorCode::InvalidJson),
        (r#"{"a":"#.repeat(10_000).into_bytes(), ErrorCode::InvalidJson),
    ] {
        let error = parse_payload(&payload).unwrap_err();
        assert_eq!(
            (error.code, error.pointer.as_str()),
            (code, ""),
            "{}",
            String::from_utf8_lossy(&payload)
        );
    }
    assert_eq!(parse_payload(many(200).as_bytes()).unwrap().len(), 200);
    assert!(parse_payload(b" [ ] ").unwrap().is_empty());
    let largest = format!("{good}{}", " ".repeat(MAX_CONTROL_BYTES - good.len()));
    assert!(parse_payload(largest.as_bytes()).unwrap()[0].message.is_ok());
}

#[test]
fn hostile_elements_spoil_only_themselves() {
    let good = r#"{"op":"advertise","topic":"a","service":"s"}"#;
    let deep = format!("{{\"x\":{}{}}}", "[".repeat(1000), "]".repeat(1000));
    let payload = format!("[{good},{deep},5,{{\"rate_hz\":1e999}},[{good}],{good}]");
    let objects = parse_payload(payload.as_bytes()).unwrap();
    let codes: Vec<_> = objects
        .iter()
        .map(|object| object.message.as_ref().err().map(|error| error.code))
        .collect();
    let (json, value) = (Some(ErrorCode::InvalidJson), Some(ErrorCode::InvalidValue));
    assert_eq!(codes, [None, json, value, json, value, None]);
    assert_eq!(objects[3].message.as_ref().unwrap_err().pointer, "/3");
    // The last of equal keys counts, as in most JSON readers.
    let twice = r#"{"op":"withdraw","op":"advertise","topic":"a","topic":"b","service":"s"}"#;
    let object = parse_payload(twice.as_bytes()).unwrap().remove(0);
    assert_eq!(object.message.unwrap().common().topic.as_str(), "b");
}

fn any_message() -> impl Strategy<Value = ControlMessage> {
    let name = "[a-z0-9]([a-z0-9-]{0,8}[a-z0-9])?";
    let common = (
        "[A-Za-z0-9_-]{1,8}(/[A-Za-z0-9_-]{1,8}){0,3}",
        name,
        name,
        proptest::option::of(name),
        proptest::option::of(name),
        any::<u64>(),
        proptest::option::of("[ -~]{0,20}"),
        any::<bool>(),
    )
        .prop_filter_map(
            "reserved",
            |(topic, service, instance, layer, node, epoch, id, reply)| {
                Some(Common {
                    topic: topic.parse().ok()?,
                    service: service.parse().ok()?,
                    instance: instance.parse().ok()?,
                    layer: layer.and_then(|name| name.parse().ok()),
                    node: node.and_then(|name| name.parse().ok()),
                    epoch,
                    id,
                    reply_to: reply.then(|| "blaze/reply/x".parse().ok()).flatten(),
                })
            },
        );
    let quality = (
        proptest::option::of("[!-~]{1,40}"),
        "[!-~]{0,40}",
        any::<bool>(),
        1..=MAX_DEPTH,
        proptest::option::of(0..3_usize),
        any::<u32>(),
    )
        .prop_map(|(encoding, type_name, strong, depth, class, lifespan_ms)| Quality {
            encoding,
            type_name,
            type_hash: String::new(),
            reliability: if strong { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if strong { Durability::Volatile } else { Durability::TransientLocal },
            depth,
            priority: class.map(|class| Priority::ALL[class]),
            lifespan_ms,
        });
    (
        common,
        quality,
        0..=MAX_TTL_S,
        proptest::option::of(1e-6..1e6_f64),
        proptest::option::of(any::<u64>()),
        0..4_u8,
    )
        .prop_map(|(common, quality, ttl_s, rate, max_bytes, op)| match op {
            0 => ControlMessage::Advertise(AdvertiseMessage {
                common,
                ttl_s,
                rate_hz: rate,
                max_bytes,
                quality,
            }),
            1 => ControlMessage::Request(RequestMessage {
                from: OriginSelector {
                    layer: common.layer.clone(),
                    node: None,
                    service: Some(common.service.clone()),
                },
                common,
                ttl_s,
                max_rate_hz: rate,
                bare: max_bytes.is_some(),
                json: ttl_s % 2 == 1,
                quality,
            }),
            2 => ControlMessage::Withdraw(WithdrawMessage {
                common,
                kind: max_bytes.map(|_| LeaseKind::Advertise),
            }),
            _ => ControlMessage::Call(CallMessage {
                common: Common {
                    id: Some("7".to_owned()),
                    reply_to: "blaze/reply/x".parse().ok(),
                    ..common
                },
                timeout_ms: ttl_s + 1,
                request: Map::from_iter([("a".to_owned(), json!(max_bytes))]),
            }),
        })
}

proptest! {
    #[test]
    fn messages_survive_their_json(messages in proptest::collection::vec(any_message(), 1..20)) {
        let mut back = Vec::new();
        for payload in ControlMessage::to_payloads(&messages) {
            back.extend(parse_payload(&payload).unwrap().into_iter()
                .map(|object| object.message.unwrap()));
        }
        prop_assert_eq!(back, messages);
    }

    #[test]
    fn garbage_never_panics(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse_payload(&bytes);
    }

    #[test]
    fn json_like_garbage_never_panics(text in "[\\[\\]{}:,\"a-z0-9./ -]{0,200}") {
        let _ = parse_payload(text.as_bytes());
    }
}

#[test]
fn many_messages_are_spread_over_payloads_within_the_limits() {
    let message = |index: usize| {
        let topic = format!("t/{index}/{}", "x".repeat(190 - index.to_string().len()));
        let mut message = AdvertiseMessage::new(topic.parse().unwrap(), "s".parse().unwrap());
        message.quality.encoding = Some("e".repeat(200));
        ControlMessage::Advertise(message)
    };
    let messages: Vec<_> = (0..1000).map(message).collect();
    let payloads = ControlMessage::to_payloads(&messages);
    let back: Vec<_> = payloads
        .iter()
        .inspect(|payload| assert!(payload.len() <= MAX_CONTROL_BYTES))
        .flat_map(|payload| parse_payload(payload).unwrap())
        .map(|object| object.message.unwrap())
        .collect();
    assert_eq!(back, messages);
}
