//! One topic that is read: where it stands, and who reads it.

use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use rdkafka::consumer::Consumer as _;
use rdkafka::error::KafkaError;
use rdkafka::{Offset, TopicPartitionList};

use super::{Client, Join, Source};
use crate::kafka::directory::{Marks, TopicInfo};
use crate::kafka::identity::TopicUuid;
use crate::port::SubscriptionSender;

pub(super) struct Partition {
    /// Offset of the next record.
    pub(super) next: i64,
    /// Writer of its bare records, where the topic has an identity.
    pub(super) bare_writer: Option<WriterId>,
    /// Since when the server has named a beginning or an end that does not hold `next`.
    pub(super) doubted_since: Option<Instant>,
}

pub(super) struct Reader {
    pub(super) sender: SubscriptionSender,
    /// Where it begins, per partition; partitions that came later from their beginning.
    pub(super) starts: Vec<i64>,
}

pub(super) struct TopicState {
    pub(super) source: Source,
    pub(super) uuid: Option<TopicUuid>,
    pub(super) partitions: Vec<Partition>,
    pub(super) readers: Vec<Reader>,
    /// Whether the client reads it now.
    pub(super) assigned: bool,
    /// It belongs to another flow: what is written meanwhile is not for its readers.
    pub(super) stood_back: bool,
    /// It was not there when its readers came: whatever it will hold came after them, so it is read from its beginning.
    pub(super) awaited: bool,
    /// It was behind the server's end when it was last looked at.
    pub(super) behind: Option<Behind>,
}

/// Records wait on the server and are not read.
pub(super) struct Behind {
    /// Where the partitions stood.
    pub(super) positions: Vec<i64>,
    /// Since when.
    pub(super) since: Instant,
    /// How long that may last: longer each time that asking again has changed nothing, because what waits may be a mark of
    /// a transaction, which no reader gets.
    pub(super) patience: Duration,
}

/// How long a reader may stand still while records wait for it.
const PATIENCE: Duration = Duration::from_secs(1);
const MOST_PATIENCE: Duration = Duration::from_secs(60);

impl TopicState {
    pub(super) fn take_in(&mut self, sender: SubscriptionSender, starts: Vec<i64>, join: Join<'_>) {
        if let Join::AfterKept(kept) = join {
            sender.send_kept(kept());
        }
        self.readers.push(Reader { sender, starts });
    }

    /// A reader that comes begins before what is read next: it is read again from there, and not given to those that had it.
    /// Returns whether that is so.
    pub(super) fn rewind(&mut self, starts: &[i64], client: &Client) -> bool {
        let mut moved = false;
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
            moved = true;
        }
        if moved && self.assigned {
            self.reassign(client);
        }
        moved
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

    /// Looks whether it stands still although records wait. The client library gives a partition up that had no leader at the
    /// moment when it was to be read (a topic that was just made, a broker that was fenced); asked again, it goes on.
    pub(super) fn watch(&mut self, marks: &[Marks], now: Instant, client: &Client) {
        let waits = self.partitions.iter().zip(marks).any(|(at, mark)| mark.high > at.next);
        if !waits {
            self.behind = None;
            return;
        }
        let positions: Vec<i64> = self.partitions.iter().map(|at| at.next).collect();
        match &mut self.behind {
            Some(behind) if behind.positions == positions => {
                if now.saturating_duration_since(behind.since) < behind.patience {
                    return;
                }
                tracing::warn!(topic = %self.source.topic, ?positions, "records wait and are not read: asking for them again");
                behind.since = now;
                behind.patience = (behind.patience * 2).min(MOST_PATIENCE);
                self.reassign(client);
            }
            _ => {
                self.behind = Some(Behind {
                    positions,
                    since: now,
                    patience: PATIENCE,
                });
            }
        }
    }

    /// What was waited for is there: it is read from its beginning.
    pub(super) fn came(&mut self, info: &TopicInfo, layer: &str, client: &Client) {
        self.identify(info.uuid.clone(), layer);
        self.grow(info.partitions, layer);
        self.awaited = false;
        if let Err(error) = self.assign(client) {
            tracing::warn!(topic = %self.source.topic, %error, "the topic cannot be read yet");
            self.awaited = true;
        }
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

    pub(super) fn assign(&mut self, client: &Client) -> Result<(), KafkaError> {
        client.incremental_assign(&self.list()?)?;
        self.assigned = true;
        Ok(())
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
        if let Err(error) = self.assign(client) {
            tracing::warn!(topic = %self.source.topic, %error, "the topic cannot be read");
        }
    }
}
