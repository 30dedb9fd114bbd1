//! Where a document counts: which layers see it, and where an instance runs.

use serde_json::Value;

use super::state::State;
use super::{Document, Key, Kind, canonical, spec};
use crate::{LayerName, NodeName, ServiceName};

/// Layers that see a document.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Visible {
    /// All of them.
    Everywhere,
    /// These; none: nobody but who is bound to no layer.
    In(Vec<LayerName>),
}

impl Visible {
    /// Whether a layer sees it.
    #[must_use]
    pub fn contains(&self, layer: &LayerName) -> bool {
        match self {
            Self::Everywhere => true,
            Self::In(layers) => layers.contains(layer),
        }
    }

    fn intersect(self, other: Self) -> Self {
        match (self, other) {
            (Self::Everywhere, other) => other,
            (one, Self::Everywhere) => one,
            (Self::In(one), Self::In(other)) => {
                Self::In(one.into_iter().filter(|l| other.contains(l)).collect())
            }
        }
    }
}

/// Where a document counts at one revision. It may change without the document: an instance moves
/// with its node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Placement {
    /// Layers that see it.
    pub visible: Visible,
    /// The layer that filters go by: of an instance where it is placed, of a node its own.
    pub layer: Option<LayerName>,
    /// The node that filters go by.
    pub node: Option<NodeName>,
}

fn name<T: std::str::FromStr>(text: Option<&str>) -> Option<T> {
    text.and_then(|text| text.parse().ok())
}

/// Where a document counts in a state. The document itself need not be part of it.
#[must_use]
pub fn placement(state: &State, document: &Document) -> Placement {
    match document.key.kind() {
        Kind::Layer => {
            let layer = LayerName::from(document.key.name());
            Placement { visible: Visible::In(vec![layer.clone()]), layer: Some(layer), node: None }
        }
        Kind::Node => {
            let layer: Option<LayerName> = name(document.spec_layer());
            Placement {
                visible: Visible::In(layer.iter().cloned().collect()),
                layer,
                node: Some(NodeName::from(document.key.name())),
            }
        }
        Kind::Service => Placement { visible: service_layers(document), layer: None, node: None },
        Kind::Instance => instance(state, document),
        Kind::Rollout => {
            // A roll-out of a roll-out is refused; it would lead in a circle.
            let target = rollout_target(document).filter(|key| key.kind() != Kind::Rollout);
            let target = target.and_then(|key| state.get(&key).cloned());
            let visible = target
                .map_or(Visible::In(Vec::new()), |held| placement(state, &held.document).visible);
            Placement { visible, layer: None, node: None }
        }
    }
}

fn service_layers(service: &Document) -> Visible {
    match service.spec_member("layers").and_then(Value::as_array) {
        Some(layers) => {
            Visible::In(layers.iter().filter_map(|layer| name(layer.as_str())).collect())
        }
        None => Visible::Everywhere,
    }
}

fn instance(state: &State, document: &Document) -> Placement {
    let node: Option<NodeName> = name(document.spec_node());
    let layer: Option<LayerName> = match &node {
        Some(node) => state.get(&Key::node(node)).and_then(|held| name(held.document.spec_layer())),
        None => name(document.spec_layer()),
    };
    let placed = match (&layer, &node) {
        (Some(layer), _) => Visible::In(vec![layer.clone()]),
        (None, None) => Visible::Everywhere,
        (None, Some(_)) => Visible::In(Vec::new()),
    };
    let service = document.key.service_name().and_then(|service| state.get(&Key::service(service)));
    let seen = service.map_or(Visible::In(Vec::new()), |held| service_layers(&held.document));
    Placement { visible: placed.intersect(seen), layer, node }
}

/// Digest of what a layer sees.
#[must_use]
pub fn layer_digest(state: &State, layer: &LayerName) -> String {
    digest_of(state, |document| placement(state, document).visible.contains(layer))
}

/// Digest of all documents of a state, which is what a worker holds.
#[must_use]
pub fn whole_digest(state: &State) -> String {
    digest_of(state, |_| true)
}

fn digest_of(state: &State, is_seen: impl Fn(&Document) -> bool) -> String {
    let seen = state.all().filter(|(_, held)| is_seen(&held.document));
    canonical::digest(seen.map(|(key, held)| {
        let service = key.service_name().map(ServiceName::as_str);
        (key.kind(), service, key.name().as_str(), held.document.revision)
    }))
}

/// The document that a roll-out changes.
#[must_use]
pub fn rollout_target(rollout: &Document) -> Option<Key> {
    spec::rollout_target(rollout.spec_member("target")?)
}

/// Whether a roll-out is on its canaries now.
#[must_use]
pub fn is_active(rollout: &Document) -> bool {
    phase(rollout) == "canary"
}

/// `status.phase` of a roll-out.
#[must_use]
pub fn phase(rollout: &Document) -> &str {
    let phase = rollout.status.as_ref().and_then(|status| status.get("phase"));
    phase.and_then(Value::as_str).unwrap_or("canary")
}
