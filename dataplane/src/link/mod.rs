//! The inter scope: flow to flow.
//!
//! ```text
//! engine      peers, priorities, who is served next            addresses  where flows are
//!  ├ control  LinkControl: Hello, Feedback, Goodbye            clock      round trips, offsets, loss
//!  ├ peer     one peer's life                                  event      what goes in and comes out
//!  │  ├ sender    queue, samples on the way, repair            outgoing   messages on their way out
//!  │  └ receiver  what came, what waits, what is missing       assembly, ranges
//!  └ wire     datagrams and records
//! transport   carries datagrams
//! ```

mod addresses;
mod assembly;
mod clock;
mod control;
pub mod dds;
mod engine;
mod event;
mod outgoing;
mod peer;
mod ranges;
mod receiver;
mod sender;
pub mod transport;
mod wire;

#[cfg(test)]
pub(crate) mod sim;
#[cfg(test)]
mod tests;

pub use engine::{Engine, EngineConfig, Limits, MIN_DATAGRAM_BYTES, PeerIndex};
pub use event::{DownReason, LaneId, LinkCounters, LinkEvent, PeerInfo, PeerState, StreamKey, Submit, Tally, Transmit};
pub use wire::{HEADER_BYTES, RECORD_BYTES};
