//! What end-to-end tests stand on: real processes and servers, emulated networks, faults, and waits on conditions.

pub mod admin;
pub mod fleet;
pub mod flow;
mod guard;
pub mod ledger;
pub mod machine;
mod memory;
pub mod network;
#[cfg(feature = "kafka")]
pub mod plain;
pub mod process;
pub mod proxy;
pub mod scenario;
pub mod servers;
#[cfg(feature = "kafka")]
pub mod stream;
pub mod wait;
pub mod wan;

/// Whether the full counts are wanted (`scripts/test --long`).
#[must_use]
pub fn long() -> bool {
    std::env::var_os("BLAZE_LONG").is_some()
}
