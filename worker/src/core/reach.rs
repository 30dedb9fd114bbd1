//! Who a change can concern. Only those are looked at, so that a change of one service costs
//! nothing to the others.
//!
//! ```text
//! Service   ─▶ places of the service, and those that its documents make new ones
//! Layer     ─▶ all places; if only overrides differ, those of the services that they are for
//! Node      ─▶ the same of the places on the node
//! Instance  ─▶ places of the instance
//! Rollout   ─▶ what it changes ─▶ the same of the places on nodes: elsewhere it does not count
//! ```

use std::collections::{BTreeMap, BTreeSet};

use blaze_domain::config::placement::{is_active, rollout_target};
use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{InstanceName, NodeName, ServiceName};
use serde_json::Value;

use super::notice::said;
use super::served_target::{ServedTarget, Site};
use super::told::Told;

/// The places that are told of changes, with what each was told last.
#[derive(Default)]
pub(super) struct Places {
    told: BTreeMap<ServedTarget, Told>,
    by_node: BTreeMap<NodeName, BTreeSet<ServedTarget>>,
    /// How often a place came or went.
    version: u64,
}

impl Places {
    pub(super) fn get(&self, place: &ServedTarget) -> Option<&Told> {
        self.told.get(place)
    }

    pub(super) fn insert(&mut self, place: ServedTarget, told: Told) {
        let is_new = !self.told.contains_key(&place);
        if let Some(node) = place.node.as_ref().filter(|_| is_new) {
            self.by_node.entry(node.clone()).or_default().insert(place.clone());
        }
        self.version += u64::from(is_new);
        self.told.insert(place, told);
    }

    /// Another number whenever a place has come or gone.
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    /// Whether it was there.
    pub(super) fn remove(&mut self, place: &ServedTarget) -> bool {
        let was_there = self.told.remove(place).is_some();
        self.version += u64::from(was_there);
        if let Some(node) = &place.node
            && let Some(places) = self.by_node.get_mut(node)
        {
            places.remove(place);
            if places.is_empty() {
                self.by_node.remove(node);
            }
        }
        was_there
    }

    pub(super) fn all(&self) -> impl Iterator<Item = (&ServedTarget, &Told)> {
        self.told.iter()
    }

    pub(super) fn of_service<'p>(
        &'p self,
        service: &'p ServiceName,
    ) -> impl Iterator<Item = &'p ServedTarget> {
        let range = self.told.range(ServedTarget::first_of(service, None)..);
        range.map(|(place, _)| place).take_while(move |place| place.service == *service)
    }

    pub(super) fn of_instance<'p>(
        &'p self,
        service: &'p ServiceName,
        instance: &'p InstanceName,
    ) -> impl Iterator<Item = &'p ServedTarget> {
        let range = self.told.range(ServedTarget::first_of(service, Some(instance))..);
        range.map(|(place, _)| place).take_while(move |place| {
            place.service == *service && place.instance.as_ref() == Some(instance)
        })
    }

    pub(super) fn on_node(&self, node: &NodeName) -> impl Iterator<Item = &ServedTarget> {
        self.by_node.get(node).into_iter().flatten()
    }
}

/// Places that changed documents can concern: those that were told before, and those that are to be
/// from now on.
pub(super) fn concerned(
    site: &Site,
    places: &Places,
    old: &State,
    new: &State,
    keys: &BTreeSet<Key>,
) -> BTreeSet<ServedTarget> {
    let mut search = Search { site, places, old, new, found: BTreeSet::new() };
    for key in keys {
        search.of_key(key);
    }
    search.found
}

/// The services about which a document says something else than before.
#[derive(Debug, PartialEq, Eq)]
enum Affected {
    All,
    Some(BTreeSet<ServiceName>),
}

struct Search<'s> {
    site: &'s Site,
    places: &'s Places,
    old: &'s State,
    new: &'s State,
    found: BTreeSet<ServedTarget>,
}

fn document<'s>(state: &'s State, key: &Key) -> Option<&'s Document> {
    state.get(key).map(|held| &*held.document)
}

impl<'s> Search<'s> {
    fn of_key(&mut self, key: &Key) {
        match key.kind() {
            Kind::Service => self.of_service(key),
            Kind::Instance => self.of_instance(key),
            Kind::Layer => self.of_layer(key),
            Kind::Node => self.of_node(key),
            Kind::Rollout => self.of_rollout(key),
        }
    }

    fn of_service(&mut self, key: &Key) {
        let service = ServiceName::from(key.name());
        self.found.extend(self.places.of_service(&service).cloned());
        self.add_home(key);
        // Instances may have waited for their service.
        for (instance, _) in self.new.instances(&service) {
            self.add_home(instance);
        }
    }

    fn of_instance(&mut self, key: &Key) {
        if let Some(service) = key.service_name() {
            let instance = InstanceName::from(key.name());
            self.found.extend(self.places.of_instance(service, &instance).cloned());
            self.add_home(key);
        }
    }

    fn add_home(&mut self, key: &Key) {
        if let Some(document) = document(self.new, key) {
            self.found.extend(self.site.home(self.new, document));
        }
    }

    fn of_layer(&mut self, key: &Key) {
        if key.name().as_str() != self.site.layer.as_str() {
            return;
        }
        let (old, new) = (document(self.old, key), document(self.new, key));
        // A roll-out may have waited for what it changes, or lose it.
        let affected = match old.is_some() == new.is_some() {
            true => affected(old, new),
            false => Affected::All,
        };
        match affected {
            Affected::All => self.found.extend(self.places.all().map(|(place, _)| place.clone())),
            Affected::Some(services) => {
                for service in &services {
                    self.found.extend(self.places.of_service(service).cloned());
                }
            }
        }
    }

    fn of_node(&mut self, key: &Key) {
        let node = NodeName::from(key.name());
        let (old, new) = (document(self.old, key), document(self.new, key));
        // Roll-outs choose nodes by their labels.
        let is_chosen_anew = old.map(|node| &node.labels) != new.map(|node| &node.labels);
        let affected = affected(old, new);
        let places = self.places.on_node(&node).filter(|place| match &affected {
            Affected::All => true,
            Affected::Some(services) => is_chosen_anew || services.contains(&place.service),
        });
        self.found.extend(places.cloned());
    }

    /// Of the documents before and after, for it may have been aimed at something else.
    fn of_rollout(&mut self, key: &Key) {
        let both = [document(self.old, key), document(self.new, key)].into_iter().flatten();
        let targets: BTreeSet<Key> =
            both.filter(|rollout| is_active(rollout)).filter_map(rollout_target).collect();
        for target in &targets {
            self.of_target(target);
        }
    }

    fn of_target(&mut self, target: &Key) {
        let places = self.places;
        let on_nodes = |place: &&ServedTarget| place.node.is_some();
        match (target.kind(), target.service_name()) {
            (Kind::Service, _) => {
                let service = ServiceName::from(target.name());
                self.found.extend(places.of_service(&service).filter(on_nodes).cloned());
            }
            (Kind::Instance, Some(service)) => {
                let instance = InstanceName::from(target.name());
                self.found.extend(places.of_instance(service, &instance).filter(on_nodes).cloned());
            }
            (Kind::Node, _) => {
                let node = NodeName::from(target.name());
                self.found.extend(places.on_node(&node).cloned());
            }
            (Kind::Layer, _) => {
                let all = places.all().map(|(place, _)| place);
                self.found.extend(all.filter(on_nodes).cloned());
            }
            (Kind::Instance, None) | (Kind::Rollout, _) => {}
        }
    }
}

/// The services about which a layer or node says something else than before.
fn affected(old: Option<&Document>, new: Option<&Document>) -> Affected {
    if config(old) != config(new) {
        return Affected::All;
    }
    let names: BTreeSet<&String> = named(old).chain(named(new)).collect();
    let differing = names.into_iter().filter(|name| overrides(old, name) != overrides(new, name));
    Affected::Some(differing.filter_map(|name| name.parse().ok()).collect())
}

fn config(document: Option<&Document>) -> Option<&Value> {
    said(document.and_then(Document::config))
}

fn overrides<'d>(document: Option<&'d Document>, service: &str) -> Option<&'d Value> {
    said(document.and_then(|document| document.overrides(service)))
}

/// Services for which it has overrides.
fn named(document: Option<&Document>) -> impl Iterator<Item = &String> {
    let overrides = document.and_then(|document| document.spec_member("overrides")?.as_object());
    overrides.into_iter().flat_map(serde_json::Map::keys)
}

#[cfg(test)]
#[path = "reach_tests.rs"]
mod tests;
