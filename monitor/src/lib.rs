//! BlazeMonitoring on one node: values of the node, pings to other nodes, latency of messages,
//! health. ARCHITECTURE.md has the map.

mod admin;
mod gather;
pub mod health;
mod history;
pub mod latency;
pub mod limits;
mod look;
pub mod metric;
pub mod node;
mod page;
pub mod ping;
mod pings;
mod programs;
pub mod report;
pub mod running;
mod services;
pub mod settings;
mod shared;
mod subscriber;

pub use shared::all_metrics;

#[cfg(test)]
mod docs_tests;
