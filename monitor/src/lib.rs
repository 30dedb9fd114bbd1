//! BlazeMonitoring on one node: values of the node, pings to other nodes, latency of messages,
//! health. ARCHITECTURE.md has the map.

pub mod health;
pub mod latency;
pub mod metric;
pub mod node;
pub mod ping;
