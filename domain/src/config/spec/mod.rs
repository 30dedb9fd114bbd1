//! What users write: the envelope of a document, and the rules for its labels, annotations and
//! spec.
//!
//! ```text
//! body ──[parse_envelope]──▶ Envelope ──key──▶ [check] ──▶ every fault, each with its pointer
//!                                                │ spec by kind · configurations: secrets, sections of the node file
//! Document ──[references]──▶ keys that must exist
//! ```
//!
//! Everything here looks at one document alone. What needs others (references, schemas of services,
//! stored secrets) is the business of the main service.

mod configuration;
mod envelope;
mod fields;
mod rollout;
mod sections;
#[cfg(test)]
mod tests;

use std::io;
use std::net::IpAddr;

use serde::Serialize;
use serde_json::Value;

use super::selector::{check_label_key, check_label_value, is_dns_name};
use super::{
    Document, FieldFault, Key, Kind, Labels, MAX_DEPTH, MAX_LABELS, MAX_SCHEMA_BYTES, json, secret,
};
use crate::names::{LayerName, NodeName};
use crate::qos::{LayerKind, word_enum};
use configuration::{check_configurations, check_program};
use fields::{At, Faults, Fields};
use rollout::check_rollout;

pub use envelope::{Envelope, parse_envelope, parse_new};
pub use sections::NODE_FILE_SECTIONS;

/// The programs of BlazeAIoT, which are services too. No other service has a name that begins as
/// theirs do.
pub const PROGRAMS: [&str; 4] = ["blaze-config", "blaze-flow", "blaze-worker", "blaze-monitor"];
/// Addresses of a node, at most.
pub const MAX_ADDRESSES: usize = 16;
/// Layers that a service names, at most.
pub const MAX_SERVICE_LAYERS: usize = 1024;
/// Longest description of a service, in characters.
pub const MAX_DESCRIPTION_CHARS: usize = 4096;
/// Longest key of an annotation, in characters.
pub const MAX_ANNOTATION_KEY_CHARS: usize = 253;
/// Longest pointer to a value of a document, in bytes: lists of changes name each of them.
pub const MAX_POINTER_BYTES: usize = 1024;
/// Most units of one resource of a node.
pub const MAX_RESOURCE_UNITS: u32 = 1_000_000;
/// Shortest and longest window of a roll-out's gate, in seconds.
pub const GATE_WINDOW_S: (u64, u64) = (5, 3600);
/// Most services that a roll-out's gate may let be unhealthy.
pub const MAX_UNHEALTHY: u64 = 1_000_000;

/// Largest integer, where it is the only bound.
const MAX_WHOLE: u64 = super::MAX_INTEGER.unsigned_abs();

word_enum!(
    /// What a node is to its network.
    NodeType {
        /// It stays where it is.
        Static = "static",
        /// It connects others.
        Gateway = "gateway",
        /// It moves.
        Mobile = "mobile",
    }
);

/// Members of the spec of a kind.
fn members_of(kind: Kind) -> &'static [&'static str] {
    match kind {
        Kind::Layer => &["kind", "config", "overrides"],
        Kind::Node => &["layer", "type", "addresses", "resources", "config", "overrides"],
        Kind::Service => &["description", "config", "schema", "layers"],
        Kind::Instance => &["node", "layer", "config"],
        Kind::Rollout => &["target", "patch", "canary", "gate"],
    }
}

/// Checks what a user wrote. Secrets may be texts, redacted or revealed.
///
/// Gives every fault, up to a hundred, with pointers into the document; none: it is good.
#[must_use]
pub fn check(key: &Key, labels: &Labels, annotations: &Labels, spec: &Value) -> Vec<FieldFault> {
    let faults = Faults::default();
    if key.kind() == Kind::Service {
        check_program(key.name().as_str(), "/name", &faults);
    }
    check_labels(labels, &faults);
    check_annotations(annotations, &faults);
    check_spec(key.kind(), &At::new(spec, "/spec", &faults));
    faults.into_vec()
}

fn check_labels(labels: &Labels, faults: &Faults) {
    if labels.len() > MAX_LABELS {
        faults.add(
            "/labels",
            format!("has {} labels, at most {MAX_LABELS} are allowed", labels.len()),
        );
        return;
    }
    for (key, value) in labels {
        let pointer = json::push("/labels", key);
        if let Err(error) = check_label_key(key) {
            faults.add(&pointer, format!("the key {error}"));
        }
        if let Err(error) = check_label_value(value) {
            faults.add(&pointer, format!("the value {error}"));
        }
    }
}

fn check_annotations(annotations: &Labels, faults: &Faults) {
    for key in annotations.keys() {
        let count = key.chars().count();
        if !(1..=MAX_ANNOTATION_KEY_CHARS).contains(&count) || key.chars().any(char::is_control) {
            let detail = format!(
                "the key must have 1 to {MAX_ANNOTATION_KEY_CHARS} characters that can be seen"
            );
            faults.add(&json::push("/annotations", key), detail);
        }
    }
}

fn check_spec(kind: Kind, at: &At<'_>) {
    // The document itself is one level.
    if let Err(fault) = json::check(at.value) {
        at.faults.add(&format!("/spec{}", fault.pointer), fault.detail);
        return;
    }
    if json::depth(at.value) >= MAX_DEPTH {
        let detail = format!(
            "is nested too deep: a document has at most {MAX_DEPTH} levels, a secret counts as two"
        );
        at.refuse::<()>(detail);
    }
    let Some(spec) = at.fields(members_of(kind)) else {
        return;
    };
    match kind {
        Kind::Layer => {
            spec.need("kind").and_then(|at| at.parsed::<LayerKind>());
            check_configurations(&spec);
        }
        Kind::Node => check_node(&spec),
        Kind::Service => check_service(&spec),
        Kind::Instance => check_instance(&spec),
        Kind::Rollout => check_rollout(&spec),
    }
}

fn check_node(spec: &Fields<'_>) {
    spec.need("layer").and_then(|at| at.parsed::<LayerName>());
    spec.get("type").and_then(|at| at.parsed::<NodeType>());
    for address in spec.get("addresses").map(|at| at.list(MAX_ADDRESSES)).unwrap_or_default() {
        if let Some(text) = address.text(253).filter(|text| !is_address(text)) {
            address.refuse::<()>(format!("{text:?} is neither an IP address nor a host name"));
        }
    }
    if let Some(resources) =
        spec.get("resources").and_then(|at| at.fields(&["cpus", "memory_bytes", "gpus", "arch"]))
    {
        resources.get("cpus").and_then(|at| at.positive(MAX_RESOURCE_UNITS.into()));
        resources.get("memory_bytes").and_then(|at| at.whole(0, MAX_WHOLE));
        resources.get("gpus").and_then(|at| at.whole(0, MAX_RESOURCE_UNITS.into()));
        if let Some(at) = resources.get("arch")
            && at.text(63).is_some_and(|text| text.is_empty() || check_label_value(text).is_err())
        {
            at.refuse::<()>(
                "is no architecture, such as arm64: 1 to 63 of A-Z, a-z, 0-9, -, _ and .",
            );
        }
    }
    check_configurations(spec);
}

/// An IPv4 or IPv6 address, or a name of the DNS.
fn is_address(text: &str) -> bool {
    let is_numeric = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    text.parse::<IpAddr>().is_ok() || (!is_numeric && is_dns_name(&text.to_ascii_lowercase()))
}

fn check_service(spec: &Fields<'_>) {
    spec.get("description").and_then(|at| at.text(MAX_DESCRIPTION_CHARS));
    if let Some(at) = spec.get("schema") {
        check_schema(&at);
    }
    let mut seen = Vec::new();
    for layer in spec.get("layers").map(|at| at.list(MAX_SERVICE_LAYERS)).unwrap_or_default() {
        if let Some(name) = layer.parsed::<LayerName>() {
            if seen.contains(&name) {
                layer.refuse::<()>(format!("{name} is named twice"));
            }
            seen.push(name);
        }
    }
    check_configurations(spec);
}

/// Whether it is a sound schema is for the main service to say.
fn check_schema(at: &At<'_>) {
    if !at.value.is_object() && !at.value.is_boolean() {
        at.expected::<()>("a JSON Schema: an object, true or false");
    }
    let bytes = json_size(at.value);
    if bytes > MAX_SCHEMA_BYTES {
        at.refuse::<()>(format!("has {bytes} bytes, at most {MAX_SCHEMA_BYTES} are allowed"));
    }
    if secret::contains(at.value) {
        at.refuse::<()>(
            "names $secret; a secret is checked as its text, so describe it as a string",
        );
    }
}

fn check_instance(spec: &Fields<'_>) {
    spec.get("node").and_then(|at| at.parsed::<NodeName>());
    spec.get("layer").and_then(|at| at.parsed::<LayerName>());
    if spec.get("node").is_some() && spec.get("layer").is_some() {
        spec.at.refuse::<()>("names both node and layer; an instance is placed on one of them");
    }
    check_configurations(spec);
}

/// The documents that a document refers to, each with the JSON pointer to where it does. Names in
/// `overrides` are no references: the service may come later.
#[must_use]
pub fn references(document: &Document) -> Vec<(String, Key)> {
    let mut out = Vec::new();
    let mut refer =
        |pointer: &str, key: Option<Key>| out.extend(key.map(|key| (pointer.to_owned(), key)));
    let layer = |text: &str| text.parse::<LayerName>().ok().map(|name| Key::layer(&name));
    match document.key.kind() {
        Kind::Layer => {}
        Kind::Node => refer("/spec/layer", document.spec_layer().and_then(layer)),
        Kind::Service => {
            let layers = document.spec_member("layers").and_then(Value::as_array);
            for (index, name) in layers.into_iter().flatten().enumerate() {
                refer(&format!("/spec/layers/{index}"), name.as_str().and_then(layer));
            }
        }
        Kind::Instance => {
            refer("/service", document.key.service_name().map(Key::service));
            let node = document.spec_node().and_then(|text| text.parse::<NodeName>().ok());
            refer("/spec/node", node.map(|name| Key::node(&name)));
            refer("/spec/layer", document.spec_layer().and_then(layer));
        }
        Kind::Rollout => {
            refer("/spec/target", document.spec_member("target").and_then(rollout_target));
        }
    }
    out
}

/// The key that `spec.target` of a roll-out names.
#[must_use]
pub fn rollout_target(target: &Value) -> Option<Key> {
    let text = |name: &str| target.get(name).and_then(Value::as_str);
    let kind: Kind = text("kind")?.parse().ok()?;
    let service = match text("service") {
        Some(service) => Some(service.parse().ok()?),
        None => None,
    };
    Key::new(kind, service, text("name")?.parse().ok()?).ok()
}

/// Size of a document without kind and name, in bytes of its compact JSON.
#[must_use]
pub fn document_size(labels: &Labels, annotations: &Labels, spec: &Value) -> usize {
    #[derive(Serialize)]
    struct Body<'a> {
        labels: &'a Labels,
        annotations: &'a Labels,
        spec: &'a Value,
    }
    json_size(&Body { labels, annotations, spec })
}

/// Size of a value, in bytes of its compact JSON.
#[must_use]
pub fn json_size(value: &impl Serialize) -> usize {
    struct Counter(usize);
    impl io::Write for Counter {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0 += bytes.len();
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let mut counter = Counter(0);
    match serde_json::to_writer(&mut counter, value) {
        Ok(()) => counter.0,
        // What is no JSON fits nowhere.
        Err(_) => usize::MAX,
    }
}
