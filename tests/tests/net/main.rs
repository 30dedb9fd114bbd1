//! The link emulator, networks of namespaces, the fault proxy, and scenarios over them.
//!
//! Needs root, iproute2 and `/dev/net/tun`; scenarios need `scripts/services install` as well.
//! `BLAZE_LONG` selects the full durations.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "the helpers of a test fail like the test"
)]

mod cuts;
mod dds_namespaces;
mod doctor;
mod layers;
mod long;
mod loss;
mod ros2;
mod scenario;
mod support;
