use std::collections::BTreeSet;

use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::config::arbitrary::{any_json, any_part, any_patch};
use crate::config::json::push;

fn merged(target: Value, patch: &Value) -> Value {
    let mut target = target;
    merge_patch(&mut target, patch);
    target
}

/// The effective configuration of parts, weakest first.
fn effective(parts: &[Part<'_>]) -> Value {
    parts.iter().fold(json!({}), |whole, part| merged(whole, part.value))
}

/// The algorithm of RFC 7396, as it is printed there.
fn printed(target: Value, patch: &Value) -> Value {
    let Value::Object(members) = patch else {
        return patch.clone();
    };
    let mut out = match target {
        Value::Object(out) => out,
        _ => Map::new(),
    };
    for (name, value) in members {
        if value.is_null() {
            out.shift_remove(name);
        } else {
            let before = out.get(name).cloned().unwrap_or(Value::Null);
            out.insert(name.clone(), printed(before, value));
        }
    }
    Value::Object(out)
}

#[test]
fn a_secret_is_one_value() {
    let stored = json!({ "$secret": { "key": "e1", "nonce": "n", "data": "d", "version": 7 } });
    let redacted = json!({ "$secret": { "redacted": true, "version": 7 } });
    let text = json!({ "$secret": "new" });
    for (target, patch) in [
        (&stored, &redacted),
        (&stored, &text),
        (&redacted, &stored),
        (&json!({ "a": 1 }), &stored),
    ] {
        let out = merged(json!({ "pw": target }), &json!({ "pw": patch }));
        assert_eq!(out, json!({ "pw": patch }));
    }
    assert_eq!(
        merged(json!({ "pw": stored }), &json!({ "pw": { "a": 1, "b": null } })),
        json!({ "pw": { "a": 1 } })
    );
    assert_eq!(merged(json!({ "pw": stored }), &json!({ "pw": null })), json!({}));
}

fn part<'v>(key: &str, revision: u64, value: &'v Value) -> Part<'v> {
    let source = Source { key: key.parse().unwrap(), revision, is_override: false };
    Part { source, value }
}

#[test]
fn the_example_of_the_contract() {
    let service = json!({ "camera": { "rate_hz": 30 } });
    let instance = json!({ "camera": { "rate_hz": 10 } });
    let parts = [part("Service/slam", 3, &service), part("Instance/slam/0", 88, &instance)];
    assert_eq!(effective(&parts), json!({ "camera": { "rate_hz": 10 } }));
    let expected = json!({ "/camera/rate_hz": {
        "kind": "Instance", "service": "slam", "name": "0", "revision": 88,
        "overridden": [{ "kind": "Service", "name": "slam", "revision": 3, "value": 30 }],
    } });
    assert_eq!(explain(&parts), expected);
    assert_eq!(explain(&parts).to_string(), expected.to_string());
}

#[test]
fn overrides_are_marked_and_the_strongest_weaker_part_comes_first() {
    let (one, two, three) = (json!({ "a": 1 }), json!({ "a": [2] }), json!({ "a": 3 }));
    let mut parts =
        [part("Service/s", 1, &one), part("Layer/edge", 2, &two), part("Layer/edge", 2, &three)];
    parts[2].source.is_override = true;
    assert_eq!(
        explain(&parts),
        json!({ "/a": { "kind": "Layer", "name": "edge", "revision": 2, "override": true,
            "overridden": [
            { "kind": "Layer", "name": "edge", "revision": 2, "value": [2] },
            { "kind": "Service", "name": "s", "revision": 1, "value": 1 },
        ] } })
    );
}

#[test]
fn what_is_taken_away_is_told() {
    let service = json!({ "a": { "b": 1, "c": 2 }, "d": 3, "e": 4 });
    let layer = json!({ "a": { "b": null }, "d": null, "nothing": null });
    let node = json!({ "d": 5, "e": null });
    let again = json!({ "e": null });
    let parts = [
        part("Service/s", 1, &service),
        part("Layer/l", 2, &layer),
        part("Node/n", 3, &node),
        part("Instance/slam/0", 4, &again),
    ];
    assert_eq!(effective(&parts), json!({ "a": { "c": 2 }, "d": 5 }));
    let explained = explain(&parts);
    let keys: Vec<&String> = explained.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["/a/b", "/a/c", "/d", "/e"]);
    assert_eq!(
        explained["/a/b"],
        json!({ "removed": true, "kind": "Layer", "name": "l", "revision": 2,
                "overridden": [{ "kind": "Service", "name": "s", "revision": 1, "value": 1 }] })
    );
    assert_eq!(
        explained["/d"],
        json!({ "kind": "Node", "name": "n", "revision": 3, "overridden": [
            { "kind": "Layer", "name": "l", "revision": 2, "value": null },
            { "kind": "Service", "name": "s", "revision": 1, "value": 3 },
        ] })
    );
    assert_eq!(explained["/e"]["kind"], "Instance");
    assert_eq!(explained["/e"]["removed"], true);
}

#[test]
fn what_is_below_a_removed_key_is_not_told() {
    let service = json!({ "a": { "b": { "c": 1 } } });
    let layer = json!({ "a": { "b": { "c": null } } });
    let node = json!({ "a": null });
    let parts =
        [part("Service/s", 1, &service), part("Layer/l", 2, &layer), part("Node/n", 3, &node)];
    let explained = explain(&parts);
    // The whole is an empty object: the last that touched it is told as well.
    let keys: Vec<&String> = explained.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["", "/a"]);
    assert_eq!(explained[""]["kind"], "Node");
    assert_eq!(explained["/a"]["removed"], true);
    assert_eq!(explained["/a"]["overridden"][0]["value"], json!({ "b": { "c": null } }));
}

#[test]
fn a_hundred_thousand_removals_are_quick() {
    let many: Value = (0..100_000).map(|index| (index.to_string(), Value::from(index))).collect();
    let none: Value = (0..100_000).map(|index| (index.to_string(), Value::Null)).collect();
    assert_eq!(merged(many, &none), json!({}));
}

/// JSON pointers to the leaves of a value: what is no object, or an object without members. A
/// secret is a leaf.
fn leaves(value: &Value) -> Vec<String> {
    let mut out = Vec::new();
    leaves_at(value, "", &mut out);
    out
}

fn leaves_at(value: &Value, pointer: &str, out: &mut Vec<String>) {
    match plain_object(value).filter(|members| !members.is_empty()) {
        Some(members) => {
            members.iter().for_each(|(name, member)| leaves_at(member, &push(pointer, name), out));
        }
        None => out.push(pointer.to_owned()),
    }
}

fn has_null(value: &Value) -> bool {
    match value {
        Value::Null => true,
        Value::Object(members) => members.values().any(has_null),
        _ => false,
    }
}

proptest! {
    #[test]
    fn merging_is_that_of_the_rfc(target in any_json(), patch in any_patch()) {
        prop_assert_eq!(merged(target.clone(), &patch), printed(target, &patch));
    }

    #[test]
    fn merging_twice_is_merging_once(target in any_json(), patch in any_patch()) {
        let once = merged(target, &patch);
        prop_assert_eq!(merged(once.clone(), &patch), once);
    }

    #[test]
    fn every_leaf_is_explained(values in prop::collection::vec(any_part(), 1..5)) {
        let parts: Vec<Part<'_>> = values
            .iter()
            .enumerate()
            .map(|(index, value)| part("Node/n", index as u64, value))
            .collect();
        let whole = effective(&parts);
        prop_assert!(!has_null(&whole));
        let explained = explain(&parts);
        let entries = explained.as_object().unwrap();
        let told: BTreeSet<String> =
            entries.iter().filter(|(_, entry)| entry.get("removed").is_none())
                .map(|(key, _)| key.clone()).collect();
        prop_assert_eq!(&told, &leaves(&whole).into_iter().collect::<BTreeSet<_>>());
        for (pointer, entry) in entries {
            let index = entry["revision"].as_u64().unwrap() as usize;
            // Nothing stronger says anything of the key, and what the part says is what came out.
            prop_assert!(values[index + 1..].iter().all(|value| value.pointer(pointer).is_none()));
            let said = values[index].pointer(pointer).unwrap();
            if entry.get("removed").is_some() {
                prop_assert!(said.is_null() && whole.pointer(pointer).is_none());
                prop_assert!(!entry["overridden"].as_array().unwrap().is_empty());
            } else if !said.is_object() || secret::is_secret(said) {
                prop_assert_eq!(whole.pointer(pointer), Some(said));
            } else {
                prop_assert_eq!(whole.pointer(pointer), Some(&json!({})));
            }
            for weaker in entry["overridden"].as_array().unwrap() {
                let value = &values[weaker["revision"].as_u64().unwrap() as usize];
                prop_assert_eq!(value.pointer(pointer), weaker.get("value"));
            }
        }
    }
}
