//! From the node file to a broker with a server.

use std::sync::Arc;

use blaze_brokers::{Broker, Role};
use blaze_domain::node_file::{LayerBroker, NodeBroker};

/// Connects to the server of a node scope, in the background.
///
/// # Errors
/// Where it can never work.
pub(crate) fn open_node(_section: &NodeBroker, _role: &Role) -> anyhow::Result<Arc<dyn Broker>> {
    anyhow::bail!("this version has no Redis adapter; use memory: {{}}")
}

/// Connects to the server of a layer scope, in the background.
///
/// # Errors
/// Where it can never work.
pub(crate) fn open_layer(_section: &LayerBroker, _role: &Role) -> anyhow::Result<Arc<dyn Broker>> {
    anyhow::bail!("this version has no Kafka adapter; use memory: {{}}")
}
