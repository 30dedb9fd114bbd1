//! A packet filter in the kernel (classic BPF) that keeps datagrams from RustDDS 0.15 which make it
//! allocate without bound, stand still or panic, and which it never sends itself:
//!
//! | submessage | dropped when |
//! |---|---|
//! | DATA_FRAG | the sample is larger than any that flows send, the fragment size is not RustDDS' own, the fragment number or count is 0 |
//! | HEARTBEAT, GAP | a sequence number is not within 0 to 2³¹ − 1, or the range is wider than any that RustDDS sends |
//! | ACKNACK, NACK_FRAG, HEARTBEAT_FRAG | a sequence number is negative or above 2³² − 1, the bitmap or fragment number is beyond all that RustDDS sends for the samples of its topics |
//!
//! Everything else passes; what RustDDS' parser refuses is left to it. The walk over the
//! submessages is unrolled, since a filter has no loops, so datagrams with more submessages than
//! there are steps are dropped, too. A *full* step knows all kinds. A *quick* step takes DATA and
//! INFO_TS as RustDDS writes them, of which it packs many into one datagram; at anything else it
//! leaves to the next full step.

mod assembler;
mod program;
mod socket;
#[cfg(test)]
mod tests;

use std::io;

pub(super) use program::{Samples, Shape};
pub(super) use socket::{Attached, attach};

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
