//! What a direction counts.

use serde::{Deserialize, Serialize};

/// Packets and their bytes, IP headers included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Tally {
    /// Packets.
    pub packets: u64,
    /// Bytes of IP packets.
    pub bytes: u64,
}

impl Tally {
    pub(super) fn add(&mut self, bytes: u64) {
        self.packets += 1;
        self.bytes += bytes;
    }

    pub(super) fn subtract(&mut self, bytes: u64) {
        self.packets -= 1;
        self.bytes -= bytes;
    }
}

impl std::ops::Add for Tally {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { packets: self.packets + other.packets, bytes: self.bytes + other.bytes }
    }
}

/// What was dropped, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Dropped {
    /// The queue before the rate was full.
    pub queue: Tally,
    /// Lost by chance.
    pub loss: Tally,
    /// Came while the direction was cut, or was on the way when it was.
    pub cut: Tally,
    /// Larger than the MTU.
    pub too_large: Tally,
    /// More was on the way than the emulator may hold ([`super::MAX_HELD_BYTES`]).
    pub memory: Tally,
}

impl Dropped {
    /// All of it.
    #[must_use]
    pub fn total(&self) -> Tally {
        self.queue + self.loss + self.cut + self.too_large + self.memory
    }
}

/// What a direction counted since its start: `in = out + dropped + waiting + flying`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DirectionStats {
    /// Came in.
    #[serde(rename = "in")]
    pub taken: Tally,
    /// Went out.
    pub out: Tally,
    /// Dropped, by reason.
    pub dropped: Dropped,
    /// In the queue before the rate now.
    pub queue: Tally,
    /// Behind it, delayed, now.
    pub flying: Tally,
    /// Packets of `out` that the interface at the other end refused.
    #[serde(default)]
    pub refused: u64,
    /// Packets that the kernel dropped before they came in, because the emulator did not get the
    /// processor in time.
    #[serde(default)]
    pub missed: u64,
}

/// Both directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LinkStats {
    /// From A to B.
    #[serde(rename = "a>b")]
    pub forward: DirectionStats,
    /// From B to A.
    #[serde(rename = "b>a")]
    pub back: DirectionStats,
}

impl LinkStats {
    /// The same, seen from the other end.
    #[must_use]
    pub fn flipped(self) -> Self {
        Self { forward: self.back, back: self.forward }
    }
}
