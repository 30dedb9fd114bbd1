use proptest::prelude::*;

use super::*;
use crate::world::{OriginFilter, Source};
use blaze_domain::{Priority, Reliability};

fn registry(now: Instant) -> Registry {
    Registry::new(config("edge/robot-1", 1, now))
}

fn send(registry: &mut Registry, now: Instant, scope: Scope, json: &Value) -> ControlOutcome {
    registry.control(now, scope, json.to_string().as_bytes())
}

/// Sends one object and gives its answer.
fn answer(registry: &mut Registry, now: Instant, scope: Scope, mut json: Value) -> Value {
    json["id"] = json!("7");
    json["reply_to"] = json!("blaze/reply/x");
    let outcome = send(registry, now, scope, &json);
    assert_eq!(outcome.answers.len(), 1, "{json}");
    let answer = outcome.answers.into_iter().next().unwrap();
    assert_eq!(
        (answer.reply_to.as_str(), answer.id.as_deref()),
        ("blaze/reply/x", Some("7"))
    );
    assert_eq!(answer.body["id"], "7");
    assert_eq!(outcome.faults, u64::from(answer.body["ok"] == false));
    assert_eq!(outcome.events.len(), usize::from(answer.body["ok"] == false));
    answer.body
}

fn refusal(registry: &mut Registry, now: Instant, scope: Scope, json: Value) -> (String, String) {
    let body = answer(registry, now, scope, json);
    assert_eq!(body["ok"], false, "{body}");
    let part = |key: &str| body["error"][key].as_str().unwrap().to_owned();
    (part("code"), part("pointer"))
}

fn refused(code: &str, pointer: &str) -> (String, String) {
    (code.to_owned(), pointer.to_owned())
}

#[test]
fn a_lease_is_granted_renewed_and_lapses() {
    let start = Instant::now();
    let mut registry = registry(start);
    let advertise = json!({"op": "advertise", "topic": "imu", "service": "driver", "rate_hz": 50});
    let body = answer(&mut registry, start, Scope::Node, advertise.clone());
    assert_eq!(
        body,
        json!({"id": "7", "ok": true, "flow": "edge/robot-1", "lease_s": 15})
    );
    let renewed = start + Duration::from_secs(10);
    let outcome = send(&mut registry, renewed, Scope::Node, &advertise);
    assert!(outcome.changed.is_empty() && outcome.answers.is_empty());
    assert_eq!(outcome.touched, BTreeSet::from([topic("imu")]));
    assert_eq!(registry.next_expiry(), Some(renewed + Duration::from_secs(15)));
    assert_eq!(
        registry.expire(renewed + Duration::from_millis(14_999)),
        Changes::default()
    );
    let changes = registry.expire(renewed + Duration::from_secs(15));
    assert_eq!(changes.changed, BTreeSet::from([topic("imu")]));
    assert_eq!(changes.events.len(), 1);
    let event = changes.events[0].stamp(&registry.world().me, 0);
    assert_eq!(
        (event.kind, event.topic.as_str(), event.code.as_str()),
        (EventKind::LeaseExpired, "imu", "lease_expired")
    );
    assert_eq!(registry.lease_count(), 0);
    assert_eq!(registry.lapsed(&topic("imu")).count(), 1);
    assert!(registry.world().own().unwrap().topics.is_empty());
    send(&mut registry, renewed, Scope::Node, &advertise);
    assert_eq!(registry.lapsed(&topic("imu")).count(), 0);
}

#[test]
fn a_lease_without_end_stays_until_withdrawn() {
    let now = Instant::now();
    let mut registry = registry(now);
    let both = json!([
        {"op": "advertise", "topic": "imu", "service": "a", "ttl_s": 0, "id": "1", "reply_to": "blaze/reply/x"},
        {"op": "request", "topic": "imu", "service": "a", "ttl_s": 0}
    ]);
    let outcome = send(&mut registry, now, Scope::Node, &both);
    assert_eq!(outcome.answers[0].body["lease_s"], 0);
    assert_eq!(registry.next_expiry(), None);
    registry.expire(now + Duration::from_secs(1_000_000));
    assert_eq!(registry.lease_count(), 2);
    let one = json!({"op": "withdraw", "topic": "imu", "service": "a", "kind": "advertise"});
    assert_eq!(answer(&mut registry, now, Scope::Node, one)["lease_s"], 0);
    assert_eq!(
        registry.leases().map(|lease| lease.key.kind).collect::<Vec<_>>(),
        [LeaseKind::Request]
    );
    send(&mut registry, now, Scope::Node, &both);
    let withdraw = json!({"op": "withdraw", "topic": "imu", "service": "a"});
    assert_eq!(answer(&mut registry, now, Scope::Node, withdraw.clone())["ok"], true);
    assert_eq!(registry.lease_count(), 0);
    assert_eq!(answer(&mut registry, now, Scope::Node, withdraw)["ok"], true);
}

#[test]
fn the_source_must_be_where_it_is_received() {
    let now = Instant::now();
    let mut registry = registry(now);
    let object = |key: &str, value: &str| {
        let mut json = json!({"op": "advertise", "topic": "imu", "service": "a"});
        json[key] = json!(value);
        json
    };
    let table = [
        (Scope::Node, "layer", "fog", Some("/layer")),
        (Scope::Node, "layer", "edge", None),
        (Scope::Node, "node", "robot-2", Some("/node")),
        (Scope::Node, "node", "robot-1", None),
        (Scope::Layer, "layer", "fog", Some("/layer")),
        (Scope::Layer, "node", "robot-2", None),
    ];
    for (scope, key, value, pointer) in table {
        match pointer {
            Some(pointer) => {
                let found = refusal(&mut registry, now, scope, object(key, value));
                assert_eq!(found, refused("source_mismatch", pointer));
            }
            None => assert_eq!(answer(&mut registry, now, scope, object(key, value))["ok"], true),
        }
    }
    // On node scope both names mean the same lease; on layer scope an absent node is a holder of its own.
    send(
        &mut registry,
        now,
        Scope::Layer,
        &json!({"op": "advertise", "topic": "imu", "service": "a"}),
    );
    let nodes: Vec<_> = registry
        .leases()
        .map(|lease| (lease.key.scope, lease.key.node.as_ref().map(ToString::to_string)))
        .collect();
    assert_eq!(
        nodes,
        [
            (Scope::Node, Some("robot-1".into())),
            (Scope::Layer, None),
            (Scope::Layer, Some("robot-2".into()))
        ]
    );
    let array = json!([object("layer", "edge"), object("layer", "fog")]);
    let outcome = send(&mut registry, now, Scope::Node, &array);
    assert_eq!(outcome.faults, 1);
    assert!(outcome.events[0].detail.contains("/1/layer"), "{:?}", outcome.events);
}

#[test]
fn an_older_life_cannot_touch_a_live_lease() {
    let start = Instant::now();
    let mut registry = registry(start);
    let with = |op: &str, epoch: u64| json!({"op": op, "topic": "imu", "service": "a", "epoch": epoch});
    assert_eq!(
        answer(&mut registry, start, Scope::Node, with("advertise", 5))["ok"],
        true
    );
    for op in ["advertise", "withdraw"] {
        let found = refusal(&mut registry, start, Scope::Node, with(op, 4));
        assert_eq!(found, refused("stale_epoch", "/epoch"));
    }
    // Another kind is another lease; but a withdraw of both is refused whole.
    assert_eq!(
        answer(&mut registry, start, Scope::Node, with("request", 3))["ok"],
        true
    );
    assert_eq!(
        refusal(&mut registry, start, Scope::Node, with("withdraw", 4)),
        refused("stale_epoch", "/epoch")
    );
    assert_eq!(registry.lease_count(), 2);
    assert_eq!(
        answer(&mut registry, start, Scope::Node, with("advertise", 6))["ok"],
        true
    );
    registry.expire(start + Duration::from_secs(15));
    assert_eq!(
        answer(&mut registry, start, Scope::Node, with("advertise", 1))["ok"],
        true
    );
}

#[test]
fn leases_are_bounded() {
    let now = Instant::now();
    let mut registry = Registry::new(RegistryConfig {
        max_leases: 3,
        ..config("edge/robot-1", 1, now)
    });
    let object = |topic: &str| json!({"op": "advertise", "topic": topic, "service": "a"});
    for name in ["a", "b", "c"] {
        assert_eq!(answer(&mut registry, now, Scope::Node, object(name))["ok"], true);
    }
    assert_eq!(
        refusal(&mut registry, now, Scope::Node, object("d")),
        refused("too_many_leases", "")
    );
    let lapsed: Vec<LapseReason> = registry
        .lapsed(&"d".parse().unwrap())
        .map(|lease| lease.reason)
        .collect();
    assert_eq!(lapsed, [LapseReason::TooMany], "people who ask are told");
    assert_eq!(answer(&mut registry, now, Scope::Node, object("a"))["ok"], true);
    let array = json!([object("d"), {"op": "withdraw", "topic": "a", "service": "a"}, object("d")]);
    let outcome = send(&mut registry, now, Scope::Node, &array);
    assert_eq!((outcome.faults, outcome.events[0].code), (1, "too_many_leases"));
    assert_eq!(registry.lease_count(), 3);
}

/// Why leases of a topic are missing, newest first.
fn missing(registry: &Registry, name: &str) -> Vec<LapseReason> {
    registry.lapsed(&topic(name)).map(|lease| lease.reason).collect()
}

#[test]
fn what_is_refused_is_remembered_until_it_is_granted() {
    let now = Instant::now();
    let mut registry = Registry::new(RegistryConfig {
        layer_names: LayerNames::Kafka { prefix_bytes: 50 },
        ..config("edge/robot-1", 1, now)
    });
    let mut elsewhere = json!({"op": "request", "topic": "imu/data", "service": "a", "layer": "fog"});
    send(&mut registry, now, Scope::Node, &elsewhere);
    assert_eq!(missing(&registry, "imu/data"), [LapseReason::SourceMismatch]);
    elsewhere["layer"] = json!("edge");
    send(&mut registry, now, Scope::Node, &elsewhere);
    assert_eq!(missing(&registry, "imu/data"), [], "it has said where it is");

    let advertise = |topic: &str| json!({"op": "advertise", "topic": topic, "service": "a"});
    let long = "t".repeat(200);
    for (name, reason, fact) in [
        ("imu_data", LapseReason::NameCollision, "imu/data"),
        (long.as_str(), LapseReason::NameNotExpressible, "250 bytes"),
    ] {
        send(&mut registry, now, Scope::Layer, &advertise("imu/data"));
        send(&mut registry, now, Scope::Layer, &advertise(name));
        assert_eq!(missing(&registry, name), [reason]);
        let refused = registry.lapsed(&topic(name)).next().cloned().unwrap();
        assert!(refused.detail.contains(fact), "{refused:?}");
    }
}

#[test]
fn what_is_the_matter_now_comes_before_what_was() {
    let start = Instant::now();
    let mut registry = Registry::new(RegistryConfig {
        max_leases: 1,
        ..config("edge/robot-1", 1, start)
    });
    let advertise = |topic: &str, service: &str| json!({"op": "advertise", "topic": topic, "service": service});
    send(&mut registry, start, Scope::Node, &advertise("imu", "old"));
    let later = start + Duration::from_secs(15);
    registry.expire(later);
    send(&mut registry, later, Scope::Node, &advertise("odom", "other"));
    send(&mut registry, later, Scope::Node, &advertise("imu", "new"));
    assert_eq!(missing(&registry, "imu"), [LapseReason::TooMany, LapseReason::Expired]);
}

#[test]
fn answers_go_only_to_those_who_ask() {
    let now = Instant::now();
    let mut registry = registry(now);
    let outcome = send(
        &mut registry,
        now,
        Scope::Node,
        &json!([
            {"op": "advertise", "topic": "a", "service": "a"},
            {"op": "fly", "topic": "b", "service": "a"},
            {"op": "request", "topic": "blaze/x", "service": "a", "id": "2", "reply_to": "blaze/reply/x"},
            {"op": "request", "topic": "c", "service": "a", "id": "3", "reply_to": "elsewhere"},
            {"op": "request", "topic": "d", "service": "a", "reply_to": "blaze/reply/y"},
        ]),
    );
    let answers: Vec<_> = outcome
        .answers
        .iter()
        .map(|answer| (answer.reply_to.as_str(), answer.body.to_string()))
        .collect();
    assert_eq!(answers.len(), 2);
    assert_eq!(answers[0].0, "blaze/reply/x");
    assert!(
        answers[0]
            .1
            .starts_with(r#"{"id":"2","ok":false,"error":{"code":"reserved_topic","pointer":"/2/topic","detail":"#),
        "{answers:?}"
    );
    assert_eq!(
        answers[1],
        (
            "blaze/reply/y",
            r#"{"ok":true,"flow":"edge/robot-1","lease_s":15}"#.to_owned()
        )
    );
    let codes: Vec<_> = outcome.events.iter().map(|event| event.code).collect();
    assert_eq!(codes, ["unknown_op", "reserved_topic", "invalid_value"]);
    assert_eq!(outcome.events[0].topic, Some(topic("b")));
    assert_eq!(outcome.faults, 3);
    // A payload that cannot be read is an event and a count.
    let outcome = registry.control(now, Scope::Node, b"{");
    assert_eq!((outcome.faults, outcome.events.len(), outcome.answers.len()), (1, 1, 0));
    assert_eq!(outcome.events[0].event, EventKind::LeaseRefused);
    assert_eq!(outcome.events[0].code, "invalid_json");
}

#[test]
fn where_answers_share_a_channel_an_id_is_required() {
    let now = Instant::now();
    let mut registry = registry(now);
    let object = json!({"op": "advertise", "topic": "a", "service": "a", "reply_to": "blaze/reply/x"});
    let outcome = send(&mut registry, now, Scope::Layer, &object);
    assert_eq!(outcome.answers[0].body["error"]["pointer"], "/id");
    assert_eq!(registry.lease_count(), 0);
    assert_eq!(send(&mut registry, now, Scope::Node, &object).faults, 0);
    let mut registry = Registry::new(RegistryConfig {
        layer_answers_need_id: false,
        ..config("edge/robot-1", 1, now)
    });
    assert_eq!(send(&mut registry, now, Scope::Layer, &object).faults, 0);
}

#[test]
fn one_of_several_replicas_answers() {
    let now = Instant::now();
    let mut replicas: Vec<Registry> = ["cloud/a", "cloud/b", "cloud/c"]
        .iter()
        .map(|me| Registry::new(config(me, 1, now)))
        .collect();
    let hellos: Vec<_> = replicas
        .iter()
        .map(|replica| (replica.world().me.clone(), hello(replica)))
        .collect();
    for replica in &mut replicas {
        replica.set_state(FlowState::Ready);
        for (from, hello) in &hellos {
            replica.on_hello(now, from, hello);
        }
    }
    let mut answered = [0; 3];
    for id in 0..60 {
        let object =
            json!({"op": "request", "topic": "a", "service": "s", "id": id.to_string(), "reply_to": "blaze/reply/x"});
        let mine: Vec<bool> = replicas
            .iter_mut()
            .map(|replica| send(replica, now, Scope::Layer, &object).answers[0].designated)
            .collect();
        assert_eq!(mine.iter().filter(|mine| **mine).count(), 1, "{id}");
        answered
            .iter_mut()
            .zip(&mine)
            .for_each(|(count, mine)| *count += u32::from(*mine));
        let local = send(&mut replicas[0], now, Scope::Node, &object);
        assert!(local.answers[0].designated);
    }
    assert!(answered.iter().all(|count| *count > 5), "{answered:?}");
}

/// The sum of two such rates is no number any more, and nothing would be left for others.
#[test]
fn what_nobody_can_publish_counts_as_the_most_that_one_can() {
    let now = Instant::now();
    let mut registry = registry(now);
    send(
        &mut registry,
        now,
        Scope::Node,
        &json!([
            {"op": "advertise", "topic": "t", "service": "a", "rate_hz": 1.7e308, "max_bytes": u64::MAX},
            {"op": "advertise", "topic": "t", "service": "b", "rate_hz": 1.7e308, "max_bytes": 1},
        ]),
    );
    let entry = registry.world().own().unwrap().topics[&topic("t")].clone();
    let advertise = entry.node.advertise.unwrap();
    assert_eq!((advertise.rate_hz, advertise.max_bytes), (Some(2e6), Some(16 << 20)));
}

#[test]
fn services_of_one_scope_are_merged() {
    let now = Instant::now();
    let mut registry = registry(now);
    let changed = send(&mut registry, now, Scope::Node, &json!([
        {"op": "advertise", "topic": "t", "service": "b", "rate_hz": 10, "max_bytes": 100, "lifespan_ms": 100, "type": "x/T"},
        {"op": "advertise", "topic": "t", "service": "a", "rate_hz": 5, "max_bytes": 300, "reliability": "reliable",
         "priority": "bulk", "lifespan_ms": 700, "depth": 4, "encoding": "application/json"},
        {"op": "advertise", "topic": "t", "service": "c", "priority": "state", "rate_hz": 1, "max_bytes": 1, "type": "x/T", "type_hash": "h"},
        {"op": "request", "topic": "t", "service": "d", "max_rate_hz": 10, "lifespan_ms": 10, "priority": "bulk", "from": {"node": "n1"}},
        {"op": "request", "topic": "t", "service": "e", "max_rate_hz": 20, "lifespan_ms": 30, "priority": "state", "bare": true,
         "from": {"layer": "fog", "service": "s"}},
    ]))
    .changed;
    assert_eq!(changed, BTreeSet::from([topic("t")]));
    let entry = registry.world().own().unwrap().topics[&topic("t")].clone();
    let source = |service: &str| Source {
        node: "robot-1".into(),
        service: service.into(),
    };
    let advertise = entry.node.advertise.unwrap();
    assert_eq!(advertise.sources, [source("a"), source("b"), source("c")]);
    assert_eq!(
        (advertise.rate_hz, advertise.max_bytes, advertise.depth),
        (Some(16.0), Some(300), 4)
    );
    assert_eq!(
        (advertise.type_name.as_str(), advertise.type_hash.as_str()),
        ("x/T", "h")
    );
    assert_eq!(
        (advertise.priority, advertise.reliability),
        (Some(Priority::State), Reliability::Reliable)
    );
    // The third gives no lifespan: its messages never become worthless.
    assert_eq!(
        (advertise.lifespan_ms, advertise.encoding.as_str()),
        (0, "application/json")
    );
    let request = entry.node.request.unwrap();
    assert_eq!((request.max_rate_hz, request.lifespan_ms), (Some(20.0), 30));
    assert_eq!(
        (request.framed, request.bare, request.priority),
        (true, true, Some(Priority::State))
    );
    let filter = |layer: Option<&str>, node: Option<&str>, service: Option<&str>| OriginFilter {
        layer: layer.map(Into::into),
        node: node.map(Into::into),
        service: service.map(Into::into),
    };
    assert_eq!(
        request.from,
        [filter(None, Some("n1"), None), filter(Some("fog"), None, Some("s"))]
    );
    assert_eq!((entry.layer.advertise, entry.layer.request), (None, None));
    // One who wants all of it, as published and without limits, outweighs the others.
    send(
        &mut registry,
        now,
        Scope::Node,
        &json!([
            {"op": "request", "topic": "t", "service": "f"}, {"op": "advertise", "topic": "t", "service": "d"},
        ]),
    );
    let entry = registry.world().own().unwrap().topics[&topic("t")].clone();
    let request = entry.node.request.unwrap();
    assert_eq!(
        (request.max_rate_hz, request.lifespan_ms, request.priority),
        (None, 0, None)
    );
    assert!(request.from.is_empty());
    let advertise = entry.node.advertise.unwrap();
    assert_eq!((advertise.rate_hz, advertise.max_bytes), (None, None));
}

#[derive(Debug, Clone)]
enum Step {
    Send { scope: Scope, payload: Vec<u8> },
    Wait { ms: u64 },
}

fn any_step() -> impl Strategy<Value = Step> {
    let scope = prop_oneof![Just(Scope::Node), Just(Scope::Layer)];
    let object = (
        0..3_usize,
        0..6_u8,
        0..4_u8,
        0..4_u64,
        0..3_u32,
        any::<bool>(),
        0..20_u8,
    )
        .prop_map(|(op, topic, service, epoch, ttl, layer, oddity)| {
            let op = ["advertise", "request", "withdraw"][op];
            let mut json = json!({"op": op, "topic": format!("t{topic}"), "service": format!("s{service}"),
                                  "epoch": epoch, "ttl_s": ttl});
            match oddity {
                0 => json["node"] = json!("elsewhere"),
                1 => json["topic"] = json!("blaze/x"),
                2 => json["ttl_s"] = json!("x"),
                3 => json["reply_to"] = json!("blaze/reply/x"),
                4 if layer => json["layer"] = json!("fog"),
                _ => {}
            }
            json
        });
    prop_oneof![
        4 => (scope.clone(), proptest::collection::vec(object, 1..8))
            .prop_map(|(scope, objects)| Step::Send { scope, payload: Value::from(objects).to_string().into_bytes() }),
        1 => (scope, proptest::collection::vec(any::<u8>(), 0..80)).prop_map(|(scope, payload)| Step::Send { scope, payload }),
        2 => (0..1500_u64).prop_map(|ms| Step::Wait { ms }),
    ]
}

proptest! {
    #[test]
    fn any_sequence_keeps_the_bounds_and_the_world(steps in proptest::collection::vec(any_step(), 1..40)) {
        let start = Instant::now();
        let mut now = start;
        let mut registry = Registry::new(RegistryConfig { max_leases: 12, ..config("edge/robot-1", 1, start) });
        for step in steps {
            match step {
                Step::Send { scope, payload } => {
                    let outcome = registry.control(now, scope, &payload);
                    prop_assert_eq!(outcome.faults, outcome.events.len() as u64);
                }
                Step::Wait { ms } => {
                    now += Duration::from_millis(ms);
                    registry.expire(now);
                    prop_assert!(registry.next_expiry().is_none_or(|at| at > now));
                }
            }
            prop_assert!(registry.lease_count() <= 12);
            prop_assert_eq!(registry.leases().count(), registry.lease_count());
            let leased: BTreeSet<_> = registry.leases().map(|lease| lease.topic.clone()).collect();
            let world: BTreeSet<_> = registry.world().own().unwrap().topics.keys().cloned().collect();
            prop_assert_eq!(leased, world);
        }
    }
}

#[test]
fn ten_thousand_leases_of_one_topic_are_taken() {
    let now = Instant::now();
    let mut registry = registry(now);
    let messages: Vec<_> = (0..10_001)
        .map(|index| {
            let mut message = RequestMessage::new(topic("t"), format!("s{index}").parse().unwrap());
            message.from.node = format!("n{index}").parse().ok();
            ControlMessage::Request(message)
        })
        .collect();
    let mut faults = 0;
    for payload in ControlMessage::to_payloads(&messages) {
        faults += registry.control(now, Scope::Node, &payload).faults;
    }
    assert_eq!((registry.lease_count(), faults), (10_000, 1));
    // More filters than an entry holds: everything is asked for.
    let entry = &registry.world().own().unwrap().topics[&topic("t")];
    assert!(entry.node.request.as_ref().unwrap().from.is_empty());
    assert_eq!(registry.expire(now + Duration::from_secs(15)).events.len(), 10_000);
    assert_eq!(registry.lease_count(), 0);
}
