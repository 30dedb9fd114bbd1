//! What joining makes of options and of what is there: the document of the node and its node file.
//! Nothing is sent or written here.

use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};

use blaze_brokers::layer_fault;
use blaze_domain::node_file::{Fault, NodeFile};
use blaze_worker::settings::WorkerSettings;
use reqwest::Url;
use serde_json::{Map, Value, json};

use super::options::{JoinOptions, LayerBrokerChoice, NodeBrokerChoice};
use crate::config::endpoint::is_loopback;
use crate::exit::{CliError, lines};

/// gRPC port of the main service where nothing else is said.
const GRPC_PORT: u16 = 50_051;
/// Redis of an edge node where nothing else is said.
const NODE_REDIS: &str = "redis://127.0.0.1:6379";
/// Kafka of a layer where nothing else is said.
const LAYER_KAFKA: &str = "127.0.0.1:9092";
/// DDS domain of an edge layer where nothing else is said.
const LAYER_DOMAIN: u16 = 10;

/// What the document of the node becomes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NodePlan {
    /// Body of the PUT.
    pub(super) body: Value,
    /// `created`, `updated` or `unchanged`.
    pub(super) action: &'static str,
}

/// The document: what is there stays, but for what the options say.
///
/// # Errors
/// [`CliError::Invalid`] for a node that stands in another layer.
pub(super) fn document(
    options: &JoinOptions,
    existing: Option<&Value>,
) -> Result<NodePlan, CliError> {
    let object = |name: &str| {
        let found = existing.and_then(|document| document.get(name)).cloned();
        found.unwrap_or_else(|| json!({}))
    };
    let (mut labels, mut spec) = (object("labels"), object("spec"));
    let layer = options.layer.as_str();
    if let Some(other) = spec.get("layer").and_then(Value::as_str).filter(|other| *other != layer) {
        let name = &options.name;
        return Err(CliError::Invalid(format!(
            "node {name} stands in layer {other}, not in {layer}.\n  Join it with --layer {other}, \
             or move it first: blaze patch node {name} -p '{{\"spec\":{{\"layer\":\"{layer}\"}}}}'"
        )));
    }
    spec["layer"] = json!(layer);
    if let Some(node_type) = options.node_type {
        spec["type"] = json!(node_type.as_str());
    }
    if !options.addresses.is_empty() {
        spec["addresses"] = json!(options.addresses);
    }
    for (key, value) in &options.labels {
        labels[key.as_str()] = json!(value);
    }
    let mut body = json!({ "labels": labels, "annotations": object("annotations"), "spec": spec });
    let action = match existing {
        None => "created",
        Some(document)
            if ["labels", "spec"].iter().all(|name| document.get(name) == body.get(name)) =>
        {
            "unchanged"
        }
        Some(_) => "updated",
    };
    if existing.is_none() {
        body = json!({ "labels": body["labels"], "spec": body["spec"] });
    }
    Ok(NodePlan { body, action })
}

/// What else the node file is made of.
#[derive(Debug, Clone)]
pub(super) struct Around<'a> {
    /// REST of the main service.
    pub(super) server: &'a Url,
    /// Authorities that were used for it.
    pub(super) ca_file: Option<&'a Path>,
    /// A client certificate was shown to it.
    pub(super) shows_certificate: bool,
    /// Kind of the layer: `edge`, `fog`, `cloud`.
    pub(super) kind: &'a str,
    /// The token on this machine, if it is kept in a file.
    pub(super) token_file: Option<&'a Path>,
    /// Addresses of the node: those of the options, else those that its document has.
    pub(super) addresses: &'a [IpAddr],
}

/// Addresses that a document has. What is none is left out: it is the document's to say, and
/// nothing of it is written.
pub(super) fn addresses_of(document: &Value) -> Vec<IpAddr> {
    let all = document.pointer("/spec/addresses").and_then(Value::as_array);
    let texts = all.into_iter().flatten().filter_map(Value::as_str);
    texts.filter_map(|text| text.parse().ok()).collect()
}

/// The node file, and what should be known of it.
///
/// # Errors
/// [`CliError::Invalid`] with everything that `blaze-flow --check` or `blaze-worker --check` would
/// have against it.
pub(super) fn node_file(
    options: &JoinOptions,
    around: &Around<'_>,
) -> Result<(Value, Vec<String>), CliError> {
    let mut notes = Vec::new();
    let mut config = Map::new();
    config.insert("server".to_owned(), json!(grpc(options, around, &mut notes)?));
    let ca_path = options.ca_path.as_deref().or(around.ca_file);
    let token_path = options.token_path.as_deref().or(around.token_file);
    let (cert_path, key_path) = (options.cert_path.as_deref(), options.key_path.as_deref());
    if around.shows_certificate && cert_path.is_none() {
        notes.push(
            "the server asks for client certificates: give the worker one of its own with \
             --cert-path and --key-path"
                .to_owned(),
        );
    }
    for (key, path) in [
        ("ca_file", ca_path),
        ("token_file", token_path),
        ("cert_file", cert_path),
        ("key_file", key_path),
    ] {
        if let Some(path) = path {
            config.insert(key.to_owned(), json!(absolute(path)));
        }
    }
    let file = json!({
        "layer": { "name": options.layer, "kind": around.kind },
        "node": { "name": options.name },
        "brokers": brokers(options, around, &mut notes),
        "config": config,
        "state_dir": options.state_dir,
    });
    let faults = faults(&file);
    if faults.is_empty() {
        return Ok((file, notes));
    }
    Err(CliError::Invalid(format!(
        "the programs of the node would not start with what these options say:\n  {}",
        lines(&faults)
    )))
}

fn grpc(
    options: &JoinOptions,
    around: &Around<'_>,
    notes: &mut Vec<String>,
) -> Result<String, CliError> {
    let url = match &options.grpc {
        Some(url) => url.clone(),
        None => {
            let mut url = around.server.clone();
            url.set_path("");
            url.set_port(Some(GRPC_PORT)).map_err(|()| {
                CliError::Usage("--server has no host: name the gRPC port with --grpc".to_owned())
            })?;
            url
        }
    };
    let host = url.host_str().unwrap_or_default().trim_matches(['[', ']']);
    if is_loopback(&url) {
        notes.push(format!(
            "config.server is {host}: the node file is for this machine; for another one give \
             --grpc https://HOST:PORT"
        ));
    } else if url.scheme() == "http" {
        return Err(CliError::Usage(format!(
            "{url}: the token and secrets would go in clear over a network; give --grpc \
             https://HOST:PORT"
        )));
    }
    Ok(url.as_str().trim_end_matches('/').to_owned())
}

fn brokers(options: &JoinOptions, around: &Around<'_>, notes: &mut Vec<String>) -> Value {
    let is_edge = around.kind == "edge";
    let own = around.addresses.iter().find_map(|address| match address {
        IpAddr::V4(address) => Some(*address),
        IpAddr::V6(_) => None,
    });
    let mut brokers = Map::new();
    let node = match &options.node_broker {
        Some(NodeBrokerChoice::Section(section)) => Some(section.clone()),
        Some(NodeBrokerChoice::None) => None,
        None => is_edge.then(|| json!({ "redis": { "url": NODE_REDIS } })),
    };
    let layer = match &options.layer_broker {
        Some(choice) => layer_section(choice, own),
        None if is_edge => {
            own.map(|own| json!({ "dds": { "domain": LAYER_DOMAIN, "interface": own } }))
        }
        None => Some(json!({ "kafka": { "bootstrap": [LAYER_KAFKA] } })),
    };
    let inter = own.map(|own| {
        json!({ "dds": { "domain": options.inter_domain, "listen": own,
            "peers": options.peers } })
    });
    if inter.is_none() {
        notes.push(
            "without --address the node reaches no other layer: brokers.inter is left out"
                .to_owned(),
        );
    }
    for (scope, section) in [("node", node), ("layer", layer), ("inter", inter)] {
        if let Some(section) = section {
            brokers.insert(scope.to_owned(), section);
        }
    }
    Value::Object(brokers)
}

fn layer_section(choice: &LayerBrokerChoice, own: Option<Ipv4Addr>) -> Option<Value> {
    match choice {
        LayerBrokerChoice::None => None,
        LayerBrokerChoice::Memory => Some(json!({ "memory": {} })),
        // Without an address the check says what is missing.
        LayerBrokerChoice::Dds(domain) => Some(match own {
            Some(own) => json!({ "dds": { "domain": domain, "interface": own } }),
            None => json!({ "dds": { "domain": domain } }),
        }),
        LayerBrokerChoice::Kafka(servers) => Some(json!({ "kafka": { "bootstrap": servers } })),
    }
}

/// What the programs of a node have against a node file.
fn faults(file: &Value) -> Vec<Fault> {
    let read = match NodeFile::read(file) {
        Ok((read, _)) => read,
        Err(faults) => return faults,
    };
    let mut faults = read.check_for_flow();
    for fault in WorkerSettings::of(&read).err().unwrap_or_default() {
        if !faults.iter().any(|known| known.path == fault.path) {
            faults.push(fault);
        }
    }
    faults.extend(layer_fault(&read));
    faults
}

/// A path of this machine from its root; as it is where that cannot be said.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
