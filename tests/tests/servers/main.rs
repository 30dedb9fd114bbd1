//! The harness of real servers: what it starts answers, what it kills has gone, what it freezes stands still.
//!
//! Needs `scripts/services install`.

#[cfg(feature = "kafka")]
mod kafka;
mod redis;
mod shared;
