//! Which [targets](ConfigTarget) a set of changed documents can concern, and whose effective
//! configuration really is another one.

use std::collections::BTreeSet;
use std::rc::Rc;

use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{LayerName, NodeName, ServiceName};

use super::view::View;
use blaze_domain::config::effective::{ConfigTarget, Sources, canaries, is_canary};
use blaze_domain::config::placement::rollout_target;
use blaze_domain::config::state::State;

/// Targets that are looked at for one request, at most: beyond it the answer would take longer than
/// it is worth.
pub(crate) const MAX_CANDIDATES: usize = 200_000;
/// The same for an answer that is kept with the commit: nobody can write while it is worked out.
pub(crate) const MAX_KEPT_CANDIDATES: usize = 1000;

/// Bytes of configurations that are merged and compared for each target that may be told, at most
/// on average.
const BYTES_PER_TARGET: usize = 64 * 1024;
/// The same for all of them.
const MAX_BYTES: usize = 1024 * 1024 * 1024;

/// Documents that are read for each target that may be found, at most.
const LOOKS_PER_TARGET: usize = 25;
/// The same for few targets together.
const LOOKS_AT_LEAST: usize = 1_000_000;

/// A search for targets, up to so many, that reads a limited number of documents. The result may be
/// incomplete when a limit is reached.
struct Search<'s> {
    state: &'s State,
    /// Services that count.
    is_wanted: &'s dyn Fn(&ServiceName) -> bool,
    /// All of them, once they were needed.
    services: Option<Rc<[(ServiceName, &'s Document)]>>,
    found: BTreeSet<ConfigTarget>,
    limit: usize,
    /// Documents that may still be read.
    looks_left: usize,
}

/// Instances with a document, and services without an instance at the layers and nodes that treat
/// them on their own.
fn candidates<'s>(
    state: &'s State,
    keys: &[Key],
    is_wanted: &'s dyn Fn(&ServiceName) -> bool,
    limit: usize,
) -> Search<'s> {
    let mut search = Search {
        state,
        is_wanted,
        services: None,
        found: BTreeSet::new(),
        limit,
        looks_left: limit.saturating_mul(LOOKS_PER_TARGET).max(LOOKS_AT_LEAST),
    };
    for key in keys {
        search.of_key(key);
    }
    search
}

impl<'s> Search<'s> {
    /// Whether a limit is reached: the result may be incomplete.
    fn is_exhausted(&self) -> bool {
        self.found.len() >= self.limit || self.looks_left == 0
    }

    fn add(&mut self, at: ConfigTarget) {
        if !self.is_exhausted() {
            self.found.insert(at);
        }
    }

    /// Counts a document that is read.
    fn look(&mut self) {
        self.looks_left = self.looks_left.saturating_sub(1);
    }

    fn of_key(&mut self, key: &Key) {
        if self.is_exhausted() {
            return;
        }
        let state = self.state;
        match key.kind() {
            Kind::Service => self.of_service(&ServiceName::from(key.name())),
            Kind::Layer => {
                let layer = LayerName::from(key.name());
                for service in self.services_of(Some(layer.as_str())) {
                    self.at_layer(&service, &layer);
                }
                for placed in state.in_layer(&layer) {
                    self.of_placed(placed);
                }
            }
            Kind::Node => {
                let node = NodeName::from(key.name());
                let layer: Option<LayerName> =
                    state.get(key).and_then(|held| held.document.spec_layer()?.parse().ok());
                let seen_by = match state.get(key) {
                    Some(_) => layer.as_ref().map(LayerName::as_str),
                    None => Some(node.as_str()),
                };
                for service in self.services_of(seen_by) {
                    self.add(ConfigTarget {
                        service: Some(service),
                        instance: None,
                        layer: layer.clone(),
                        node: Some(node.clone()),
                    });
                }
                for placed in state.on_node(&node) {
                    self.of_placed(placed);
                }
            }
            Kind::Instance => self.of_placed(key),
            Kind::Rollout => {
                let target = state.get(key).and_then(|held| rollout_target(&held.document));
                if let Some(target) = target.filter(|target| target.kind() != Kind::Rollout) {
                    self.of_key(&target);
                }
            }
        }
    }

    fn of_service(&mut self, service: &ServiceName) {
        if !(self.is_wanted)(service) {
            return;
        }
        let state = self.state;
        for (_, held) in state.instances(service) {
            if self.is_exhausted() {
                return;
            }
            self.look();
            self.add(Sources::placed(state, service, &held.document));
        }
        for (layer, _) in state.of_kind(Kind::Layer, None) {
            self.at_layer(service, &LayerName::from(layer.name()));
        }
    }

    /// A node's or an instance's own places.
    fn of_placed(&mut self, key: &Key) {
        if self.is_exhausted() {
            return;
        }
        self.look();
        let state = self.state;
        match (key.kind(), key.service_name()) {
            (Kind::Instance, Some(service)) if (self.is_wanted)(service) => {
                if let Some(held) = state.get(key) {
                    self.add(Sources::placed(state, service, &held.document));
                }
            }
            (Kind::Node, _) => {
                for placed in state.on_node(&NodeName::from(key.name())) {
                    self.of_placed(placed);
                }
            }
            _ => {}
        }
    }

    /// Services that a layer, or a node of it, can matter to; without a layer all.
    fn services_of(&mut self, layer: Option<&str>) -> Vec<ServiceName> {
        let (state, is_wanted) = (self.state, self.is_wanted);
        let all = self.services.get_or_insert_with(|| {
            let services = state.of_kind(Kind::Service, None);
            services
                .map(|(key, held)| (ServiceName::from(key.name()), &*held.document))
                .filter(|(name, _)| is_wanted(name))
                .collect()
        });
        let all = Rc::clone(all);
        self.looks_left = self.looks_left.saturating_sub(all.len());
        all.iter()
            .filter(|(_, document)| layer.is_none_or(|layer| document.is_for_layer(layer)))
            .map(|(name, _)| name.clone())
            .collect()
    }

    /// A service without instance in a layer: on no node, on each node that has configuration
    /// of its own, and on each where a roll-out tries a change of the service, the layer or the
    /// node.
    fn at_layer(&mut self, service: &ServiceName, layer: &LayerName) {
        let state = self.state;
        let visible = state
            .get(&Key::service(service))
            .is_none_or(|held| held.document.is_for_layer(layer.as_str()));
        self.look();
        if !visible || self.is_exhausted() {
            return;
        }
        let target = |node: Option<NodeName>| ConfigTarget {
            service: Some(service.clone()),
            instance: None,
            layer: Some(layer.clone()),
            node,
        };
        self.add(target(None));
        let tried: Vec<LabelSelector> = [Key::service(service), Key::layer(layer)]
            .iter()
            .flat_map(|target| state.active_on(target))
            .filter_map(|held| canaries(&held.document))
            .collect();
        for key in state.in_layer(layer) {
            if self.is_exhausted() {
                return;
            }
            self.look();
            let Some(held) = state.get(key).filter(|_| key.kind() == Kind::Node) else {
                continue;
            };
            let node = &held.document;
            if has_own_config(node, service)
                || tried.iter().any(|selector| selector.matches(&node.labels))
                || state.active_on(key).any(|rollout| is_canary(&rollout.document, node))
            {
                self.add(target(Some(NodeName::from(key.name()))));
            }
        }
    }
}

/// Whether a node has configuration of its own for a service.
fn has_own_config(node: &Document, service: &ServiceName) -> bool {
    let is_empty =
        |value: &serde_json::Value| value.as_object().is_some_and(serde_json::Map::is_empty);
    let overrides = node.overrides(service.as_str());
    [node.config(), overrides].into_iter().flatten().any(|config| !is_empty(config))
}

/// Targets of wanted services whose effective configuration may be another one after the change;
/// `None` if they are more than `limit`, or too hard to find.
pub(crate) fn touched(
    state: &State,
    keys: &[Key],
    is_wanted: &dyn Fn(&ServiceName) -> bool,
    limit: usize,
) -> Option<BTreeSet<ConfigTarget>> {
    // One more, to tell whether it is all of them.
    let search = candidates(state, keys, is_wanted, limit + 1);
    (!search.is_exhausted()).then_some(search.found)
}

/// Targets whose effective configuration is another one, in order, as far as they are seen. Of each
/// state at most `limit` are looked at, and no more bytes of configurations than so many targets
/// usually have.
pub(crate) fn changed(
    before: &State,
    after: &State,
    keys: &[Key],
    view: &View,
    limit: usize,
) -> Vec<ConfigTarget> {
    let all = |_: &ServiceName| true;
    let mut targets = candidates(before, keys, &all, limit).found;
    targets.extend(candidates(after, keys, &all, limit).found);
    let mut left = limit.saturating_mul(BYTES_PER_TARGET).min(MAX_BYTES);
    targets
        .into_iter()
        .filter(|at| view.sees_place(before, at) || view.sees_place(after, at))
        .take_while(|at| {
            let bytes = |state: &State| Sources::at(state, at).size_bound();
            let enough = left.checked_sub(bytes(before) + bytes(after));
            left = enough.unwrap_or(0);
            enough.is_some()
        })
        .filter(|at| {
            let hash = |state: &State| exists(state, at).then(|| Sources::at(state, at).hash());
            hash(before) != hash(after)
        })
        .collect()
}

/// Whether the service, and the instance if one is named, is there to have a configuration.
fn exists(state: &State, at: &ConfigTarget) -> bool {
    let service = at.service.as_ref().is_some_and(|name| state.get(&Key::service(name)).is_some());
    match (&at.service, &at.instance) {
        (Some(service), Some(instance)) => {
            state.get(&Key::instance(service.clone(), instance.clone())).is_some()
        }
        _ => service,
    }
}
