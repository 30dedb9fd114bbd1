//! The link emulator, networks of namespaces, the fault proxy, and scenarios over them.
//!
//! Needs root, iproute2 and `/dev/net/tun`; scenarios need `scripts/services install` as well. Most measure time, so they run
//! one after another. `BLAZE_LONG` selects the full durations.

mod budget;
mod cuts;
mod emulator;
mod joins;
mod layers;
mod proxy;
mod scenario;
mod soak;
mod support;
mod topology;
