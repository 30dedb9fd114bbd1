//! Documents, notes and copies for tests.

use std::sync::Arc;

use blaze_domain::config::{Document, Key, Labels, Timestamp};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::{Loaded, Notes, Position};
use crate::core::ServedTarget;

/// A document of any kind.
pub(super) fn document(key: &str, revision: u64, spec: Value) -> Document {
    Document {
        key: key.parse().unwrap(),
        uid: format!("uid-{key}"),
        revision,
        create_time: Timestamp::from_millis(1_795_244_472_345),
        update_time: Timestamp::from_millis(1_795_244_472_345 + i64::try_from(revision).unwrap()),
        updated_by: "ops@example.org".to_owned(),
        labels: Labels::new(),
        annotations: Labels::new(),
        spec: Arc::new(spec),
        status: None,
    }
}

/// A service.
pub(super) fn service(name: &str, revision: u64, spec: Value) -> Document {
    document(&format!("Service/{name}"), revision, spec)
}

/// How far, in store `store-a` and layer `edge`.
pub(super) fn position(revision: u64) -> Position {
    Position {
        store_id: "store-a".to_owned(),
        layer: "edge".parse().unwrap(),
        revision,
        as_of: Timestamp::from_millis(1_795_244_472_000 + i64::try_from(revision).unwrap()),
    }
}

/// A copy with these documents, in the order of their keys.
pub(super) fn loaded(revision: u64, documents: impl IntoIterator<Item = Document>) -> Loaded {
    let mut documents: Vec<Arc<Document>> = documents.into_iter().map(Arc::new).collect();
    documents.sort_by(|one, other| one.key.cmp(&other.key));
    Loaded { position: position(revision), documents, notes: Arc::default() }
}

/// Notes with one failed roll-out and one place.
pub(super) fn notes(uid: &str, floor: u64) -> Notes {
    Notes {
        failed: vec![uid.to_owned()],
        places: vec![ServedTarget {
            service: "slam".parse().unwrap(),
            instance: Some("0".parse().unwrap()),
            node: None,
        }],
        ended: Vec::new(),
        floor,
    }
}

/// A service whose configuration holds a text that must not be found anywhere.
pub(super) fn with_secret(name: &str, revision: u64, text: &str) -> Document {
    let secret = json!({ "$secret": { "text": text, "version": revision } });
    service(
        name,
        revision,
        json!({ "config": { "user": "me", "password": secret, "list": [secret] } }),
    )
}

fn any_value() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::from),
        any::<i32>().prop_map(Value::from),
        prop::num::f64::NORMAL.prop_map(|number| Value::from(number % 1e12)),
        ".{0,8}".prop_map(Value::from),
        (".{0,8}", 0_u64..9)
            .prop_map(|(text, version)| json!({ "$secret": { "text": text, "version": version } })),
        ".{0,8}".prop_map(|text| json!({ "$secret": text })),
    ];
    leaf.prop_recursive(4, 32, 4, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(Value::from),
            prop::collection::btree_map("[a-d.$\u{e4}]{0,3}", inner, 0..4)
                .prop_map(|members| Value::Object(members.into_iter().collect())),
        ]
    })
}

fn any_key() -> impl Strategy<Value = Key> {
    prop_oneof![
        "[a-c]{1,2}".prop_map(|name| format!("Layer/{name}")),
        "[a-c]{1,2}".prop_map(|name| format!("Node/{name}")),
        "[a-c]{1,2}".prop_map(|name| format!("Service/{name}")),
        ("[a-c]{1,2}", "[a-c0-9]{1,2}")
            .prop_map(|(service, name)| format!("Instance/{service}/{name}")),
        "[a-c]{1,2}".prop_map(|name| format!("Rollout/{name}")),
    ]
    .prop_map(|text| text.parse().unwrap())
}

fn any_labels() -> impl Strategy<Value = Labels> {
    prop::collection::btree_map("[a-c./]{1,4}", ".{0,5}", 0..3)
}

/// Any document, with secrets here and there.
pub(super) fn any_document() -> impl Strategy<Value = Document> {
    let spec = prop::collection::btree_map("[a-d]{1,2}", any_value(), 0..4)
        .prop_map(|members| Value::Object(members.into_iter().collect()));
    let times = (0_i64..4_000_000_000_000, 0_i64..4_000_000_000_000);
    let status =
        prop::option::of(any_value().prop_map(|value| json!({ "phase": "canary", "more": value })));
    let texts = ("[0-9a-f-]{0,36}", ".{0,12}");
    (any_key(), texts, 0..1_u64 << 53, times, (any_labels(), any_labels()), spec, status).prop_map(
        |(key, (uid, updated_by), revision, times, (labels, annotations), spec, status)| Document {
            key,
            uid,
            revision,
            create_time: Timestamp::from_millis(times.0),
            update_time: Timestamp::from_millis(times.1),
            updated_by,
            labels,
            annotations,
            spec: Arc::new(spec),
            status,
        },
    )
}

/// Documents of different keys, in their order.
pub(super) fn any_documents() -> impl Strategy<Value = Vec<Arc<Document>>> {
    prop::collection::vec(any_document(), 0..8).prop_map(|documents| {
        let by_key: std::collections::BTreeMap<Key, Arc<Document>> = documents
            .into_iter()
            .map(|document| (document.key.clone(), Arc::new(document)))
            .collect();
        by_key.into_values().collect()
    })
}

/// Any notes.
pub(super) fn any_notes() -> impl Strategy<Value = Notes> {
    let name = || prop::option::of("[a-c]{1,2}");
    let place = ("[a-c]{1,2}", name(), name()).prop_map(|(service, instance, node)| ServedTarget {
        service: service.parse().unwrap(),
        instance: instance.map(|name| name.parse().unwrap()),
        node: node.map(|name| name.parse().unwrap()),
    });
    let failed = prop::collection::vec("[0-9a-f]{1,4}", 0..5);
    let places = move || prop::collection::vec(place.clone(), 0..6);
    (failed, places(), places(), 0..1_u64 << 53).prop_map(|(failed, places, ended, floor)| Notes {
        failed,
        places,
        ended,
        floor,
    })
}

/// These bytes, cut off somewhere or with one of them changed.
pub(super) fn any_bytes_of(bytes: Vec<u8>) -> impl Strategy<Value = Vec<u8>> {
    let length = bytes.len();
    (0..length.max(1), any::<bool>(), 1..=255_u8).prop_map(move |(at, cut, change)| {
        let mut bytes = bytes.clone();
        if cut {
            bytes.truncate(at);
        } else if let Some(byte) = bytes.get_mut(at) {
            *byte ^= change;
        }
        bytes
    })
}
