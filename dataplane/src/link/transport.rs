//! How datagrams get from flow to flow. DDS today; QUIC is to be a second one.
//!
//! A transport finds other flows, carries single datagrams to them and tells what came. It knows
//! nothing of messages, acknowledgements or rates: those are the engine's. It never blocks a
//! sender.

use std::fmt;

use blaze_domain::{FlowId, Priority};
use bytes::Bytes;

/// One life of one flow on the inter scope. Names of link topics hold all three parts, so that a
/// dead life's readers never hold back writers to the new one.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Endpoint {
    /// The flow.
    pub flow: FlowId,
    /// Its life; larger is newer.
    pub epoch: u64,
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.flow, self.epoch)
    }
}

/// What a transport tells its flow.
#[derive(Debug, Clone)]
pub enum TransportEvent {
    /// Another flow's endpoint can be written to.
    Discovered(Endpoint),
    /// The transport no longer sees that endpoint. Silence on the link decides, not this.
    Lost(Endpoint),
    /// A datagram for this flow; who sent it stands in the link header.
    Received {
        /// The class whose topic it came on.
        class: Priority,
        /// The datagram.
        datagram: Bytes,
    },
    /// The transport died and was rebuilt; `epoch` is this flow's new life on the link.
    Rebuilt {
        /// The new epoch.
        epoch: u64,
    },
}

/// What became of a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendOutcome {
    /// Handed to the network.
    Sent,
    /// No writer to that endpoint, or it could not take it now; the engine's repair treats it as
    /// lost.
    NotSent,
}
