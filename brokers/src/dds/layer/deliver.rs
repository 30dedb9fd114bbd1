//! From a DDS sample to the subscriptions of its channel.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use rustdds::Timestamp;
use rustdds::no_key::DeserializedCacheChange;

use super::channel::Channel;
use super::kept::History;
use super::seen::Seen;
use super::shared::{Shared, WriterFacts};
use crate::dds::EndpointId;
use crate::dds::participant::prefix_of;
use crate::dds::sample::Octets;
use crate::dds::writer::endpoint_of;
use crate::port::{Content, Received};

/// Writers of one channel whose progress is remembered; those that are gone are forgotten first.
const MAX_WRITERS: usize = 4096;
/// How much older than the subscription a sample may seem and count as live: clocks are compared over the network.
const CLOCK_SLACK: Duration = Duration::from_millis(20);

/// Which of the two readers of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Reliable,
    BestEffort,
}

/// How far the readers of a channel have come.
pub(super) struct Progress<'a> {
    pub(super) opened: Timestamp,
    pub(super) seen: &'a mut HashMap<EndpointId, Seen>,
    pub(super) history: &'a mut History,
}

impl Progress<'_> {
    /// What was seen of a writer.
    fn of_writer(&mut self, shared: &Shared, writer: EndpointId) -> &mut Seen {
        if self.seen.len() >= MAX_WRITERS && !self.seen.contains_key(&writer) {
            let known = shared.writers.read();
            self.seen.retain(|id, _| known.contains_key(id));
            if self.seen.len() >= MAX_WRITERS {
                self.seen.clear();
            }
        }
        self.seen.entry(writer).or_default()
    }
}

/// Takes a sample of another participant, or what an own writer keeps. Own live messages come by another way.
pub(super) fn deliver(
    shared: &Shared,
    channel: &Channel,
    kind: Kind,
    progress: &mut Progress<'_>,
    sample: DeserializedCacheChange<Octets>,
) {
    let now = Timestamp::now();
    let writer = endpoint_of(sample.writer_guid());
    let facts = shared.writers.read().get(&writer).copied();
    if kind == Kind::BestEffort && facts.is_some_and(|facts| facts.reliable) {
        // The reliable reader has it, in order and complete.
        return;
    }
    let since_opened = sample.receive_instant >= progress.opened;
    let seen = progress.of_writer(shared, writer);
    // A topic's samples lie in one cache for both readers.
    let Some(missing) = seen.take(i64::from(sample.sequence_number), since_opened) else {
        return;
    };
    let own = facts.is_some_and(|facts| facts.own);
    let age = age_of(shared, facts, &sample, now);
    let is_old = age > since(progress.opened, now) + if own { Duration::ZERO } else { CLOCK_SLACK };
    if missing > 0 && !own && !is_old && facts.is_some_and(|facts| facts.reliable) {
        // RustDDS acknowledges what it takes in, and drops the oldest that were not read in time.
        shared.counters.overrun.fetch_add(missing, Ordering::Relaxed);
        channel.note_lost(missing);
    }
    if channel.with_kept {
        if own && !is_old {
            return;
        }
    } else if own || is_old || !since_opened {
        return;
    }
    let bytes = sample.into_value().0;
    let content = if channel.is_reserved {
        Content::Bare {
            payload: bytes,
            identity: None,
        }
    } else {
        Content::from_bytes(bytes)
    };
    let at = Instant::now();
    let mut received = Received::live(content, at);
    if is_old {
        received.kept = true;
        received.broker_age_us = u64::try_from(age.as_micros()).unwrap_or(u64::MAX);
        if let Some(received) = progress.history.hold(at, writer, received) {
            channel.send(received);
        }
        return;
    }
    for kept in progress.history.of_writer(writer) {
        channel.send(kept);
    }
    channel.send(received);
}

/// How long ago a sample that its writer keeps for late joiners was written; zero for all others.
fn age_of(
    shared: &Shared,
    facts: Option<WriterFacts>,
    sample: &DeserializedCacheChange<Octets>,
    now: Timestamp,
) -> Duration {
    if !facts.is_some_and(|facts| facts.durable) {
        return Duration::ZERO;
    }
    let Some(written) = sample.write_options.source_timestamp() else {
        return Duration::ZERO;
    };
    let behind = shared.clocks.read().behind_ns(prefix_of(sample.writer_guid()));
    let age_ns = nanos(now) - (nanos(written) + behind);
    Duration::from_nanos(u64::try_from(age_ns.max(0)).unwrap_or(u64::MAX))
}

fn since(earlier: Timestamp, now: Timestamp) -> Duration {
    let passed = (nanos(now) - nanos(earlier)).max(0);
    Duration::from_nanos(u64::try_from(passed).unwrap_or(u64::MAX))
}

/// Nanoseconds since 1970.
pub(super) fn nanos(time: Timestamp) -> i128 {
    (i128::from(time.to_ticks()) * 1_000_000_000) >> 32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_of_rustdds_is_time_of_day() {
        let now = nanos(Timestamp::now());
        let system = std::time::SystemTime::now()
            .duration_since(std::time::UNIX_EPOCH)
            .unwrap()
            .as_nanos();
        assert!(i128::try_from(system).unwrap() - now < 1_000_000_000);
        let later = Timestamp::from_ticks(Timestamp::now().to_ticks() + (3 << 31));
        assert!(since(Timestamp::now(), later) > Duration::from_millis(1_490));
        assert_eq!(since(later, Timestamp::now()), Duration::ZERO);
    }
}
