//! The writer of one bridge, and what became of the messages that it took.
//!
//! A broker's adapter takes a message and may drop it later: its time is over, the server refuses
//! it, newer ones need the room. So what was handed over is `out` only when it is neither queued
//! nor dropped any more.

use std::sync::Arc;
use std::time::Instant;

use blaze_brokers::{Later, PublishOutcome, Publisher, PublisherOptions};
use blaze_proto::Frame;

use super::stats::{BridgeStats, Count};

/// A publisher that serves one bridge alone, and its options.
#[derive(Clone)]
pub struct NewWriter {
    /// The publisher.
    pub publisher: Arc<dyn Publisher>,
    /// What it was made for.
    pub options: PublisherOptions,
}

/// A publisher and the account of what it took.
pub struct Writer {
    made: NewWriter,
    /// Messages that it took.
    taken: u64,
    /// Of these, what has left for good.
    out: u64,
    /// Of these, what was dropped.
    lost: Later,
    /// What is neither out nor lost.
    pending: Count,
}

impl Writer {
    pub(super) fn new(made: NewWriter) -> Self {
        Self { made, taken: 0, out: 0, lost: Later::default(), pending: Count::default() }
    }

    /// The publisher and its options.
    #[must_use]
    pub fn made(&self) -> &NewWriter {
        &self.made
    }

    /// Whether both are the same publisher.
    pub(super) fn is(&self, other: &NewWriter) -> bool {
        Arc::ptr_eq(&self.made.publisher, &other.publisher)
    }

    /// Messages that it took.
    pub(super) fn taken(&self) -> u64 {
        self.taken
    }

    /// Messages that wait for the server.
    #[must_use]
    pub fn queued(&self) -> u64 {
        self.made.publisher.later().queued
    }

    pub(super) fn publish(
        &mut self,
        frame: &Frame,
        bare: bool,
        deadline: Option<Instant>,
    ) -> PublishOutcome {
        let payload = frame.payload();
        let outcome = if bare {
            self.made.publisher.publish_copy(frame, deadline)
        } else {
            self.made.publisher.publish(frame, deadline)
        };
        if outcome == PublishOutcome::Taken {
            self.taken += 1;
            self.pending.add(payload.len() as u64);
        }
        outcome
    }

    /// Brings the counters up to date. Returns how many still wait.
    pub(super) fn settle(&mut self, stats: &mut BridgeStats) -> u64 {
        let later = self.made.publisher.later();
        for ((reason, now), (_, before)) in later.by_reason().into_iter().zip(self.lost.by_reason())
        {
            let lost = now.saturating_sub(before);
            stats.dropped.add(reason, lost);
            self.take_pending(lost);
        }
        self.lost = later;
        // The adapter's counters are read one after the other: for a moment a message may seem to
        // be both queued and dropped. It is out when it is out, never before, and never comes back.
        let out = self.taken.saturating_sub(later.dropped() + later.queued);
        let more = out.saturating_sub(self.out);
        self.out += more;
        let bytes = self.take_pending(more);
        stats.out.add_many(more, bytes);
        later.queued
    }

    /// Ends the account of a writer that is given up: what still waits counts as written.
    pub(super) fn close(&mut self, stats: &mut BridgeStats) {
        self.settle(stats);
        let rest = std::mem::take(&mut self.pending);
        self.out += rest.messages;
        stats.out.add_many(rest.messages, rest.bytes);
    }

    /// Takes messages out of what is pending, with their share of its bytes.
    fn take_pending(&mut self, messages: u64) -> u64 {
        let all = self.pending;
        let bytes = if messages >= all.messages {
            all.bytes
        } else {
            let share = u128::from(all.bytes) * u128::from(messages) / u128::from(all.messages);
            u64::try_from(share).unwrap_or(all.bytes)
        };
        self.pending =
            Count { messages: all.messages.saturating_sub(messages), bytes: all.bytes - bytes };
        bytes
    }
}
