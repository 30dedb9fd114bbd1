//! Classic BPF with labels instead of jump offsets.
//!
//! The machine has an accumulator A, an index register X, 16 words of memory, and jumps forward
//! only.

/// One instruction, as the kernel takes it (`struct sock_filter`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Instruction {
    pub(super) code: u16,
    pub(super) if_true: u8,
    pub(super) if_false: u8,
    pub(super) k: u32,
}

/// The instructions that the filter needs, with their codes (`linux/bpf_common.h`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub(super) enum Op {
    /// A = k
    LoadConstant = 0x00,
    /// A = the big-endian word at k
    LoadWordAt = 0x20,
    /// A = the big-endian word at X + k
    LoadWord = 0x40,
    /// A = the big-endian half word at X + k
    LoadHalf = 0x48,
    /// A = length of the packet
    LoadLength = 0x80,
    /// A = memory\[k\]
    Recall = 0x60,
    /// X = k
    IndexConstant = 0x01,
    /// X = memory\[k\]
    RecallIndex = 0x61,
    /// memory\[k\] = A
    Store = 0x02,
    /// memory\[k\] = X
    StoreIndex = 0x03,
    /// A += k
    Add = 0x04,
    /// A += X
    AddIndex = 0x0c,
    /// A -= X
    SubtractIndex = 0x1c,
    /// A *= k
    Multiply = 0x24,
    /// A &= k
    And = 0x54,
    /// A >>= k
    ShiftRight = 0x74,
    /// X = A
    ToIndex = 0x07,
    /// Ends; k bytes of the packet are kept, 0 drops it.
    Return = 0x06,
}

/// Conditions of jumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub(super) enum Test {
    /// A == k
    Equal = 0x15,
    /// A & k != 0
    AnyBit = 0x45,
    /// A == X
    EqualsIndex = 0x1d,
    /// A > X (unsigned)
    AboveIndex = 0x2d,
}

/// `goto k`, the only jump that reaches further than 255 instructions.
pub(super) const JUMP: u16 = 0x05;

/// A place in the program that jumps can name before it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Label(usize);

/// What the kernel takes.
const MAX_INSTRUCTIONS: usize = 4096;

#[derive(Clone, Copy)]
enum Jump {
    Always,
    IfTrue,
    IfFalse,
}

/// Collects a program.
#[derive(Default)]
pub(super) struct Assembler {
    code: Vec<Instruction>,
    labels: Vec<Option<usize>>,
    jumps: Vec<(usize, Jump, Label)>,
}

impl Assembler {
    /// A label that is not placed yet.
    pub(super) fn label(&mut self) -> Label {
        self.labels.push(None);
        Label(self.labels.len() - 1)
    }

    /// Places a label before the next instruction.
    pub(super) fn place(&mut self, label: Label) {
        if let Some(place) = self.labels.get_mut(label.0) {
            *place = Some(self.code.len());
        }
    }

    /// Adds an instruction; `k` is ignored by those that have none.
    pub(super) fn op(&mut self, op: Op, k: u32) {
        self.push(op as u16, k);
    }

    /// Goes on at `label`.
    pub(super) fn jump(&mut self, label: Label) {
        self.jumps.push((self.code.len(), Jump::Always, label));
        self.push(JUMP, 0);
    }

    /// Goes on at `label` when the condition holds, else with the next instruction.
    pub(super) fn when(&mut self, test: Test, k: u32, label: Label) {
        self.jumps.push((self.code.len(), Jump::IfTrue, label));
        self.push(test as u16, k);
    }

    /// Goes on with the next instruction when the condition holds, else at `label`.
    pub(super) fn unless(&mut self, test: Test, k: u32, label: Label) {
        self.jumps.push((self.code.len(), Jump::IfFalse, label));
        self.push(test as u16, k);
    }

    fn push(&mut self, code: u16, k: u32) {
        self.code.push(Instruction { code, if_true: 0, if_false: 0, k });
    }

    /// The program with all jumps resolved; `None` if a label is nowhere, a jump is too far, or the
    /// program too long.
    pub(super) fn finish(mut self) -> Option<Vec<Instruction>> {
        for (at, jump, label) in self.jumps {
            let target = self.labels.get(label.0).copied().flatten()?;
            let distance = target.checked_sub(at + 1)?;
            let instruction = self.code.get_mut(at)?;
            match jump {
                Jump::Always => instruction.k = u32::try_from(distance).ok()?,
                Jump::IfTrue => instruction.if_true = u8::try_from(distance).ok()?,
                Jump::IfFalse => instruction.if_false = u8::try_from(distance).ok()?,
            }
        }
        (self.code.len() <= MAX_INSTRUCTIONS).then_some(self.code)
    }
}
