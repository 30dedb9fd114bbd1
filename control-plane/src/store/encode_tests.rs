use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::store::samples::{commit, node, record};

/// Any JSON of some depth, with the keys that databases take for their own.
fn value() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::from),
        any::<i64>().prop_map(Value::from),
        any::<f64>()
            .prop_filter("JSON has no others", |float| float.is_finite())
            .prop_map(Value::from),
        ".{0,12}".prop_map(Value::from),
    ];
    let key = prop_oneof![
        Just("$secret".to_owned()),
        Just("a.b".to_owned()),
        Just("_id".to_owned()),
        ".{0,6}"
    ];
    leaf.prop_recursive(4, 40, 6, move |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..6).prop_map(Value::from),
            prop::collection::vec((key.clone(), inner), 0..6)
                .prop_map(|members| Value::Object(members.into_iter().collect())),
        ]
    })
}

proptest! {
    #[test]
    fn a_document_is_read_as_it_was_written(spec in value(),
        labels in prop::collection::btree_map("[a-z./]{1,20}", ".{0,10}", 0..4)) {
        let mut written = node("robot-1", 7);
        written.spec = Arc::new(spec);
        written.labels = labels;
        let text = document_text(&written).unwrap();
        prop_assert_eq!(document(written.key.clone(), &text).unwrap(), written);
    }
}

#[test]
fn the_order_of_members_and_the_status_are_kept() {
    let mut written = node("robot-1", 7);
    written.spec = Arc::new(json!({"z": 1, "a": {"y": 0.1, "b": null}, "$set": {"_id": "x.y"}}));
    written.status = Some(json!({"phase": "canary"}));
    let text = document_text(&written).unwrap();
    let read = document(written.key.clone(), &text).unwrap();
    assert_eq!(read, written);
    assert_eq!(read.spec.to_string(), written.spec.to_string());
}

fn rows(group: &[EncodedCommit]) -> (Vec<EventRow>, Vec<VersionRow>) {
    let events = group.iter().map(|commit| commit.event.clone()).collect();
    let versions = group.iter().flat_map(|commit| commit.versions.clone()).collect();
    (events, versions)
}

#[test]
fn what_is_missing_from_the_log_is_noticed() {
    let group = encode_group(&[record(commit(4, &["a", "b"])), record(commit(5, &["a"]))]).unwrap();
    let (events, versions) = rows(&group);
    for (after, events, versions) in [
        (2, events.clone(), versions.clone()),
        (3, events[1..].to_vec(), versions.clone()),
        (3, events.clone(), versions[1..].to_vec()),
        (3, events.clone(), versions[..2].to_vec()),
    ] {
        let error = decode_commits(after, events, versions).unwrap_err();
        assert!(matches!(error, StoreError::Corrupt(_)), "{error}");
    }
}

#[test]
fn commits_that_do_not_follow_one_another_are_refused() {
    let mut empty = commit(4, &["a"]);
    empty.changes.clear();
    for wrong in [
        vec![record(commit(4, &["a"])), record(commit(6, &["a"]))],
        vec![record(commit(0, &["a"]))],
        vec![record(empty)],
    ] {
        assert!(encode_group(&wrong).is_err());
    }
}

#[test]
fn garbage_is_corrupt_and_no_panic() {
    let key: Key = "Node/a".parse().unwrap();
    for text in ["", "{}", "null", "{\"uid\":1}", "[1", "\u{0}"] {
        assert!(matches!(document(key.clone(), text), Err(StoreError::Corrupt(_))), "{text}");
    }
    let row = DocumentRow { key: "nonsense".to_owned(), revision: 1, document: "{}".to_owned() };
    assert!(matches!(row.into_document(), Err(StoreError::Corrupt(_))));
    assert!(unsigned(-1).is_err());
}
