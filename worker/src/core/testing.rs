//! Small documents for the tests of this module.

use std::sync::Arc;

use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, Labels, Timestamp};
use serde_json::Value;

use super::served_target::{ServedTarget, Site};

/// A document of a key such as `Instance/slam/0`; its uid is its key.
pub(crate) fn document(key: &str, revision: u64, spec: Value) -> Document {
    Document {
        key: key.parse().unwrap(),
        uid: key.to_owned(),
        revision,
        create_time: Timestamp::default(),
        update_time: Timestamp::default(),
        updated_by: "ops".to_owned(),
        labels: Labels::new(),
        annotations: Labels::new(),
        spec: Arc::new(spec),
        status: None,
    }
}

/// The same with a label.
pub(crate) fn labelled(key: &str, revision: u64, spec: Value, label: (&str, &str)) -> Document {
    let mut out = document(key, revision, spec);
    out.labels.insert(label.0.to_owned(), label.1.to_owned());
    out
}

pub(crate) fn state(revision: u64, documents: impl IntoIterator<Item = Document>) -> State {
    State::new(revision, documents)
}

pub(crate) fn keys<const N: usize>(texts: [&str; N]) -> Vec<Key> {
    let mut out: Vec<Key> = texts.iter().map(|text| text.parse().unwrap()).collect();
    out.sort();
    out
}

/// `slam`, `slam/0`, each with `@node` behind it or not.
pub(crate) fn place(text: &str) -> ServedTarget {
    let (name, node) = match text.split_once('@') {
        Some((name, node)) => (name, Some(node.parse().unwrap())),
        None => (text, None),
    };
    let (service, instance) = match name.split_once('/') {
        Some((service, instance)) => (service, Some(instance.parse().unwrap())),
        None => (name, None),
    };
    ServedTarget { service: service.parse().unwrap(), instance, node }
}

/// Layer `edge`, on the broker of a node or of the layer.
pub(crate) fn site(node: Option<&str>) -> Site {
    Site { layer: "edge".parse().unwrap(), node: node.map(|node| node.parse().unwrap()) }
}
