//! The way to the main service.
//!
//! ```text
//! client ──[who asks, what it has?]──▶ engine
//!        ──Hello──▶ main service ──Welcome, Snapshot, Commit, Bookmark──▶ client ──[Incoming]──▶ engine ──[Ack]──▶ client
//! ```

pub mod client;
pub mod wire;

pub use client::{StreamError, SyncEvent, follow};
