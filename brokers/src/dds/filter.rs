//! A packet filter in the kernel (classic BPF) that keeps datagrams from RustDDS 0.15 which make it
//! allocate without bound, stand still or panic:
//!
//! | submessage | dropped when |
//! |---|---|
//! | DATA_FRAG | the sample is larger than any that is expected, the fragment size is not RustDDS' own (of other implementations: below 256 bytes), the fragment number or count is 0 |
//! | HEARTBEAT, GAP | the range is wider than any that writers send, ends more than one before its begin, or crosses a multiple of 2³²; a GAP from 1 on may have any range |
//! | ACKNACK, NACK_FRAG, HEARTBEAT_FRAG | the bitmap or fragment number is beyond all that is sent for the samples of the topics |
//! | all of these | a sequence number is negative, or 2⁴⁷ or more |
//!
//! Everything else passes; what RustDDS' parser refuses is left to it. The walk over the
//! submessages is unrolled, since a filter has no loops, so datagrams with more submessages than
//! there are steps are dropped, too. A *full* step knows all kinds. A *quick* step takes DATA and
//! INFO_TS in little endian, of which many are packed into one datagram; at anything else it leaves
//! to the packed steps. A *packed* step knows all kinds in little endian that implementations are
//! known to send; at anything else it leaves to the last full steps.

mod assembler;
mod program;
mod socket;
mod steps;
#[cfg(test)]
mod tests;

use std::io;

pub(super) use program::Samples;
pub(super) use socket::{Attached, attach, keep_announcements, steer};

/// Why datagrams are not filtered.
#[derive(Debug, thiserror::Error)]
pub(super) enum FilterError {
    #[error("{what}: {error}")]
    System { what: &'static str, error: io::Error },
    #[error("no socket of this process has one of the ports {0:?}")]
    NoSocket(Vec<u16>),
    #[error("the program is wrong")]
    Program,
}

fn system(what: &'static str) -> impl FnOnce(io::Error) -> FilterError {
    move |error| FilterError::System { what, error }
}
