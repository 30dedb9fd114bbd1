use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::config::arbitrary::{any_json, any_part};
use crate::names::ServiceName;

fn lines(faults: &[FieldFault]) -> Vec<String> {
    faults.iter().map(|fault| format!("{}: {}", fault.pointer, fault.detail)).collect()
}

fn check_of(key: &str, spec: &Value) -> Vec<String> {
    lines(&check(&key.parse().unwrap(), &Labels::new(), &Labels::new(), spec))
}

fn no_faults(key: &str, spec: &Value) {
    assert_eq!(check_of(key, spec), [""; 0], "{key} {spec}");
}

fn pairs(pairs: &[(&str, &str)]) -> Labels {
    pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

fn rollout() -> Value {
    json!({
        "target": { "kind": "Service", "name": "slam" },
        "patch": { "config": { "camera": { "rate_hz": 10 } } },
        "canary": { "node_selector": "canary=true" },
        "gate": { "window_s": 60, "max_unhealthy": 0 },
    })
}

#[test]
fn the_examples_of_the_contract_are_good() {
    no_faults(
        "Layer/edge",
        &json!({ "kind": "edge", "config": { "log": { "level": "info" } },
                 "overrides": { "blaze-flow": { "flow": { "bandwidth": { "limit_mbps": 40 } } } } }),
    );
    no_faults(
        "Node/robot-1",
        &json!({ "layer": "edge", "type": "mobile",
            "addresses": ["10.0.1.7", "fe80::1", "robot-1.example.org"],
                 "resources": {
                     "cpus": 8,
                     "memory_bytes": 34_359_738_368_u64,
                     "gpus": 1,
                     "arch": "arm64",
                 },
                 "config": {}, "overrides": {} }),
    );
    no_faults(
        "Service/slam",
        &json!({ "description": "", "config": { "camera": { "rate_hz": 30 } },
            "schema": { "type": "object" },
                 "layers": ["edge", "fog"] }),
    );
    no_faults(
        "Instance/slam/0",
        &json!({ "node": "robot-1", "config": { "camera": { "rate_hz": 10 } } }),
    );
    no_faults("Rollout/slam-slower", &rollout());
}

#[test]
fn what_may_be_absent_may_be_absent() {
    for (key, spec) in [
        ("Layer/edge", json!({ "kind": "fog" })),
        ("Node/robot-1", json!({ "layer": "edge" })),
        ("Service/slam", json!({})),
        ("Service/slam", json!({ "schema": true, "layers": [] })),
        ("Service/blaze-flow", json!({})),
        ("Instance/slam/0", json!({})),
        ("Instance/slam/0", json!({ "layer": "edge" })),
        ("Node/robot-1", json!({ "layer": "edge", "resources": { "cpus": 0.5 } })),
    ] {
        no_faults(key, &spec);
    }
}

#[test]
fn all_faults_come_at_once() {
    assert_eq!(
        check_of(
            "Layer/edge",
            &json!({
                "kind": "edgy",
                "confg": {},
                "config": [],
                "overrides": { "Slam": {}, "blaze-x": 5 },
            })
        ),
        [
            "/spec/confg: unknown member; did you mean config?",
            "/spec/kind: \"edgy\" is not one of edge, fog, cloud",
            "/spec/config: expected an object, found a list",
            "/spec/overrides/Slam: the name of a service \"Slam\" holds 'S'; allowed are a-z, 0-9 \
             and -",
            "/spec/overrides/blaze-x: \"blaze-x\" is reserved: names that begin with blaze- are \
             blaze-config, blaze-flow, \
             blaze-worker, blaze-monitor",
            "/spec/overrides/blaze-x: expected an object, found the number 5",
        ]
    );
    assert_eq!(check_of("Layer/edge", &json!({})), ["/spec/kind: is required"]);
    assert_eq!(check_of("Layer/edge", &json!([])), ["/spec: expected an object, found a list"]);
    let addresses: Vec<Value> = vec![json!("10.0.0.256"), json!(7), json!("a b"), json!("")];
    assert_eq!(
        check_of(
            "Node/robot-1",
            &json!({ "layer": "Edge", "type": "flying", "addresses": addresses, "config": null,
                     "resources": { "cpus": 0, "memory_bytes": -1, "gpus": 1.5, "arch": "",
                         "disk": 1 } })
        ),
        [
            "/spec/layer: \"Edge\" holds 'E'; allowed are a-z, 0-9 and -",
            "/spec/type: \"flying\" is not one of static, gateway, mobile",
            "/spec/addresses/0: \"10.0.0.256\" is neither an IP address nor a host name",
            "/spec/addresses/1: expected text, found the number 7; put it in quotes",
            "/spec/addresses/2: \"a b\" is neither an IP address nor a host name",
            "/spec/addresses/3: \"\" is neither an IP address nor a host name",
            "/spec/resources/disk: unknown member; known are cpus, memory_bytes, gpus, arch",
            "/spec/resources/cpus: 0 is not above 0 and at most 1000000",
            "/spec/resources/memory_bytes: -1 is not a whole number from 0 to 9007199254740991",
            "/spec/resources/gpus: 1.5 is not a whole number from 0 to 1000000",
            "/spec/resources/arch: is no architecture, such as arm64: 1 to 63 of A-Z, a-z, 0-9, -, \
             _ and .",
            "/spec/config: expected an object, found nothing; leave it out instead",
        ]
    );
    let many: Vec<&str> = vec!["10.0.0.1"; 17];
    assert_eq!(
        check_of("Node/robot-1", &json!({ "layer": "edge", "addresses": many })),
        ["/spec/addresses: has 17 entries, at most 16 are allowed"]
    );
}

#[test]
fn services_and_instances() {
    assert_eq!(
        check_of(
            "Service/blaze-x",
            &json!({ "schema": 5, "layers": ["edge", "edge"], "overrides": {}, "description": 5 })
        ),
        [
            "/name: \"blaze-x\" is reserved: names that begin with blaze- are blaze-config, \
             blaze-flow, blaze-worker, \
             blaze-monitor",
            "/spec/overrides: unknown member; known are description, config, schema, layers",
            "/spec/description: expected text, found the number 5; put it in quotes",
            "/spec/schema: expected a JSON Schema: an object, true or false, found the number 5",
            "/spec/layers/1: edge is named twice",
        ]
    );
    let large = json!({ "schema": { "title": "x".repeat(MAX_SCHEMA_BYTES) } });
    assert_eq!(
        check_of("Service/slam", &large),
        ["/spec/schema: has 65548 bytes, at most 65536 are allowed"]
    );
    let secret = json!({ "schema": { "properties": { "$secret": true } } });
    assert_eq!(check_of("Service/slam", &secret).len(), 1);
    assert_eq!(
        check_of("Instance/slam/0", &json!({ "node": "robot-1", "layer": "edge" })),
        ["/spec: names both node and layer; an instance is placed on one of them"]
    );
}

#[test]
fn rollouts() {
    assert_eq!(
        check_of("Rollout/r", &json!({})),
        ["/spec/target: is required", "/spec/patch: is required", "/spec/canary: is required"]
    );
    let mut wrong = rollout();
    wrong["target"] = json!({ "kind": "Instance", "name": "0" });
    wrong["patch"] = json!({ "overrides": {}, "config": null });
    wrong["canary"] = json!({ "node_selector": "a b" });
    wrong["gate"] = json!({ "window_s": 4, "max_unhealthy": -1 });
    assert_eq!(
        check_of("Rollout/r", &wrong),
        [
            "/spec/target/service: is required of an Instance",
            "/spec/patch/overrides: unknown member; known are node, layer, config",
            "/spec/canary/node_selector: the selector needs =, ==, !=, in, notin, a comma or the \
             end at character 3",
            "/spec/gate/window_s: 4 is not a whole number from 5 to 3600",
            "/spec/gate/max_unhealthy: -1 is not a whole number from 0 to 1000000",
        ]
    );
    for (target, fault) in [
        (
            json!({ "kind": "Rollout", "name": "r" }),
            "/spec/target/kind: a Rollout cannot be the target of another one",
        ),
        (
            json!({ "kind": "Node", "name": "n", "service": "s" }),
            "/spec/target/service: a Node has no service",
        ),
        (json!({ "kind": "Node" }), "/spec/target/name: is required"),
        (json!({ "name": "n" }), "/spec/target/kind: is required"),
        (json!("Node/n"), "/spec/target: expected an object, found text"),
    ] {
        let mut wrong = rollout();
        wrong["target"] = target;
        assert_eq!(check_of("Rollout/r", &wrong), [fault]);
    }
    let mut layer = rollout();
    layer["target"] = json!({ "kind": "Layer", "name": "edge" });
    layer["patch"] = json!({
        "overrides": { "slam": null, "blaze-flow": { "flow": { "gateway": "perhaps" } } },
        "config": null,
    });
    assert_eq!(
        check_of("Rollout/r", &layer),
        ["/spec/patch/overrides/blaze-flow/flow/gateway: expected auto, true or false, found text"]
    );
}

#[test]
fn labels_and_annotations() {
    let key: Key = "Layer/edge".parse().unwrap();
    let spec = json!({ "kind": "edge" });
    let good = pairs(&[("site", "lab"), ("example.org/row", ""), ("A.b_c-1", "x.y")]);
    let notes = pairs(&[("any key: \u{e4} / ~", "any\nvalue"), ("empty", "")]);
    assert_eq!(check(&key, &good, &notes, &spec), []);
    let bad = pairs(&[("a b", "x"), ("ok", "a b"), ("x/y/z", "1")]);
    let notes = pairs(&[("", "x"), ("tab\t", "x"), (&"k".repeat(254), "x")]);
    assert_eq!(
        lines(&check(&key, &bad, &notes, &spec)),
        [
            "/labels/a b: the key may hold A-Z, a-z, 0-9, -, _ and ., and begins and ends with a \
             letter or digit",
            "/labels/ok: the value may hold A-Z, a-z, 0-9, -, _ and ., and begins and ends with a \
             letter or digit",
            "/labels/x~1y~1z: the key may hold A-Z, a-z, 0-9, -, _ and ., and begins and ends with \
             a letter or digit",
            "/annotations/: the key must have 1 to 253 characters that can be seen",
            &format!(
                "/annotations/{}: the key must have 1 to 253 characters that can be seen",
                "k".repeat(254)
            ),
            "/annotations/tab\t: the key must have 1 to 253 characters that can be seen",
        ]
    );
    let many: Labels = (0..=MAX_LABELS).map(|index| (format!("l{index}"), String::new())).collect();
    assert_eq!(
        lines(&check(&key, &many, &Labels::new(), &spec)),
        ["/labels: has 65 labels, at most 64 are allowed"]
    );
}

#[test]
fn secrets_of_users() {
    no_faults(
        "Service/slam",
        &json!({ "config": { "a": { "$secret": "text" },
            "b": [{ "$secret": { "redacted": true, "version": 3 } }],
                             "c": { "d": { "$secret": { "text": "x", "version": 3 } } } } }),
    );
    let stored = json!({ "$secret": { "key": "e1", "nonce": "n", "data": "d", "version": 7 } });
    let faults = check_of(
        "Service/slam",
        &json!({ "config": { "a": stored, "b": [{ "$secret": 5 }],
            "c/d": { "$secret": "canary", "x": 1 } } }),
    );
    assert_eq!(
        faults[0],
        "/spec/config/a: is a secret as the store alone writes it; write {\"$secret\":\"text\"}"
    );
    assert!(faults[1].starts_with("/spec/config/b/0: is no secret: "), "{faults:?}");
    assert_eq!(faults[2], "/spec/config/c~1d: has other members beside $secret");
    assert_eq!(faults.len(), 3);
    for spec in [
        json!({ "config": { "$secret": "canary" } }),
        json!({ "description": { "$secret": "canary" } }),
    ] {
        let faults = check_of("Service/slam", &spec);
        assert_eq!(faults.len(), 1);
        assert!(!faults[0].contains("canary"));
    }
}

#[test]
fn depth_and_pointers_are_bounded() {
    let nested =
        |depth: usize, inner: Value| (0..depth).fold(inner, |value, _| json!({ "a": value }));
    // The document, the spec and the configuration are three levels.
    no_faults("Service/slam", &json!({ "config": nested(MAX_DEPTH - 2, json!(1)) }));
    assert_eq!(
        check_of("Service/slam", &json!({ "config": nested(MAX_DEPTH - 1, json!(1)) })).len(),
        1
    );
    assert_eq!(
        check_of("Service/slam", &json!({ "config": nested(2 * MAX_DEPTH, json!(1)) })).len(),
        1
    );
    no_faults(
        "Service/slam",
        &json!({ "config": nested(MAX_DEPTH - 4, json!({ "$secret": "x" })) }),
    );
    assert_eq!(
        check_of(
            "Service/slam",
            &json!({ "config": nested(MAX_DEPTH - 3, json!({ "$secret": "x" })) })
        ),
        ["/spec: is nested too deep: a document has at most 32 levels, a secret counts as two"]
    );
    let faults = check_of("Service/slam", &json!({ "config": { ("k".repeat(2000)): 1 } }));
    assert!(
        faults.len() == 1 && faults[0].ends_with("has a path of more than 1024 bytes"),
        "{faults:?}"
    );
    assert_eq!(
        check_of("Service/slam", &json!({ "config": { "n": u64::MAX } })).len(),
        1,
        "integers that some readers round"
    );
    let many: Value = (0..500).map(|index| (format!("m{index}"), Value::Null)).collect();
    assert_eq!(check_of("Service/slam", &many).len(), 100);
}

mod sections_of_the_node_file {
    use super::*;

    fn faults(config: &Value) -> Vec<String> {
        check_of("Service/slam", &json!({ "config": config }))
    }

    #[test]
    fn they_follow_its_schema() {
        assert_eq!(
            faults(&json!({
                "flow": {
                    "bandwidth": { "limit_mbps": "fast", "limit_mbs": 3 },
                    "topics": [ { "priority": "urgent" } ],
                },
                "layer": { "name": "Edge" },
                "log": 5,
                "brokers": { "node": { "redis": { "url": "http://user:canary@host" } } },
                "anything": { "else": { "is": "free" } },
                "admin": "free, too",
            })),
            [
                "/spec/config/layer/name: \"Edge\" holds 'E'; allowed are a-z, 0-9 and -",
                "/spec/config/brokers/node/redis/url: is not a URL that starts with redis:// or \
                 rediss:// or \
                 redis+unix:// or unix://",
                "/spec/config/flow/bandwidth/limit_mbps: expected a number from 0.001 to 1000000, \
                 found text",
                "/spec/config/flow/bandwidth/limit_mbs: unknown key; did you mean limit_mbps?",
                "/spec/config/flow/topics/0/match: is required",
                "/spec/config/flow/topics/0/priority: \"urgent\" is not one of control, state, \
                 bulk",
                "/spec/config/log: expected a mapping, found the number 5",
            ]
        );
    }

    #[test]
    fn a_part_may_lack_what_others_give() {
        for config in [
            json!({ "layer": { "kind": "edge" } }),
            json!({ "node": {}, "layer": {} }),
            json!({ "brokers": { "node": {}, "layer": { "kafka": { "prefix": "x" } },
                "inter": { "dds": { "mtu": 1400 } } } }),
            json!({ "brokers": { "node": { "redis": { "tls": { "cert_file": "c.pem" } } } } }),
            json!({ "control_plane": { "tls": { "key_file": "k.pem" },
                "auth": { "jwks": { "refresh_s": 60 } }, "store": {} } }),
            json!({ "cache": {}, "database": { "mongodb": {} }, "config": { "ca_file": "a.pem" } }),
        ] {
            assert_eq!(faults(&config), [""; 0], "{config}");
        }
    }

    #[test]
    fn what_is_in_a_list_is_complete() {
        assert_eq!(
            faults(&json!({
                "control_plane": { "auth": { "keys": [ { "id": "k1" } ] } },
                "brokers": { "plugins": [ {} ] },
            })),
            [
                "/spec/config/brokers/plugins/0: needs one of ros2",
                "/spec/config/control_plane/auth/keys/0/alg: is required",
                "/spec/config/control_plane/auth/keys/0/file: is required",
            ]
        );
    }

    #[test]
    fn contradictions_stay_faults() {
        assert_eq!(
            faults(&json!({ "control_plane": { "auth": { "jwks": { "url": "https://idp/jwks",
                    "file": "j.json" } } },
                           "brokers": { "layer": { "dds": { "domain": 3, "interface": "10.0.0.1" },
                               "memory": {} } } })),
            [
                "/spec/config/brokers/layer: holds dds and memory; only one of dds, kafka, memory \
                 is allowed",
                "/spec/config/control_plane/auth/jwks: needs one of url, file",
            ]
        );
    }

    #[test]
    fn removals_are_left_out() {
        for config in [
            json!({ "flow": null, "log": { "level": null } }),
            json!({ "brokers": { "layer": { "dds": null, "kafka": { "bootstrap": ["h:1"] } } } }),
            json!({ "flow": { "topics": [ { "match": "**", "priority": null } ] } }),
        ] {
            assert_eq!(faults(&config), [""; 0], "{config}");
        }
        assert_eq!(faults(&json!({ "flow": { "nonsense": null } })), [""; 0]);
        // Nothing is removed from a list.
        assert_eq!(
            faults(&json!({ "flow": { "topics": [null] } })),
            ["/spec/config/flow/topics/0/match: is required"]
        );
    }

    #[test]
    fn a_secret_stands_where_text_may_stand() {
        let secret = || json!({ "$secret": "canary" });
        for config in [
            json!({
                "cache": { "redis": { "url": secret() } },
                "database": { "mongodb": { "uri": secret() } },
            }),
            json!({ "brokers": { "layer": { "kafka": { "bootstrap": [secret()],
                                                      "properties": { "sasl.password": secret(),
                                                          "a[0].b": secret() } } } } }),
        ] {
            assert_eq!(faults(&config), [""; 0], "{config}");
        }
        assert_eq!(
            faults(&json!({
                "flow": { "bandwidth": { "limit_mbps": secret() } },
                "log": secret(),
                "worker": { "lease_ms": [secret()] },
            })),
            [
                "/spec/config/flow/bandwidth/limit_mbps: expected a number from 0.001 to 1000000, \
                 found text",
                "/spec/config/log: expected a mapping, found text",
                "/spec/config/worker/lease_ms: expected a whole number from 100 to 600000, found a \
                 list",
            ]
        );
    }

    #[test]
    fn keys_with_points_and_brackets_keep_their_place() {
        assert_eq!(
            faults(&json!({ "brokers": { "layer": { "kafka": { "properties": { "a.b": [], "a": 1,
                    "c[0]": {}, "x/y": null } } } },
                           "flow": { "bandwidth": { "links": { "a.b": { "limit_mbps": 1 } } } } })),
            [
                "/spec/config/brokers/layer/kafka/properties/a.b: expected text, a number or true \
                 or false, found a list",
                "/spec/config/brokers/layer/kafka/properties/c[0]: expected text, a number or true \
                 or false, found a mapping",
                "/spec/config/flow/bandwidth/links/a.b: the name of a layer holds '.'; allowed are \
                 a-z, 0-9 and -",
            ]
        );
    }

    #[test]
    fn every_section_is_one_of_the_node_file() {
        for section in NODE_FILE_SECTIONS {
            assert_eq!(faults(&json!({ section: {} })), [""; 0], "{section}");
            assert_eq!(faults(&json!({ section: "x" })).len(), 1, "{section}");
        }
    }
}

mod envelopes {
    use super::*;

    fn faults(value: Value, expected: Option<&str>) -> Vec<String> {
        let key = expected.map(|key| key.parse::<Key>().unwrap());
        lines(&parse_envelope(value, key.as_ref()).unwrap_err())
    }

    #[test]
    fn the_path_fills_in_what_the_body_leaves_out() {
        let key: Key = "Instance/slam/0".parse().unwrap();
        let body = json!({ "spec": { "node": "robot-1" }, "labels": { "a": "b" }, "uid": 5,
            "revision": "x", "status": {},
                           "create_time": null, "update_time": 1, "updated_by": [] });
        let envelope = parse_envelope(body, Some(&key)).unwrap();
        assert_eq!(envelope.key().unwrap(), key);
        assert_eq!(
            (envelope.spec, envelope.revision, envelope.delete),
            (json!({ "node": "robot-1" }), None, false)
        );
        assert_eq!((envelope.labels, envelope.annotations), (pairs(&[("a", "b")]), Labels::new()));
        let body = json!({
            "kind": "Instance",
            "service": "slam",
            "name": "0",
            "spec": {},
            "revision": 7,
        });
        assert_eq!(parse_envelope(body, Some(&key)).unwrap().revision, Some(7));
    }

    #[test]
    fn a_body_that_contradicts_the_path_is_refused() {
        assert_eq!(
            faults(
                json!({ "kind": "Node", "name": "b", "service": "s", "spec": {} }),
                Some("Layer/a")
            ),
            [
                "/kind: is \"Node\", but the path says \"Layer\"",
                "/name: is \"b\", but the path says \"a\"",
                "/service: a Layer has no service",
            ]
        );
        assert_eq!(
            faults(json!({ "service": "other", "spec": {} }), Some("Instance/slam/0")),
            ["/service: is \"other\", but the path says \"slam\""]
        );
    }

    #[test]
    fn unknown_members_and_wrong_types_are_refused() {
        assert_eq!(
            faults(
                json!({ "kind": "Nod", "name": 5, "lables": {}, "labels": { "a": 5, "b": null },
                    "annotations": [], "spec": [],
                        "delete": true }),
                Some("Layer/a")
            ),
            [
                "/lables: unknown member; did you mean labels?",
                "/delete: unknown member; known are kind, name, service, labels, annotations, spec",
                "/kind: \"Nod\" is not one of Layer, Node, Service, Instance, Rollout",
                "/name: expected text, found the number 5; put it in quotes",
                "/labels/a: expected text, found the number 5; put it in quotes",
                "/labels/b: expected text, found nothing; leave it out instead",
                "/annotations: expected an object, found a list",
                "/spec: expected an object, found a list",
            ]
        );
        assert_eq!(faults(json!([]), None), [": expected an object, found a list"]);
        assert_eq!(faults(json!({}), Some("Layer/a")), ["/spec: is required"]);
        assert_eq!(
            faults(json!({ "name": "A", "spec": {} }), None),
            ["/name: \"A\" holds 'A'; allowed are a-z, 0-9 and -"]
        );
    }

    #[test]
    fn apply_says_what_is_to_be_done() {
        let envelope = parse_envelope(
            json!({ "kind": "Layer", "name": "a", "delete": true, "revision": 3 }),
            None,
        )
        .unwrap();
        assert!(envelope.delete && envelope.spec == json!({}) && envelope.revision == Some(3));
        assert_eq!(envelope.key().unwrap().to_string(), "Layer/a");
        assert_eq!(
            faults(json!({ "kind": "Layer", "name": "a", "delete": "yes", "revision": -3 }), None),
            [
                "/delete: expected true or false, found text",
                "/spec: is required",
                "/revision: expected a revision, found the number -3",
            ]
        );
    }

    #[test]
    fn keys_need_their_parts() {
        let key = |value: Value| {
            parse_envelope(value, None).unwrap().key().map_err(|faults| lines(&faults))
        };
        for (value, faults) in [
            (json!({ "spec": {} }), vec!["/kind: is required", "/name: is required"]),
            (json!({ "kind": "Layer", "spec": {} }), vec!["/name: is required"]),
            (
                json!({ "kind": "Instance", "name": "0", "spec": {} }),
                vec!["/service: is required of an Instance"],
            ),
            (
                json!({ "kind": "Node", "name": "n", "service": "s", "spec": {} }),
                vec!["/service: a Node has no service"],
            ),
        ] {
            assert_eq!(key(value).unwrap_err(), faults);
        }
    }

    #[test]
    fn a_new_document_names_itself() {
        let slam: ServiceName = "slam".parse().unwrap();
        let envelope =
            parse_new(json!({ "name": "1", "spec": {} }), Kind::Instance, Some(&slam)).unwrap();
        assert_eq!(envelope.key().unwrap().to_string(), "Instance/slam/1");
        let nameless = parse_new(json!({ "spec": {} }), Kind::Layer, None).unwrap();
        assert_eq!(lines(&nameless.key().unwrap_err()), ["/name: is required"]);
        assert!(
            parse_new(json!({ "kind": "Node", "name": "a", "spec": {} }), Kind::Layer, None)
                .is_err()
        );
    }

    #[test]
    fn what_is_shown_can_be_sent_back() {
        let shown = document("Instance/slam/0", json!({ "node": "robot-1" })).to_json();
        let key: Key = "Instance/slam/0".parse().unwrap();
        assert!(parse_envelope(shown.clone(), Some(&key)).is_ok());
        assert_eq!(parse_envelope(shown, None).unwrap().key(), Ok(key));
    }
}

fn document(key: &str, spec: Value) -> Document {
    Document::new(key.parse().unwrap(), spec)
}

#[test]
fn references_have_their_pointers() {
    for (key, spec, expected) in [
        ("Layer/edge", json!({ "kind": "edge", "overrides": { "later": {} } }), vec![]),
        ("Node/robot-1", json!({ "layer": "edge" }), vec!["/spec/layer Layer/edge"]),
        (
            "Service/slam",
            json!({ "layers": ["edge", "fog"] }),
            vec!["/spec/layers/0 Layer/edge", "/spec/layers/1 Layer/fog"],
        ),
        (
            "Instance/slam/0",
            json!({ "node": "robot-1" }),
            vec!["/service Service/slam", "/spec/node Node/robot-1"],
        ),
        (
            "Instance/slam/0",
            json!({ "layer": "edge" }),
            vec!["/service Service/slam", "/spec/layer Layer/edge"],
        ),
        ("Rollout/r", rollout(), vec!["/spec/target Service/slam"]),
        (
            "Rollout/r",
            json!({ "target": { "kind": "Instance", "service": "slam", "name": "0" } }),
            vec!["/spec/target Instance/slam/0"],
        ),
        ("Rollout/r", json!({ "target": 5 }), vec![]),
    ] {
        let found: Vec<String> = references(&document(key, spec))
            .iter()
            .map(|(pointer, key)| format!("{pointer} {key}"))
            .collect();
        assert_eq!(found, expected, "{key}");
    }
}

#[test]
fn sizes_are_those_of_the_text() {
    let labels = pairs(&[("a", "\u{e4}\"")]);
    let spec = json!({ "config": { "x": [1, 2.5, null, "\n"] } });
    let text = json!({ "labels": labels, "annotations": {}, "spec": spec }).to_string();
    assert_eq!(document_size(&labels, &Labels::new(), &spec), text.len());
}

proptest! {
    #[test]
    fn any_spec_is_read_or_refused(kind in 0..5_usize, spec in any_json()) {
        let key = ["Layer/a", "Node/a", "Service/a", "Instance/a/b", "Rollout/a"][kind];
        for fault in check(&key.parse().unwrap(), &Labels::new(), &Labels::new(), &spec) {
            prop_assert!(fault.pointer.starts_with("/spec"));
        }
    }

    #[test]
    fn free_configurations_are_good(config in any_part()) {
        prop_assert_eq!(check_of("Service/slam", &json!({ "config": config })), [""; 0]);
    }

    #[test]
    fn any_sections_are_read_or_refused_with_a_place(section in prop::sample::select(NODE_FILE_SECTIONS.to_vec()), value in any_part()) {
        let spec = json!({ "config": { section: value } });
        for fault in check(&"Service/a".parse().unwrap(), &Labels::new(), &Labels::new(), &spec) {
            prop_assert!(
                fault.pointer.starts_with(&format!("/spec/config/{section}")),
                "{:?}",
                fault,
            );
        }
    }

    #[test]
    fn any_body_is_read_or_refused(body in any_part()) {
        if let Err(faults) = parse_envelope(body, None) {
            prop_assert!(!faults.is_empty());
        }
    }
}
