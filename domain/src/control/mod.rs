//! The control protocol: what services tell their flow on `blaze/flow/control`, and what it
//! answers.
//!
//! ```text
//! payload ──parse_payload──► [ParsedObject] ──registry──► Answer (where `reply_to` is given), Event
//! ControlMessage::to_json ──► payload (SDK, restored leases)
//! ```
//!
//! A payload is one JSON object or an array of them. A fault of one object leaves the others of its
//! array alone.

mod answer;
mod message;
mod parse;
mod words;

pub use answer::{Answer, ControlError, Event, rfc3339_millis};
pub use message::{
    AdvertiseMessage, CallMessage, Common, ControlMessage, OriginSelector, Quality, RequestMessage,
    WithdrawMessage,
};
pub use parse::{ParsedObject, parse_payload};
pub use words::{ErrorCode, EventKind, LeaseKind};

/// Largest control payload, in bytes.
pub const MAX_CONTROL_BYTES: usize = 64 * 1024;
/// Most objects in one control payload.
pub const MAX_CONTROL_OBJECTS: usize = 200;
/// Lifetime of a lease that names none, in seconds.
pub const DEFAULT_TTL_S: u32 = 15;
/// Longest finite lifetime of a lease, in seconds.
pub const MAX_TTL_S: u32 = 86_400;
/// Most samples that a writer may ask to be kept.
pub const MAX_DEPTH: u32 = 65_535;
/// Longest media type, in bytes.
pub const MAX_ENCODING_BYTES: usize = 200;
/// Longest type name or type hash, in bytes.
pub const MAX_TYPE_BYTES: usize = 200;
/// Longest `id` of a control message, in bytes.
pub const MAX_ID_BYTES: usize = 256;
/// Time that a call without `timeout_ms` waits for its reply, in milliseconds.
pub const DEFAULT_CALL_TIMEOUT_MS: u32 = 5_000;
/// Longest time that a call may wait for its reply, in milliseconds.
pub const MAX_CALL_TIMEOUT_MS: u32 = 600_000;
/// Media type of a topic whose publisher names none.
pub const DEFAULT_ENCODING: &str = "application/octet-stream";
/// Channels that may be named as `reply_to` begin so.
pub const REPLY_PREFIX: &str = "blaze/reply/";
