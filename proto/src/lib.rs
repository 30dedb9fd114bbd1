//! Wire formats and their conversion to and from domain types.
//!
//! - [`frame`]: a message on a broker: `BLZ1`, header length, header, payload;
//! - [`v1`]: the message header as generated from `blaze/v1/message.proto`;
//! - [`link`]: what flows tell one another, generated from `blaze/link/v1/control.proto`.

pub mod frame;

pub use frame::{Frame, FrameError, Header};

/// Generated from `blaze/v1/message.proto`.
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
        Self {
            body: Some(body),
            channel: None,
        }
    }
}

/// A priority as it travels; [`Priority::State`](blaze_domain::Priority::State) for one that is not given.
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
