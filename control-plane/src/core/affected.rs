//! Which places a set of changed documents can concern, and whose effective configuration really is another one.

use std::collections::BTreeSet;

use blaze_domain::config::{Key, Kind};
use blaze_domain::{LayerName, NodeName, ServiceName};

use super::effective::{At, Sources};
use super::placement::rollout_target;
use super::state::State;

/// Places that are looked at for one request, at most: beyond it the answer would take longer than it is worth.
const MAX_CANDIDATES: usize = 200_000;

/// Instances with a document, and services without an instance at the layers and nodes that treat them on their own.
fn candidates(state: &State, keys: &[Key]) -> BTreeSet<At> {
    let mut out = BTreeSet::new();
    for key in keys {
        if out.len() >= MAX_CANDIDATES {
            break;
        }
        of_key(state, key, &mut out);
    }
    out
}

fn of_key(state: &State, key: &Key, out: &mut BTreeSet<At>) {
    match key.kind() {
        Kind::Service => {
            let service = ServiceName::from(key.name());
            for (_, held) in state.instances(&service) {
                out.insert(Sources::placed(state, &service, &held.document));
            }
            for (layer, _) in state.of_kind(Kind::Layer, None) {
                out.extend(at_layer(state, &service, &LayerName::from(layer.name())));
            }
        }
        Kind::Layer => {
            let layer = LayerName::from(key.name());
            for service in services_of(state, key) {
                out.extend(at_layer(state, &service, &layer));
            }
            for placed in state.in_layer(&layer) {
                of_placed(state, placed, out);
            }
        }
        Kind::Node => {
            let node = NodeName::from(key.name());
            let layer = state.get(key).and_then(|held| held.document.spec_layer()?.parse().ok());
            for service in services_of(state, key) {
                out.insert(At {
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
fn of_placed(state: &State, key: &Key, out: &mut BTreeSet<At>) {
    match (key.kind(), key.service_name()) {
        (Kind::Instance, Some(service)) => {
            if let Some(held) = state.get(key) {
                out.insert(Sources::placed(state, service, &held.document));
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

/// A service without instance in a layer: on no node, and on each node that has something of its own to say.
fn at_layer(state: &State, service: &ServiceName, layer: &LayerName) -> Vec<At> {
    let visible = state
        .get(&Key::service(service))
        .is_none_or(|held| held.document.is_for_layer(layer.as_str()));
    if !visible {
        return Vec::new();
    }
    let place = |node: Option<NodeName>| At {
        service: Some(service.clone()),
        instance: None,
        layer: Some(layer.clone()),
        node,
    };
    let own_word = |key: &&Key| {
        let node = state.get(key).filter(|_| key.kind() == Kind::Node);
        node.is_some_and(|held| {
            let is_empty = |value: &serde_json::Value| value.as_object().is_some_and(serde_json::Map::is_empty);
            held.document.config().is_some_and(|config| !is_empty(config))
                || held
                    .document
                    .overrides(service.as_str())
                    .is_some_and(|config| !is_empty(config))
        })
    };
    let nodes = state.in_layer(layer).filter(own_word);
    let nodes = nodes.map(|key| place(Some(NodeName::from(key.name()))));
    std::iter::once(place(None)).chain(nodes).collect()
}

/// Places whose effective configuration may be another one after the change, in both states.
pub(crate) fn touched(state: &State, keys: &[Key]) -> BTreeSet<At> {
    candidates(state, keys)
}

/// Places whose effective configuration is another one, in order.
pub(crate) fn changed(before: &State, after: &State, keys: &[Key]) -> Vec<At> {
    let mut places = candidates(before, keys);
    places.extend(candidates(after, keys));
    places
        .into_iter()
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
