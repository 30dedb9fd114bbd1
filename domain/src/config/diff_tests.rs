use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::config::arbitrary::{any_json, any_part};

fn lines(deltas: &[Delta]) -> Vec<String> {
    let shown = |value: &Option<Value>| value.as_ref().map_or("-".to_owned(), Value::to_string);
    let line = |delta: &Delta| {
        format!("{} {} {} {}", delta.op, delta.path, shown(&delta.old), shown(&delta.value))
    };
    deltas.iter().map(line).collect()
}

fn document(labels: &[(&str, &str)], spec: Value) -> Document {
    let pairs = labels.iter();
    Document {
        labels: pairs.map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect(),
        ..Document::new("Layer/edge".parse().unwrap(), spec)
    }
}

#[test]
fn objects_are_descended_and_the_rest_is_whole() {
    let old = json!({
        "b": { "x": 1, "y": { "z": 2 } },
        "a": [1, 2],
        "gone": { "p": 1 },
        "same": {},
        "n": null,
    });
    let new = json!({
        "b": { "x": 1, "y": { "z": 3 } },
        "a": [1, 3],
        "new/er": { "q": 1 },
        "same": {},
        "n": 0,
    });
    assert_eq!(
        lines(&diff(&old, &new, "/spec/config")),
        [
            "replace /spec/config/a [1,2] [1,3]",
            "replace /spec/config/b/y/z 2 3",
            "remove /spec/config/gone {\"p\":1} -",
            "replace /spec/config/n null 0",
            "add /spec/config/new~1er - {\"q\":1}",
        ]
    );
    assert_eq!(lines(&diff(&json!(1), &json!({ "a": 1 }), "")), ["replace  1 {\"a\":1}"]);
    assert!(diff(&old, &old, "").is_empty());
}

#[test]
fn differences_of_documents() {
    let old = document(&[("site", "lab"), ("row", "1")], json!({ "kind": "edge" }));
    let new = document(
        &[("site", "hall")],
        json!({ "kind": "edge", "config": { "log": { "level": "info" } }, "overrides": {} }),
    );
    assert_eq!(
        lines(&document_diff(Some(&old), Some(&new))),
        [
            "remove /labels/row \"1\" -",
            "replace /labels/site \"lab\" \"hall\"",
            "add /spec/config/log - {\"level\":\"info\"}",
        ]
    );
    assert_eq!(
        lines(&document_diff(None, Some(&new))),
        [
            "add /labels/site - \"hall\"",
            "add /spec/config/log - {\"level\":\"info\"}",
            "add /spec/kind - \"edge\""
        ]
    );
    assert_eq!(
        lines(&document_diff(Some(&old), None)),
        [
            "remove /labels/row \"1\" -",
            "remove /labels/site \"lab\" -",
            "remove /spec/kind \"edge\" -"
        ]
    );
    assert!(document_diff(None, None).is_empty());
}

#[test]
fn secrets_are_redacted_and_compared_by_version() {
    let with = |version: u64, data: &str| {
        document(
            &[],
            json!({ "config": { "pw": { "$secret": { "key": "e1", "nonce": data, "data": data,
                "version": version } } } }),
        )
    };
    assert!(document_diff(Some(&with(3, "one")), Some(&with(3, "two"))).is_empty());
    let deltas = document_diff(Some(&with(3, "one")), Some(&with(4, "two")));
    assert_eq!(
        lines(&deltas),
        ["replace /spec/config/pw {\"$secret\":{\"redacted\":true,\"version\":3}} \
          {\"$secret\":{\"redacted\":true,\"version\":4}}"]
    );
    let text = document(&[], json!({ "config": { "list": [{ "$secret": "canary" }] } }));
    assert!(!lines(&document_diff(None, Some(&text))).concat().contains("canary"));
}

#[test]
fn a_difference_survives_its_json() {
    for delta in
        diff(&json!({ "a": null, "b": 1, "c": 2 }), &json!({ "a": 1, "b": null, "d": null }), "")
    {
        assert_eq!(Delta::from_json(&delta.to_json()), Some(delta.clone()), "{delta:?}");
    }
    assert_eq!(
        diff(&json!({}), &json!({ "a": null }), "")[0].to_json(),
        json!({ "op": "add", "path": "/a", "value": null })
    );
    for wrong in [
        json!({}),
        json!({ "op": "move", "path": "/a", "value": 1 }),
        json!({ "op": "add", "path": 5 }),
    ] {
        assert_eq!(Delta::from_json(&wrong), None);
    }
}

#[test]
fn too_many_differences_are_told_by_whole_objects() {
    let many = |base: usize| -> Value {
        let inner: Value = (0..MAX_DELTAS + 1)
            .map(|index| (format!("k{index}"), Value::from(base + index)))
            .collect();
        json!({ "a": { "b": { "c": inner } }, "x": base })
    };
    assert_eq!(
        paths(&diff(&many(0), &many(1), "/spec/config")),
        ["/spec/config/a/b/c", "/spec/config/x"]
    );
    let deep = |value: usize| {
        let inner: Value =
            (0..300).map(|index| (format!("k{index}"), Value::from(value))).collect();
        json!({ "a": { ("k".repeat(5000)): inner } })
    };
    assert_eq!(paths(&diff(&deep(0), &deep(1), "")), [format!("/a/{}", "k".repeat(5000))]);
}

#[test]
fn paths_are_cut_to_what_fits() {
    let delta = |path: String| Delta::new(&path, None, Some(&json!(1)));
    let few: Vec<Delta> =
        ["/b/c", "/a", "/b/c"].into_iter().map(|path| delta(path.to_owned())).collect();
    assert_eq!(paths(&few), ["/a", "/b/c"]);
    let many: Vec<Delta> =
        (0..=MAX_PATHS).map(|index| delta(format!("/spec/config/{}/{index}", index % 7))).collect();
    let expected: Vec<String> = (0..7).map(|index| format!("/spec/config/{index}")).collect();
    assert_eq!(paths(&many), expected);
    let long: Vec<Delta> =
        (0..100).map(|index| delta(format!("/spec/{}/{index}", "x".repeat(1000)))).collect();
    assert_eq!(paths(&long), [format!("/spec/{}", "x".repeat(1000))]);
    assert!(paths(&[]).is_empty());
}

/// Does what the differences say.
fn apply(mut value: Value, deltas: &[Delta]) -> Value {
    for delta in deltas {
        if delta.path.is_empty() {
            value = delta.value.clone().unwrap();
            continue;
        }
        let (parent, name) = delta.path.rsplit_once('/').unwrap();
        let name = name.replace("~1", "/").replace("~0", "~");
        let parent = value.pointer_mut(parent).unwrap().as_object_mut().unwrap();
        assert_eq!(parent.get(&name), delta.old.as_ref());
        match &delta.value {
            Some(new) => parent.insert(name, new.clone()),
            None => parent.shift_remove(&name),
        };
    }
    value
}

proptest! {
    #[test]
    fn the_differences_lead_from_one_to_the_other(old in any_part(), new in any_part()) {
        let deltas = diff(&old, &new, "");
        prop_assert!(deltas.is_sorted_by(|one, other| one.path < other.path));
        prop_assert_eq!(apply(old, &deltas), new);
    }

    #[test]
    fn what_is_equal_has_no_difference(value in any_json()) {
        prop_assert!(diff(&value, &value.clone(), "").is_empty());
    }
}
