//! The program: what RustDDS 0.15.1 reads of a datagram, and what must not get there.
//!
//! A filter of a UDP socket sees the UDP header at 0. A load beyond the packet ends the program and
//! drops the packet; RustDDS refuses such a datagram as a whole, too.

use super::assembler::{Assembler, Instruction, Op, Test};
use super::steps::{
    DROP, Limits, PASS, full_step, on_announcement, packed_step, pass_at_end, quick_step,
};

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
    /// the value from before Linux 6.8; the large one fits into 70,000 bytes and not into 66,000. A
    /// packet of 1500 bytes holds at most 15 of the link's datagrams.
    const SMALL: Self = Self { first: 2, quick: 24, packed: 0, last: 2 };
    /// For other implementations: Cyclone packs some 60 announcements, each with its time, into one
    /// datagram, and heartbeats and acknowledgements of many endpoints. Fast DDS ends a datagram
    /// with a fragment by a heartbeat and a submessage of its own. 4,058 instructions, which fit
    /// into 90,000 bytes and not into 80,000.
    const LARGE_ANY_VENDOR: Self = Self { first: 1, quick: 114, packed: 22, last: 2 };
    const SMALL_ANY_VENDOR: Self = Self { first: 2, quick: 12, packed: 3, last: 1 };

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
    /// Whether announcements are repeated to RustDDS: it gets nothing but the header of others.
    pub(in super::super) repeated: bool,
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
    if samples.repeated {
        trim_announcements(&mut asm);
    }
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

/// Cuts announcements off behind the header, which tells RustDDS whence others come. It is no drop,
/// and not counted as one.
fn trim_announcements(asm: &mut Assembler) {
    let [announcement, other] = [(); 2].map(|()| asm.label());
    on_announcement(asm, UDP_HEADER + RTPS_HEADER, announcement, other);
    asm.place(announcement);
    asm.op(Op::Return, UDP_HEADER + RTPS_HEADER);
    asm.place(other);
}

/// Passes announcements alone.
pub(super) fn announcements() -> Option<Vec<Instruction>> {
    choice(UDP_HEADER, PASS, DROP)
}

/// Of two sockets of a port the second gets announcements, the first all else. Such a program sees
/// no UDP header.
pub(super) fn steering() -> Option<Vec<Instruction>> {
    choice(0, 1, 0)
}

fn choice(begin: u32, for_announcement: u32, for_other: u32) -> Option<Vec<Instruction>> {
    let mut asm = Assembler::default();
    let [announcement, other] = [(); 2].map(|()| asm.label());
    asm.op(Op::LoadWordAt, begin);
    asm.unless(Test::Equal, MAGIC, other);
    on_announcement(&mut asm, begin + RTPS_HEADER, announcement, other);
    asm.place(announcement);
    asm.op(Op::Return, for_announcement);
    asm.place(other);
    asm.op(Op::Return, for_other);
    asm.finish()
}
