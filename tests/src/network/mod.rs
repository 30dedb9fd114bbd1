//! Several hosts on one machine: network namespaces, the wires, switches and links between them.
//!
//! [`Topology`] builds what a [`Plan`] says: hosts, LAN segments, WAN links through `blaze-wan`, and the routes. [`Pair`] and
//! [`Lan`] are two simple ones without routers.

mod link;
mod meter;
mod namespace;
mod pair;
mod plan;
mod routes;
mod topology;

pub use link::Link;
pub use meter::{Meter, Sample};
pub use namespace::{check_rights, connect, inside, program, run};
pub use pair::{Lan, Pair};
pub use plan::{Plan, Segment, WanLink};
pub use topology::{Host, Topology};
