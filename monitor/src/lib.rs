//! BlazeMonitoring on one node: values of the node, pings to other nodes, latency of messages,
//! health. ARCHITECTURE.md has the map.

pub mod admin;
pub mod expiry;
pub mod gather;
pub mod health;
pub mod history;
pub mod latency;
pub mod limits;
pub mod look;
pub mod metric;
pub mod node;
pub mod page;
pub mod ping;
pub mod pings;
pub mod programs;
pub mod report;
pub mod running;
pub mod services;
pub mod settings;
pub mod shared;
pub mod subscriber;
mod tasks;

pub use shared::all_metrics;

#[cfg(test)]
mod docs_tests;
