//! The configuration of a whole system as plain data: documents, their merging and comparing, and
//! how they are written.
//!
//! ```text
//! bytes ──[json, yaml]──▶ Value ──[spec]──▶ Document (kind, name, labels, spec) ──[merge]──▶ effective configuration
//!                                                   │                                            │
//!                                                   └──[diff]──▶ changes                          └──[canonical]──▶ hash
//! ```
//!
//! The main service and the worker share all of it, so that both come to the same configuration and
//! the same hash.

#[cfg(test)]
mod arbitrary;
pub mod canonical;
mod code;
pub mod diff;
mod document;
pub mod effective;
pub mod json;
mod key;
pub mod merge;
pub mod placement;
mod problem;
pub mod secret;
pub mod selector;
pub mod spec;
pub mod state;
mod time;
mod words;

pub use code::Code;
pub use document::{Document, Labels};
pub use key::{Key, KeyError, Kind};
pub use problem::{Applied, FieldFault, Problem};
pub use time::Timestamp;
pub use words::{AckStatus, ConfigScope, ConfigSource, ServiceState};

/// Largest document, in bytes of its compact JSON (256 KiB).
pub const MAX_DOCUMENT_BYTES: usize = 256 * 1024;
/// Largest effective configuration, in bytes of its compact JSON (512 KiB).
pub const MAX_EFFECTIVE_BYTES: usize = 512 * 1024;
/// Largest JSON Schema of a service, in bytes of its compact JSON (64 KiB).
pub const MAX_SCHEMA_BYTES: usize = 64 * 1024;
/// Deepest nesting of objects and arrays in a request or document.
pub const MAX_DEPTH: usize = 32;
/// Labels of one document, at most.
pub const MAX_LABELS: usize = 64;
/// Documents of one store, at most.
pub const MAX_DOCUMENTS: usize = 100_000;
/// Largest integer that every reader of JSON takes exactly: 2^53 - 1.
pub const MAX_INTEGER: i64 = 9_007_199_254_740_991;
