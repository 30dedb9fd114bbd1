//! The JSON of the local broker, and the keys of Redis.
//!
//! ```text
//! blaze/config/get      bytes ──[get]──▶ GetRequest ──▶ Reply ──[write]──▶ text     blaze/reply/…, blaze:config:…
//!                                                      Notice ──[write]──▶ text     blaze/config/changed/<service>
//! blaze/config/ack      bytes ──[ack]──▶ ConfigAck
//! blaze/watchdog        bytes ─┐
//! blaze:watchdog:…      fields ┴[watchdog]──▶ ServiceState
//! ```
//!
//! What comes in may be anything: it is bounded in bytes and depth, unknown members are ignored,
//! and a fault names the member but never repeats a value that is not a name.

mod ack;
mod fields;
mod get;
mod keys;
mod watchdog;
mod write;

pub use ack::ConfigAck;
pub use fields::MAX_MESSAGE_BYTES;
pub use get::{ErrorCode, GetRequest, RefusedRequest, RequestError, default_reply};
pub use keys::{config_key, lease_key, node_lease_key};
pub use watchdog::{DEFAULT_TTL_MS, Health, ServiceState, WatchdogKey};
pub use write::{Delivery, TooLargeMessage, notice, refusal, reply, state_value};
