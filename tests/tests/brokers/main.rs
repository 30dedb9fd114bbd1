//! The adapters of brokers that have a server, against real servers (`scripts/services install`).

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod redis;
