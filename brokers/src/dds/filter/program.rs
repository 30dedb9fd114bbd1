//! The program: what RustDDS 0.15.1 reads of a datagram, and what must not get there.
//!
//! A filter of a UDP socket sees the UDP header at 0. A load beyond the packet ends the program and
//! drops the packet; RustDDS refuses such a datagram as a whole, too.

use super::assembler::{Assembler, Instruction, Label, Op, Test};

/// Returned for what passes: more than any datagram has.
const PASS: u32 = 0x4_0000;
const DROP: u32 = 0;

const UDP_HEADER: u32 = 8;
const RTPS_HEADER: u32 = 20;
const MAGIC: u32 = u32::from_be_bytes(*b"RTPS");

const PAD: u32 = 0x01;
const ACKNACK: u32 = 0x06;
const HEARTBEAT: u32 = 0x07;
const GAP: u32 = 0x08;
const INFO_TS: u32 = 0x09;
const NACK_FRAG: u32 = 0x12;
const HEARTBEAT_FRAG: u32 = 0x13;
const DATA: u32 = 0x15;
const DATA_FRAG: u32 = 0x16;

/// Bit of the first word of a submessage (kind, flags, length): little endian.
const LITTLE: u32 = 0x0001_0000;
const HIGH_BIT_OF_HALF: u32 = 0x8000;

/// RustDDS cuts samples into fragments of this many bytes.
const FRAGMENT: u32 = 256;
/// First fragment that a NACK_FRAG may ask for where only samples of discovery are repaired, which
/// have less than one packet. RustDDS allocates a bit for each fragment before it.
const MAX_NACK_FRAGMENT: u32 = 0x3ff;
/// Last fragment of a HEARTBEAT_FRAG, at least.
const MAX_FRAGMENT: u32 = 0xffff;
/// Bits of a bitmap. RustDDS takes 256 and no more; this only is the next power of two.
const MAX_BITS: u32 = 0x1ff;
/// Width of a HEARTBEAT's range in units of 65,536: up to 2²⁰ numbers, which RustDDS lists with 8
/// bytes each.
const HEARTBEAT_RANGE: u32 = 15;
/// Width of a GAP's range: up to 2¹⁷ numbers, of which RustDDS makes a map, and itself sends the
/// 8,192 of a writer.
const GAP_RANGE: u32 = 1;
/// A GAP from 1 on says what a writer no longer has. RustDDS sends it over any range and only notes
/// where it ends.
const ANY_RANGE: u32 = 0x7fff;

// Words of memory.
/// First word of the submessage: kind, flags, length.
const HEAD: u32 = 0;
/// Where the submessage begins.
const POSITION: u32 = 1;
const FIRST: u32 = 2;
const RANGE: u32 = 3;

/// How many steps a filter has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) struct Shape {
    /// Full steps at the begin, and again at the end.
    pub(in super::super) full: usize,
    /// Quick steps between them.
    pub(in super::super) quick: usize,
}

impl Shape {
    /// 3,824 of 4,096 possible instructions: enough for all that RustDDS packs into 9000 bytes, and
    /// on loopback (65,536) for the 128 samples that may wait in a writer of 32 KiB samples.
    pub(in super::super) const LARGE: Self = Self { full: 4, quick: 160 };
    /// What fits into the 20 KiB that a socket has for its options where `net.core.optmem_max` has
    /// the value from before Linux 6.8; the large one needs 60 KiB. A packet of 1500 bytes holds at
    /// most 15 of the link's datagrams.
    pub(in super::super) const SMALL: Self = Self { full: 2, quick: 24 };
}

/// The samples that come in fragments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) struct Samples {
    /// Bytes of the largest: DATA_FRAG passes up to the next power of two.
    pub(in super::super) largest: u32,
    /// Whether single fragments are asked for again.
    pub(in super::super) repaired: bool,
}

/// Bits that must not be set.
#[derive(Debug, Clone, Copy)]
struct Masks {
    sample: u32,
    nack_fragment: u32,
    fragment: u32,
}

impl Samples {
    fn masks(self) -> Masks {
        let limit = self.largest.max(1).checked_next_power_of_two().unwrap_or(1 << 31);
        let fragments = (limit / FRAGMENT).max(1) - 1;
        let nack = if self.repaired { fragments.max(MAX_NACK_FRAGMENT) } else { MAX_NACK_FRAGMENT };
        Masks { sample: !(limit - 1), nack_fragment: !nack, fragment: !fragments.max(MAX_FRAGMENT) }
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
    let masks = samples.masks();
    for _ in 0..shape.full {
        full_step(&mut asm, masks);
    }
    let other = asm.label();
    for _ in 0..shape.quick {
        quick_step(&mut asm, other);
    }
    asm.place(other);
    for _ in 0..shape.full {
        full_step(&mut asm, masks);
    }
    pass_at_end(&mut asm);
    asm.op(Op::Return, DROP);
    asm.finish()
}

/// Passes the packet when X has reached its end.
fn pass_at_end(asm: &mut Assembler) {
    let more = asm.label();
    asm.op(Op::LoadLength, 0);
    asm.unless(Test::EqualsIndex, 0, more);
    asm.op(Op::Return, PASS);
    asm.place(more);
}

/// Swaps the two bytes of A, which has no others.
fn swap_half(asm: &mut Assembler) {
    asm.op(Op::Multiply, 0x0001_0001);
    asm.op(Op::ShiftRight, 8);
    asm.op(Op::And, 0xffff);
}

/// Moves X behind a submessage header and a body of A bytes.
fn advance(asm: &mut Assembler) {
    asm.op(Op::Add, 4);
    asm.op(Op::AddIndex, 0);
    asm.op(Op::ToIndex, 0);
}

/// Skips a little-endian DATA or INFO_TS. A DATA without length extends to the end of the packet;
/// here what follows its header is then looked at as if it were submessages, which RustDDS does
/// not.
fn quick_step(asm: &mut Assembler, other: Label) {
    pass_at_end(asm);
    let known = asm.label();
    asm.op(Op::LoadWord, 0);
    asm.op(Op::Store, HEAD);
    asm.op(Op::And, 0xff00_0000 | LITTLE);
    asm.when(Test::Equal, DATA << 24 | LITTLE, known);
    asm.when(Test::Equal, INFO_TS << 24 | LITTLE, known);
    asm.jump(other);
    asm.place(known);
    asm.op(Op::Recall, HEAD);
    asm.op(Op::And, 0xffff);
    swap_half(asm);
    advance(asm);
}

/// Looks at one submessage of any kind.
fn full_step(asm: &mut Assembler, masks: Masks) {
    pass_at_end(asm);
    let [data_frag, heartbeat, gap, acknack, nack_frag, heartbeat_frag] =
        [(); 6].map(|()| asm.label());
    let [range, good, bad, next] = [(); 4].map(|()| asm.label());
    asm.op(Op::StoreIndex, POSITION);
    asm.op(Op::LoadWord, 0);
    asm.op(Op::Store, HEAD);
    asm.op(Op::ShiftRight, 24);
    asm.when(Test::Equal, DATA_FRAG, data_frag);
    asm.when(Test::Equal, HEARTBEAT, heartbeat);
    asm.when(Test::Equal, GAP, gap);
    asm.when(Test::Equal, ACKNACK, acknack);
    asm.when(Test::Equal, NACK_FRAG, nack_frag);
    asm.when(Test::Equal, HEARTBEAT_FRAG, heartbeat_frag);
    asm.jump(good);

    asm.place(data_frag);
    zero(asm, 16, bad);
    not_zero(asm, 24, bad);
    fragment_shape(asm, bad);
    no_bits(asm, 32, masks.sample, bad);
    asm.jump(good);

    asm.place(acknack);
    zero(asm, 12, bad);
    no_bits(asm, 20, !MAX_BITS, bad);
    asm.jump(good);

    asm.place(nack_frag);
    zero(asm, 12, bad);
    not_zero(asm, 20, bad);
    no_bits(asm, 20, masks.nack_fragment, bad);
    no_bits(asm, 24, !MAX_BITS, bad);
    asm.jump(good);

    asm.place(heartbeat_frag);
    zero(asm, 12, bad);
    no_bits(asm, 20, masks.fragment, bad);
    asm.jump(good);

    asm.place(heartbeat);
    asm.op(Op::LoadConstant, HEARTBEAT_RANGE);
    asm.jump(range);
    asm.place(gap);
    gap_range(asm);
    asm.place(range);
    check_range(asm, bad);

    asm.place(good);
    skip_body(asm);
    asm.jump(next);
    asm.place(bad);
    asm.op(Op::Return, DROP);
    asm.place(next);
}

/// The word at an offset must be 0, whatever the endianness.
fn zero(asm: &mut Assembler, offset: u32, bad: Label) {
    asm.op(Op::LoadWord, offset);
    asm.unless(Test::Equal, 0, bad);
}

fn not_zero(asm: &mut Assembler, offset: u32, bad: Label) {
    asm.op(Op::LoadWord, offset);
    asm.when(Test::Equal, 0, bad);
}

/// None of some bits may be set in the word at an offset.
fn no_bits(asm: &mut Assembler, offset: u32, bits: u32, bad: Label) {
    let [little, done] = [(); 2].map(|()| asm.label());
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadWord, offset);
    asm.when(Test::AnyBit, bits, bad);
    asm.jump(done);
    asm.place(little);
    asm.op(Op::LoadWord, offset);
    asm.when(Test::AnyBit, bits.swap_bytes(), bad);
    asm.place(done);
}

/// The number of fragments in a DATA_FRAG is not 0, and their size is RustDDS' own.
fn fragment_shape(asm: &mut Assembler, bad: Label) {
    let [little, done] = [(); 2].map(|()| asm.label());
    asm.op(Op::LoadHalf, 28);
    asm.when(Test::Equal, 0, bad);
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadHalf, 30);
    asm.unless(Test::Equal, FRAGMENT, bad);
    asm.jump(done);
    asm.place(little);
    asm.op(Op::LoadHalf, 30);
    asm.unless(Test::Equal, FRAGMENT.swap_bytes() >> 16, bad);
    asm.place(done);
}

/// A = the widest range that a GAP may have.
fn gap_range(asm: &mut Assembler) {
    let [little, any, done] = [(); 3].map(|()| asm.label());
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadWord, 16);
    asm.when(Test::Equal, 1, any);
    asm.op(Op::LoadConstant, GAP_RANGE);
    asm.jump(done);
    asm.place(little);
    asm.op(Op::LoadWord, 16);
    asm.when(Test::Equal, 1_u32.swap_bytes(), any);
    asm.op(Op::LoadConstant, GAP_RANGE);
    asm.jump(done);
    asm.place(any);
    asm.op(Op::LoadConstant, ANY_RANGE);
    asm.place(done);
}

/// Two sequence numbers, at 12 and 20, must be below 2³¹, and their upper halves differ by at most
/// A. RustDDS does nothing when the second one is less. A sequence number is two words, the upper
/// one first.
fn check_range(asm: &mut Assembler, bad: Label) {
    let [little, compare, ordered, done] = [(); 4].map(|()| asm.label());
    asm.op(Op::Store, RANGE);
    zero(asm, 12, bad);
    zero(asm, 20, bad);
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadHalf, 16);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadHalf, 24);
    asm.jump(compare);
    asm.place(little);
    asm.op(Op::LoadHalf, 16 + 2);
    swap_half(asm);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadHalf, 24 + 2);
    swap_half(asm);
    asm.place(compare);
    asm.when(Test::AnyBit, HIGH_BIT_OF_HALF, bad);
    asm.op(Op::RecallIndex, FIRST);
    asm.when(Test::AboveIndex, 0, ordered);
    asm.op(Op::FromIndex, 0);
    asm.when(Test::AnyBit, HIGH_BIT_OF_HALF, bad);
    asm.jump(done);
    asm.place(ordered);
    asm.op(Op::SubtractIndex, 0);
    asm.op(Op::RecallIndex, RANGE);
    asm.when(Test::AboveIndex, 0, bad);
    asm.place(done);
    asm.op(Op::RecallIndex, POSITION);
}

/// Moves X to the next submessage. Without length PAD and INFO_TS are empty, and all others extend
/// to the end.
fn skip_body(asm: &mut Assembler) {
    let [little, big, filled, empty] = [(); 4].map(|()| asm.label());
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::And, 0xffff);
    asm.jump(big);
    asm.place(little);
    asm.op(Op::And, 0xffff);
    swap_half(asm);
    asm.place(big);
    asm.unless(Test::Equal, 0, filled);
    asm.op(Op::Recall, HEAD);
    asm.op(Op::ShiftRight, 24);
    asm.when(Test::Equal, PAD, empty);
    asm.when(Test::Equal, INFO_TS, empty);
    asm.op(Op::Return, PASS);
    asm.place(empty);
    asm.op(Op::LoadConstant, 0);
    asm.place(filled);
    advance(asm);
}
