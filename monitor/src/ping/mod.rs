//! Round trips to other nodes through BlazeFlow, and the offsets of their clocks.
//!
//! ```text
//! requesters, measured, links ──▶ ┌────────┐ ──▶ pings: blaze/ping/<layer that is asked>
//! pings of others, pongs ───────▶ │ Engine │ ──▶ pongs: blaze/pong/<own layer>/<own node>
//! clocks ───────────────────────▶ └────────┘ ──▶ topics to request, offsets, /v1/ping, metrics
//! ```
//!
//! [`Engine`] is sans-io: it reads no clock and no socket, and its random numbers come from a seed.
//! The caller polls it at its deadline, publishes its outputs at once, and hands in messages as soon
//! as they are read, each with the clocks of that moment.

mod answers;
mod choose;
mod engine;
mod estimate;
mod ignored;
mod limits;
mod nodes;
mod open;
mod order;
mod other;
mod report;
mod rounds;
mod topics;
mod wire;

pub use engine::{Engine, Output, Settings};
pub use estimate::{Now, Offset, Source};
pub use ignored::Ignored;
pub use order::{OrderError, OrderId, PingSample};
pub use other::LinkOffset;
pub use report::{LatencyView, METRICS, NodeView, PingView, Reading, Value};
pub use topics::TopicChanges;

#[cfg(test)]
mod property_tests;
#[cfg(test)]
mod rule_tests;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod testing;
