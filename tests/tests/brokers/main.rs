//! The adapters of brokers that have a server, against real servers (`scripts/services install`): the conformance suite, and
//! what only a real server does.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

#[cfg(feature = "kafka")]
mod kafka;
mod redis;
