//! What every adapter of a port must do, as tests that each adapter runs against its own server.

pub mod broker;
pub mod store;

/// Whether the full counts are wanted (`scripts/test --long`).
fn full() -> bool {
    std::env::var_os("BLAZE_LONG").is_some()
}
