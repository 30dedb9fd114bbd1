//! Pictures of the fleet as JSON: the live view, problems, what the topology has of health and
//! links, targets of Prometheus. What is not known is absent.

use std::time::Duration;

use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{Document, Timestamp};
use blaze_domain::{LayerName, NodeName};
use serde_json::{Map, Value, json};

use super::detail::{Detail, HealthProblem, Link, worst_first};
use super::fleet::{Entry, Fleet, Presence};
use super::health::{Health, Now};
use super::limits::{IDLE_PERIOD, MAX_LISTED};
use super::patch::{rounded, without_nulls};

/// What is shown.
#[derive(Debug, Clone, Default)]
pub struct Filter {
    /// The layer that the token is bound to: of others only name and state are shown.
    pub bound: Option<LayerName>,
    /// Only this layer.
    pub layer: Option<LayerName>,
    /// Only this node.
    pub node: Option<NodeName>,
    /// Only nodes with these labels.
    pub selector: Option<LabelSelector>,
}

impl Filter {
    fn sees(&self, layer: &LayerName) -> bool {
        self.bound.as_ref().is_none_or(|bound| bound == layer)
    }

    fn wants_layer(&self, layer: &LayerName) -> bool {
        self.layer.as_ref().is_none_or(|wanted| wanted == layer)
    }

    fn matches(&self, node: &NodeName, layer: &LayerName, document: &Document) -> bool {
        self.sees(layer)
            && self.wants_layer(layer)
            && self.node.as_ref().is_none_or(|wanted| wanted == node)
            && self.selector.as_ref().is_none_or(|wanted| wanted.matches(&document.labels))
    }

    /// Nodes that it shows, in the order of their names.
    pub fn nodes<'f>(
        &'f self,
        fleet: &'f Fleet,
    ) -> impl Iterator<Item = (&'f NodeName, &'f LayerName, &'f Document)> {
        fleet
            .nodes()
            .map(|(node, layer, held)| (node, layer, &*held.document))
            .filter(|(node, layer, document)| self.matches(node, layer, document))
    }
}

/// Revision of a node's worker, and whether it is in sync.
pub type WorkerOf<'w> = dyn Fn(&NodeName) -> Option<(u64, bool)> + 'w;

/// The fleet at a glance.
#[must_use]
pub fn fleet(fleet: &Fleet, filter: &Filter, revision: u64, worker: &WorkerOf, now: Now) -> Value {
    let layers = fleet.layers().filter(|(layer, _)| filter.wants_layer(layer));
    let layers = layers.map(|(layer, health)| {
        let kind = filter.sees(layer).then_some(&health.kind);
        (layer.to_string(), json!({ "kind": kind, "state": health.state().as_str() }))
    });
    let (mut nodes, mut links) = (Map::new(), Map::new());
    for (node, layer, document) in filter.nodes(fleet) {
        let entry = fleet.entry(node);
        let mut row = json!({
            "layer": layer, "labels": document.labels,
            "state": entry.map_or(Health::Unknown, Entry::health).as_str(),
        });
        if let Some((revision, in_sync)) = worker(node) {
            (row["revision"], row["in_sync"]) = (revision.into(), in_sync.into());
        }
        if let Some(entry) = entry {
            put_entry(&mut row, entry, now);
            put_links(&mut links, entry);
        }
        nodes.insert(node.to_string(), row);
    }
    without_nulls(json!({
        "revision": revision, "layers": layers.collect::<Map<_, _>>(), "nodes": nodes,
        "links": links, "missing": [],
    }))
}

fn put_entry(row: &mut Value, entry: &Entry, now: Now) {
    row["age_s"] = silent_s(entry.age(now)).into();
    let count = match entry.presence() {
        Presence::Present => {
            detail(entry).map_or(0, |detail| detail.problems.len() + detail.left_out)
        }
        Presence::Silent | Presence::Gone => 1,
    };
    row["problems"] = count.into();
    let (Some(report), Presence::Present) = (&entry.report, entry.presence()) else { return };
    let head = &report.head;
    row["topics"] = head.topics.into();
    for (name, value) in [
        ("cpu_ratio", head.cpu_ratio),
        ("memory_ratio", head.memory_ratio),
        ("celsius", head.celsius),
        ("in_hz", Some(entry.rates.taken_hz)),
        ("out_hz", Some(entry.rates.given_hz)),
        ("dropped_hz", Some(entry.rates.dropped_hz)),
    ] {
        row[name] = value.and_then(rounded).unwrap_or_default();
    }
}

/// Whole seconds without a summary; 0 while the next one is not due.
fn silent_s(age: Duration) -> u64 {
    if age <= IDLE_PERIOD + Duration::from_secs(2) { 0 } else { age.as_secs() }
}

fn detail(entry: &Entry) -> Option<&Detail> {
    entry.report.as_ref().map(|report| report.detail(&entry.layer))
}

fn put_links(out: &mut Map<String, Value>, entry: &Entry) {
    if entry.presence() != Presence::Present {
        return;
    }
    for link in detail(entry).into_iter().flat_map(|detail| &detail.links) {
        let number = |value: Option<f64>| value.and_then(rounded);
        let row = json!({
            "state": link.state, "rtt_ms": number(link.rtt_ms), "loss": number(link.loss),
            "bytes_per_s": number(link.bytes_per_s),
            "limit_bytes_per_s": number(link.limit_bytes_per_s),
            "queued_bytes": number(link.queued_bytes),
            "dropped_hz": number(dropped_hz(entry, link)),
        });
        out.insert(format!("{}>{}", link.from, link.to), row);
    }
}

fn dropped_hz(entry: &Entry, link: &Link) -> Option<f64> {
    let (then, before) = entry.dropped_before.as_ref()?;
    let before = *before.get(&(link.from.clone(), link.to.clone()))?;
    let report = entry.report.as_ref()?;
    let seconds = report.arrived.at.saturating_duration_since(then.at).as_secs_f64();
    let dropped = link.dropped.checked_sub(before).unwrap_or(link.dropped);
    (seconds > 0.0).then(|| dropped as f64 / seconds)
}

/// Problems of nodes and layers, worst first, then oldest: those that are shown, and how many there
/// are.
#[must_use]
pub fn problems(fleet: &Fleet, filter: &Filter, state: Option<Health>) -> (Vec<Value>, usize) {
    let mut found: Vec<(HealthProblem, &LayerName, Option<&NodeName>)> = Vec::new();
    for (layer, health) in fleet.layers() {
        if filter.sees(layer) && filter.wants_layer(layer) {
            let problems = health.problems(layer).into_iter();
            found.extend(problems.map(|problem| (problem, layer, None)));
        }
    }
    for (node, layer, _) in filter.nodes(fleet) {
        let Some(entry) = fleet.entry(node) else { continue };
        match entry.own_problem(node) {
            // What the node said before is old.
            Some(own) => found.push((own, layer, Some(node))),
            None => {
                let said = detail(entry).into_iter().flat_map(|detail| &detail.problems);
                found.extend(said.map(|problem| (problem.clone(), layer, Some(node))));
            }
        }
    }
    found.retain(|(problem, ..)| state.is_none_or(|state| state == problem.state));
    found.sort_by(|(a, ..), (b, ..)| worst_first(a, b));
    let total = found.len();
    let items = found.into_iter().take(MAX_LISTED).map(|(problem, layer, node)| {
        let mut item = problem.to_json();
        (item["layer"], item["node"]) = (json!(layer), json!(node));
        item
    });
    (items.collect(), total)
}

/// Health of a layer, as the topology has it.
#[must_use]
pub fn layer_health(fleet: &Fleet, layer: &LayerName) -> Value {
    let Some(health) = fleet.layer(layer) else { return Value::Null };
    let codes: Vec<String> =
        health.problems(layer).into_iter().map(|problem| problem.code).collect();
    health_json(health.state(), Some(health.since()), &codes)
}

fn health_json(state: Health, since: Option<Timestamp>, codes: &[String]) -> Value {
    let since = since.filter(|_| state != Health::Unknown).map(|since| since.to_string());
    json!({ "state": state.as_str(), "since": since, "codes": codes })
}

/// Health of a node, as the topology has it.
#[must_use]
pub fn node_health(fleet: &Fleet, node: &NodeName) -> Value {
    let Some(entry) = fleet.entry(node) else {
        return health_json(Health::Unknown, None, &[]);
    };
    if let Some(own) = entry.own_problem(node) {
        return json!({ "state": own.state.as_str(), "since": own.since, "codes": [own.code] });
    }
    let Some(detail) = detail(entry) else {
        return health_json(Health::Unknown, None, &[]);
    };
    let mut codes: Vec<&str> = detail.problems.iter().map(|p| p.code.as_str()).collect();
    codes.sort_unstable();
    codes.dedup();
    let since = Some(&detail.since).filter(|since| !since.is_empty());
    json!({ "state": entry.health().as_str(), "since": since, "codes": codes })
}

/// Health of a service on a node, as the topology has it.
#[must_use]
pub fn service_health(fleet: &Fleet, node: &NodeName, service: &str, instance: &str) -> Value {
    let entry = fleet.entry(node).filter(|entry| entry.presence() == Presence::Present);
    let services = entry.and_then(detail).into_iter().flat_map(|detail| &detail.services);
    let mut found = services.filter(|s| s.service == service && s.instance == instance);
    match found.next() {
        Some(service) => {
            let since = Some(&service.since).filter(|since| !since.is_empty());
            json!({ "state": service.state.as_str(), "since": since, "codes": service.codes })
        }
        None => health_json(Health::Unknown, None, &[]),
    }
}

/// Links of the flows, as the topology has them: one way is half the round trip.
#[must_use]
pub fn topology_links(fleet: &Fleet, filter: &Filter) -> Vec<Value> {
    let entries = filter.nodes(fleet).filter_map(|(node, ..)| fleet.entry(node));
    let present = entries.filter(|entry| entry.presence() == Presence::Present);
    let links = present.filter_map(detail).flat_map(|detail| &detail.links);
    let link = |link: &Link| {
        json!({
            "from_node": link.from.node, "to_node": link.to.node,
            "latency_ms": link.rtt_ms.and_then(|rtt| rounded(rtt / 2.0)),
            "loss": link.loss.and_then(rounded),
        })
    };
    links.map(link).collect()
}

/// Targets for Prometheus' discovery over HTTP: nodes whose metrics can be scraped from outside.
#[must_use]
pub fn targets(fleet: &Fleet, filter: &Filter) -> Value {
    let targets = filter.nodes(fleet).filter_map(|(node, layer, _)| {
        let address = &fleet.entry(node)?.metrics_address;
        (!address.is_empty()).then(|| {
            json!({
                "targets": [address],
                "labels": { "layer": layer, "node": node, "__param_all": "1" },
            })
        })
    });
    targets.collect()
}
