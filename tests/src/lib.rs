//! What end-to-end tests stand on: real processes, network namespaces, and waits on conditions.

pub mod admin;
pub mod flow;
pub mod network;
#[cfg(feature = "kafka")]
pub mod plain;
pub mod process;
pub mod servers;
pub mod wait;

/// Whether the full counts are wanted (`scripts/test --long`).
#[must_use]
pub fn long() -> bool {
    std::env::var_os("BLAZE_LONG").is_some()
}
