use proptest::prelude::*;

use super::*;
use crate::world::{OriginFilter, Source, TopicEntry};
use blaze_domain::{Priority, Reliability};

/// A registry that services of a node and of its layer write to.
struct Desk {
    registry: Registry,
    now: Instant,
}

impl Desk {
    fn new() -> Self {
        Self::with(|config| config)
    }

    fn with(change: impl FnOnce(RegistryConfig) -> RegistryConfig) -> Self {
        let now = Instant::now();
        let registry = Registry::new(change(config("edge/robot-1", 1, now)));
        Self { registry, now }
    }

    fn wait(&mut self, ms: u64) -> Changes {
        self.now += Duration::from_millis(ms);
        self.registry.expire(self.now)
    }

    fn send(&mut self, scope: Scope, json: &Value) -> ControlOutcome {
        self.registry.control(self.now, scope, json.to_string().as_bytes())
    }

    fn node(&mut self, json: &Value) -> ControlOutcome {
        self.send(Scope::Node, json)
    }

    /// Sends one object and gives its answer.
    fn answer(&mut self, scope: Scope, json: &Value) -> Value {
        let mut json = json.clone();
        json["id"] = json!("7");
        json["reply_to"] = json!("blaze/reply/x");
        let mut outcome = self.send(scope, &json);
        assert_eq!(outcome.answers.len(), 1, "{json}");
        let answer = outcome.answers.remove(0);
        let (to, id) = (answer.reply_to.as_str(), answer.id.as_deref());
        assert_eq!((to, id, &answer.body["id"]), ("blaze/reply/x", Some("7"), &json!("7")));
        let refused = answer.body["ok"] == false;
        assert_eq!(
            (outcome.faults, outcome.events.len()),
            (u64::from(refused), usize::from(refused))
        );
        answer.body
    }

    /// What one object on the node's scope is answered: `ok`, or what is wrong and where.
    fn says(&mut self, json: &Value) -> String {
        self.says_on(Scope::Node, json)
    }

    fn says_on(&mut self, scope: Scope, json: &Value) -> String {
        let body = self.answer(scope, json);
        if body["ok"] == true {
            return "ok".to_owned();
        }
        let part = |key: &str| body["error"][key].as_str().unwrap().to_owned();
        format!("{} {}", part("code"), part("pointer"))
    }

    /// Why leases of a topic are missing, newest first.
    fn missing(&self, name: &str) -> Vec<LapseReason> {
        self.registry.lapsed(&topic(name)).map(|lease| lease.reason).collect()
    }

    /// What this flow has of the topic `t`.
    fn entry(&self) -> TopicEntry {
        self.registry.world().own().unwrap().topics[&topic("t")].clone()
    }
}

/// One service's object for a topic.
fn object(op: &str, topic: &str, service: &str) -> Value {
    json!({"op": op, "topic": topic, "service": service})
}

#[test]
fn a_lease_is_granted_renewed_and_lapses() {
    let mut desk = Desk::new();
    let advertise = json!({"op": "advertise", "topic": "imu", "service": "driver", "rate_hz": 50});
    let body = desk.answer(Scope::Node, &advertise);
    assert_eq!(body, json!({"id": "7", "ok": true, "flow": "edge/robot-1", "lease_s": 15}));
    desk.wait(10_000);
    let renewed = desk.now;
    let outcome = desk.node(&advertise);
    assert!(outcome.changed.is_empty() && outcome.answers.is_empty());
    assert_eq!(outcome.touched, BTreeSet::from([topic("imu")]));
    assert_eq!(desk.registry.next_expiry(), Some(renewed + Duration::from_secs(15)));
    assert_eq!(desk.wait(14_999), Changes::default());
    let changes = desk.wait(1);
    assert_eq!(changes.changed, BTreeSet::from([topic("imu")]));
    assert_eq!(changes.events.len(), 1);
    let event = changes.events[0].stamp(&desk.registry.world().me, 0);
    assert_eq!(
        (event.kind, event.topic.as_str(), event.code.as_str()),
        (EventKind::LeaseExpired, "imu", "lease_expired")
    );
    assert_eq!(desk.registry.lease_count(), 0);
    assert_eq!(desk.missing("imu").len(), 1);
    assert!(desk.registry.world().own().unwrap().topics.is_empty());
    desk.node(&advertise);
    assert_eq!(desk.missing("imu").len(), 0);
}

#[test]
fn a_lease_without_end_stays_until_withdrawn() {
    let mut desk = Desk::new();
    let both = json!([
        {
            "op": "advertise",
            "topic": "imu",
            "service": "a",
            "ttl_s": 0,
            "id": "1",
            "reply_to": "blaze/reply/x",
        },
        {"op": "request", "topic": "imu", "service": "a", "ttl_s": 0}
    ]);
    assert_eq!(desk.node(&both).answers[0].body["lease_s"], 0);
    assert_eq!(desk.registry.next_expiry(), None);
    desk.wait(1_000_000_000);
    assert_eq!(desk.registry.lease_count(), 2);
    let one = json!({"op": "withdraw", "topic": "imu", "service": "a", "kind": "advertise"});
    assert_eq!(desk.answer(Scope::Node, &one)["lease_s"], 0);
    let left: Vec<_> = desk.registry.leases().map(|lease| lease.key.kind).collect();
    assert_eq!(left, [LeaseKind::Request]);
    desk.node(&both);
    assert_eq!(desk.says(&object("withdraw", "imu", "a")), "ok");
    assert_eq!(desk.registry.lease_count(), 0);
    assert_eq!(desk.says(&object("withdraw", "imu", "a")), "ok");
}

#[test]
fn the_source_must_be_where_it_is_received() {
    let mut desk = Desk::new();
    let from = |key: &str, value: &str| {
        let mut json = object("advertise", "imu", "a");
        json[key] = json!(value);
        json
    };
    for (scope, key, value, says) in [
        (Scope::Node, "layer", "fog", "source_mismatch /layer"),
        (Scope::Node, "layer", "edge", "ok"),
        (Scope::Node, "node", "robot-2", "source_mismatch /node"),
        (Scope::Node, "node", "robot-1", "ok"),
        (Scope::Layer, "layer", "fog", "source_mismatch /layer"),
        (Scope::Layer, "node", "robot-2", "ok"),
    ] {
        assert_eq!(desk.says_on(scope, &from(key, value)), says);
    }
    // On node scope both names mean the same lease; on layer scope an absent node is a holder of
    // its own.
    desk.send(Scope::Layer, &object("advertise", "imu", "a"));
    let leases = desk.registry.leases();
    let nodes: Vec<_> = leases
        .map(|lease| (lease.key.scope, lease.key.node.as_ref().map(ToString::to_string)))
        .collect();
    let (first, second) = (Some("robot-1".to_owned()), Some("robot-2".to_owned()));
    assert_eq!(nodes, [(Scope::Node, first), (Scope::Layer, None), (Scope::Layer, second)]);
    let outcome = desk.node(&json!([from("layer", "edge"), from("layer", "fog")]));
    assert_eq!(outcome.faults, 1);
    assert!(outcome.events[0].detail.contains("/1/layer"), "{:?}", outcome.events);
}

#[test]
fn an_older_life_cannot_touch_a_live_lease() {
    let mut desk = Desk::new();
    let with =
        |op: &str, epoch: u64| json!({"op": op, "topic": "imu", "service": "a", "epoch": epoch});
    for (op, epoch, says) in [
        ("advertise", 5, "ok"),
        ("advertise", 4, "stale_epoch /epoch"),
        ("withdraw", 4, "stale_epoch /epoch"),
        // Another kind is another lease; but a withdraw of both is refused whole.
        ("request", 3, "ok"),
        ("withdraw", 4, "stale_epoch /epoch"),
        ("advertise", 6, "ok"),
    ] {
        assert_eq!(desk.says(&with(op, epoch)), says, "{op} {epoch}");
    }
    assert_eq!(desk.registry.lease_count(), 2);
    desk.wait(15_000);
    assert_eq!(desk.says(&with("advertise", 1)), "ok");
}

#[test]
fn leases_are_bounded() {
    let mut desk = Desk::with(|config| RegistryConfig { max_leases: 3, ..config });
    let advertise = |topic: &str| object("advertise", topic, "a");
    for name in ["a", "b", "c"] {
        assert_eq!(desk.says(&advertise(name)), "ok");
    }
    assert_eq!(desk.says(&advertise("d")), "too_many_leases ");
    assert_eq!(desk.missing("d"), [LapseReason::TooMany], "people who ask are told");
    assert_eq!(desk.says(&advertise("a")), "ok");
    let outcome = desk.node(&json!([advertise("d"), object("withdraw", "a", "a"), advertise("d")]));
    assert_eq!((outcome.faults, outcome.events[0].code), (1, "too_many_leases"));
    assert_eq!(desk.registry.lease_count(), 3);
}

#[test]
fn what_is_refused_is_remembered_until_it_is_granted() {
    let layer_names = LayerNames::Kafka { prefix: "p".repeat(50) };
    let mut desk = Desk::with(|config| RegistryConfig { layer_names, ..config });
    let mut elsewhere =
        json!({"op": "request", "topic": "imu/data", "service": "a", "layer": "fog"});
    desk.node(&elsewhere);
    assert_eq!(desk.missing("imu/data"), [LapseReason::SourceMismatch]);
    elsewhere["layer"] = json!("edge");
    desk.node(&elsewhere);
    assert_eq!(desk.missing("imu/data"), [], "it has said where it is");

    let long = "t".repeat(200);
    for (name, reason, fact) in [
        ("imu_data", LapseReason::NameCollision, "imu/data"),
        (long.as_str(), LapseReason::NameNotExpressible, "250 bytes"),
    ] {
        desk.send(Scope::Layer, &object("advertise", "imu/data", "a"));
        desk.send(Scope::Layer, &object("advertise", name, "a"));
        assert_eq!(desk.missing(name), [reason]);
        let refused = desk.registry.lapsed(&topic(name)).next().cloned().unwrap();
        assert!(refused.detail.contains(fact), "{refused:?}");
    }
}

#[test]
fn what_is_the_matter_now_comes_before_what_was() {
    let mut desk = Desk::with(|config| RegistryConfig { max_leases: 1, ..config });
    desk.node(&object("advertise", "imu", "old"));
    desk.wait(15_000);
    desk.node(&object("advertise", "odom", "other"));
    desk.node(&object("advertise", "imu", "new"));
    assert_eq!(desk.missing("imu"), [LapseReason::TooMany, LapseReason::Expired]);
}

#[test]
fn answers_go_only_to_those_who_ask() {
    let mut desk = Desk::new();
    let outcome = desk.node(&json!([
        {"op": "advertise", "topic": "a", "service": "a"},
        {"op": "fly", "topic": "b", "service": "a"},
        {
            "op": "request",
            "topic": "blaze/x",
            "service": "a",
            "id": "2",
            "reply_to": "blaze/reply/x",
        },
        {"op": "request", "topic": "c", "service": "a", "id": "3", "reply_to": "elsewhere"},
        {"op": "request", "topic": "d", "service": "a", "reply_to": "blaze/reply/y"},
    ]));
    let said = |answer: &AnswerOut| (answer.reply_to.to_string(), answer.body.to_string());
    let [first, second]: [_; 2] =
        outcome.answers.iter().map(said).collect::<Vec<_>>().try_into().unwrap();
    let begin =
        r#"{"id":"2","ok":false,"error":{"code":"reserved_topic","pointer":"/2/topic","detail":"#;
    assert!(first.0 == "blaze/reply/x" && first.1.starts_with(begin), "{first:?}");
    let granted = r#"{"ok":true,"flow":"edge/robot-1","lease_s":15}"#;
    assert_eq!(second, ("blaze/reply/y".to_owned(), granted.to_owned()));
    let codes: Vec<_> = outcome.events.iter().map(|event| event.code).collect();
    assert_eq!(codes, ["unknown_op", "reserved_topic", "invalid_value"]);
    assert_eq!(outcome.events[0].topic, Some(topic("b")));
    assert_eq!(outcome.faults, 3);
    // A payload that cannot be read is an event and a count.
    let outcome = desk.registry.control(desk.now, Scope::Node, b"{");
    assert_eq!((outcome.faults, outcome.events.len(), outcome.answers.len()), (1, 1, 0));
    assert_eq!(outcome.events[0].event, EventKind::LeaseRefused);
    assert_eq!(outcome.events[0].code, "invalid_json");
}

#[test]
fn where_answers_share_a_channel_an_id_is_required() {
    let mut desk = Desk::new();
    let object =
        json!({"op": "advertise", "topic": "a", "service": "a", "reply_to": "blaze/reply/x"});
    let outcome = desk.send(Scope::Layer, &object);
    assert_eq!(outcome.answers[0].body["error"]["pointer"], "/id");
    assert_eq!(desk.registry.lease_count(), 0);
    assert_eq!(desk.node(&object).faults, 0);
    let layer_answers_need_id = false;
    let mut desk = Desk::with(|config| RegistryConfig { layer_answers_need_id, ..config });
    assert_eq!(desk.send(Scope::Layer, &object).faults, 0);
}

#[test]
fn one_of_several_replicas_answers() {
    let mut desks = ["cloud/a", "cloud/b", "cloud/c"]
        .map(|me| Desk::with(|other| config(me, 1, other.started)));
    let hellos =
        desks.each_ref().map(|desk| (desk.registry.world().me.clone(), hello(&desk.registry)));
    for desk in &mut desks {
        desk.registry.set_state(FlowState::Ready);
        for (from, hello) in &hellos {
            desk.registry.on_hello(desk.now, from, hello);
        }
    }
    let mut answered = [0; 3];
    for id in 0..60 {
        let mut json = object("request", "a", "s");
        (json["id"], json["reply_to"]) = (json!(id.to_string()), json!("blaze/reply/x"));
        let mine =
            desks.each_mut().map(|desk| desk.send(Scope::Layer, &json).answers[0].designated);
        assert_eq!(mine.iter().filter(|mine| **mine).count(), 1, "{id}");
        let all = answered.iter_mut().zip(mine);
        all.for_each(|(count, mine)| *count += u32::from(mine));
        assert!(desks[0].node(&json).answers[0].designated);
    }
    assert!(answered.iter().all(|count| *count > 5), "{answered:?}");
}

/// The sum of two such rates is no number any more, and nothing would be left for others.
#[test]
fn what_nobody_can_publish_counts_as_the_most_that_one_can() {
    let mut desk = Desk::new();
    desk.node(&json!([
        {
            "op": "advertise",
            "topic": "t",
            "service": "a",
            "rate_hz": 1.7e308,
            "max_bytes": u64::MAX,
        },
        {"op": "advertise", "topic": "t", "service": "b", "rate_hz": 1.7e308, "max_bytes": 1},
    ]));
    let advertise = desk.entry().node.advertise.unwrap();
    assert_eq!((advertise.rate_hz, advertise.max_bytes), (Some(2e6), Some(16 << 20)));
}

#[test]
fn services_of_one_scope_are_merged() {
    let mut desk = Desk::new();
    let outcome = desk.node(&json!([
        {
            "op": "advertise",
            "topic": "t",
            "service": "b",
            "rate_hz": 10,
            "max_bytes": 100,
            "lifespan_ms": 100,
            "type": "x/T",
        },
        {"op": "advertise", "topic": "t", "service": "a", "rate_hz": 5, "max_bytes": 300,
            "reliability": "reliable",
         "priority": "bulk", "lifespan_ms": 700, "depth": 4, "encoding": "application/json"},
        {
            "op": "advertise",
            "topic": "t",
            "service": "c",
            "priority": "state",
            "rate_hz": 1,
            "max_bytes": 1,
            "type": "x/T",
            "type_hash": "h",
        },
        {
            "op": "request",
            "topic": "t",
            "service": "d",
            "max_rate_hz": 10,
            "lifespan_ms": 10,
            "priority": "bulk",
            "from": {"node": "n1"},
        },
        {"op": "request", "topic": "t", "service": "e", "max_rate_hz": 20, "lifespan_ms": 30,
            "priority": "state", "bare": true,
         "from": {"layer": "fog", "service": "s"}},
    ]));
    assert_eq!(outcome.changed, BTreeSet::from([topic("t")]));
    let entry = desk.entry();
    let source = |service: &str| Source { node: "robot-1".into(), service: service.into() };
    let advertise = entry.node.advertise.unwrap();
    assert_eq!(advertise.sources, [source("a"), source("b"), source("c")]);
    assert_eq!(
        (advertise.rate_hz, advertise.max_bytes, advertise.depth),
        (Some(16.0), Some(300), 4)
    );
    assert_eq!((advertise.type_name.as_str(), advertise.type_hash.as_str()), ("x/T", "h"));
    assert_eq!(
        (advertise.priority, advertise.reliability),
        (Some(Priority::State), Reliability::Reliable)
    );
    // The third gives no lifespan: its messages never become worthless.
    assert_eq!((advertise.lifespan_ms, advertise.encoding.as_str()), (0, "application/json"));
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
    desk.node(&json!([object("request", "t", "f"), object("advertise", "t", "d")]));
    let entry = desk.entry();
    let request = entry.node.request.unwrap();
    assert_eq!((request.max_rate_hz, request.lifespan_ms), (None, 0));
    assert!(request.priority.is_none() && request.from.is_empty());
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
            let mut json =
                json!({"op": op, "topic": format!("t{topic}"), "service": format!("s{service}"),
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
            .prop_map(|(scope, objects)| Step::Send { scope,
                payload: Value::from(objects).to_string().into_bytes() }),
        1 => (scope, proptest::collection::vec(any::<u8>(), 0..80))
            .prop_map(|(scope, payload)| Step::Send { scope, payload }),
        2 => (0..1500_u64).prop_map(|ms| Step::Wait { ms }),
    ]
}

proptest! {
    #[test]
    fn any_sequence_keeps_the_bounds_and_the_world(steps in proptest::collection::vec(any_step(),
        1..40)) {
        let start = Instant::now();
        let mut now = start;
        let mut registry =
            Registry::new(RegistryConfig { max_leases: 12, ..config("edge/robot-1", 1, start) });
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
            let world: BTreeSet<_> =
                registry.world().own().unwrap().topics.keys().cloned().collect();
            prop_assert_eq!(leased, world);
        }
    }
}

#[test]
fn ten_thousand_leases_of_one_topic_are_taken() {
    let mut desk = Desk::new();
    let messages: Vec<_> = (0..10_001)
        .map(|index| {
            let mut message = RequestMessage::new(topic("t"), format!("s{index}").parse().unwrap());
            message.from.node = format!("n{index}").parse().ok();
            ControlMessage::Request(message)
        })
        .collect();
    let mut faults = 0;
    for payload in ControlMessage::to_payloads(&messages) {
        faults += desk.registry.control(desk.now, Scope::Node, &payload).faults;
    }
    assert_eq!((desk.registry.lease_count(), faults), (10_000, 1));
    // More filters than an entry holds: everything is asked for.
    assert!(desk.entry().node.request.unwrap().from.is_empty());
    assert_eq!(desk.wait(15_000).events.len(), 10_000);
    assert_eq!(desk.registry.lease_count(), 0);
}

#[test]
fn a_request_says_in_which_forms_it_is_served() {
    for (scope, bare, json, served) in [
        (Scope::Node, false, false, (true, false, false)),
        (Scope::Node, true, false, (false, true, false)),
        (Scope::Node, false, true, (false, false, true)),
        (Scope::Node, true, true, (false, true, true)),
        // A layer scope has no bare copies: those get messages with a header.
        (Scope::Layer, true, false, (true, true, false)),
        (Scope::Layer, false, true, (false, false, true)),
        (Scope::Layer, true, true, (true, true, true)),
    ] {
        let now = Instant::now();
        let mut registry = Registry::new(config("edge/robot-1", 1, now));
        let mut ask = lease("request", "odom", "a");
        (ask["bare"], ask["json"]) = (bare.into(), json.into());
        assert_eq!(say(&mut registry, now, scope, &ask).faults, 0);
        let entry = &registry.world().own().unwrap().topics[&topic("odom")];
        let entry = if scope == Scope::Node { &entry.node } else { &entry.layer };
        let request = entry.request.as_ref().unwrap();
        assert_eq!((request.framed, request.bare, request.json), served, "{scope} {bare} {json}");
    }
}
