//! Where a worker serves, whom, and from what.

use std::fmt;

pub use blaze_domain::config::ConfigSource as Source;
use blaze_domain::config::effective::ConfigTarget;
use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{DocumentName, InstanceName, LayerName, NodeName, ServiceName};
use serde::{Deserialize, Serialize};

/// What a worker serves: a whole layer, or one node of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Site {
    /// Its layer.
    pub layer: LayerName,
    /// The one node whose broker it is on; `None`: the broker of the layer.
    pub node: Option<NodeName>,
}

/// Who is served a configuration: an instance, or a service without one, at a node or at the
/// layer alone.
///
/// Ordered by service first, then instance (none before all others), so that the places of a
/// service are a range.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ServedTarget {
    /// Which service.
    pub service: ServiceName,
    /// Which instance of it; `None`: the service without instance.
    pub instance: Option<InstanceName>,
    /// Where; `None`: the layer alone.
    pub node: Option<NodeName>,
}

impl ServedTarget {
    /// The same for [`Sources`](blaze_domain::config::effective::Sources).
    #[must_use]
    pub fn at(&self, site: &Site) -> ConfigTarget {
        ConfigTarget {
            service: Some(self.service.clone()),
            instance: self.instance.as_ref().map(DocumentName::from),
            layer: Some(site.layer.clone()),
            node: self.node.clone(),
        }
    }

    /// The first place of a service, in their order.
    pub(super) fn first_of(service: &ServiceName, instance: Option<&InstanceName>) -> Self {
        Self { service: service.clone(), instance: instance.cloned(), node: None }
    }
}

/// `slam`, `slam/0`, `slam/0 at robot-1`.
impl fmt::Display for ServedTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.service)?;
        if let Some(instance) = &self.instance {
            write!(f, "/{instance}")?;
        }
        match &self.node {
            Some(node) => write!(f, " at {node}"),
            None => Ok(()),
        }
    }
}

impl Site {
    /// The place that a document alone makes one of those that are told of changes: of a service
    /// the one without instance, of an instance where it may run.
    ///
    /// On the broker of a node these are the instances placed on the node, and those placed on the
    /// layer or nowhere: they may be started here at any time, and then look at the keys of Redis
    /// before anybody has asked for them. Those placed on another node run there, and that node's
    /// worker tells them; if one asks here all the same, it is told because it asked. On the broker
    /// of a layer these are all instances of the view, each at the node that its document names.
    pub(super) fn home(&self, state: &State, document: &Document) -> Option<ServedTarget> {
        let (service, instance) = match document.key.kind() {
            Kind::Service => (ServiceName::from(document.key.name()), None),
            Kind::Instance => {
                let service = document.key.service_name()?.clone();
                // A mounted file may name a service that it does not have.
                state.get(&Key::service(&service))?;
                (service, Some(InstanceName::from(document.key.name())))
            }
            Kind::Layer | Kind::Node | Kind::Rollout => return None,
        };
        let node = match (&self.node, &instance) {
            (Some(own), Some(_)) if !self.may_run(own, document) => return None,
            (Some(own), _) => Some(own.clone()),
            (None, _) => document.spec_node().and_then(|name| name.parse().ok()),
        };
        Some(ServedTarget { service, instance, node })
    }

    fn may_run(&self, own: &NodeName, instance: &Document) -> bool {
        match (instance.spec_node(), instance.spec_layer()) {
            (Some(node), _) => node == own.as_str(),
            (None, Some(layer)) => layer == self.layer.as_str(),
            (None, None) => true,
        }
    }

    /// Whether a document alone makes a place one of those that are told of changes.
    pub(super) fn is_home(&self, state: &State, place: &ServedTarget) -> bool {
        let key = match &place.instance {
            Some(instance) => Key::instance(place.service.clone(), instance.into()),
            None => Key::service(&place.service),
        };
        let held = state.get(&key);
        held.and_then(|held| self.home(state, &held.document)).as_ref() == Some(place)
    }
}
