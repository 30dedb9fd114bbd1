//! Counters of one bridge. For each of them `in = out + Σ dropped + queued` holds at any time; what
//! brokers' adapters did since is in them after
//! [`BridgeState::settle`](super::path::BridgeState::settle).

use std::collections::BTreeMap;

use blaze_domain::{DropReason, FlowId, LayerName};

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

/// Origin layers that ages are kept apart for; those of others count together.
const MAX_ORIGINS: usize = 16;
/// The value of a label that stands for all that have none of their own.
pub const OTHER: &str = "_other";

/// Ages of messages when they were written to a broker, by the layer that they come from.
#[derive(Debug, Clone, Default)]
pub struct Ages(Vec<(String, LatencyHistogram)>);

impl Ages {
    /// Counts a message of a layer with its age in microseconds.
    pub fn record(&mut self, layer: &str, age_us: u64) {
        if let Some((_, ages)) = self.0.iter_mut().find(|(it, _)| it == layer) {
            ages.record(age_us);
            return;
        }
        // The name comes from the message: it may be anything.
        let has_room = self.0.len() < MAX_ORIGINS && layer.parse::<LayerName>().is_ok();
        if !has_room && layer != OTHER {
            return self.record(OTHER, age_us);
        }
        let mut ages = LatencyHistogram::default();
        ages.record(age_us);
        self.0.push((layer.to_owned(), ages));
    }

    /// All layers of origin with the ages of their messages.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &LatencyHistogram)> {
        self.0.iter().map(|(layer, ages)| (layer.as_str(), ages))
    }

    /// All ages together.
    #[must_use]
    pub fn all(&self) -> LatencyHistogram {
        let mut all = LatencyHistogram::default();
        self.0.iter().for_each(|(_, ages)| all.merge(ages));
        all
    }
}

/// Bridges by what they are doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Phases {
    /// Take messages in.
    pub up: u64,
    /// Empty their queue.
    pub draining: u64,
    /// Have no writer.
    pub failed: u64,
}

/// What all bridges of a flow have done since its start, up to the last mark, those that are gone
/// included.
#[derive(Debug, Clone, Default)]
pub struct Totals {
    /// Taken in.
    pub taken: Count,
    /// Written.
    pub out: Count,
    /// Dropped, by reason.
    pub dropped: Drops,
    /// Dropped on the way to other flows.
    pub dropped_to: BTreeMap<FlowId, u64>,
    /// The bridges at the mark.
    pub phases: Phases,
}

impl Totals {
    /// Adds what a bridge has done between two marks.
    fn add(&mut self, before: &Mark, after: &Mark, to: Option<&FlowId>) {
        for (sum, before, after) in
            [(&mut self.taken, before.taken, after.taken), (&mut self.out, before.out, after.out)]
        {
            // Less than before where a message was taken back, to go to another bridge.
            sum.messages = (sum.messages + after.messages).saturating_sub(before.messages);
            sum.bytes = (sum.bytes + after.bytes).saturating_sub(before.bytes);
        }
        for (reason, count) in after.dropped.since(&before.dropped) {
            self.dropped.add(reason, count);
            if let Some(to) = to {
                *self.dropped_to.entry(to.clone()).or_default() += count;
            }
        }
    }
}

/// Counters of a bridge at one moment, so that what happened lately can be told.
#[derive(Debug, Clone, Default)]
pub struct Mark {
    taken: Count,
    out: Count,
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
    /// How old messages were when they were written to a broker.
    pub ages: Ages,
    marks: [Mark; 2],
}

impl BridgeStats {
    /// Puts a mark, from which [`BridgeStats::lately`] counts once the next one is put, and adds
    /// what happened since the last one to the totals. `to`: the flow that the bridge writes to.
    pub fn mark(&mut self, totals: &mut Totals, to: Option<&FlowId>) {
        let mark = Mark { taken: self.taken, out: self.out, dropped: self.dropped.clone() };
        totals.add(&self.marks[1], &mark, to);
        self.marks = [std::mem::take(&mut self.marks[1]), mark];
    }

    /// What happened since the mark before the last.
    #[must_use]
    pub fn lately(&self) -> Lately {
        let before = &self.marks[0];
        Lately {
            taken: self.taken.messages.saturating_sub(before.taken.messages),
            out: self.out.messages - before.out.messages,
            dropped: self.dropped.since(&before.dropped),
        }
    }

    /// Messages that are inside: taken in, neither written nor dropped.
    #[must_use]
    pub fn queued(&self) -> u64 {
        self.taken.messages.saturating_sub(self.out.messages).saturating_sub(self.dropped.total())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_are_kept_by_layer_and_what_is_no_layer_or_too_many_counts_together() {
        let mut ages = Ages::default();
        ages.record("edge", 1_000);
        ages.record("bad\"\n", 2_000);
        for number in 0..2 * MAX_ORIGINS {
            ages.record(&format!("l{number}"), 3_000);
        }
        assert_eq!(ages.0.len(), MAX_ORIGINS);
        assert_eq!(ages.all().count(), 2 + 2 * MAX_ORIGINS as u64);
        assert!(ages.iter().all(|(layer, _)| layer == OTHER || layer.parse::<LayerName>().is_ok()));
    }

    #[test]
    fn totals_outlive_bridges_and_count_each_message_once() {
        let (mut totals, cloud) = (Totals::default(), "cloud/cloud-1".parse::<FlowId>().unwrap());
        for _ in 0..2 {
            let mut bridge = BridgeStats::default();
            bridge.taken.add_many(3, 30);
            bridge.mark(&mut totals, Some(&cloud));
            // One is taken back and comes again.
            bridge.taken.remove(10);
            bridge.mark(&mut totals, Some(&cloud));
            bridge.taken.add(10);
            bridge.out.add(10);
            bridge.dropped.add(DropReason::QueueFull, 2);
            bridge.mark(&mut totals, Some(&cloud));
            bridge.mark(&mut totals, Some(&cloud));
        }
        assert_eq!((totals.taken.messages, totals.taken.bytes, totals.out.messages), (6, 60, 2));
        assert_eq!((totals.dropped.total(), totals.dropped_to[&cloud]), (4, 4));
    }
}
