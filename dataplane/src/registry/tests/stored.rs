//! Leases that brokers keep, names of the layer broker, and scopes that are another flow's.

use proptest::prelude::*;

use super::*;
use bytes::Bytes;

type Kept = BTreeMap<(Scope, String), Bytes>;

const SECOND: Duration = Duration::from_secs(1);

/// A life of `edge/robot-1`, and what its brokers keep of its leases.
struct Life {
    now: Instant,
    registry: Registry,
    kept: Kept,
}

impl Life {
    /// It has not read what is kept.
    fn begin(now: Instant, kept: Kept) -> Self {
        let registry = Registry::new(RegistryConfig {
            lease_stores: BTreeSet::from([Scope::Node, Scope::Layer]),
            layer_answers_need_id: false,
            ..config("edge/robot-1", 1, now)
        });
        Self { now, registry, kept }
    }

    /// The first one: nothing is kept.
    fn first() -> Self {
        let mut first = Self::begin(Instant::now(), Kept::new());
        first.restore();
        first
    }

    fn restore(&mut self) -> [Restored; 2] {
        let kept = self.kept.clone();
        [Scope::Node, Scope::Layer]
            .map(|scope| self.registry.restore(self.now, scope, &of_scope(&kept, scope)))
    }

    fn send(&mut self, scope: Scope, json: &Value) -> ControlOutcome {
        send(&mut self.registry, self.now, scope, json)
    }

    /// Does what brokers would do. Returns how many changes there were.
    fn save(&mut self) -> usize {
        let unsaved = self.registry.take_unsaved();
        let count = unsaved.len();
        for lease in unsaved {
            match lease.value {
                Some(value) => self.kept.insert((lease.scope, lease.key), value),
                None => self.kept.remove(&(lease.scope, lease.key)),
            };
        }
        count
    }
}

fn of_scope(kept: &Kept, scope: Scope) -> Vec<(String, Bytes)> {
    let of_scope = kept.iter().filter(|((s, _), _)| *s == scope);
    of_scope.map(|((_, key), value)| (key.clone(), value.clone())).collect()
}

fn send(registry: &mut Registry, now: Instant, scope: Scope, json: &Value) -> ControlOutcome {
    registry.control(now, scope, json.to_string().as_bytes())
}

fn lease(op: &str, topic: &str, ttl_s: u64) -> Value {
    json!({"op": op, "topic": topic, "service": "a", "ttl_s": ttl_s})
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
    let mut first = Life::first();
    let of_node = json!([
        {"op": "advertise", "topic": "imu/data", "service": "driver", "epoch": 7, "rate_hz": 50.5,
            "max_bytes": 400,
         "encoding": "application/json", "reliability": "reliable", "durability": "transient_local",
         "depth": 3,
         "priority": "control", "lifespan_ms": 900, "type": "x/T", "type_hash": "h"},
        {"op": "request", "topic": "map", "service": "driver", "ttl_s": 0, "bare": true,
            "max_rate_hz": 2.5,
         "from": {"layer": "fog", "service": "mapper"}},
    ]);
    first.send(Scope::Node, &of_node);
    first.send(Scope::Layer, &lease("request", "imu/data", 60));
    assert_eq!(first.save(), 3);
    assert_eq!(
        first.kept.keys().map(|(_, key)| key.as_str()).collect::<Vec<_>>(),
        [
            "advertise|imu/data|edge|robot-1|driver|0",
            "request|map|edge|robot-1|driver|0",
            "request|imu/data|edge||a|0"
        ]
    );

    let later = first.now + 1000 * SECOND;
    let mut second = Life::begin(later, first.kept.clone());
    assert!(second.registry.is_reading(Scope::Node));
    let [node, layer] = second.restore();
    assert_eq!((node.restored, layer.restored), (2, 1));
    assert_eq!(node.changed, BTreeSet::from([topic("imu/data"), topic("map")]));
    assert!(!second.registry.is_reading(Scope::Node) && !second.registry.is_reading(Scope::Layer));
    assert_eq!(terms(&second.registry), terms(&first.registry));
    assert_eq!(second.registry.next_expiry(), Some(later + 15 * SECOND));
    assert_eq!(second.save(), 0, "what was read is not written again");
    let [of_second, of_first] =
        [&second, &first].map(|life| &life.registry.world().own().unwrap().topics);
    assert_eq!(of_second, of_first);
}

#[test]
fn only_what_changes_is_written() {
    let mut life = Life::first();
    let advertise = |epoch: u64, rate: u64| {
        json!({
            "op": "advertise",
            "topic": "t",
            "service": "a",
            "epoch": epoch,
            "rate_hz": rate,
        })
    };
    let withdraw = json!({"op": "withdraw", "topic": "t", "service": "a", "epoch": 2});
    for (said, changes, left, what) in [
        (&advertise(1, 10), 1, 1, "a lease"),
        (&advertise(1, 10), 0, 1, "a renewal"),
        (&advertise(2, 10), 1, 1, "another life"),
        (&advertise(2, 20), 1, 1, "other terms"),
        (&withdraw, 1, 0, "its end"),
        (&withdraw, 0, 0, "nothing to withdraw"),
        (&advertise(3, 1), 1, 1, "a lease again"),
    ] {
        life.now += SECOND;
        life.send(Scope::Node, said);
        assert_eq!((life.save(), life.kept.len()), (changes, left), "{what}");
    }
    life.registry.expire(life.now + 15 * SECOND);
    assert_eq!((life.save(), life.kept.len()), (1, 0), "it lapsed");
}

#[test]
fn what_services_say_while_leases_are_read_counts_for_more() {
    let mut first = Life::first();
    for name in ["renewed", "ended", "lapsed", "quiet"] {
        first.send(Scope::Node, &lease("advertise", name, 15));
    }
    first.save();
    let was = of_scope(&first.kept, Scope::Node);
    let mut second = Life::begin(first.now, first.kept);
    second.send(Scope::Node, &lease("advertise", "renewed", 20));
    second.send(Scope::Node, &lease("withdraw", "ended", 15));
    second.send(Scope::Node, &lease("advertise", "lapsed", 1));
    second.registry.expire(second.now + SECOND);
    second.save();

    let restored = second.registry.restore(second.now, Scope::Node, &was);
    assert_eq!((restored.restored, restored.newer), (1, 3));
    let leased: Vec<_> = second.registry.leases().map(|lease| lease.topic.to_string()).collect();
    assert_eq!(leased, ["quiet", "renewed"]);
    second.save();
    let names: Vec<_> = second.kept.keys().map(|(_, key)| key.split('|').nth(1).unwrap()).collect();
    assert_eq!(names, ["quiet", "renewed"]);
    let renewed = &second.kept[&(Scope::Node, "advertise|renewed|edge|robot-1|a|0".into())];
    assert!(String::from_utf8_lossy(renewed).contains("\"ttl_s\":20"), "{renewed:?}");
    // Now that they are read, a withdrawn lease may come back.
    second.send(Scope::Node, &lease("advertise", "ended", 15));
    assert_eq!(second.registry.lease_count(), 3);
}

#[test]
fn what_is_no_lease_of_this_flow_is_left_alone() {
    let Life { mut registry, now, .. } = Life::begin(Instant::now(), Kept::new());
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
            entry("advertise|t|edge|robot-1|a|0", r#"{"op":"withdraw","topic":"t","service":"a"}"#),
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
    let mut life = Life::first();
    let start = life.now;
    life.send(Scope::Node, &lease("advertise", "t", 15));
    life.send(Scope::Layer, &lease("advertise", "t", 15));
    life.registry.set_renewable(start, Scope::Node, false);
    let lapsed = life.registry.expire(start + 16 * SECOND).lapsed;
    assert_eq!(lapsed.len(), 1, "that of the other scope");
    let back = start + 29 * SECOND;
    life.registry.set_renewable(back, Scope::Node, true);
    let before = back + Duration::from_millis(14_999);
    assert_eq!(life.registry.expire(before), Changes::default());
    assert_eq!(life.registry.expire(back + 15 * SECOND).lapsed.len(), 1);
}

#[test]
fn a_topic_that_kafka_cannot_tell_from_another_is_refused() {
    let now = Instant::now();
    let mut registry = Registry::new(RegistryConfig {
        layer_names: LayerNames::Kafka { prefix: "p".repeat(60) },
        ..config("fog/fog-1", 1, now)
    });
    // The code and the place of a refusal; empty where there is none.
    let said = |registry: &mut Registry, scope, op: &str, topic: &str| {
        let object = json!({
            "op": op,
            "topic": topic,
            "service": "a",
            "id": "1",
            "reply_to": "blaze/reply/x",
        });
        let error = &send(registry, now, scope, &object).answers[0].body["error"];
        ["code", "pointer"].map(|key| error[key].as_str().unwrap_or("").to_owned())
    };
    let (none, collision) = (["", ""], ["name_collision", "/topic"]);
    let long = "t".repeat(190);
    for (scope, op, topic, expected) in [
        (Scope::Layer, "advertise", "imu/data", none),
        (Scope::Layer, "request", "imu/data", none),
        (Scope::Layer, "request", "imu_data", collision),
        // Redis has both.
        (Scope::Node, "request", "imu_data", none),
        (Scope::Layer, "advertise", long.as_str(), ["name_not_expressible", "/topic"]),
    ] {
        assert_eq!(said(&mut registry, scope, op, topic), expected, "{op} {topic}");
    }
    // A topic that is only delivered there holds its name, too, until it is not any more.
    registry.put_on_layer(&topic("a/b")).unwrap();
    assert_eq!(said(&mut registry, Scope::Layer, "advertise", "a_b"), collision);
    registry.take_off_layer(&topic("a/b"));
    assert_eq!(said(&mut registry, Scope::Layer, "advertise", "a_b"), none);
    assert!(registry.put_on_layer(&topic("a/b")).is_err());
    assert_eq!(said(&mut registry, Scope::Layer, "withdraw", "imu/data"), none);
    let again = said(&mut registry, Scope::Layer, "request", "imu_data");
    assert_eq!(again, none, "it is free now");
}

#[test]
fn a_scope_of_another_flow_is_as_if_it_were_not_there() {
    let mut life = Life::first();
    let now = life.now;
    life.send(Scope::Node, &lease("advertise", "t", 0));
    life.send(Scope::Layer, &lease("request", "t", 0));
    let before = life.registry.world().own().unwrap().clone();
    life.save();
    let changed = life.registry.set_in_use(now, Scope::Layer, true);
    assert_eq!(changed, BTreeSet::from([topic("t")]));
    let own = life.registry.world().own().unwrap();
    assert!(own.layer_scope.is_none() && own.node_scope);
    let entry = &own.topics[&topic("t")];
    assert!(entry.node.advertise.is_some() && entry.layer.request.is_none());
    life.registry.set_in_use(now, Scope::Node, true);
    let own = life.registry.world().own().unwrap();
    assert!(!own.node_scope && own.topics.is_empty());
    assert_eq!(life.registry.lease_count(), 0, "they are the other's");
    assert_eq!(life.save(), 0, "and nothing that is kept is touched");
    life.registry.set_in_use(now, Scope::Node, false);
    life.registry.set_in_use(now, Scope::Layer, false);
    assert!(life.registry.is_reading(Scope::Node) && life.registry.is_reading(Scope::Layer));
    life.restore();
    assert_eq!(*life.registry.world().own().unwrap(), before);
}

proptest! {
    /// Whatever services say, and whenever the flow dies, its next life has the leases that it had.
    #[test]
    fn a_restart_at_any_time_changes_nothing(
        steps in proptest::collection::vec((0..3_usize, 0..5_u8, 0..3_u8, 0..3_u32, any::<bool>(),
            0..2500_u64), 1..40),
        restarts in proptest::collection::btree_set(0..40_usize, 0..4),
    ) {
        let mut life = Life::first();
        for (index, (op, name, service, ttl, on_node, wait)) in steps.into_iter().enumerate() {
            let op = ["advertise", "request", "withdraw"][op];
            let scope = if on_node { Scope::Node } else { Scope::Layer };
            life.send(
                scope,
                &json!({
                    "op": op,
                    "topic": format!("t{name}"),
                    "service": format!("s{service}"),
                    "ttl_s": ttl,
                }),
            );
            life.save();
            life.now += Duration::from_millis(wait);
            life.registry.expire(life.now);
            life.save();
            prop_assert_eq!(life.kept.len(), life.registry.lease_count());
            if restarts.contains(&index) {
                let mut next = Life::begin(life.now, life.kept.clone());
                next.restore();
                prop_assert_eq!(terms(&next.registry), terms(&life.registry));
                prop_assert!(next.registry.take_unsaved().is_empty());
                life = next;
            }
        }
    }
}
