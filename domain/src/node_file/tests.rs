use serde_json::json;

use super::*;
use crate::names::TopicName;
use crate::qos::Priority;

/// The example of the documentation, as its YAML reads.
fn example() -> Value {
    json!({
        "layer": { "name": "edge", "kind": "edge" },
        "node": { "name": "robot-1" },
        "brokers": {
            "node": { "redis": { "url": "redis://127.0.0.1:6379", "prefix": "" } },
            "layer": { "dds": { "domain": 10, "interface": "10.0.9.1" } },
            "inter": { "dds": { "domain": 20, "listen": "10.0.1.1", "peers": ["10.0.3.1"],
                "peer_slots": 4,
                                "mtu": 1500, "chunking": "auto" } },
            "plugins": [ { "ros2": { "domain": 0, "distro": "jazzy", "allow": ["**"],
                "deny": [] } } ],
        },
        "admin": {
            "flow": "127.0.0.1:9101",
            "worker": "127.0.0.1:9102",
            "monitor": "127.0.0.1:9103",
        },
        "config": { "server": "https://10.0.3.1:50051", "ca_file": "/etc/blaze/ca.pem",
                    "token_file": "/etc/blaze/token" },
        "cache": { "redis": { "url": "redis://127.0.0.1:6379", "prefix": "" } },
        "database": { "mongodb": { "uri": "mongodb://127.0.0.1:27017", "database": "blaze" } },
        "flow": {
            "bandwidth": { "limit_mbps": 150, "per_message_share": 0.95, "overhead": 1.02,
                "min_rate_hz": 2,
                           "large_bytes": 65536, "share": "paper", "wire_overhead": "measured",
                           "adaptive": true,
                           "links": { "cloud": { "limit_mbps": 40 } } },
            "compression": { "codec": "lz4", "level": 10, "min_bytes": 65536 },
            "topics": [ { "match": "camera/**", "priority": "bulk", "max_rate_hz": 15,
                "lifespan_ms": 500,
                          "compression": { "level": 9 } } ],
            "pool_threads": 0,
            "gateway": "auto",
        },
        "monitor": { "ping_period_s": 60, "latency_topics": ["camera/image_raw"] },
        "log": { "level": "info", "format": "text" },
        "state_dir": "/var/lib/blaze",
    })
}

fn control_plane() -> Value {
    json!({
        "rest": { "listen": "127.0.0.1:8080" },
        "grpc": { "listen": "127.0.0.1:50051", "reflection": false },
        "admin": { "listen": "127.0.0.1:9104" },
        "tls": {
            "cert_file": "c.pem",
            "key_file": "k.pem",
            "client_ca_file": "a.pem",
            "allow_plaintext": false,
        },
        "store": { "sqlite": { "path": "./blaze-config.db" } },
        "auth": { "issuer": "blaze", "audience": "blaze-config",
                  "keys": [{
                      "id": "k1",
                      "alg": "HS256",
                      "file": "/etc/blaze/jwt.key",
                      "sign": true,
                  }],
                  "jwks": { "url": "https://idp/jwks", "refresh_s": 300 } },
        "encryption": { "keys": [ { "id": "e1", "file": "/etc/blaze/enc.key" } ] },
        "history": {
            "keep_revisions": 100000,
            "keep_s": 2592000,
            "keep_versions": 20,
            "trim_period_s": 60,
        },
        "limits": {
            "in_flight": 512,
            "watches_per_subject": 1000,
            "requests_per_s": 0,
            "auth_failures_per_s": 10,
        },
    })
}

fn faults(tree: &Value) -> Vec<String> {
    NodeFile::read(tree).unwrap_err().iter().map(ToString::to_string).collect()
}

#[test]
fn the_example_is_read_whole() {
    let (file, warnings) = NodeFile::read(&example()).unwrap();
    assert_eq!(file.flow_id().unwrap().to_string(), "edge/robot-1");
    assert_eq!(file.layer.as_ref().unwrap().kind, LayerKind::Edge);
    let inter = file.brokers.inter.as_ref().unwrap();
    assert_eq!((inter.domain, inter.peers.len(), inter.peer_slots, inter.mtu), (20, 1, 4, 1500));
    assert_eq!(file.flow.bandwidth.limit_bytes_per_s(), 150.0 * 131_072.0);
    let cloud = "cloud".parse().unwrap();
    assert_eq!(file.flow.bandwidth.link_limit_bytes_per_s(&cloud), Some(40.0 * 131_072.0));
    assert_eq!(file.state_dir.as_deref(), Some(std::path::Path::new("/var/lib/blaze")));
    assert!(file.check_for_flow().is_empty());
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn what_is_in_effect_gives_no_warning() {
    let mut tree = json!({
        "layer": { "name": "fog", "kind": "fog" },
        "node": { "name": "fog-1" },
        "brokers": { "node": { "memory": {} }, "layer": { "memory": null },
                     "inter": { "dds": { "domain": 20, "listen": "127.0.0.1" } } },
        "admin": { "flow": "127.0.0.1:0" },
        "flow": { "bandwidth": { "limit_mbps": 40.5, "large_bytes": 1000 },
                  "topics": [ { "match": "**", "priority": "state" } ] },
        "log": { "level": "info,blaze_flow=debug" },
        "state_dir": "./state",
    });
    let (file, warnings) = NodeFile::read(&tree).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(file.brokers.layer, Some(LayerBroker::Memory));
    tree["brokers"] = json!({ "node": { "redis": { "url": "redis://127.0.0.1:6379" } },
                              "layer": { "kafka": { "bootstrap": ["127.0.0.1:9092"] } } });
    let (file, warnings) = NodeFile::read(&tree).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    assert!(matches!(file.brokers.layer, Some(LayerBroker::Kafka(_))));
}

#[test]
fn an_empty_file_has_the_documented_defaults() {
    let (file, warnings) = NodeFile::read(&Value::Null).unwrap();
    assert!(warnings.is_empty());
    assert_eq!(file, NodeFile::default());
    let bandwidth = &file.flow.bandwidth;
    assert_eq!(bandwidth.limit_mbps, 160.0);
    assert_eq!(
        (bandwidth.per_message_share, bandwidth.overhead, bandwidth.min_rate_hz),
        (0.95, 1.02, 2.0)
    );
    assert_eq!((bandwidth.large_bytes, bandwidth.adaptive), (65_536, true));
    assert_eq!(
        (bandwidth.share, bandwidth.wire_overhead),
        (SharePolicy::Paper, WireOverhead::Measured)
    );
    assert_eq!(
        file.flow.compression,
        Compression { codec: Codec::Lz4, level: 10, min_bytes: 65_536, adaptive: true }
    );
    assert_eq!(file.admin.flow.to_string(), "127.0.0.1:9101");
    assert_eq!(file.control_plane.grpc.listen.to_string(), "127.0.0.1:50051");
    assert_eq!((file.log.level.as_str(), file.worker.lease_ms), ("info", 5000));
    let missing: Vec<String> =
        file.check_for_flow().iter().map(|fault| fault.path.clone()).collect();
    assert_eq!(missing, ["layer", "node", "brokers"]);
}

#[test]
fn the_sections_of_the_main_service_are_read() {
    let tree = json!({
        "control_plane": control_plane(),
        "worker": { "defaults_file": "/etc/blaze/defaults.yaml",
            "state_dir": "/var/lib/blaze/worker",
                    "key_file": "/etc/blaze/worker.key", "deliver_secrets": "auto",
                    "lease_ms": 5000 },
    });
    let (file, warnings) = NodeFile::read(&tree).unwrap();
    let auth = file.control_plane.auth.unwrap();
    assert_eq!((auth.keys[0].algorithm, auth.keys[0].sign), (JwtAlgorithm::Hs256, true));
    assert_eq!(file.control_plane.history.keep_s, 2_592_000);
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn all_faults_come_at_once() {
    let tree = json!({
        "layer": { "name": "Edge", "kind": "edgy" },
        "ndoe": { "name": "robot-1" },
        "brokers": {
            "node": { "redis": { "prefix": "a b" }, "memory": {} },
            "layer": {},
            "inter": { "dds": { "domain": 101, "listen": "here", "peers": ["10.0.0.1", 7],
                "mtu": 1279 } },
        },
        "flow": { "bandwidth": { "limit_mbps": "fast", "limit_mbs": 3,
            "links": { "Cloud": { "limit_mbps": 0 } } },
                  "topics": [ { "match": "a*/b" }, { "priority": "urgent" }, 5 ],
                  "gateway": "perhaps" },
        "log": { "level": "loud" },
        "state_dir": 7,
    });
    assert_eq!(
        faults(&tree),
        [
            "layer.name: \"Edge\" holds 'E'; allowed are a-z, 0-9 and -",
            "layer.kind: \"edgy\" is not one of edge, fog, cloud",
            "brokers.node.redis.url: is required",
            "brokers.node.redis.prefix: has at most 64 of A-Z a-z 0-9 _ - . : /",
            "brokers.node: holds redis and memory; only one of redis, memory is allowed",
            "brokers.layer: needs one of dds, kafka, memory",
            "brokers.inter.dds.domain: 101 is not a whole number from 0 to 100",
            "brokers.inter.dds.listen: \"here\" is not the IPv4 address of one host",
            "brokers.inter.dds.peers[1]: expected text, found the number 7; put it in quotes",
            "brokers.inter.dds.mtu: 1279 is not a whole number from 1280 to 65535",
            "flow.bandwidth.limit_mbps: expected a number from 0.001 to 1000000, found text",
            "flow.bandwidth.links.Cloud: the name of a layer holds 'C'; allowed are a-z, 0-9 and -",
            "flow.bandwidth.links.Cloud.limit_mbps: 0 is not between 0.001 and 1000000",
            "flow.bandwidth.limit_mbs: unknown key; did you mean limit_mbps?",
            "flow.topics[0].match: \"a*/b\" has a star inside \"a*\": `*` and `**` stand for whole \
             segments",
            "flow.topics[1].match: is required",
            "flow.topics[1].priority: \"urgent\" is not one of control, state, bulk",
            "flow.topics[2]: expected a mapping, found the number 5",
            "flow.gateway: expected auto, true or false, found text",
            "log.level: \"loud\" is not error, warn, info, debug, trace, off, or directives such \
             as \
             info,blaze_flow=debug",
            "state_dir: expected text, found the number 7; put it in quotes",
            "ndoe: unknown key; did you mean node?",
        ]
    );
}

#[test]
fn domains_differ() {
    let mut tree = example();
    tree["brokers"]["inter"]["dds"]["domain"] = json!(10);
    tree["brokers"]["plugins"] = json!([{ "ros2": { "domain": 10 } }]);
    assert_eq!(
        faults(&tree),
        [
            "brokers.inter.dds.domain: 10 is also brokers.layer.dds.domain; all DDS domains of a \
             node file differ",
            "brokers.plugins[0].ros2.domain: 10 is also brokers.layer.dds.domain; all DDS domains \
             of a node file differ",
        ]
    );
}

#[test]
fn the_ros2_network() {
    let read = |ros2: Value| {
        let tree = json!({ "brokers": { "plugins": [{ "ros2": ros2 }] } });
        NodeFile::read(&tree).map(|(file, _)| file.brokers.ros2.unwrap())
    };
    let plain = read(Value::Null).unwrap();
    assert_eq!((plain.domain, plain.interface), (0, std::net::Ipv4Addr::LOCALHOST));
    assert_eq!((plain.distro, &plain.namespace), (Ros2Distro::Jazzy, &None));
    assert!(plain.live.announce && !plain.live.system && plain.peers.is_empty());
    let given = read(json!({ "domain": 100, "interface": "10.0.1.1", "peers": ["10.0.1.2"],
        "distro": "humble", "namespace": "arm/left", "allow": ["scan"], "deny": ["*/secret"],
        "system": true, "announce": false, "interfaces": ["/opt/ros/jazzy/share"] }));
    let given = given.unwrap();
    assert_eq!(given.namespace.unwrap().as_str(), "arm/left");
    assert!(given.live.system && !given.live.announce && given.live.interfaces.len() == 1);
    assert_eq!(read(json!({ "namespace": "" })).unwrap().namespace, None);
    for (key, value, detail) in [
        ("domain", json!(101), "101 is not a whole number from 0 to 100"),
        ("interface", json!("0.0.0.0"), "\"0.0.0.0\" is not the IPv4 address of one host"),
        ("peers", json!(vec!["10.0.0.1"; 65]), "has 65 entries, at most 64 are allowed"),
        ("distro", json!("foxy"), "\"foxy\" is not one of"),
        ("namespace", json!("/arm"), "\"/arm\" has an empty segment"),
        ("namespace", json!("blaze/x"), "\"blaze/x\" is reserved"),
        ("deny", json!(["/scan"]), "\"/scan\" has an empty segment"),
        ("system", json!("no"), "expected true or false, found text"),
        ("anounce", json!(true), "unknown key; did you mean announce?"),
    ] {
        let faults = read(json!({ key: value })).unwrap_err();
        assert_eq!(faults.len(), 1, "{key}: {faults:?}");
        assert!(faults[0].path.starts_with(&format!("brokers.plugins[0].ros2.{key}")));
        assert!(faults[0].detail.starts_with(detail), "{key}: {}", faults[0].detail);
    }
    let tree = json!({ "brokers": { "plugins": [{ "ros2": {} }, { "ros2": { "domain": 3 } }] } });
    let two = faults(&tree);
    assert_eq!(two, ["brokers.plugins[1].ros2: is a second one; a flow is on one ROS 2 network"]);
}

#[test]
fn secrets_are_not_repeated() {
    let tree = json!({ "cache": { "redis": { "url": "http://user:geheim@host" } } });
    assert_eq!(faults(&tree).len(), 1);
    assert!(!faults(&tree)[0].contains("geheim"));
    let tree = json!({ "cache": { "redis": { "url": "redis://user:geheim@host" } },
        "brokers": { "layer": { "kafka": { "bootstrap": ["h:1"],
            "properties": { "sasl.password": "geheim" } } } } });
    let (file, _) = NodeFile::read(&tree).unwrap();
    assert!(!format!("{file:?}").contains("geheim"));
    let Some(LayerBroker::Kafka(kafka)) = file.brokers.layer else { panic!("kafka") };
    assert_eq!(kafka.properties["sasl.password"].reveal(), "geheim");
}

#[test]
fn a_password_of_kafka_stands_in_one_place() {
    let tree = |properties: serde_json::Value| {
        let kafka =
            json!({ "bootstrap": ["h:1"], "password_file": "/f", "properties": properties });
        json!({ "brokers": { "layer": { "kafka": kafka } } })
    };
    assert!(NodeFile::read(&tree(json!({}))).is_ok());
    let found = faults(&tree(json!({ "sasl.password": "geheim" })));
    assert!(found.len() == 1 && found[0].contains("exclude each other"), "{found:?}");
}

#[test]
fn ports_of_urls_are_checked() {
    let of = |redis: &str, server: &str, mongodb: &str| {
        json!({
            "layer": { "name": "edge", "kind": "edge" },
            "node": { "name": "robot-1" },
            "brokers": { "node": { "redis": { "url": redis } } },
            "config": { "server": server },
            "database": { "mongodb": { "uri": mongodb } },
        })
    };
    for (redis, server, mongodb) in [
        ("redis://h", "https://h", "mongodb://h,i"),
        ("redis://u:0@h:1/2", "https://h:65535/", "mongodb://u:p@h:1,[::1]:2/x?y=z:0"),
        ("unix:///run/a:0", "http://[::1]", "mongodb+srv://h"),
    ] {
        NodeFile::read(&of(redis, server, mongodb)).unwrap();
    }
    for (redis, server, mongodb) in [
        ("redis://h:0", "https://h:0", "mongodb://h:0"),
        ("redis://u:1@h:65536", "http://h:99999/x", "mongodb://h:1,i:0"),
        ("redis://h:", "https://h:x", "mongodb://[::1]:0"),
    ] {
        let found = faults(&of(redis, server, mongodb));
        let places: Vec<_> = found.iter().filter_map(|fault| fault.split(": ").next()).collect();
        assert_eq!(
            places,
            ["brokers.node.redis.url", "config.server", "database.mongodb.uri"],
            "{found:?}"
        );
    }
}

#[test]
fn names_of_databases_are_checked() {
    let found = |name: &str| {
        let database = json!({ "mongodb": { "uri": "mongodb://h", "database": name } });
        faults(&json!({ "database": database, "control_plane": { "store": database } }))
    };
    for right in ["blaze_main-2", &"x".repeat(63)] {
        let store = json!({ "mongodb": { "uri": "mongodb://h", "database": right } });
        NodeFile::read(&json!({ "database": store })).unwrap();
    }
    for wrong in ["", "a/b", "a.b", "$cmd", "ä", "a b", &"x".repeat(64)] {
        let found = found(wrong);
        assert_eq!(found.len(), 2, "{wrong}: {found:?}");
        assert!(found[0].starts_with("database.mongodb.database: "), "{found:?}");
        assert!(found[1].starts_with("control_plane.store.mongodb.database: "), "{found:?}");
    }
}

#[test]
fn a_password_of_mongodb_belongs_to_a_user_of_the_uri() {
    let tree = |uri: &str| {
        let store = json!({ "mongodb": { "uri": uri, "password_file": "/f" } });
        json!({ "control_plane": { "store": store }, "database": store })
    };
    for uri in ["mongodb://me@h", "mongodb://me@h:1,i:2/?x=y@z", "mongodb+srv://a%40b@h.example"] {
        let (file, _) = NodeFile::read(&tree(uri)).unwrap();
        let Some(DatabaseSection::MongoDb(section)) = file.database else { panic!("{uri}") };
        let whole = section.uri_with(Some(&"p@:/%ä".to_owned().into()));
        assert_eq!(whole.reveal(), uri.replacen('@', ":p%40%3A%2F%25%C3%A4@", 1));
        assert_eq!(section.uri_with(None).reveal(), uri);
    }
    for uri in [
        "mongodb://h:1",
        "mongodb://me:geheim@h",
        "mongodb://@h",
        "mongodb://m@e@h",
        "mongodb://h/?x=a@b",
    ] {
        let found = faults(&tree(uri));
        assert!(found.len() == 2 && !found[0].contains("geheim"), "{uri}: {found:?}");
        assert!(found.iter().all(|fault| fault.contains("mongodb://USER@HOST")), "{found:?}");
    }
}

#[test]
fn the_first_rule_that_gives_a_value_wins() {
    let tree = json!({ "flow": { "compression": { "level": 3 }, "topics": [
        { "match": "camera/*", "max_rate_hz": 15, "compression": { "level": 9 } },
        {
            "match": "camera/**",
            "max_rate_hz": 5,
            "priority": "bulk",
            "compression": { "codec": "none" },
        },
    ] } });
    let (file, _) = NodeFile::read(&tree).unwrap();
    let settings = |topic: &str| file.flow.topic(&topic.parse::<TopicName>().unwrap());
    let near = settings("camera/left");
    assert_eq!((near.max_rate_hz, near.priority), (Some(15.0), Some(Priority::Bulk)));
    assert_eq!((near.compression.level, near.compression.codec), (9, Codec::None));
    assert_eq!(settings("camera/left/raw").max_rate_hz, Some(5.0));
    let unbound = json!({ "flow": { "topics": [
        { "match": "cmd", "lifespan_ms": 0 },
        { "match": "**", "lifespan_ms": 500, "max_rate_hz": 15 },
    ] } });
    let (unbound, _) = NodeFile::read(&unbound).unwrap();
    let cmd = TopicValues::of(&unbound.flow.topics, &"cmd".parse().unwrap());
    assert_eq!((cmd.lifespan_ms, cmd.max_rate_hz), (Some(0), Some(15.0)));
    let other = settings("imu");
    assert_eq!((other.max_rate_hz, other.priority, other.compression.level), (None, None, 3));
}

#[test]
fn a_tree_that_is_no_mapping_is_refused() {
    for tree in [json!([]), json!("x"), json!(3)] {
        assert_eq!(NodeFile::read(&tree).unwrap_err().len(), 1, "{tree}");
    }
    for (section, found) in
        [("flow", 1), ("admin", 1), ("control_plane", 1), ("brokers", 1), ("layer", 1)]
    {
        assert_eq!(NodeFile::read(&json!({ section: 5 })).unwrap_err().len(), found, "{section}");
    }
}

mod any_tree {
    use proptest::prelude::*;

    use super::*;

    fn tree() -> impl Strategy<Value = Value> {
        let keys = prop::sample::select(vec![
            "flow",
            "bandwidth",
            "limit_mbps",
            "links",
            "topics",
            "match",
            "brokers",
            "node",
            "redis",
            "url",
            "inter",
            "dds",
            "domain",
            "peers",
            "log",
            "level",
            "control_plane",
            "auth",
            "keys",
            "x",
        ]);
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<f64>().prop_map(Value::from),
            ".{0,8}".prop_map(Value::from),
        ];
        leaf.prop_recursive(5, 64, 6, move |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..4).prop_map(Value::from),
                prop::collection::vec((keys.clone(), inner), 0..6).prop_map(|pairs| pairs
                    .into_iter()
                    .map(|(key, value)| (key.to_owned(), value))
                    .collect()),
            ]
        })
    }

    proptest! {
        #[test]
        fn is_read_or_refused_with_a_place(tree in tree()) {
            if let Err(faults) = NodeFile::read(&tree) {
                prop_assert!(!faults.is_empty());
            }
        }
    }
}
