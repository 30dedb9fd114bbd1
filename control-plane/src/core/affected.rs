//! Which places a set of changed documents can concern, and whose effective configuration really is another one.

use std::collections::BTreeSet;

use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{LayerName, NodeName, ServiceName};

use super::effective::{At, Sources, canaries, is_canary};
use super::placement::rollout_target;
use super::state::State;
use super::view::View;

/// Places that are looked at for one request, at most: beyond it the answer would take longer than it is worth.
pub(crate) const MAX_CANDIDATES: usize = 200_000;
/// The same for an answer that is kept with the commit: nobody can write while it is worked out.
pub(crate) const MAX_KEPT_CANDIDATES: usize = 1000;

/// A set of places that takes no more than so many.
struct Places {
    found: BTreeSet<At>,
    limit: usize,
}

impl Places {
    fn is_full(&self) -> bool {
        self.found.len() >= self.limit
    }

    fn add(&mut self, at: At) {
        if !self.is_full() {
            self.found.insert(at);
        }
    }
}

/// Instances with a document, and services without an instance at the layers and nodes that treat them on their own.
fn candidates(state: &State, keys: &[Key], limit: usize) -> BTreeSet<At> {
    let mut out = Places {
        found: BTreeSet::new(),
        limit,
    };
    for key in keys {
        of_key(state, key, &mut out);
    }
    out.found
}

fn of_key(state: &State, key: &Key, out: &mut Places) {
    if out.is_full() {
        return;
    }
    match key.kind() {
        Kind::Service => {
            let service = ServiceName::from(key.name());
            for (_, held) in state.instances(&service).take(out.limit) {
                out.add(Sources::placed(state, &service, &held.document));
            }
            for (layer, _) in state.of_kind(Kind::Layer, None) {
                at_layer(state, &service, &LayerName::from(layer.name()), out);
            }
        }
        Kind::Layer => {
            let layer = LayerName::from(key.name());
            for service in services_of(state, key) {
                at_layer(state, &service, &layer, out);
            }
            for placed in state.in_layer(&layer) {
                of_placed(state, placed, out);
            }
        }
        Kind::Node => {
            let node = NodeName::from(key.name());
            let layer = state.get(key).and_then(|held| held.document.spec_layer()?.parse().ok());
            for service in services_of(state, key) {
                out.add(At {
                    service: Some(service),
                    instance: None,
                    layer: layer.clone(),
                    node: Some(node.clone()),
                });
            }
            for placed in state.on_node(&node) {
                of_placed(state, placed, out);
            }
        }
        Kind::Instance => of_placed(state, key, out),
        Kind::Rollout => {
            let target = state.get(key).and_then(|held| rollout_target(&held.document));
            if let Some(target) = target.filter(|target| target.kind() != Kind::Rollout) {
                of_key(state, &target, out);
            }
        }
    }
}

/// A node's or an instance's own places.
fn of_placed(state: &State, key: &Key, out: &mut Places) {
    if out.is_full() {
        return;
    }
    match (key.kind(), key.service_name()) {
        (Kind::Instance, Some(service)) => {
            if let Some(held) = state.get(key) {
                out.add(Sources::placed(state, service, &held.document));
            }
        }
        (Kind::Node, _) => {
            for placed in state.on_node(&NodeName::from(key.name())) {
                of_placed(state, placed, out);
            }
        }
        _ => {}
    }
}

/// Services that a layer or node can matter to.
fn services_of(state: &State, key: &Key) -> Vec<ServiceName> {
    let layer = match state.get(key) {
        Some(held) if key.kind() == Kind::Node => held.document.spec_layer().map(ToOwned::to_owned),
        _ => Some(key.name().to_string()),
    };
    let services = state.of_kind(Kind::Service, None);
    services
        .filter(|(_, held)| layer.as_ref().is_none_or(|layer| held.document.is_for_layer(layer)))
        .map(|(key, _)| ServiceName::from(key.name()))
        .collect()
}

/// A service without instance in a layer: on no node, on each node that has something of its own to say, and on each where
/// a roll-out tries a change of the service, the layer or the node.
fn at_layer(state: &State, service: &ServiceName, layer: &LayerName, out: &mut Places) {
    let visible = state
        .get(&Key::service(service))
        .is_none_or(|held| held.document.is_for_layer(layer.as_str()));
    if !visible || out.is_full() {
        return;
    }
    let place = |node: Option<NodeName>| At {
        service: Some(service.clone()),
        instance: None,
        layer: Some(layer.clone()),
        node,
    };
    out.add(place(None));
    let is_empty = |value: &serde_json::Value| value.as_object().is_some_and(serde_json::Map::is_empty);
    let own_word = |document: &Document| {
        let overrides = document.overrides(service.as_str());
        [document.config(), overrides]
            .into_iter()
            .flatten()
            .any(|config| !is_empty(config))
    };
    let tried: Vec<LabelSelector> = [Key::service(service), Key::layer(layer)]
        .iter()
        .flat_map(|target| state.active_on(target))
        .filter_map(|held| canaries(&held.document))
        .collect();
    for key in state.in_layer(layer) {
        if out.is_full() {
            return;
        }
        let Some(held) = state.get(key).filter(|_| key.kind() == Kind::Node) else {
            continue;
        };
        let node = &held.document;
        if own_word(node)
            || tried.iter().any(|selector| selector.matches(&node.labels))
            || state.active_on(key).any(|rollout| is_canary(&rollout.document, node))
        {
            out.add(place(Some(NodeName::from(key.name()))));
        }
    }
}

/// Places whose effective configuration may be another one after the change.
pub(crate) fn touched(state: &State, keys: &[Key]) -> BTreeSet<At> {
    candidates(state, keys, MAX_CANDIDATES)
}

/// Places whose effective configuration is another one, in order, as far as they are seen. Of each state at most `limit`
/// are looked at.
pub(crate) fn changed(before: &State, after: &State, keys: &[Key], view: &View, limit: usize) -> Vec<At> {
    let mut places = candidates(before, keys, limit);
    places.extend(candidates(after, keys, limit));
    places
        .into_iter()
        .filter(|at| view.sees_place(before, at) || view.sees_place(after, at))
        .filter(|at| {
            let hash = |state: &State| exists(state, at).then(|| Sources::at(state, at).hash());
            hash(before) != hash(after)
        })
        .collect()
}

/// Whether the service, and the instance if one is named, is there to have a configuration.
fn exists(state: &State, at: &At) -> bool {
    let service = at
        .service
        .as_ref()
        .is_some_and(|name| state.get(&Key::service(name)).is_some());
    match (&at.service, &at.instance) {
        (Some(service), Some(instance)) => state.get(&Key::instance(service.clone(), instance.clone())).is_some(),
        _ => service,
    }
}
