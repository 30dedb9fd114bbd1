//! One topic that is read: where it stands, and its readers.

use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use rdkafka::consumer::Consumer as _;
use rdkafka::error::KafkaError;
use rdkafka::{Offset, TopicPartitionList};

use super::{Client, Source};
use crate::kafka::directory::{Marks, TopicInfo};
use crate::kafka::identity::TopicUuid;
use crate::port::SubscriptionSender;

/// How long a reader may stand still while records wait for it.
const PATIENCE: Duration = Duration::from_secs(1);
const MOST_PATIENCE: Duration = Duration::from_secs(60);
/// A beginning or an end that does not hold what is to be read next is believed after this time: a
/// server that stood still for a moment, and begins to lead the partition again, names others
/// first. To believe them would be to read the last records twice, or never.
const BELIEVED: Duration = Duration::from_secs(3);

pub(super) struct Partition {
    /// Offset of the next record.
    pub(super) next: i64,
    /// Writer of its bare records, where the topic has an identity.
    pub(super) bare_writer: Option<WriterId>,
    /// Since when the server has named a beginning or an end that does not hold `next`.
    doubted_since: Option<Instant>,
}

pub(super) struct Reader {
    pub(super) sender: SubscriptionSender,
    /// Where it begins, per partition; partitions that came later from their beginning.
    pub(super) starts: Vec<i64>,
}

pub(super) struct TopicState {
    pub(super) source: Source,
    pub(super) uuid: Option<TopicUuid>,
    /// None while the topic is not there: all that it will hold came after its readers, so it is
    /// read from its beginning.
    pub(super) partitions: Vec<Partition>,
    pub(super) readers: Vec<Reader>,
    /// Whether the client reads it now.
    pub(super) assigned: bool,
    /// It belongs to another flow: its readers do not get what is written meanwhile.
    pub(super) stood_back: bool,
    /// It was behind the server's end when it was last looked at.
    behind: Option<Behind>,
}

/// Records wait on the server and are not read.
struct Behind {
    /// Where the partitions stood.
    positions: Vec<i64>,
    /// Since when.
    since: Instant,
    /// How long that may last: longer each time that asking again has changed nothing, because what
    /// waits may be a mark of a transaction, which no reader gets.
    patience: Duration,
}

impl TopicState {
    pub(super) fn new(source: &Source) -> Self {
        Self {
            source: source.clone(),
            uuid: None,
            partitions: Vec::new(),
            readers: Vec::new(),
            assigned: false,
            stood_back: false,
            behind: None,
        }
    }

    /// Whether the server does not have it yet.
    pub(super) fn is_awaited(&self) -> bool {
        self.partitions.is_empty()
    }

    pub(super) fn positions(&self) -> Vec<i64> {
        self.partitions.iter().map(|at| at.next).collect()
    }

    /// Whether records at or behind these offsets have been read.
    pub(super) fn is_beyond(&self, starts: &[i64]) -> bool {
        self.partitions.iter().zip(starts).any(|(at, start)| at.next > *start)
    }

    /// The server has it: further partitions than `starts` are read from their beginning.
    pub(super) fn begin_at(&mut self, starts: &[i64], info: &TopicInfo, layer: &str) {
        self.grow(info.partitions, layer);
        for (partition, start) in self.partitions.iter_mut().zip(starts) {
            partition.next = *start;
        }
        self.identify(info.uuid.clone(), layer);
    }

    /// It is to be read again. A topic that this flow stood back from begins at its end, because
    /// what was written meanwhile was another's; one that the client did not take, where it stood.
    pub(super) fn begin(&mut self, info: &TopicInfo, marks: &[Marks], layer: &str) {
        let ends: Vec<i64> = marks.iter().map(|mark| mark.high).collect();
        if !std::mem::take(&mut self.stood_back) || self.is_awaited() {
            return self.begin_at(&[], info, layer);
        }
        self.begin_at(&ends, info, layer);
        for reader in &mut self.readers {
            reader.starts.clone_from(&ends);
        }
    }

    /// A reader that comes begins before what is read next: it is read again from there, and not
    /// given to those that had it.
    pub(super) fn rewind(&mut self, starts: &[i64], client: &Client) {
        if !self.is_beyond(starts) {
            return;
        }
        for (number, (partition, start)) in self.partitions.iter_mut().zip(starts).enumerate() {
            if *start >= partition.next {
                continue;
            }
            for reader in &mut self.readers {
                if reader.starts.len() <= number {
                    reader.starts.resize(number + 1, 0);
                }
                reader.starts[number] = reader.starts[number].max(partition.next);
            }
            partition.next = *start;
        }
        if self.assigned {
            self.reassign(client);
        }
    }

    pub(super) fn identify(&mut self, uuid: Option<TopicUuid>, layer: &str) {
        for (number, partition) in self.partitions.iter_mut().enumerate() {
            partition.bare_writer = uuid.as_ref().map(|uuid| uuid.bare_writer(layer, number));
        }
        self.uuid = uuid;
    }

    /// Another topic has this name now: nothing of it was seen.
    pub(super) fn made_anew(&mut self, uuid: TopicUuid, layer: &str) {
        for partition in &mut self.partitions {
            partition.next = 0;
        }
        for reader in &mut self.readers {
            reader.starts.clear();
        }
        self.identify(Some(uuid), layer);
    }

    /// Whether records waited at the last [`TopicState::watch`].
    pub(super) fn is_behind(&self) -> bool {
        self.behind.is_some()
    }

    /// Looks whether it stands still although records wait. The client library gives a partition up
    /// that had no leader at the moment when it was to be read (a topic that was just made, a
    /// broker that was fenced); asked again, it goes on.
    pub(super) fn watch(&mut self, marks: &[Marks], now: Instant, client: &Client) {
        let waits = self.partitions.iter().zip(marks).any(|(at, mark)| mark.high > at.next);
        if !waits {
            self.behind = None;
            return;
        }
        let positions = self.positions();
        match &mut self.behind {
            Some(behind) if behind.positions == positions => {
                if now.saturating_duration_since(behind.since) < behind.patience {
                    return;
                }
                tracing::warn!(
                    topic = %self.source.topic,
                    ?positions,
                    "records wait and are not read: asking for them again",
                );
                behind.since = now;
                behind.patience = (behind.patience * 2).min(MOST_PATIENCE);
                self.reassign(client);
            }
            _ => {
                self.behind = Some(Behind { positions, since: now, patience: PATIENCE });
            }
        }
    }

    /// Moves positions that the server does not have to what is nearest. Returns whether that is
    /// not sure yet.
    pub(super) fn compare(&mut self, marks: &[Marks], now: Instant, client: &Client) -> bool {
        let mut in_doubt = false;
        for (number, (partition, mark)) in self.partitions.iter_mut().zip(marks).enumerate() {
            if mark.holds(partition.next) {
                partition.doubted_since = None;
                continue;
            }
            let since = *partition.doubted_since.get_or_insert(now);
            if now.saturating_duration_since(since) < BELIEVED {
                in_doubt = true;
                continue;
            }
            let at = partition.next.clamp(mark.low, mark.high.max(mark.low));
            tracing::warn!(
                topic = %self.source.topic, partition = number, position = partition.next,
                moved_to = at,
                "the server no longer has what was to be read next"
            );
            partition.next = at;
        }
        // Also where nothing moved: the client stops reading a partition whose position it could
        // not find for a moment.
        self.reassign(client);
        in_doubt
    }

    pub(super) fn grow(&mut self, partitions: usize, layer: &str) {
        for number in self.partitions.len()..partitions {
            self.partitions.push(Partition {
                next: 0,
                bare_writer: self.uuid.as_ref().map(|uuid| uuid.bare_writer(layer, number)),
                doubted_since: None,
            });
        }
    }

    fn list(&self) -> Result<TopicPartitionList, KafkaError> {
        let mut list = TopicPartitionList::new();
        for (number, partition) in (0..).zip(&self.partitions) {
            list.add_partition_offset(&self.source.topic, number, Offset::Offset(partition.next))?;
        }
        Ok(list)
    }

    /// Reads it from now on. Returns whether the client takes that; else it is tried again with the
    /// next look.
    pub(super) fn assign(&mut self, client: &Client) -> bool {
        let done = self.list().and_then(|list| client.incremental_assign(&list));
        if let Err(error) = &done {
            tracing::warn!(topic = %self.source.topic, %error, "the topic cannot be read yet");
        }
        self.assigned = done.is_ok();
        self.assigned
    }

    pub(super) fn unassign(&mut self, client: &Client) {
        if !std::mem::take(&mut self.assigned) {
            return;
        }
        // Not the list of now: the partitions may have become more since.
        let assigned = client.assignment().map(|assigned| {
            let mut list = TopicPartitionList::new();
            for element in assigned.elements_for_topic(&self.source.topic) {
                list.add_partition(&self.source.topic, element.partition());
            }
            list
        });
        if let Err(error) = assigned.and_then(|list| client.incremental_unassign(&list)) {
            tracing::debug!(topic = %self.source.topic, %error, "could not be left");
        }
    }

    /// Reads on at the positions of now.
    pub(super) fn reassign(&mut self, client: &Client) {
        self.unassign(client);
        self.assign(client);
    }
}
