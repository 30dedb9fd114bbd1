//! Counters of one bridge. For each of them `in = out + Σ dropped + queued` holds at any time; what
//! brokers' adapters did since is in them after
//! [`BridgeState::settle`](super::path::BridgeState::settle).

use blaze_domain::DropReason;

use super::measure::LatencyHistogram;

/// Messages and bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Count {
    /// Messages.
    pub messages: u64,
    /// Payload bytes.
    pub bytes: u64,
}

impl Count {
    /// Adds one message.
    pub fn add(&mut self, bytes: u64) {
        self.add_many(1, bytes);
    }

    /// Adds several messages.
    pub fn add_many(&mut self, messages: u64, bytes: u64) {
        self.messages += messages;
        self.bytes += bytes;
    }

    /// Takes one message back.
    pub(super) fn remove(&mut self, bytes: u64) {
        self.messages = self.messages.saturating_sub(1);
        self.bytes = self.bytes.saturating_sub(bytes);
    }
}

/// Dropped messages by reason.
#[derive(Debug, Clone, Default)]
pub struct Drops([u64; DropReason::ALL.len()]);

impl Drops {
    /// Counts dropped messages.
    pub fn add(&mut self, reason: DropReason, messages: u64) {
        self.0[reason as usize] += messages;
    }

    /// How many were dropped for a reason.
    #[must_use]
    pub fn get(&self, reason: DropReason) -> u64 {
        self.0[reason as usize]
    }

    /// All reasons that occurred, with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (DropReason, u64)> + '_ {
        DropReason::ALL
            .iter()
            .map(|reason| (*reason, self.get(*reason)))
            .filter(|(_, count)| *count > 0)
    }

    /// What came since an earlier moment, by reason.
    #[must_use]
    pub fn since(&self, before: &Self) -> Vec<(DropReason, u64)> {
        let new = self.iter().map(|(reason, count)| (reason, count - before.get(reason)));
        new.filter(|(_, count)| *count > 0).collect()
    }

    /// All of them.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }
}

/// Counters of a bridge at one moment, so that what happened lately can be told.
#[derive(Debug, Clone, Default)]
pub struct Mark {
    taken: u64,
    out: u64,
    dropped: Drops,
}

/// What happened lately.
#[derive(Debug, Clone, Default)]
pub struct Lately {
    /// Messages taken in.
    pub taken: u64,
    /// Messages written.
    pub out: u64,
    /// Messages dropped, by reason.
    pub dropped: Vec<(DropReason, u64)>,
}

/// What went through one bridge since it was first made.
#[derive(Debug, Clone, Default)]
pub struct BridgeStats {
    /// Taken in.
    pub taken: Count,
    /// Written to the destination: the broker's server has it; on the link of reliable or chunked
    /// messages: acknowledged.
    pub out: Count,
    /// Dropped, by reason.
    pub dropped: Drops,
    /// Time that the messages spent in this flow until they were written; on the link until their
    /// last byte was sent.
    pub latency: LatencyHistogram,
    marks: [Mark; 2],
}

impl BridgeStats {
    /// Puts a mark, from which [`BridgeStats::lately`] counts once the next one is put.
    pub fn mark(&mut self) {
        let mark = Mark {
            taken: self.taken.messages,
            out: self.out.messages,
            dropped: self.dropped.clone(),
        };
        self.marks = [std::mem::take(&mut self.marks[1]), mark];
    }

    /// What happened since the mark before the last.
    #[must_use]
    pub fn lately(&self) -> Lately {
        let before = &self.marks[0];
        Lately {
            taken: self.taken.messages - before.taken,
            out: self.out.messages - before.out,
            dropped: self.dropped.since(&before.dropped),
        }
    }

    /// Messages that are inside: taken in, neither written nor dropped.
    #[must_use]
    pub fn queued(&self) -> u64 {
        self.taken.messages.saturating_sub(self.out.messages).saturating_sub(self.dropped.total())
    }
}
