//! Commands of `blaze` that need more than one of our programs, as their users have them: real processes, real servers.
//!
//! Needs `cargo build --workspace` and `scripts/services install` (Redis).

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "the helpers of a test fail like the test"
)]

mod apply_wait;
mod dev;
mod dev_flow;
mod node_join;
mod stage;
