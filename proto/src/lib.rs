//! Wire formats and their conversion to and from domain types.
//!
//! - [`frame`]: a message on a broker: `BLZ1`, header length, header, payload;
//! - [`v1`]: the message header as generated from `blaze/v1/message.proto`;
//! - [`link`]: what flows tell one another, generated from `blaze/link/v1/control.proto`;
//! - with feature `config`, `v1` has the configuration's services too, and `config` turns their
//!   messages into documents.

#[cfg(feature = "config")]
pub mod config;
pub mod frame;

pub use frame::{Frame, FrameError, Header};
/// Encodes and decodes a message of [`v1`].
#[cfg(feature = "config")]
pub use prost::Message;
/// Types that messages of [`v1`] have from the package `google.protobuf`.
#[cfg(feature = "config")]
pub use prost_types as google;

/// Descriptors (`google.protobuf.FileDescriptorSet`) of the configuration's services and their
/// messages, for reflection.
#[cfg(feature = "config")]
pub const CONFIG_DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/blaze.config.bin"));

/// Generated from `blaze/v1/message.proto`; with feature `config` from `config.proto` and
/// `sync.proto` beside it too.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated code")]
pub mod v1 {
    include!(concat!(env!("OUT_DIR"), "/blaze.v1.rs"));
}

/// Generated from `blaze/link/v1/control.proto`.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated code")]
pub mod link {
    include!(concat!(env!("OUT_DIR"), "/blaze.link.v1.rs"));
}

impl From<link::link_control::Body> for link::LinkControl {
    fn from(body: link::link_control::Body) -> Self {
        Self { body: Some(body), channel: None }
    }
}

/// A priority as it travels; [`Priority::State`](blaze_domain::Priority::State) for one that is not
/// given.
#[must_use]
pub fn priority_from_wire(value: i32) -> blaze_domain::Priority {
    match value {
        1 => blaze_domain::Priority::Control,
        3 => blaze_domain::Priority::Bulk,
        _ => blaze_domain::Priority::State,
    }
}

/// The number of a priority on the wire.
#[must_use]
pub fn priority_to_wire(priority: blaze_domain::Priority) -> i32 {
    match priority {
        blaze_domain::Priority::Control => 1,
        blaze_domain::Priority::State => 2,
        blaze_domain::Priority::Bulk => 3,
    }
}
