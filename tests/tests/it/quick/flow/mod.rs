//! Whole flows over simulated brokers, networks and clocks.

mod allocation;
mod brokers;
#[path = "../../../../../dataplane/src/link/flights.rs"]
mod flights;
mod protocol;
mod replicas;
