//! The steps of the program. Each begins with X at a submessage and leaves it at the next one.

use super::assembler::{Assembler, Label, Op, Test};

/// Returned for what passes: more than any datagram has.
pub(super) const PASS: u32 = 0x4_0000;
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
/// writer reaches in 4,000 years at 1 kHz.
const UPPER_WORD: u32 = 0xffff_8000;
/// Width of a HEARTBEAT's range in units of 65,536: up to 2²⁰ numbers, which RustDDS lists with 8
/// bytes each.
const HEARTBEAT_RANGE: u32 = 15;
/// Width of a GAP's range: up to 2¹⁷ numbers, of which RustDDS makes a map. It itself sends the
/// 8,192 of a writer, others some ten. One from 1 on may have any: of it RustDDS only notes where
/// it ends.
const GAP_RANGE: u32 = 1;

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
}

/// Passes the packet when X has reached its end.
pub(super) fn pass_at_end(asm: &mut Assembler) {
    let more = asm.label();
    asm.op(Op::LoadLength, 0);
    asm.unless(Test::EqualsIndex, 0, more);
    asm.op(Op::Return, PASS);
    asm.place(more);
}

/// Submessages of an announcement: its DATA, behind time and destination at most.
const ANNOUNCEMENT: usize = 3;
/// Writer of announcements, and where a DATA names its writer.
const SPDP_WRITER: u32 = 0x0001_00c2;
const WRITER: u32 = 12;

/// Goes on at `announcement` or `other`. The submessages begin at `begin`. What RustDDS gets
/// repeated begins with another submessage than those of announcements, and so is none.
pub(super) fn on_announcement(asm: &mut Assembler, begin: u32, announcement: Label, other: Label) {
    let data = asm.label();
    asm.op(Op::IndexConstant, begin);
    for _ in 0..ANNOUNCEMENT {
        let skip = asm.label();
        asm.op(Op::LoadLength, 0);
        asm.when(Test::EqualsIndex, 0, other);
        asm.op(Op::LoadWord, 0);
        asm.op(Op::And, 0xff00_0000 | LITTLE);
        asm.when(Test::Equal, DATA << 24 | LITTLE, data);
        asm.when(Test::Equal, INFO_TS << 24 | LITTLE, skip);
        asm.unless(Test::Equal, INFO_DST << 24 | LITTLE, other);
        asm.place(skip);
        skip_little(asm);
    }
    asm.jump(other);
    asm.place(data);
    asm.op(Op::LoadWord, WRITER);
    asm.when(Test::Equal, SPDP_WRITER, announcement);
    asm.jump(other);
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

/// Looks at one little-endian submessage of any kind that implementations are known to send.
pub(super) fn packed_step(asm: &mut Assembler, limits: Limits, other: Label) {
    pass_at_end(asm);
    let labels = Labels::new(asm);
    asm.op(Op::StoreIndex, POSITION);
    asm.op(Op::LoadWord, 0);
    asm.op(Op::And, 0xff00_0000 | LITTLE);
    for kind in [DATA, INFO_TS, INFO_DST, FAST_DDS] {
        asm.when(Test::Equal, kind << 24 | LITTLE, labels.good);
    }
    for (kind, label) in labels.kinds() {
        asm.when(Test::Equal, kind << 24 | LITTLE, label);
    }
    asm.jump(other);
    check_kinds(asm, limits, ByteOrder::Little, &labels);
    skip_little(asm);
    labels.end(asm);
}

/// Looks at one submessage of any kind.
pub(super) fn full_step(asm: &mut Assembler, limits: Limits) {
    pass_at_end(asm);
    let labels = Labels::new(asm);
    asm.op(Op::StoreIndex, POSITION);
    asm.op(Op::LoadWord, 0);
    asm.op(Op::Store, HEAD);
    asm.op(Op::ShiftRight, 24);
    for (kind, label) in labels.kinds() {
        asm.when(Test::Equal, kind, label);
    }
    asm.jump(labels.good);
    check_kinds(asm, limits, ByteOrder::Any, &labels);
    skip_body(asm);
    labels.end(asm);
}

/// Of which byte order a submessage may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ByteOrder {
    Little,
    /// As its first word in memory says.
    Any,
}

/// Where a step goes on for the kinds that it looks at, and at its end.
struct Labels {
    data_frag: Label,
    heartbeat: Label,
    gap: Label,
    acknack: Label,
    nack_frag: Label,
    heartbeat_frag: Label,
    good: Label,
    bad: Label,
    next: Label,
}

impl Labels {
    fn new(asm: &mut Assembler) -> Self {
        let [data_frag, heartbeat, gap, acknack, nack_frag, heartbeat_frag, good, bad, next] =
            [(); 9].map(|()| asm.label());
        Self { data_frag, heartbeat, gap, acknack, nack_frag, heartbeat_frag, good, bad, next }
    }

    fn kinds(&self) -> [(u32, Label); 6] {
        [
            (HEARTBEAT, self.heartbeat),
            (ACKNACK, self.acknack),
            (DATA_FRAG, self.data_frag),
            (GAP, self.gap),
            (NACK_FRAG, self.nack_frag),
            (HEARTBEAT_FRAG, self.heartbeat_frag),
        ]
    }

    fn end(&self, asm: &mut Assembler) {
        asm.jump(self.next);
        asm.place(self.bad);
        asm.op(Op::Return, DROP);
        asm.place(self.next);
    }
}

/// Checks a submessage of each kind; ends where what is good goes on.
fn check_kinds(asm: &mut Assembler, limits: Limits, order: ByteOrder, labels: &Labels) {
    let [range, gap_range, from_one, numbered] = [(); 4].map(|()| asm.label());
    let bad = labels.bad;
    asm.place(labels.data_frag);
    no_bits(asm, order, 16, UPPER_WORD, bad);
    not_zero(asm, 24, bad);
    fragment_shape(asm, order, limits.exact_fragment, bad);
    no_bits(asm, order, 32, limits.sample, bad);
    asm.jump(labels.good);

    asm.place(labels.acknack);
    no_bits(asm, order, 20, !MAX_BITS, bad);
    asm.jump(numbered);

    asm.place(labels.nack_frag);
    not_zero(asm, 20, bad);
    no_bits(asm, order, 20, limits.nack_fragment, bad);
    no_bits(asm, order, 24, !MAX_BITS, bad);
    asm.jump(numbered);

    asm.place(labels.heartbeat_frag);
    no_bits(asm, order, 20, limits.fragment, bad);
    asm.jump(numbered);

    asm.place(labels.gap);
    // A number is two words, the upper one first; 1 is 0 and 1.
    asm.op(Op::LoadWord, 12);
    asm.unless(Test::Equal, 0, gap_range);
    is_one(asm, order, 16, from_one);
    asm.place(gap_range);
    asm.op(Op::LoadConstant, GAP_RANGE + 1);
    asm.jump(range);
    asm.place(from_one);
    no_bits(asm, order, 20, UPPER_WORD, bad);
    asm.jump(numbered);
    asm.place(labels.heartbeat);
    asm.op(Op::LoadConstant, HEARTBEAT_RANGE + 1);
    asm.place(range);
    check_range(asm, order, bad);

    asm.place(numbered);
    no_bits(asm, order, 12, UPPER_WORD, bad);
    asm.place(labels.good);
}

/// The word at an offset must not be 0, whatever the byte order.
fn not_zero(asm: &mut Assembler, offset: u32, bad: Label) {
    asm.op(Op::LoadWord, offset);
    asm.when(Test::Equal, 0, bad);
}

/// Emits what is to be done in big and in little endian.
fn by_order(asm: &mut Assembler, order: ByteOrder, emit: impl Fn(&mut Assembler, ByteOrder)) {
    if order == ByteOrder::Little {
        emit(asm, order);
        return;
    }
    let [little, done] = [(); 2].map(|()| asm.label());
    asm.op(Op::Recall, HEAD);
    asm.when(Test::AnyBit, LITTLE, little);
    emit(asm, ByteOrder::Any);
    asm.jump(done);
    asm.place(little);
    emit(asm, ByteOrder::Little);
    asm.place(done);
}

/// The word of a submessage as the big-endian machine loads it.
fn word(order: ByteOrder, value: u32) -> u32 {
    if order == ByteOrder::Little { value.swap_bytes() } else { value }
}

/// None of some bits may be set in the word at an offset.
fn no_bits(asm: &mut Assembler, order: ByteOrder, offset: u32, bits: u32, bad: Label) {
    by_order(asm, order, |asm, order| {
        asm.op(Op::LoadWord, offset);
        asm.when(Test::AnyBit, word(order, bits), bad);
    });
}

/// Goes on at `one` when the word at an offset is 1.
fn is_one(asm: &mut Assembler, order: ByteOrder, offset: u32, one: Label) {
    by_order(asm, order, |asm, order| {
        asm.op(Op::LoadWord, offset);
        asm.when(Test::Equal, word(order, 1), one);
    });
}

/// The number of fragments in a DATA_FRAG is not 0, and their size is the exact one, or at least
/// 256 bytes.
fn fragment_shape(asm: &mut Assembler, order: ByteOrder, exact: Option<u32>, bad: Label) {
    asm.op(Op::LoadHalf, 28);
    asm.when(Test::Equal, 0, bad);
    by_order(asm, order, |asm, order| {
        let half = |value: u32| word(order, value << 16) & 0xffff | word(order, value) & 0xffff;
        asm.op(Op::LoadHalf, 30);
        match exact {
            Some(bytes) => asm.unless(Test::Equal, half(bytes), bad),
            None => asm.unless(Test::AnyBit, half(0xff00), bad),
        }
    });
}

/// Two sequence numbers, at 12 and 20, must have the same upper word, and the upper half of the
/// second one's lower word is one less than that of the first, the same, or larger by less than A.
fn check_range(asm: &mut Assembler, order: ByteOrder, bad: Label) {
    asm.op(Op::Store, RANGE);
    // The upper words are equal, whatever the byte order.
    asm.op(Op::LoadWord, 12);
    asm.op(Op::Store, FIRST);
    asm.op(Op::LoadWord, 20);
    asm.op(Op::RecallIndex, FIRST);
    asm.unless(Test::EqualsIndex, 0, bad);
    asm.op(Op::RecallIndex, POSITION);
    by_order(asm, order, |asm, order| {
        let is_little = order == ByteOrder::Little;
        let upper_half = if is_little { 2 } else { 0 };
        asm.op(Op::LoadHalf, 16 + upper_half);
        if is_little {
            swap_half(asm);
        }
        asm.op(Op::Store, FIRST);
        asm.op(Op::LoadHalf, 24 + upper_half);
        if is_little {
            swap_half(asm);
        }
    });
    // A HEARTBEAT of a writer that has nothing ends one before its begin.
    asm.op(Op::Add, 1);
    asm.op(Op::RecallIndex, FIRST);
    asm.op(Op::SubtractIndex, 0);
    asm.op(Op::RecallIndex, RANGE);
    asm.when(Test::AboveIndex, 0, bad);
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
