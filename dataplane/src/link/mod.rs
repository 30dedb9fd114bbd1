//! The inter scope: flow to flow.

pub mod transport;
