//! What a document is called.

use std::fmt;
use std::str::FromStr;

use crate::names::{DocumentName, LayerName, NameError, NodeName, ServiceName};
use crate::qos::{UnknownWord, word_enum};

word_enum!(
    /// Kind of a document.
    Kind {
        /// A cluster: edge, fog or cloud.
        Layer = "Layer",
        /// A machine of a layer.
        Node = "Node",
        /// A program that does work.
        Service = "Service",
        /// One running copy of a service.
        Instance = "Instance",
        /// A change that is tried on some nodes first.
        Rollout = "Rollout",
    }
);

impl Kind {
    /// The collection in the path of the REST API: `layers`, …
    #[must_use]
    pub fn collection(self) -> &'static str {
        match self {
            Self::Layer => "layers",
            Self::Node => "nodes",
            Self::Service => "services",
            Self::Instance => "instances",
            Self::Rollout => "rollouts",
        }
    }

    /// The word in operation names and on the command line: `layer`, …
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Layer => "layer",
            Self::Node => "node",
            Self::Service => "service",
            Self::Instance => "instance",
            Self::Rollout => "rollout",
        }
    }
}

/// Kind and name of a document; of an instance also its service. Ordered by kind, service, name,
/// bytewise.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Key {
    kind: Kind,
    service: Option<ServiceName>,
    name: DocumentName,
}

/// A kind and a name that do not go together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// An instance without its service.
    #[error("an Instance needs its service")]
    NoService,
    /// A service where there is none.
    #[error("a {0} has no service")]
    Service(Kind),
    /// The kind is not known.
    #[error("kind {0}")]
    Kind(#[from] UnknownWord),
    /// The name breaks the rules.
    #[error("name {0}")]
    Name(#[from] NameError),
    /// The text has another form than `Kind/name` or `Instance/service/name`.
    #[error("{0:?} is not Kind/name or Instance/service/name")]
    Form(String),
}

impl Key {
    /// A key of any kind.
    ///
    /// # Errors
    /// [`KeyError::NoService`], [`KeyError::Service`].
    pub fn new(
        kind: Kind,
        service: Option<ServiceName>,
        name: DocumentName,
    ) -> Result<Self, KeyError> {
        match (kind, &service) {
            (Kind::Instance, None) => Err(KeyError::NoService),
            (Kind::Instance, Some(_)) | (_, None) => Ok(Self { kind, service, name }),
            (_, Some(_)) => Err(KeyError::Service(kind)),
        }
    }

    /// A layer.
    #[must_use]
    pub fn layer(name: &LayerName) -> Self {
        Self::plain(Kind::Layer, name.into())
    }

    /// A node.
    #[must_use]
    pub fn node(name: &NodeName) -> Self {
        Self::plain(Kind::Node, name.into())
    }

    /// A service.
    #[must_use]
    pub fn service(name: &ServiceName) -> Self {
        Self::plain(Kind::Service, name.into())
    }

    /// An instance of a service.
    #[must_use]
    pub fn instance(service: ServiceName, name: DocumentName) -> Self {
        Self { kind: Kind::Instance, service: Some(service), name }
    }

    /// A roll-out.
    #[must_use]
    pub fn rollout(name: DocumentName) -> Self {
        Self::plain(Kind::Rollout, name)
    }

    fn plain(kind: Kind, name: DocumentName) -> Self {
        Self { kind, service: None, name }
    }

    /// Its kind.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The service of an instance.
    #[must_use]
    pub fn service_name(&self) -> Option<&ServiceName> {
        self.service.as_ref()
    }

    /// Its name.
    #[must_use]
    pub fn name(&self) -> &DocumentName {
        &self.name
    }
}

/// `Node/robot-1`, `Instance/slam/0`: also how it stands in the store.
impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.service {
            Some(service) => write!(f, "{}/{service}/{}", self.kind, self.name),
            None => write!(f, "{}/{}", self.kind, self.name),
        }
    }
}

impl FromStr for Key {
    type Err = KeyError;
    fn from_str(text: &str) -> Result<Self, KeyError> {
        let form = || KeyError::Form(text.to_owned());
        let (kind, rest) = text.split_once('/').ok_or_else(form)?;
        let kind: Kind = kind.parse()?;
        let (service, name) = match rest.split_once('/') {
            Some((service, name)) => (Some(service.parse()?), name),
            None => (None, rest),
        };
        Self::new(kind, service, name.parse()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_reads_as_it_is_written() {
        for text in
            ["Layer/edge", "Node/robot-1", "Service/slam", "Instance/slam/0", "Rollout/slower"]
        {
            assert_eq!(text.parse::<Key>().unwrap().to_string(), text);
        }
        for text in
            ["Layer", "Layer/a/b", "Instance/slam", "layer/a", "Node/A", "Instance/slam/0/1", ""]
        {
            assert!(text.parse::<Key>().is_err(), "{text}");
        }
    }
}
