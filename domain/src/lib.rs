//! The words of BlazeAIoT: names, identities, quality of service, control protocol, drop reasons.
//!
//! Everything here is plain data and pure functions: no input or output, no clock, no asynchronous
//! code. Each name is a type that cannot hold a bad value; each closed set of the contract is an
//! `enum` with its text on the wire.

pub mod config;
pub mod control;
pub mod identity;
pub mod media;
pub mod names;
pub mod node_file;
pub mod qos;
pub mod reasons;

pub use identity::{FlowId, Origin, WriterId};
pub use names::{
    DocumentName, InstanceName, LayerName, NameError, NodeName, ServiceName, TopicName,
};
pub use qos::{Durability, LayerKind, Priority, Reliability, Scope};
pub use reasons::{DropReason, WhyCode};

/// Largest payload of one message, in bytes (16 MiB).
pub const MAX_PAYLOAD_BYTES: usize = 16 * 1024 * 1024;

/// Highest rate of a topic, in Hz. Above it nothing is measured or planned.
pub const MAX_RATE_HZ: f64 = 1_000_000.0;

/// Largest encoded message header, in bytes.
pub const MAX_HEADER_BYTES: usize = 4096;
