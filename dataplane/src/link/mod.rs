//! The inter scope: flow to flow.

pub mod dds;
pub mod transport;
