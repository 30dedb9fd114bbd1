use serde_json::json;

use super::super::testing::{document, keys, labelled, place, site, state};
use super::*;

const TRACKED: [&str; 7] = ["blur", "blur/0@a", "slam", "slam/0@a", "slam/1@b", "slam/2", "slam@a"];

fn places() -> Places {
    let mut places = Places::default();
    for text in TRACKED {
        let told = Told { revision: 1, hash: Some("sha256:1".to_owned()) };
        places.insert(place(text), told);
    }
    places
}

fn found<const N: usize>(old: &State, new: &State, changed: [&str; N]) -> Vec<String> {
    let keys = keys(changed).into_iter().collect();
    let found = concerned(&site(None), &places(), old, new, &keys);
    found.iter().map(|place| place.to_string().replace(" at ", "@")).collect()
}

#[test]
fn a_service_concerns_its_places_and_new_ones() {
    let old = State::default();
    let new = state(
        2,
        [
            document("Service/mono", 2, json!({})),
            document("Instance/mono/0", 1, json!({"node": "a"})),
        ],
    );
    assert_eq!(found(&old, &new, ["Service/mono"]), ["mono", "mono/0@a"]);
    assert_eq!(found(&old, &new, ["Service/blur"]), ["blur", "blur/0@a"]);
    assert_eq!(found(&old, &new, ["Instance/slam/1"]), ["slam/1@b"]);
}

#[test]
fn a_layer_concerns_all_or_those_whose_overrides_differ() {
    let layer = |spec| state(1, [document("Layer/edge", 1, spec)]);
    let plain = layer(json!({"config": {}}));
    let config = layer(json!({"config": {"a": 1}}));
    let overrides = layer(json!({"overrides": {"blur": {"a": 1}, "slam": {}}}));
    assert_eq!(found(&plain, &config, ["Layer/edge"]).len(), TRACKED.len());
    assert_eq!(found(&plain, &overrides, ["Layer/edge"]), ["blur", "blur/0@a"]);
    assert!(found(&plain, &layer(json!({"kind": "edge"})), ["Layer/edge"]).is_empty());
    assert!(found(&plain, &config, ["Layer/fog"]).is_empty());
    // A roll-out of the layer may have waited for it.
    assert_eq!(found(&State::default(), &plain, ["Layer/edge"]).len(), TRACKED.len());
}

#[test]
fn who_went_is_on_no_node() {
    let mut places = places();
    let node = "a".parse().unwrap();
    assert_eq!(places.on_node(&node).count(), 3);
    for text in ["blur/0@a", "slam", "slam/0@a"] {
        assert!(places.remove(&place(text)));
    }
    assert_eq!(places.on_node(&node).collect::<Vec<_>>(), [&place("slam@a")]);
    assert!(!places.remove(&place("slam")));
}

#[test]
fn a_node_concerns_who_is_on_it() {
    let node = |spec| state(1, [document("Node/a", 1, spec)]);
    let plain = node(json!({"layer": "edge"}));
    let config = node(json!({"layer": "edge", "config": {"a": 1}}));
    let overrides = node(json!({"layer": "edge", "overrides": {"blur": {"a": 1}}}));
    assert_eq!(found(&plain, &config, ["Node/a"]), ["blur/0@a", "slam@a", "slam/0@a"]);
    assert_eq!(found(&plain, &overrides, ["Node/a"]), ["blur/0@a"]);
    assert!(
        found(&plain, &node(json!({"layer": "edge", "type": "mobile"})), ["Node/a"]).is_empty()
    );
    let chosen = state(1, [labelled("Node/a", 1, json!({"layer": "edge"}), ("canary", "true"))]);
    assert_eq!(found(&plain, &chosen, ["Node/a"]).len(), 3);
}

#[test]
fn a_roll_out_concerns_what_it_changes_on_nodes() {
    let rollout = |target: serde_json::Value, phase: &str| {
        let mut rollout = document("Rollout/try", 1, json!({"target": target, "patch": {}}));
        rollout.status = Some(json!({"phase": phase}));
        state(1, [rollout])
    };
    let none = State::default();
    for (target, expected) in [
        (json!({"kind": "Service", "name": "slam"}), vec!["slam@a", "slam/0@a", "slam/1@b"]),
        (
            json!({"kind": "Layer", "name": "edge"}),
            vec!["blur/0@a", "slam@a", "slam/0@a", "slam/1@b"],
        ),
        (json!({"kind": "Node", "name": "b"}), vec!["slam/1@b"]),
        (json!({"kind": "Instance", "service": "slam", "name": "0"}), vec!["slam/0@a"]),
        (json!({"kind": "Instance", "service": "slam", "name": "2"}), vec![]),
    ] {
        let tried = rollout(target.clone(), "canary");
        assert_eq!(found(&none, &tried, ["Rollout/try"]), expected);
        assert_eq!(found(&tried, &none, ["Rollout/try"]), expected);
        assert_eq!(found(&tried, &rollout(target.clone(), "failed"), ["Rollout/try"]), expected);
        let over = rollout(target, "promoted");
        assert!(found(&over, &over, ["Rollout/try"]).is_empty());
    }
}
