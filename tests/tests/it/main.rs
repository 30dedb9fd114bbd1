//! Tests over crates, real servers and real processes; those that need root are in `net`.
//!
//! Where a test runs is in its path: what stands below a module `quick` runs in every tier, below
//! `long` with `scripts/test --long` alone, everything else with `scripts/test`. They need `cargo
//! build --workspace` and `scripts/services install`.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "the helpers of a test fail like the test"
)]

mod brokers;
mod cli;
mod config_docs;
mod control_plane;
mod demo;
mod e2e;
mod garbage;
mod long;
mod quick;
mod real;
mod stores;
mod worker;
