//! Configurations and their changes, as a service sees them.

use std::fmt;
use std::sync::Arc;

pub use blaze_domain::config::{ConfigScope, ConfigSource};
use serde_json::Value;

/// A configuration that a worker gave.
#[derive(Clone, PartialEq)]
pub(crate) struct Held {
    pub(crate) revision: u64,
    pub(crate) hash: String,
    pub(crate) config: Arc<Value>,
    pub(crate) source: ConfigSource,
    /// Store that the revision is of, as far as its worker says.
    pub(crate) store: Option<String>,
}

/// Without the configuration, for it may hold texts of secrets.
impl fmt::Debug for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Held")
            .field("revision", &self.revision)
            .field("hash", &self.hash)
            .field("source", &self.source)
            .finish_non_exhaustive()
    }
}

/// A change of the service's configuration.
#[derive(Clone, PartialEq)]
pub struct ConfigChange {
    /// What it was; absent if it is the first one.
    pub old: Option<Arc<Value>>,
    /// What it is; absent if the service was deleted.
    pub new: Option<Arc<Value>>,
    /// Revision of what it is.
    pub revision: u64,
    /// Hash of what it is; absent if the service was deleted.
    pub hash: Option<String>,
    /// JSON pointers of what is different, sorted; empty if the service was deleted.
    pub paths: Vec<String>,
    /// Which kinds of document changed. Empty = unknown: it is the first configuration, the notice
    /// was missed and the change was found by asking, or the service was deleted.
    pub scopes: Vec<ConfigScope>,
    /// The service was deleted.
    pub deleted: bool,
}

impl ConfigChange {
    /// Whether a document of such a kind changed, or may have.
    #[must_use]
    pub fn is_of(&self, scope: ConfigScope) -> bool {
        self.scopes.is_empty() || self.scopes.contains(&scope)
    }

    /// This change and the one after it, as one.
    pub(super) fn followed_by(self, next: Self) -> Self {
        let mut paths = self.paths;
        paths.extend(next.paths);
        paths.sort();
        paths.dedup();
        // One of them may be of any kind, so both together may be.
        let mut scopes = match self.scopes.is_empty() || next.scopes.is_empty() {
            true => Vec::new(),
            false => [self.scopes, next.scopes].concat(),
        };
        scopes.sort();
        scopes.dedup();
        Self { old: self.old, paths: if next.deleted { Vec::new() } else { paths }, scopes, ..next }
    }
}

/// Without the configurations, for they may hold texts of secrets.
impl fmt::Debug for ConfigChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ConfigChange")
            .field("revision", &self.revision)
            .field("paths", &self.paths)
            .field("scopes", &self.scopes)
            .field("deleted", &self.deleted)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use serde_json::json;

    use super::*;

    pub(in crate::config) fn change(
        revision: u64,
        scopes: &[ConfigScope],
        paths: &[&str],
    ) -> ConfigChange {
        ConfigChange {
            old: Some(Arc::new(json!({ "n": revision - 1 }))),
            new: Some(Arc::new(json!({ "n": revision, "password": "geheim" }))),
            revision,
            hash: Some(format!("sha256:{revision}")),
            paths: paths.iter().map(|path| (*path).to_owned()).collect(),
            scopes: scopes.to_vec(),
            deleted: false,
        }
    }

    #[test]
    fn two_changes_are_one_from_the_first_to_the_last() {
        let first = change(2, &[ConfigScope::Service], &["/n", "/b"]);
        let both = first.clone().followed_by(change(3, &[ConfigScope::Node], &["/a", "/n"]));
        assert_eq!(both.old, first.old);
        assert_eq!(both.new.as_ref().map(|new| new["n"].clone()), Some(json!(3)));
        assert_eq!(both.paths, ["/a", "/b", "/n"]);
        assert_eq!(both.scopes, [ConfigScope::Node, ConfigScope::Service]);
        assert!(!both.is_of(ConfigScope::Layer));
        let unknown = first.followed_by(change(3, &[], &["/n"]));
        assert!(unknown.is_of(ConfigScope::Layer));
    }

    #[test]
    fn a_configuration_is_never_written_for_people() {
        let change = change(2, &[], &["/password"]);
        assert!(!format!("{change:?}").contains("geheim"));
        let held = Held {
            revision: 1,
            hash: "sha256:a".to_owned(),
            config: change.new.unwrap(),
            source: ConfigSource::Main,
            store: None,
        };
        assert!(!format!("{held:?}").contains("geheim"));
    }
}
