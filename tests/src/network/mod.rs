//! Several hosts on one machine: network namespaces, the wires, switches and links between them.
//!
//! [`Topology`] builds what a [`Plan`] says: hosts, LAN segments, WAN links through `blaze-wan`,
//! and the routes.

mod link;
mod namespace;
mod plan;
mod routes;
mod topology;
pub mod udp;

pub use link::Link;
pub use namespace::{connect, inside, program, run};
pub use plan::{Plan, Segment, WanLink};
pub use topology::{Host, Topology};
