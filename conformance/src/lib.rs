//! What every adapter of a port must do, as tests that each adapter runs against its own server.

pub mod broker;
pub mod store;
