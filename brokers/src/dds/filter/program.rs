//! The program: what RustDDS 0.15.1 reads of a datagram, and what must not get there.
//!
//! A filter of a UDP socket sees the UDP header at 0. A load beyond the packet ends the program and
//! drops the packet; RustDDS refuses such a datagram as a whole, too.

use super::assembler::{Assembler, Instruction, Op, Test};
use super::steps::{DROP, Limits, full_step, packed_step, pass_at_end, quick_step};

const UDP_HEADER: u32 = 8;
const RTPS_HEADER: u32 = 20;
const MAGIC: u32 = u32::from_be_bytes(*b"RTPS");

/// RustDDS cuts samples into fragments of this many bytes. Smaller ones are not taken of anybody.
const FRAGMENT: u32 = 256;
/// First fragment that a NACK_FRAG may ask for where only samples of discovery are repaired, which
/// have less than one packet. RustDDS allocates a bit for each fragment before it.
const MAX_NACK_FRAGMENT: u32 = 0x3ff;
/// Last fragment of a HEARTBEAT_FRAG, at least.
const MAX_FRAGMENT: u32 = 0xffff;
/// How many steps a filter has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Shape {
    /// Full steps at the begin.
    pub(super) first: usize,
    /// Quick steps behind them.
    pub(super) quick: usize,
    /// Packed steps behind the quick ones.
    pub(super) packed: usize,
    /// Full steps at the end.
    pub(super) last: usize,
}

impl Shape {
    /// 3,592 of 4,096 possible instructions: enough for all that RustDDS packs into 9000 bytes, and
    /// on loopback (65,536) for the 128 samples that may wait in a writer of 32 KiB samples.
    const LARGE: Self = Self { first: 4, quick: 160, packed: 0, last: 4 };
    /// What fits into the 20 KiB that a socket has for its options where `net.core.optmem_max` has
    /// the value from before Linux 6.8; the large one needs 60 KiB. A packet of 1500 bytes holds at
    /// most 15 of the link's datagrams.
    const SMALL: Self = Self { first: 2, quick: 24, packed: 0, last: 2 };
    /// For other implementations: Cyclone packs some 60 announcements, each with its time, into one
    /// datagram, and heartbeats and acknowledgements of many endpoints. Fast DDS ends a datagram
    /// with a fragment by a heartbeat and a submessage of its own. 4,070 instructions.
    const LARGE_ANY_VENDOR: Self = Self { first: 1, quick: 118, packed: 22, last: 2 };
    const SMALL_ANY_VENDOR: Self = Self { first: 2, quick: 16, packed: 3, last: 1 };

    /// The large and the small shape for samples.
    pub(super) fn both(samples: Samples) -> [Self; 2] {
        if samples.any_vendor {
            [Self::LARGE_ANY_VENDOR, Self::SMALL_ANY_VENDOR]
        } else {
            [Self::LARGE, Self::SMALL]
        }
    }
}

/// The samples that come in fragments, and from whom.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) struct Samples {
    /// Bytes of the largest: DATA_FRAG passes up to the next power of two.
    pub(in super::super) largest: u32,
    /// Whether single fragments are asked for again.
    pub(in super::super) repaired: bool,
    /// Whether other implementations than RustDDS send them: in fragments of at least 256 bytes,
    /// not of exactly as many, and with more kinds of submessages in one datagram.
    pub(in super::super) any_vendor: bool,
}

impl Samples {
    fn limits(self) -> Limits {
        let limit = self.largest.max(1).checked_next_power_of_two().unwrap_or(1 << 31);
        let fragments = (limit / FRAGMENT).max(1) - 1;
        let nack = if self.repaired { fragments.max(MAX_NACK_FRAGMENT) } else { MAX_NACK_FRAGMENT };
        Limits {
            sample: !(limit - 1),
            nack_fragment: !nack,
            fragment: !fragments.max(MAX_FRAGMENT),
            exact_fragment: (!self.any_vendor).then_some(FRAGMENT),
        }
    }
}

/// Makes the filter; `None` as [`Assembler::finish`].
pub(super) fn program(shape: Shape, samples: Samples) -> Option<Vec<Instruction>> {
    let mut asm = Assembler::default();
    let is_rtps = asm.label();
    asm.op(Op::LoadWordAt, UDP_HEADER);
    asm.when(Test::Equal, MAGIC, is_rtps);
    asm.op(Op::Return, DROP);
    asm.place(is_rtps);
    asm.op(Op::IndexConstant, UDP_HEADER + RTPS_HEADER);
    let limits = samples.limits();
    for _ in 0..shape.first {
        full_step(&mut asm, limits);
    }
    let [packed, other] = [(); 2].map(|()| asm.label());
    for _ in 0..shape.quick {
        quick_step(&mut asm, packed);
    }
    asm.place(packed);
    for _ in 0..shape.packed {
        packed_step(&mut asm, limits, other);
    }
    asm.place(other);
    for _ in 0..shape.last {
        full_step(&mut asm, limits);
    }
    pass_at_end(&mut asm);
    asm.op(Op::Return, DROP);
    asm.finish()
}
