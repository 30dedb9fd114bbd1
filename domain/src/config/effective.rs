//! The effective configuration of a service at a place.

use std::sync::Arc;

use serde_json::Value;

use super::merge::{Part, Source};
use super::placement::placement;
use super::selector::LabelSelector;
use super::state::State;
use super::{Document, Key, canonical, merge, secret};
use crate::{DocumentName, LayerName, NodeName, ServiceName};

/// The documents whose configurations are merged, weakest first.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// Of the service: its defaults.
    pub service: Option<Arc<Document>>,
    /// Of the layer that it runs in.
    pub layer: Option<Arc<Document>>,
    /// Of the node that it runs on.
    pub node: Option<Arc<Document>>,
    /// Of the instance.
    pub instance: Option<Arc<Document>>,
    /// The roll-out that changed one of them.
    pub rollout: Option<DocumentName>,
    /// Whose overrides count.
    service_name: Option<ServiceName>,
}

/// Service, instance, layer and node whose effective configuration is asked for.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ConfigTarget {
    /// Which service; `None`: layer and node alone.
    pub service: Option<ServiceName>,
    /// Which instance of it.
    pub instance: Option<DocumentName>,
    /// Where it runs.
    pub layer: Option<LayerName>,
    /// On which node of that layer.
    pub node: Option<NodeName>,
}

impl Sources {
    /// The documents that count at a place; a roll-out counts on its canary nodes.
    #[must_use]
    pub fn at(state: &State, at: &ConfigTarget) -> Self {
        Self::at_where(state, at, |_| true)
    }

    /// The same with those roll-outs alone that `counts` lets pass: a worker undoes one that failed
    /// on its node before the main service knows.
    #[must_use]
    pub fn at_where(state: &State, at: &ConfigTarget, counts: impl Fn(&Document) -> bool) -> Self {
        let document = |key: Key| state.get(&key).map(|held| Arc::clone(&held.document));
        let mut sources = Self {
            service: at.service.as_ref().and_then(|name| document(Key::service(name))),
            layer: at.layer.as_ref().and_then(|name| document(Key::layer(name))),
            node: at.node.as_ref().and_then(|name| document(Key::node(name))),
            instance: match (&at.service, &at.instance) {
                (Some(service), Some(instance)) => {
                    document(Key::instance(service.clone(), instance.clone()))
                }
                _ => None,
            },
            rollout: None,
            service_name: at.service.clone(),
        };
        sources.roll_out(state, counts);
        sources
    }

    /// Where an instance's own document places it.
    #[must_use]
    pub fn placed(state: &State, service: &ServiceName, instance: &Document) -> ConfigTarget {
        let placement = placement(state, instance);
        ConfigTarget {
            service: Some(service.clone()),
            instance: Some(instance.key.name().clone()),
            layer: placement.layer,
            node: placement.node,
        }
    }

    fn roll_out(&mut self, state: &State, counts: impl Fn(&Document) -> bool) {
        let Some(node) = self.node.clone() else { return };
        let parts = [&mut self.service, &mut self.layer, &mut self.node, &mut self.instance];
        for part in parts {
            let Some(key) = part.as_ref().map(|document| document.key.clone()) else {
                continue;
            };
            for held in state.active_on(&key) {
                let rollout = &held.document;
                if let Some(patch) = rollout.spec_member("patch")
                    && let Some(document) = part.as_ref()
                    && is_canary(rollout, &node)
                    && counts(rollout)
                {
                    *part = Some(Arc::new(patched(document, patch)));
                    self.rollout = Some(rollout.key.name().clone());
                }
            }
        }
    }

    /// The parts, weakest first, each with the document that it is of.
    #[must_use]
    pub fn parts(&self) -> Vec<(&Document, bool, &Value)> {
        let service = self.service_name.as_ref().map(ServiceName::as_str);
        let mut out = Vec::with_capacity(6);
        for (document, with_overrides) in [
            (&self.service, false),
            (&self.layer, true),
            (&self.node, true),
            (&self.instance, false),
        ] {
            let Some(document) = document else { continue };
            if let Some(config) = document.config() {
                out.push((&**document, false, config));
            }
            if with_overrides
                && let Some(config) = service.and_then(|service| document.overrides(service))
            {
                out.push((&**document, true, config));
            }
        }
        out
    }

    /// The effective configuration, secrets as they are in the documents.
    #[must_use]
    pub fn merged(&self) -> Value {
        let mut out = Value::Object(serde_json::Map::new());
        for (_, _, value) in self.parts() {
            merge::merge_patch(&mut out, value);
        }
        out
    }

    /// The same with each part changed first, for secrets in other forms.
    #[must_use]
    pub fn merged_with(&self, form: impl Fn(&Document, &Value) -> Value) -> Value {
        let mut out = Value::Object(serde_json::Map::new());
        for (document, _, value) in self.parts() {
            merge::merge_patch(&mut out, &form(document, value));
        }
        out
    }

    /// Where each key comes from.
    #[must_use]
    pub fn explain(&self, form: impl Fn(&Document, &Value) -> Value) -> Value {
        let values: Vec<Value> =
            self.parts().iter().map(|(document, _, value)| form(document, value)).collect();
        let parts: Vec<Part<'_>> = self
            .parts()
            .iter()
            .zip(&values)
            .map(|((document, is_override, _), value)| Part {
                source: Source {
                    key: document.key.clone(),
                    revision: document.revision,
                    is_override: *is_override,
                },
                value,
            })
            .collect();
        merge::explain(&parts)
    }

    /// The hash that tells whether the configuration is another one.
    #[must_use]
    pub fn hash(&self) -> String {
        canonical::hash(&secret::for_hash(&self.merged()))
    }

    /// An upper bound of the size, in bytes.
    #[must_use]
    pub fn size_bound(&self) -> usize {
        self.parts().iter().map(|(_, _, value)| value.to_string().len()).sum()
    }
}

/// Whether a node is one that a roll-out tries its change on.
#[must_use]
pub fn is_canary(rollout: &Document, node: &Document) -> bool {
    canaries(rollout).is_some_and(|selector| selector.matches(&node.labels))
}

/// The nodes that a roll-out tries its change on.
#[must_use]
pub fn canaries(rollout: &Document) -> Option<LabelSelector> {
    let canary = rollout.spec_member("canary")?;
    canary.get("node_selector")?.as_str()?.parse().ok()
}

/// A document with a roll-out's change in its spec. Secrets of the change were encrypted for the
/// roll-out, so they are not carried over here: a roll-out may not change secrets.
#[must_use]
pub fn patched(document: &Document, patch: &Value) -> Document {
    let mut out = document.clone();
    let mut spec = (*document.spec).clone();
    merge::merge_patch(&mut spec, patch);
    out.spec = Arc::new(spec);
    out
}
