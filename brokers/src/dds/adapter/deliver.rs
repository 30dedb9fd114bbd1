//! From a DDS sample to the subscriptions of its channel.

use std::collections::HashMap;
use std::time::Instant;

use rustdds::Timestamp;

use super::channel::Channel;
use super::kept::History;
use super::seen::{Moment, Seen};
use super::shared::{Shared, WriterFacts};
use super::{Decoded, NoMessage};
use crate::dds::EndpointId;
use crate::dds::Sample;
use crate::dds::writer::{CYCLONE, endpoint_of};
use crate::port::Received;

/// Writers of one channel whose progress is remembered; those that are gone are forgotten first.
const MAX_WRITERS: usize = 4096;

/// Which reader of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Begins with what writers keep, and is not given what others publish.
    Durable,
    Reliable,
    BestEffort,
}

impl Kind {
    pub(super) const ALL: [Self; 3] = [Self::Durable, Self::Reliable, Self::BestEffort];

    /// The reader that is best for a writer.
    pub(super) fn of(facts: WriterFacts, with_kept: bool) -> Self {
        match facts.reliable {
            true if facts.durable && with_kept => Self::Durable,
            true => Self::Reliable,
            false => Self::BestEffort,
        }
    }
}

/// How far the readers of a channel have come.
pub(super) struct Progress<'a> {
    pub(super) opened: Timestamp,
    /// Which of them counts samples that cannot be read, so that each counts once.
    pub(super) counts: Option<Kind>,
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

/// Counts a sample as lost that waited in vain.
pub(super) fn note_lost(
    shared: &Shared,
    channel: &Channel,
    kind: Kind,
    progress: &mut Progress<'_>,
    sample: &Sample,
) {
    let writer = endpoint_of(sample.writer_guid());
    let facts = shared.facts_of(&writer);
    let since_opened = sample.receive_instant >= progress.opened;
    if !since_opened || !channel.reads(kind, facts) {
        return;
    }
    let seen = progress.of_writer(shared, writer);
    if let Some(missing) = seen.take(i64::from(sample.sequence_number), since_opened) {
        let repairs = facts.is_some_and(|facts| facts.reliable);
        channel.note_lost(1 + if repairs { missing } else { 0 });
    }
}

/// Takes a sample of another participant, or what an own writer keeps. Own live messages come by
/// another way.
pub(super) fn deliver(
    shared: &Shared,
    channel: &Channel,
    kind: Kind,
    progress: &mut Progress<'_>,
    sample: &Sample,
) {
    let writer = endpoint_of(sample.writer_guid());
    let facts = shared.facts_of(&writer);
    if !channel.reads(kind, facts) {
        // Another reader has it, complete.
        return;
    }
    let opened = progress.opened;
    let since_opened = sample.receive_instant >= opened;
    let seen = progress.of_writer(shared, writer);
    // A topic's samples lie in one cache for both readers.
    let Some(missing) = seen.take(i64::from(sample.sequence_number), since_opened) else {
        return;
    };
    let own = facts.is_some_and(|facts| facts.own);
    let moment = moment_of(shared, facts, writer, sample);
    let is_old = moment.is_some_and(|moment| {
        // Without a reader that asks for what is kept, RustDDS gives none of it. Its volatile readers
        // request all that a writer says it has, and Cyclone DDS gives it.
        let may_be_kept = channel.with_kept
            || shared.channels.ask_for_kept(&channel.topic.name)
            || writer.starts_with(&CYCLONE);
        may_be_kept && moment.is_old(nanos(opened), own, seen)
    });
    if missing > 0 && !own && !is_old && facts.is_some_and(|facts| facts.reliable) {
        // RustDDS acknowledges what it takes in, and drops the oldest that were not read in time.
        channel.note_lost(missing);
    }
    if channel.with_kept {
        if own && !is_old {
            return;
        }
    } else if own || is_old || !since_opened {
        return;
    }
    let Decoded { content, age_us } = match shared.dialect.decode(&channel.topic, sample) {
        Ok(decoded) => decoded,
        Err(NoMessage::NotForUs) => return,
        Err(NoMessage::Malformed) => {
            shared.counts.lock().malformed += 1;
            tracing::debug!(topic = &*channel.topic.name, "a sample is malformed");
            return;
        }
    };
    let at = Instant::now();
    let mut received = Received { broker_age_us: age_us, ..Received::live(content, at) };
    match moment {
        Some(moment) if is_old => {
            received.kept = true;
            if let Some(received) = progress.history.hold(at, writer, received, moment) {
                channel.put(received);
            }
        }
        _ => {
            // One that is written now tells how far an unknown clock is behind.
            let behind_ns =
                moment.map(|moment| moment.clock.behind_ns().unwrap_or(moment.lag_ns()));
            channel.send_kept(&progress.history.of_writer(writer, behind_ns));
            channel.put(received);
        }
    }
}

/// When a sample was written and came. `None` for those that nobody keeps, or whose writer does not
/// tell.
fn moment_of(
    shared: &Shared,
    facts: Option<WriterFacts>,
    writer: EndpointId,
    sample: &Sample,
) -> Option<Moment> {
    let facts = facts.filter(|facts| facts.durable)?;
    Some(Moment {
        written_ns: nanos(sample.write_options.source_timestamp()?),
        received_ns: nanos(sample.receive_instant),
        taken_ns: nanos(Timestamp::now()),
        clock: shared.clock_of(writer, Some(facts)),
    })
}

/// Nanoseconds since 1970.
pub(crate) fn nanos(time: Timestamp) -> i128 {
    (i128::from(time.to_ticks()) * 1_000_000_000) >> 32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_of_rustdds_is_time_of_day() {
        let now = nanos(Timestamp::now());
        let system =
            std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos();
        assert!(i128::try_from(system).unwrap() - now < 1_000_000_000);
    }
}
