//! BlazeFlow: connects the publishers of a topic with the services that request it.
//!
//! See `ARCHITECTURE.md` for the map.

pub mod codec;
pub mod control;
pub mod flow;
pub mod lane;
pub mod limit;
pub mod link;
pub mod plan;
pub mod registry;
#[cfg(test)]
mod testing;
pub mod types;
pub mod why;
pub mod world;
