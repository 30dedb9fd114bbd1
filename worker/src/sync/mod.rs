//! The stream from the main service.
//!
//! ```text
//! v1::SyncResponse ──[wire]──▶ core::Incoming ──▶ core::Replica
//! ```

pub mod wire;
