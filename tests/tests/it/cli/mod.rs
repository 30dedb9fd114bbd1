//! Commands of `blaze` that need more than one of our programs, as their users have them: real
//! processes, real servers.
//!
//! Needs `cargo build --workspace` and `scripts/services install` (Redis).

mod admin;
mod apply_wait;
mod dev;
mod dev_flow;
mod doctor;
mod node_join;
mod stage;
