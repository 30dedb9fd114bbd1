//! Leases that brokers keep, names of the layer broker, and scopes that are another flow's.

use proptest::prelude::*;

use super::*;
use bytes::Bytes;

type Kept = BTreeMap<(Scope, String), Bytes>;

fn keeping(me: &str, now: Instant) -> Registry {
    Registry::new(RegistryConfig {
        lease_stores: BTreeSet::from([Scope::Node, Scope::Layer]),
        layer_answers_need_id: false,
        ..config(me, 1, now)
    })
}

/// Does what brokers would do. Returns how many changes there were.
fn save(registry: &mut Registry, kept: &mut Kept) -> usize {
    let unsaved = registry.take_unsaved();
    let count = unsaved.len();
    for lease in unsaved {
        match lease.value {
            Some(value) => kept.insert((lease.scope, lease.key), value),
            None => kept.remove(&(lease.scope, lease.key)),
        };
    }
    count
}

fn of_scope(kept: &Kept, scope: Scope) -> Vec<(String, Bytes)> {
    let of_scope = kept.iter().filter(|((s, _), _)| *s == scope);
    of_scope.map(|((_, key), value)| (key.clone(), value.clone())).collect()
}

fn send(registry: &mut Registry, now: Instant, scope: Scope, json: &Value) -> ControlOutcome {
    registry.control(now, scope, json.to_string().as_bytes())
}

fn restore_all(registry: &mut Registry, now: Instant, kept: &Kept) -> [Restored; 2] {
    [Scope::Node, Scope::Layer].map(|scope| registry.restore(now, scope, &of_scope(kept, scope)))
}

/// What a lease is, without its time.
fn terms(registry: &Registry) -> Vec<String> {
    let text = |lease: LeaseView<'_>| {
        format!(
            "{:?} {:?} {} {} {:?}",
            lease.topic, lease.key, lease.epoch, lease.ttl_s, lease.terms
        )
    };
    registry.leases().map(text).collect()
}

#[test]
fn leases_survive_a_restart_of_the_flow_with_their_whole_ttl() {
    let start = Instant::now();
    let mut kept = Kept::new();
    let mut first = keeping("edge/robot-1", start);
    restore_all(&mut first, start, &kept);
    send(
        &mut first,
        start,
        Scope::Node,
        &json!([
            {"op": "advertise", "topic": "imu/data", "service": "driver", "epoch": 7, "rate_hz": 50.5, "max_bytes": 400,
             "encoding": "application/json", "reliability": "reliable", "durability": "transient_local", "depth": 3,
             "priority": "control", "lifespan_ms": 900, "type": "x/T", "type_hash": "h"},
            {"op": "request", "topic": "map", "service": "driver", "ttl_s": 0, "bare": true, "max_rate_hz": 2.5,
             "from": {"layer": "fog", "service": "mapper"}},
        ]),
    );
    send(
        &mut first,
        start,
        Scope::Layer,
        &json!({"op": "request", "topic": "imu/data", "service": "logger", "ttl_s": 60}),
    );
    assert_eq!(save(&mut first, &mut kept), 3);
    assert_eq!(
        kept.keys().map(|(_, key)| key.as_str()).collect::<Vec<_>>(),
        [
            "advertise|imu/data|edge|robot-1|driver|0",
            "request|map|edge|robot-1|driver|0",
            "request|imu/data|edge||logger|0"
        ]
    );

    let later = start + Duration::from_secs(1000);
    let mut second = keeping("edge/robot-1", later);
    assert!(second.is_reading(Scope::Node));
    let [node, layer] = restore_all(&mut second, later, &kept);
    assert_eq!((node.restored, layer.restored), (2, 1));
    assert_eq!(node.changed, BTreeSet::from([topic("imu/data"), topic("map")]));
    assert!(!second.is_reading(Scope::Node) && !second.is_reading(Scope::Layer));
    assert_eq!(terms(&second), terms(&first));
    assert_eq!(second.next_expiry(), Some(later + Duration::from_secs(15)));
    assert_eq!(save(&mut second, &mut kept), 0, "what was read is not written again");
    assert_eq!(
        second.world().own().unwrap().topics,
        first.world().own().unwrap().topics
    );
}

#[test]
fn only_what_changes_is_written() {
    let now = Instant::now();
    let mut kept = Kept::new();
    let mut registry = keeping("edge/robot-1", now);
    restore_all(&mut registry, now, &kept);
    let with = |epoch: u64, rate: u64| json!({"op": "advertise", "topic": "t", "service": "a", "epoch": epoch, "rate_hz": rate});
    send(&mut registry, now, Scope::Node, &with(1, 10));
    assert_eq!(save(&mut registry, &mut kept), 1);
    for second in 1..4 {
        send(
            &mut registry,
            now + Duration::from_secs(second),
            Scope::Node,
            &with(1, 10),
        );
        assert_eq!(save(&mut registry, &mut kept), 0, "a renewal");
    }
    send(&mut registry, now, Scope::Node, &with(2, 10));
    assert_eq!(save(&mut registry, &mut kept), 1, "another life");
    send(&mut registry, now, Scope::Node, &with(2, 20));
    assert_eq!(save(&mut registry, &mut kept), 1, "other terms");
    send(
        &mut registry,
        now,
        Scope::Node,
        &json!({"op": "withdraw", "topic": "t", "service": "a", "epoch": 2}),
    );
    assert_eq!((save(&mut registry, &mut kept), kept.len()), (1, 0));
    send(
        &mut registry,
        now,
        Scope::Node,
        &json!({"op": "withdraw", "topic": "t", "service": "a", "epoch": 2}),
    );
    assert_eq!(save(&mut registry, &mut kept), 0, "nothing to withdraw");
    send(&mut registry, now, Scope::Node, &with(3, 1));
    assert_eq!((save(&mut registry, &mut kept), kept.len()), (1, 1));
    registry.expire(now + Duration::from_secs(15));
    assert_eq!((save(&mut registry, &mut kept), kept.len()), (1, 0), "it lapsed");
}

#[test]
fn what_services_say_while_leases_are_read_counts_for_more() {
    let now = Instant::now();
    let mut kept = Kept::new();
    let mut first = keeping("edge/robot-1", now);
    restore_all(&mut first, now, &kept);
    for name in ["renewed", "ended", "lapsed", "quiet"] {
        send(
            &mut first,
            now,
            Scope::Node,
            &json!({"op": "advertise", "topic": name, "service": "a", "rate_hz": 1}),
        );
    }
    save(&mut first, &mut kept);

    let mut second = keeping("edge/robot-1", now);
    let was = of_scope(&kept, Scope::Node);
    send(
        &mut second,
        now,
        Scope::Node,
        &json!({"op": "advertise", "topic": "renewed", "service": "a", "rate_hz": 2}),
    );
    send(
        &mut second,
        now,
        Scope::Node,
        &json!({"op": "withdraw", "topic": "ended", "service": "a"}),
    );
    send(
        &mut second,
        now,
        Scope::Node,
        &json!({"op": "advertise", "topic": "lapsed", "service": "a", "ttl_s": 1}),
    );
    second.expire(now + Duration::from_secs(1));
    save(&mut second, &mut kept);
    let restored = second.restore(now, Scope::Node, &was);
    assert_eq!((restored.restored, restored.newer), (1, 3));
    let leased: Vec<_> = second.leases().map(|lease| lease.topic.to_string()).collect();
    assert_eq!(leased, ["quiet", "renewed"]);
    save(&mut second, &mut kept);
    let names: Vec<_> = kept.keys().map(|(_, key)| key.split('|').nth(1).unwrap()).collect();
    assert_eq!(names, ["quiet", "renewed"]);
    assert!(
        String::from_utf8_lossy(&kept[&(Scope::Node, "advertise|renewed|edge|robot-1|a|0".into())])
            .contains("\"rate_hz\":2")
    );
    // Now that they are read, a withdrawn lease may come back.
    send(
        &mut second,
        now,
        Scope::Node,
        &json!({"op": "advertise", "topic": "ended", "service": "a"}),
    );
    assert_eq!(second.lease_count(), 3);
}

#[test]
fn what_is_no_lease_of_this_flow_is_left_alone() {
    let now = Instant::now();
    let mut registry = keeping("edge/robot-1", now);
    let good = r#"{"op":"advertise","topic":"t","service":"a"}"#;
    let entry = |key: &str, value: &str| (key.to_owned(), Bytes::from(value.to_owned()));
    let restored = registry.restore(
        now,
        Scope::Node,
        &[
            entry("advertise|t|edge|robot-2|a|0", good),
            entry("advertise|t|fog|robot-1|a|0", good),
            entry("", good),
            entry("a|b|c", good),
            entry("advertise|t|edge|robot-1|a|0", "{"),
            entry("advertise|t|edge|robot-1|a|0", "[]"),
            entry(
                "advertise|t|edge|robot-1|a|0",
                r#"{"op":"withdraw","topic":"t","service":"a"}"#,
            ),
            entry(
                "advertise|t|edge|robot-1|a|0",
                r#"{"op":"advertise","topic":"blaze/x","service":"a"}"#,
            ),
            entry("advertise|other|edge|robot-1|a|0", good),
            entry("request|t|edge|robot-1|a|0", good),
            entry("advertise|t|edge|robot-1|a|0", good),
        ],
    );
    assert_eq!((restored.restored, restored.foreign, restored.skipped), (1, 2, 8));
    assert_eq!(registry.lease_count(), 1);
    assert!(registry.take_unsaved().is_empty(), "nothing of it is touched");
}

#[test]
fn nothing_lapses_while_nobody_can_renew() {
    let start = Instant::now();
    let mut registry = keeping("edge/robot-1", start);
    restore_all(&mut registry, start, &Kept::new());
    let advertise = |service: &str| json!({"op": "advertise", "topic": "t", "service": service});
    send(&mut registry, start, Scope::Node, &advertise("a"));
    send(&mut registry, start, Scope::Layer, &advertise("a"));
    registry.set_renewable(start, Scope::Node, false);
    let later = start + Duration::from_secs(16);
    assert_eq!(registry.expire(later).lapsed.len(), 1, "that of the other scope");
    let back = start + Duration::from_secs(29);
    registry.set_renewable(back, Scope::Node, true);
    assert_eq!(
        registry.expire(back + Duration::from_millis(14_999)),
        Changes::default()
    );
    assert_eq!(registry.expire(back + Duration::from_secs(15)).lapsed.len(), 1);
}

#[test]
fn a_topic_that_kafka_cannot_tell_from_another_is_refused() {
    let now = Instant::now();
    let mut registry = Registry::new(RegistryConfig {
        layer_names: LayerNames::Kafka { prefix_bytes: 60 },
        ..config("fog/fog-1", 1, now)
    });
    let refusal = |outcome: ControlOutcome| {
        let answer = outcome.answers.into_iter().next().unwrap();
        let error = &answer.body["error"];
        (
            error["code"].as_str().unwrap_or("").to_owned(),
            error["pointer"].as_str().unwrap_or("").to_owned(),
        )
    };
    let object = |op: &str, topic: &str| json!({"op": op, "topic": topic, "service": "a", "id": "1", "reply_to": "blaze/reply/x"});
    let none = (String::new(), String::new());
    let collision = ("name_collision".to_owned(), "/topic".to_owned());
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("advertise", "imu/data"))),
        none
    );
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("request", "imu/data"))),
        none
    );
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("request", "imu_data"))),
        collision
    );
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Node, &object("request", "imu_data"))),
        none,
        "Redis has both"
    );
    let long = "t".repeat(190);
    let found = refusal(send(&mut registry, now, Scope::Layer, &object("advertise", &long)));
    assert_eq!(found, ("name_not_expressible".to_owned(), "/topic".to_owned()));
    // A topic that is only delivered there holds its name, too, until it is not any more.
    registry.put_on_layer(&topic("a/b")).unwrap();
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("advertise", "a_b"))),
        collision
    );
    registry.take_off_layer(&topic("a/b"));
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("advertise", "a_b"))),
        none
    );
    assert!(registry.put_on_layer(&topic("a/b")).is_err());
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("withdraw", "imu/data"))),
        none
    );
    assert_eq!(
        refusal(send(&mut registry, now, Scope::Layer, &object("request", "imu_data"))),
        none,
        "it is free now"
    );
}

#[test]
fn a_scope_of_another_flow_is_as_if_it_were_not_there() {
    let now = Instant::now();
    let mut registry = keeping("edge/robot-1", now);
    restore_all(&mut registry, now, &Kept::new());
    send(
        &mut registry,
        now,
        Scope::Node,
        &json!({"op": "advertise", "topic": "t", "service": "a", "ttl_s": 0}),
    );
    send(
        &mut registry,
        now,
        Scope::Layer,
        &json!({"op": "request", "topic": "t", "service": "b", "ttl_s": 0}),
    );
    let before = registry.world().own().unwrap().clone();
    let changed = registry.set_in_use(now, Scope::Layer, true);
    assert_eq!(changed, BTreeSet::from([topic("t")]));
    let own = registry.world().own().unwrap();
    assert!(own.layer_scope.is_none() && own.node_scope);
    let entry = &own.topics[&topic("t")];
    assert!(entry.node.advertise.is_some() && entry.layer.request.is_none());
    registry.set_in_use(now, Scope::Node, true);
    let own = registry.world().own().unwrap();
    assert!(!own.node_scope && own.topics.is_empty());
    assert_eq!(registry.lease_count(), 2, "the leases stay");
    registry.set_in_use(now, Scope::Node, false);
    registry.set_in_use(now, Scope::Layer, false);
    assert_eq!(*registry.world().own().unwrap(), before);
}

proptest! {
    /// Whatever services say, and whenever the flow dies, its next life has the leases that it had.
    #[test]
    fn a_restart_at_any_time_changes_nothing(
        steps in proptest::collection::vec((0..3_usize, 0..5_u8, 0..3_u8, 0..3_u32, any::<bool>(), 0..2500_u64), 1..40),
        restarts in proptest::collection::btree_set(0..40_usize, 0..4),
    ) {
        let mut now = Instant::now();
        let mut kept = Kept::new();
        let mut registry = keeping("edge/robot-1", now);
        restore_all(&mut registry, now, &kept);
        for (index, (op, name, service, ttl, on_node, wait)) in steps.into_iter().enumerate() {
            let op = ["advertise", "request", "withdraw"][op];
            let scope = if on_node { Scope::Node } else { Scope::Layer };
            send(&mut registry, now, scope, &json!({"op": op, "topic": format!("t{name}"), "service": format!("s{service}"), "ttl_s": ttl}));
            save(&mut registry, &mut kept);
            now += Duration::from_millis(wait);
            registry.expire(now);
            save(&mut registry, &mut kept);
            prop_assert_eq!(kept.len(), registry.lease_count());
            if restarts.contains(&index) {
                let mut next = keeping("edge/robot-1", now);
                restore_all(&mut next, now, &kept);
                prop_assert_eq!(terms(&next), terms(&registry));
                prop_assert!(next.take_unsaved().is_empty());
                registry = next;
            }
        }
    }
}
