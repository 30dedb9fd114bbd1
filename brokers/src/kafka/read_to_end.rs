//! What a topic holds, key by key, up to its end.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rdkafka::consumer::{BaseConsumer, Consumer as _};
use rdkafka::error::KafkaError;
use rdkafka::message::{BorrowedMessage, Message as _};
use rdkafka::{Offset, TopicPartitionList};

use super::context::ReadContext;
use super::directory::{LookupError, Marks};
use super::inner::Shared;

/// Keys that are kept at most; what is beyond is counted and left out.
const MAX_KEYS: usize = 65_536;
/// Bytes that are kept at most; what is beyond is counted and left out.
const MAX_BYTES: usize = 256 * 1024 * 1024;
/// How long to wait for the next record before looking at the time.
const TURN: Duration = Duration::from_millis(50);

/// Reads one topic from its beginning with a client of its own.
pub(super) struct ReaderToEnd<T> {
    client: BaseConsumer<ReadContext>,
    topic: String,
    /// Offset of the next record, per partition.
    positions: Vec<i64>,
    ended: Vec<bool>,
    latest: Latest<T>,
}

impl<T> ReaderToEnd<T> {
    /// Begins at the beginning of each partition.
    pub(super) fn open(shared: &Shared, topic: &str, marks: &[Marks]) -> Result<Self, LookupError> {
        let context = ReadContext::new(&Arc::default(), &shared.last_error);
        let client: BaseConsumer<ReadContext> =
            shared.settings.reader_to_end().create_with_context(context)?;
        let mut list = TopicPartitionList::new();
        for (partition, mark) in (0..).zip(marks) {
            list.add_partition_offset(topic, partition, Offset::Offset(mark.low))?;
        }
        client.assign(&list)?;
        Ok(Self {
            client,
            topic: topic.to_owned(),
            positions: marks.iter().map(|mark| mark.low).collect(),
            ended: vec![false; marks.len()],
            latest: Latest::default(),
        })
    }

    /// Reads until every partition has been read to its end and at least to the given offset;
    /// returns where it stands. `make` turns a record with its payload into what is kept; `None`
    /// leaves it out. A record without a payload takes its key away.
    pub(super) fn read(
        &mut self,
        least: &[i64],
        deadline: Instant,
        is_cancelled: &dyn Fn() -> bool,
        mut make: impl FnMut(&BorrowedMessage<'_>, &[u8]) -> Option<T>,
    ) -> Result<Vec<i64>, LookupError> {
        for ((ended, position), least) in self.ended.iter_mut().zip(&self.positions).zip(least) {
            *ended |= position >= least;
        }
        while !self.ended.iter().all(|ended| *ended) {
            if is_cancelled() {
                return Err(LookupError::Closed);
            }
            if Instant::now() >= deadline {
                return Err(LookupError::Away(format!(
                    "{} could not be read to its end in time",
                    self.topic
                )));
            }
            match self.client.poll(TURN) {
                None => {}
                Some(Ok(message)) => {
                    if let Some(at) = index(message.partition(), &self.positions) {
                        self.positions[at] = message.offset() + 1;
                        self.ended[at] |=
                            least.get(at).is_some_and(|least| self.positions[at] >= *least);
                    }
                    self.latest.apply(&message, &mut make);
                }
                // Between the last record and the end there may be a gap that compaction made.
                Some(Err(KafkaError::PartitionEOF(partition))) => {
                    if let Some(at) = index(partition, &self.positions) {
                        self.ended[at] = true;
                    }
                }
                // The client tries again by itself; what lasts ends at the deadline.
                Some(Err(error)) => {
                    tracing::debug!(topic = self.topic, %error, "reading to the end");
                }
            }
        }
        for (position, least) in self.positions.iter_mut().zip(least) {
            *position = (*position).max(*least);
        }
        Ok(self.positions.clone())
    }

    /// What is there, in the order of the topic.
    pub(super) fn take_latest(&mut self) -> Vec<(Vec<u8>, T)> {
        if self.latest.left_out > 0 {
            tracing::warn!(
                topic = self.topic,
                left_out = self.latest.left_out,
                "the topic holds more than can be taken at once"
            );
        }
        let mut latest: Vec<_> = std::mem::take(&mut self.latest).by_key.into_iter().collect();
        latest.sort_unstable_by_key(|(_, kept)| kept.place);
        latest.into_iter().map(|(key, kept)| (key, kept.value)).collect()
    }
}

fn index<T>(partition: i32, of: &[T]) -> Option<usize> {
    usize::try_from(partition).ok().filter(|at| *at < of.len())
}

/// The last record of a key.
struct Kept<T> {
    value: T,
    place: (i32, i64),
    bytes: usize,
}

struct Latest<T> {
    by_key: HashMap<Vec<u8>, Kept<T>>,
    bytes: usize,
    left_out: u64,
}

impl<T> Default for Latest<T> {
    fn default() -> Self {
        Self { by_key: HashMap::new(), bytes: 0, left_out: 0 }
    }
}

impl<T> Latest<T> {
    fn apply(
        &mut self,
        message: &BorrowedMessage<'_>,
        make: &mut impl FnMut(&BorrowedMessage<'_>, &[u8]) -> Option<T>,
    ) {
        let Some(key) = message.key() else { return };
        let made = message.payload().map(|payload| (payload.len(), make(message, payload)));
        // A payload that is left out leaves what was there before.
        if matches!(made, Some((_, None))) {
            return;
        }
        if let Some(before) = self.by_key.remove(key) {
            self.bytes -= before.bytes;
        }
        let Some((bytes, Some(value))) = made else { return };
        if self.by_key.len() >= MAX_KEYS || self.bytes + bytes > MAX_BYTES {
            self.left_out += 1;
            return;
        }
        self.bytes += bytes;
        self.by_key.insert(
            key.to_vec(),
            Kept { value, place: (message.partition(), message.offset()), bytes },
        );
    }
}
