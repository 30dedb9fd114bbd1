//! Adapters against real servers: the conformance suite, and what only a real server does.

#[cfg(feature = "kafka")]
mod kafka;
