//! BlazeConfig main service: the configuration of layers, nodes, services and instances of the
//! whole system.
//!
//! ```text
//! listen ─▶ api: rest, grpc ─▶ core: rules, committer, watches ─▶ store: SQLite, MongoDB
//!                │                    │
//!                └── auth ────────────┴── secrets, status (what monitors report)
//! ```
//!
//! Interfaces translate and decide nothing; the core decides and does no I/O of its own; a store
//! keeps commits in order.

// Test data that the conformance suite shares names this crate from outside.
#[cfg(test)]
extern crate self as blaze_config;

pub mod api;
pub mod auth;
pub mod core;
pub mod listen;
pub mod metrics;
pub mod process;
mod reload;
pub mod running;
pub mod secrets;
pub mod status;
pub mod store;
mod waiting;
