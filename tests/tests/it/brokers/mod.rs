//! The adapters against real servers (`scripts/services install`) and over loopback: the
//! conformance suite, and what only a real server or network does.

mod dds;
mod kafka;
mod memory;
mod redis;
mod ros2;
mod support;
