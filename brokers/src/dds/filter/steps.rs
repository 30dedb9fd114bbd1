//! The steps of the program. Each begins with X at a submessage and leaves it at the next one.

use super::assembler::{Assembler, Label, Op, Test};

/// Returned for what passes: more than any datagram has.
const PASS: u32 = 0x4_0000;
pub(super) const DROP: u32 = 0;

const PAD: u32 = 0x01;
const ACKNACK: u32 = 0x06;
const HEARTBEAT: u32 = 0x07;
const GAP: u32 = 0x08;
const INFO_TS: u32 = 0x09;
const INFO_DST: u32 = 0x0e;
const NACK_FRAG: u32 = 0x12;
const HEARTBEAT_FRAG: u32 = 0x13;
const DATA: u32 = 0x15;
const DATA_FRAG: u32 = 0x16;
/// A kind of its own, which Fast DDS puts at the end of its datagrams.
const FAST_DDS: u32 = 0x80;

/// Bit of the first word of a submessage (kind, flags, length): little endian.
const LITTLE: u32 = 0x0001_0000;

/// Bits of a bitmap. RustDDS takes 256 and no more; this only is the next power of two.
const MAX_BITS: u32 = 0x1ff;
/// Bits that the upper word of a sequence number must not have: numbers below 2⁴⁷ pass, which a
/// writer reaches in 4,000 years of 1,000 samples a second.
const UPPER_WORD: u32 = 0xffff_8000;
/// Width of a HEARTBEAT's range in units of 65,536: up to 2²⁰ numbers, which RustDDS lists with 8
/// bytes each.
pub(super) const HEARTBEAT_RANGE: u32 = 15;

// Words of memory.
/// First word of the submessage: kind, flags, length.
const HEAD: u32 = 0;
/// Where the submessage begins.
const POSITION: u32 = 1;
const FIRST: u32 = 2;
const RANGE: u32 = 3;

/// What submessages may have; of most the bits that must not be set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    /// Of the bytes of a sample.
    pub(super) sample: u32,
    /// Of the first fragment that a NACK_FRAG asks for.
    pub(super) nack_fragment: u32,
    /// Of the last fragment of a HEARTBEAT_FRAG.
    pub(super) fragment: u32,
    /// Bytes of a fragment; `None`: 256 or more.
    pub(super) exact_fragment: Option<u32>,
    /// Width of a GAP's range in units of 65,536; RustDDS makes a map of its numbers. One from 1 on
    /// may have any: of it RustDDS only notes where it ends.
    pub(super) gap_range: u32,
}

/// Passes the packet when X has reached its end.
pub(super) fn pass_at_end(asm: &mut Assembler) {
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

/// Moves X behind a little-endian submessage.
fn skip_little(asm: &mut Assembler) {
    asm.op(Op::LoadHalf, 2);
    swap_half(asm);
    advance(asm);
}

/// Skips a little-endian DATA or INFO_TS. A DATA without length extends to the end of the packet;
/// here what follows its header is then looked at as if it were submessages, which RustDDS does
/// not.
pub(super) fn quick_step(asm: &mut Assembler, other: Label) {
    pass_at_end(asm);
    let known = asm.label();
    asm.op(Op::LoadWord, 0);
    asm.op(Op::And, 0xff00_0000 | LITTLE);
    asm.when(Test::Equal, DATA << 24 | LITTLE, known);
    asm.when(Test::Equal, INFO_TS << 24 | LITTLE, known);
    asm.jump(other);
    asm.place(known);
    skip_little(asm);
}

/// Looks at one little-endian submessage of the kinds that others than RustDDS pack into one
/// datagram. A GAP may be as wide as a HEARTBEAT.
pub(super) fn packed_step(asm: &mut Assembler, limits: Limits, other: Label) {
    pass_at_end(asm);
    let [gap, range, acknack, nack_frag, numbered, known, bad, next] =
        [(); 8].map(|()| asm.label());
    asm.op(Op::LoadWord, 0);
    asm.op(Op::And, 0xff00_0000 | LITTLE);
    asm.when(Test::Equal, DATA << 24 | LITTLE, known);
    asm.when(Test::Equal, INFO_TS << 24 | LITTLE, known);
    asm.when(Test::Equal, INFO_DST << 24 | LITTLE, known);
    asm.when(Test::Equal, HEARTBEAT << 24 | LITTLE, range);
    asm.when(Test::Equal, ACKNACK << 24 | LITTLE, acknack);
    asm.when(Test::Equal, GAP << 24 | LITTLE, gap);
    asm.when(Test::Equal, NACK_FRAG << 24 | LITTLE, nack_frag);
    asm.when(Test::Equal, FAST_DDS << 24 | LITTLE, known);
    asm.jump(other);

    asm.place(nack_frag);
    not_zero(asm, 20, bad);
    asm.when(Test::AnyBit, limits.nack_fragment.swap_bytes(), bad);
    asm.op(Op::LoadWord, 24);
    asm.when(Test::AnyBit, (!MAX_BITS).swap_bytes(), bad);
    asm.jump(numbered);

    asm.place(acknack);
    asm.op(Op::LoadWord, 20);
    asm.when(Test::AnyBit, (!MAX_BITS).swap_bytes(), bad);
    asm.jump(numbered);

    asm.place(gap);
    asm.op(Op::LoadWord, 16);
    asm.unless(Test::Equal, 1_u32.swap_bytes(), range);
    asm.op(Op::LoadWord, 20);
    asm.when(Test::AnyBit, UPPER_WORD.swap_bytes(), bad);
    asm.jump(numbered);

    asm.place(range);
    asm.op(Op::StoreIndex, POSITION);
    same_upper_word(asm, bad);
    little_halves(asm);
    asm.op(Op::Add, 1);
    asm.op(Op::RecallIndex, FIRST);
    asm.op(Op::SubtractIndex, 0);
    asm.op(Op::RecallIndex, POSITION);
    asm.when(Test::Above, HEARTBEAT_RANGE + 1, bad);

    asm.place(numbered);
    asm.op(Op::LoadWord, 12);
    asm.when(Test::AnyBit, UPPER_WORD.swap_bytes(), bad);
    asm.place(known);
    skip_little(asm);
    asm.jump(next);
    asm.place(bad);
    asm.op(Op::Return, DROP);
    asm.place(next);
}

/// Looks at one submessage of any kind.
pub(super) fn full_step(asm: &mut Assembler, limits: Limits) {
    pass_at_end(asm);
    let [data_frag, heartbeat, gap, acknack, nack_frag, heartbeat_frag] =
        [(); 6].map(|()| asm.label());
    let [range, from_one, numbered, good, bad, next] = [(); 6].map(|()| asm.label());
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
    no_bits(asm, 16, UPPER_WORD, bad);
    not_zero(asm, 24, bad);
    fragment_shape(asm, limits.exact_fragment, bad);
    no_bits(asm, 32, limits.sample, bad);
    asm.jump(good);

    asm.place(acknack);
    no_bits(asm, 20, !MAX_BITS, bad);
    asm.jump(numbered);

    asm.place(nack_frag);
    not_zero(asm, 20, bad);
    no_bits(asm, 20, limits.nack_fragment, bad);
    no_bits(asm, 24, !MAX_BITS, bad);
    asm.jump(numbered);

    asm.place(heartbeat_frag);
    no_bits(asm, 20, limits.fragment, bad);
    asm.jump(numbered);

    asm.place(gap);
    is_from_one(asm, from_one);
    asm.op(Op::LoadConstant, limits.gap_range + 1);
    asm.jump(range);
    asm.place(from_one);
    no_bits(asm, 20, UPPER_WORD, bad);
    asm.jump(numbered);
    asm.place(heartbeat);
    asm.op(Op::LoadConstant, HEARTBEAT_RANGE + 1);
    asm.place(range);
    check_range(asm, bad);

    asm.place(numbered);
    no_bits(asm, 12, UPPER_WORD, bad);
    asm.place(good);
    skip_body(asm);
    asm.jump(next);
    asm.place(bad);
    asm.op(Op::Return, DROP);
    asm.place(next);
}

/// The word at an offset must not be 0, whatever the endianness.
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

/// The number of fragments in a DATA_FRAG is not 0, and their size is the exact one, or at least 256.
fn fragment_shape(asm: &mut Assembler, exact: Option<u32>, bad: Label) {
    let [little, done] = [(); 2].map(|()| asm.label());
    asm.op(Op::LoadHalf, 28);
    asm.when(Test::Equal, 0, bad);
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadHalf, 30);
    match exact {
        Some(bytes) => asm.unless(Test::Equal, bytes, bad),
        None => asm.unless(Test::AnyBit, 0xff00, bad),
    }
    asm.jump(done);
    asm.place(little);
    asm.op(Op::LoadHalf, 30);
    match exact {
        Some(bytes) => asm.unless(Test::Equal, bytes.swap_bytes() >> 16, bad),
        None => asm.unless(Test::AnyBit, 0x00ff, bad),
    }
    asm.place(done);
}

/// Goes on at `from_one` when the lower word of the sequence number at 12 is 1.
fn is_from_one(asm: &mut Assembler, from_one: Label) {
    let [little, done] = [(); 2].map(|()| asm.label());
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadWord, 16);
    asm.when(Test::Equal, 1, from_one);
    asm.jump(done);
    asm.place(little);
    asm.op(Op::LoadWord, 16);
    asm.when(Test::Equal, 1_u32.swap_bytes(), from_one);
    asm.place(done);
}

/// Two sequence numbers, at 12 and 20, must have the same upper word, and the upper half of the
/// second one's lower word is one less than that of the first, the same, or larger by less than A.
/// A sequence number is two words, the upper one first.
fn check_range(asm: &mut Assembler, bad: Label) {
    let [little, compare] = [(); 2].map(|()| asm.label());
    asm.op(Op::Store, RANGE);
    same_upper_word(asm, bad);
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    asm.op(Op::LoadHalf, 16);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadHalf, 24);
    asm.jump(compare);
    asm.place(little);
    little_halves(asm);
    asm.place(compare);
    // A HEARTBEAT of a writer that has nothing ends one before its begin.
    asm.op(Op::Add, 1);
    asm.op(Op::RecallIndex, FIRST);
    asm.op(Op::SubtractIndex, 0);
    asm.op(Op::RecallIndex, RANGE);
    asm.when(Test::AboveIndex, 0, bad);
    asm.op(Op::RecallIndex, POSITION);
}

/// The upper words of two sequence numbers, at 12 and 20, are equal.
fn same_upper_word(asm: &mut Assembler, bad: Label) {
    asm.op(Op::LoadWord, 12);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadWord, 20);
    asm.op(Op::RecallIndex, FIRST);
    asm.unless(Test::EqualsIndex, 0, bad);
    asm.op(Op::RecallIndex, POSITION);
}

/// The upper halves of the lower words of two little-endian sequence numbers, at 12 and 20: the
/// first in memory, the second in A.
fn little_halves(asm: &mut Assembler) {
    asm.op(Op::LoadHalf, 16 + 2);
    swap_half(asm);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadHalf, 24 + 2);
    swap_half(asm);
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
