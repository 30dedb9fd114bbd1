//! What services are told: a configuration, and how it differs from the one before.

use std::fmt;
use std::sync::Arc;

pub use blaze_domain::config::ConfigScope as Scope;
use blaze_domain::config::diff::{self, diff};
use blaze_domain::config::effective::{ConfigTarget, Sources};
use blaze_domain::config::{Document, json, secret};
use blaze_domain::{DocumentName, LayerName};
use serde_json::{Map, Value};

use super::served_target::{ServedTarget, Source};

/// Leaves that a notice names, at most. Beyond, whole objects are named instead.
const MAX_LEAVES: usize = 1_000;

/// An effective configuration, with secrets in clear as far as they are known.
#[derive(Clone, PartialEq)]
pub struct Config(Arc<Value>);

/// Never shows what is in it.
impl fmt::Debug for Config {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Config(…)")
    }
}

impl Config {
    /// The configuration that documents make.
    #[must_use]
    pub fn of(sources: &Sources) -> Self {
        Self(Arc::new(sources.merged()))
    }

    /// The value, secrets as they are in the documents.
    #[must_use]
    pub fn value(&self) -> &Value {
        &self.0
    }
}

/// A configuration as it stands: what is answered, and what is kept in Redis.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Whose it is.
    pub at: ConfigTarget,
    /// Where the store stood when it became what it is.
    pub revision: u64,
    /// Over it.
    pub hash: String,
    /// The configuration.
    pub config: Config,
    /// Where it comes from.
    pub source: Source,
    /// Of which store: revisions of two stores cannot be compared. `None`: of a file.
    pub store: Option<Arc<str>>,
    /// The roll-out that changed it.
    pub rollout: Option<DocumentName>,
}

/// That a configuration is another one, or gone with its service.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// Whose it is.
    pub place: ServedTarget,
    /// The layer in which it counts.
    pub layer: LayerName,
    /// Where the store stood when it changed; never goes down for a place, and may be the same for
    /// two notices (when a roll-out is undone here, without a commit).
    pub revision: u64,
    /// Over it; `None`: its service is deleted.
    pub hash: Option<String>,
    /// Over what was told before; `None`: nothing was.
    pub previous_hash: Option<String>,
    /// JSON pointers of the leaves that differ, sorted. If what was told before is not known any
    /// more: all of them.
    pub paths: Vec<String>,
    /// Kinds of the documents that say something else than before, sorted.
    pub scopes: Vec<Scope>,
    /// The configuration; `None`: its service is deleted.
    pub config: Option<Config>,
    /// Where it comes from.
    pub source: Source,
    /// Of which store: revisions of two stores cannot be compared. `None`: of a file.
    pub store: Option<Arc<str>>,
    /// The roll-out that changed it.
    pub rollout: Option<DocumentName>,
}

impl Notice {
    /// The same as an answer has it; `None` if the service is deleted.
    #[must_use]
    pub fn standing(&self) -> Option<Standing> {
        let (hash, config) = (self.hash.clone()?, self.config.clone()?);
        Some(Standing {
            at: ConfigTarget {
                service: Some(self.place.service.clone()),
                instance: self.place.instance.as_ref().map(DocumentName::from),
                layer: Some(self.layer.clone()),
                node: self.place.node.clone(),
            },
            revision: self.revision,
            hash,
            config,
            source: self.source,
            store: self.store.clone(),
            rollout: self.rollout.clone(),
        })
    }
}

/// Kinds of the documents that say something else about a service than before. A roll-out counts as
/// what it changes, because its change is in the documents that are compared.
pub(super) fn scopes(old: &Sources, new: &Sources, service: &str) -> Vec<Scope> {
    let differs = |scope: Scope, one: &Option<Arc<Document>>, other: &Option<Arc<Document>>| {
        let (one, other) = (one.as_deref(), other.as_deref());
        let is_same = words(one, service, scope) == words(other, service, scope);
        (!is_same).then_some(scope)
    };
    [
        differs(Scope::Layer, &old.layer, &new.layer),
        differs(Scope::Node, &old.node, &new.node),
        differs(Scope::Service, &old.service, &new.service),
        differs(Scope::Instance, &old.instance, &new.instance),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// What a document says about a service: its configuration and its overrides. Empty ones are as
/// absent.
fn words<'d>(
    document: Option<&'d Document>,
    service: &str,
    scope: Scope,
) -> [Option<&'d Value>; 2] {
    let Some(document) = document else { return [None, None] };
    let overrides = match scope {
        Scope::Layer | Scope::Node => document.overrides(service),
        Scope::Service | Scope::Instance => None,
    };
    [said(document.config()), said(overrides)]
}

/// A configuration, unless it says nothing.
pub(super) fn said(config: Option<&Value>) -> Option<&Value> {
    config.filter(|value| value.as_object().is_none_or(|members| !members.is_empty()))
}

/// JSON pointers of the leaves that differ, sorted. A secret is another one when its version is.
pub(super) fn paths(old: &Value, new: &Value) -> Vec<String> {
    let deltas = diff(&secret::for_hash(old), &secret::for_hash(new), "");
    let mut leaves = Vec::new();
    for delta in &deltas {
        let sides = [delta.old.as_ref(), delta.value.as_ref()];
        for value in sides.into_iter().flatten() {
            if !add_leaves(&delta.path, value, &mut leaves) {
                return diff::paths(&deltas);
            }
        }
    }
    leaves.sort_unstable();
    leaves.dedup();
    leaves
}

/// Adds the pointers of the leaves of a value; `false` if they become too many.
fn add_leaves(pointer: &str, value: &Value, out: &mut Vec<String>) -> bool {
    match value.as_object().filter(|_| !secret::is_secret(value)) {
        Some(members) if !members.is_empty() => members_leaves(pointer, members, out),
        Some(_) | None => {
            out.push(pointer.to_owned());
            out.len() <= MAX_LEAVES
        }
    }
}

fn members_leaves(pointer: &str, members: &Map<String, Value>, out: &mut Vec<String>) -> bool {
    members.iter().all(|(name, member)| add_leaves(&json::push(pointer, name), member, out))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn paths_are_those_of_leaves() {
        let old =
            json!({"a": {"b": 1, "c": [1, 2]}, "gone": {"x": 1, "y": {}}, "same": {"deep": true}});
        let new = json!({
            "a": {"b": 2, "c": [1, 3]},
            "new": {"p": {"q": 1}, "r/s": null},
            "same": {"deep": true},
        });
        let expected = ["/a/b", "/a/c", "/gone/x", "/gone/y", "/new/p/q", "/new/r~1s"];
        assert_eq!(paths(&old, &new), expected);
        assert_eq!(paths(&json!({}), &json!({"camera": {"rate_hz": 1}})), ["/camera/rate_hz"]);
        // A leaf that becomes an object, and the other way round.
        assert_eq!(paths(&json!({"a": 1}), &json!({"a": {"b": 2}})), ["/a", "/a/b"]);
        assert!(paths(&new, &new).is_empty());
    }

    #[test]
    fn a_secret_is_one_leaf_and_its_version_counts_alone() {
        let secret = |text: &str, version: u64| json!({"pw": {"$secret": {"text": text, "version": version}}});
        assert_eq!(paths(&secret("a", 1), &secret("b", 2)), ["/pw"]);
        assert!(paths(&secret("a", 1), &secret("a", 1)).is_empty());
        assert_eq!(paths(&json!({}), &secret("a", 1)), ["/pw"]);
    }

    #[test]
    fn too_many_leaves_are_told_as_objects() {
        let members: Map<String, Value> =
            (0..2000).map(|number| (number.to_string(), number.into())).collect();
        let new = json!({"many": members});
        assert_eq!(paths(&json!({}), &new), ["/many"]);
    }
}
