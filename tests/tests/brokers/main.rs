//! The adapters against real servers (`scripts/services install`) and over loopback: the conformance suite, and what only a real
//! server or network does.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod dds;
#[cfg(feature = "kafka")]
mod kafka;
mod redis;
