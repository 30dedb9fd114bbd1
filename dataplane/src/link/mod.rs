//! The inter scope: flow to flow.
//!
//! ```text
//! engine       messages in, events out                        addresses  where flows are
//!  ├ budget     what may go to each peer
//!  ├ lifecycle  peers come and go                              clock      round trips, offsets, loss
//!  ├ transmit   who is served next; Hello, Feedback            event      what goes in and comes out
//!  ├ receive    LinkControl and messages
//!  ├ peer       one peer: its clocks, and of each class
//!  │  ├ sender    queue, samples on the way, repair            outgoing   messages on their way out
//!  │  └ receiver  what came, what waits, what is missing       assembly   unfinished ones; ranges
//!  └ wire       datagrams and records
//! transport   carries datagrams
//! ```

mod addresses;
mod assembly;
mod budget;
mod clock;
pub mod dds;
mod engine;
mod event;
mod lifecycle;
mod namesakes;
mod outgoing;
mod peer;
mod ranges;
mod receive;
mod receiver;
mod sender;
mod transmit;
pub mod transport;
mod wire;

#[cfg(test)]
mod flights;
#[cfg(test)]
pub(crate) mod sim;
#[cfg(test)]
mod tests;

pub use budget::{LinkBudgets, LinkCapacity, PacketSize};
pub use engine::{Engine, EngineConfig, Limits, MAX_PEERS, MIN_DATAGRAM_BYTES};
pub use event::{
    Begun, DownReason, LaneId, LinkCounters, LinkEvent, PeerInfo, PeerState, StreamKey, Submit,
    Tally, Transmit,
};
pub use namesakes::NameConflict;
pub use wire::{HEADER_BYTES, RECORD_BYTES};
pub(crate) use wire::{class_code, class_of, kind_from_wire, kind_to_wire};
