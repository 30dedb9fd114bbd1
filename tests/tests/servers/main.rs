//! The harness of real servers: what it starts answers, what it kills has gone, what it freezes stands still.
//!
//! Needs `scripts/services install`.

#![allow(clippy::unwrap_used, reason = "the helpers of a test fail like the test")]

mod etcd;
#[cfg(feature = "kafka")]
mod kafka;
mod mongo;
mod redis;
mod shared;
