//! What end-to-end tests stand on: real processes and servers, emulated networks, faults, and waits
//! on conditions.

use std::time::Duration;

pub mod admin;
mod dialogue;
pub mod fleet;
pub mod flow;
mod guard;
pub mod ledger;
pub mod machine;
mod memory;
pub mod monitor;
pub mod network;
pub mod plain;
pub mod process;
pub mod proxy;
pub mod ros2;
pub mod scenario;
pub mod servers;
pub mod stream;
pub mod wait;
pub mod wan;

/// A limit of delay: as it is where each test has the machine for itself (`scripts/test --long`),
/// else four times as much and at most two seconds more, as others that run beside take their share
/// of two processors.
#[must_use]
pub fn within(limit: Duration) -> Duration {
    const MOST: Duration = Duration::from_secs(2);
    if long() { limit } else { limit + (limit * 3).min(MOST) }
}

/// Whether the full counts are wanted (`scripts/test --long`).
#[must_use]
pub fn long() -> bool {
    std::env::var_os("BLAZE_LONG").is_some()
}
