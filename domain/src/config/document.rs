//! One document.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::{Key, Kind, Timestamp};

/// Labels or annotations, in the order of their keys.
pub type Labels = BTreeMap<String, String>;

/// A document as the store has it. Secrets in `spec` may be there in any of their three forms
/// ([`super::secret`]): encrypted in the store, redacted towards users, as text in `Sync` alone.
#[derive(Debug, Clone, PartialEq)]
pub struct Document {
    /// Kind and name.
    pub key: Key,
    /// UUIDv7; a new one after delete and recreate.
    pub uid: String,
    /// Revision of the last change.
    pub revision: u64,
    /// When it was made.
    pub create_time: Timestamp,
    /// When it was last changed.
    pub update_time: Timestamp,
    /// Subject of the token that changed it last.
    pub updated_by: String,
    /// For selecting.
    pub labels: Labels,
    /// For people and tools.
    pub annotations: Labels,
    /// What the user wrote, shared because most copies of a document have the same.
    pub spec: Arc<Value>,
    /// What the system says of it; roll-outs only.
    pub status: Option<Value>,
}

impl Document {
    /// A document that no store has yet: without labels, and without what the server sets.
    #[must_use]
    pub fn new(key: Key, spec: Value) -> Self {
        Self {
            key,
            uid: String::new(),
            revision: 0,
            create_time: Timestamp::default(),
            update_time: Timestamp::default(),
            updated_by: String::new(),
            labels: Labels::new(),
            annotations: Labels::new(),
            spec: Arc::new(spec),
            status: None,
        }
    }

    /// The envelope as JSON, members in the order of the contract.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let mut out = self.clean_json();
        if let Value::Object(members) = &mut out {
            members.insert("uid".to_owned(), self.uid.clone().into());
            members.insert("revision".to_owned(), self.revision.into());
            members.insert("create_time".to_owned(), self.create_time.to_string().into());
            members.insert("update_time".to_owned(), self.update_time.to_string().into());
            members.insert("updated_by".to_owned(), self.updated_by.clone().into());
            if let Some(status) = &self.status {
                members.insert("status".to_owned(), status.clone());
            }
        }
        out
    }

    /// The same without the members that the server sets: what can be applied again.
    #[must_use]
    pub fn clean_json(&self) -> Value {
        let mut members = Map::new();
        members.insert("kind".to_owned(), self.key.kind().as_str().into());
        members.insert("name".to_owned(), self.key.name().as_str().into());
        if let Some(service) = self.key.service_name() {
            members.insert("service".to_owned(), service.as_str().into());
        }
        members.insert("labels".to_owned(), json!(self.labels));
        members.insert("annotations".to_owned(), json!(self.annotations));
        members.insert("spec".to_owned(), (*self.spec).clone());
        Value::Object(members)
    }

    /// Member of the spec, if there is one and it is not `null`.
    #[must_use]
    pub fn spec_member(&self, name: &str) -> Option<&Value> {
        self.spec.get(name).filter(|value| !value.is_null())
    }

    /// Layer that a node names, or that an instance is placed on directly.
    #[must_use]
    pub fn spec_layer(&self) -> Option<&str> {
        match self.key.kind() {
            Kind::Node | Kind::Instance => self.spec_member("layer")?.as_str(),
            Kind::Layer | Kind::Service | Kind::Rollout => None,
        }
    }

    /// Node that an instance is placed on.
    #[must_use]
    pub fn spec_node(&self) -> Option<&str> {
        match self.key.kind() {
            Kind::Instance => self.spec_member("node")?.as_str(),
            Kind::Layer | Kind::Node | Kind::Service | Kind::Rollout => None,
        }
    }

    /// `spec.config`, if there is one.
    #[must_use]
    pub fn config(&self) -> Option<&Value> {
        self.spec_member("config")
    }

    /// `spec.overrides.<service>` of a layer or node.
    #[must_use]
    pub fn overrides(&self, service: &str) -> Option<&Value> {
        match self.key.kind() {
            Kind::Layer | Kind::Node => {
                self.spec_member("overrides")?.get(service).filter(|value| !value.is_null())
            }
            Kind::Service | Kind::Instance | Kind::Rollout => None,
        }
    }

    /// Whether services on a layer may see this service; `true` for what is no service.
    #[must_use]
    pub fn is_for_layer(&self, layer: &str) -> bool {
        match (self.key.kind(), self.spec_member("layers").and_then(Value::as_array)) {
            (Kind::Service, Some(layers)) => {
                layers.iter().any(|value| value.as_str() == Some(layer))
            }
            _ => true,
        }
    }
}
