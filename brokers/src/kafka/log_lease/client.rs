//! The two clients of a lease: one reads the partition to its end and on, the other writes one record at a time.

use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::consumer::{BaseConsumer, CommitMode, Consumer as _, ConsumerContext};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::message::{BorrowedMessage, DeliveryResult, Message as _};
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _, ProducerContext, PurgeConfig};
use rdkafka::{ClientContext, Offset, Timestamp, TopicPartitionList};

use super::ledger::{Act, Entry, Ledger, Place};
use crate::kafka::context::{self, LastError};
use crate::kafka::directory::is_passing;
use crate::kafka::settings::Settings;

/// How long the writer looks for an answer at a time.
const TURN: Duration = Duration::from_millis(10);
/// The partition that all is in.
const PARTITION: i32 = 0;
/// The least time that the server has to tell where the log begins and ends: a new client connects first.
const OPEN: Duration = Duration::from_secs(2);

/// What became of a record: its offset, or why it was not taken.
type Answer = Arc<Mutex<Option<Result<i64, KafkaError>>>>;

struct Context(Arc<LastError>);

impl ClientContext for Context {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        context::log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        // The end of the log is no fault of anything.
        if !matches!(error, KafkaError::PartitionEOF(_)) {
            self.0.note(format!("{error}: {reason}"));
        }
    }
}

impl ConsumerContext for Context {}

impl ProducerContext for Context {
    type DeliveryOpaque = Box<Answer>;

    fn delivery(&self, result: &DeliveryResult<'_>, answer: Self::DeliveryOpaque) {
        *answer.lock() = Some(match result {
            Ok(message) => Ok(message.offset()),
            Err((error, _)) => Err(error.clone()),
        });
    }
}

/// A lease's place in the log, as one owner sees it.
pub(super) struct Link {
    reader: BaseConsumer<Context>,
    writer: BaseProducer<Context>,
    topic: Arc<str>,
    layer: String,
    /// Offset of the next record.
    position: i64,
    /// What there was when it began ends here, unless it was compacted away.
    end: i64,
    is_caught_up: bool,
    /// Of what there was when it began something had been taken away.
    has_gaps: bool,
    ledger: Ledger,
}

/// Why the log must be read from its beginning again.
#[derive(Debug, thiserror::Error)]
#[error("the log of the lease is read anew: {0}")]
pub(super) struct Broken(String);

impl Link {
    /// Begins to read at the beginning.
    pub(super) fn open(
        settings: &Settings,
        last_error: &Arc<LastError>,
        (topic, layer, group): (&Arc<str>, &str, &str),
        patience: Duration,
    ) -> Result<Self, KafkaError> {
        let context = || Context(Arc::clone(last_error));
        let reader: BaseConsumer<Context> = settings.lease_reader(group).create_with_context(context())?;
        let writer: BaseProducer<Context> = settings.lease_writer(patience).create_with_context(context())?;
        // An empty partition would say so only after the longest wait of a fetch.
        let timeout = patience.max(OPEN);
        let deadline = Instant::now() + timeout;
        let (low, end) = loop {
            match reader.fetch_watermarks(topic, PARTITION, timeout) {
                // It may just have been made.
                Err(error) if is_passing(&error) && Instant::now() < deadline => std::thread::sleep(TURN),
                found => break found?,
            }
        };
        let mut list = TopicPartitionList::new();
        list.add_partition_offset(topic, PARTITION, Offset::Offset(low))?;
        reader.assign(&list)?;
        Ok(Self {
            reader,
            writer,
            topic: Arc::clone(topic),
            layer: layer.to_owned(),
            position: low,
            end,
            is_caught_up: low >= end,
            has_gaps: low > 0,
            ledger: Ledger::default(),
        })
    }

    pub(super) fn ledger(&mut self) -> &mut Ledger {
        &mut self.ledger
    }

    /// Reads what is there, and waits until everything before `least` was read, or until `deadline`; `None`: all that there
    /// was when it began. Returns whether that was reached.
    pub(super) fn read(&mut self, least: Option<i64>, deadline: Instant) -> Result<bool, Broken> {
        // What it has to say waits for that.
        self.writer.poll(Duration::ZERO);
        loop {
            let is_enough = self.is_caught_up && least.is_none_or(|least| self.position >= least);
            let wait = if is_enough {
                Duration::ZERO
            } else {
                deadline.saturating_duration_since(Instant::now()).min(TURN)
            };
            match self.reader.poll(wait) {
                None if is_enough => return Ok(true),
                None if Instant::now() >= deadline => return Ok(false),
                None => {}
                Some(Ok(message)) => {
                    self.has_gaps |= !self.is_caught_up && message.offset() != self.position;
                    self.position = message.offset() + 1;
                    if let Some(entry) = of_layer(&self.layer, &message) {
                        let place = Place {
                            offset: message.offset(),
                            appended_ms: appended_ms(message.timestamp()),
                            read: Instant::now(),
                            is_after_gap: self.has_gaps && !self.is_caught_up,
                        };
                        self.ledger.apply(entry, place);
                    }
                    if self.position >= self.end {
                        self.catch_up();
                    }
                }
                Some(Err(KafkaError::PartitionEOF(_))) => self.catch_up(),
                Some(Err(error)) if is_broken(&error, self.reader.client().fatal_error().is_some()) => {
                    return Err(Broken(error.to_string()));
                }
                // The client tries again by itself.
                Some(Err(error)) => tracing::debug!(%error, topic = %self.topic, "reading the lease"),
            }
        }
    }

    fn catch_up(&mut self) {
        if !std::mem::replace(&mut self.is_caught_up, true) {
            self.ledger.is_caught_up();
        }
    }

    /// Writes a record, and reads up to it: its offset, or why nobody knows what became of it.
    pub(super) fn write(&mut self, entry: &Entry, deadline: Instant) -> Result<Result<i64, String>, Broken> {
        let bytes = match entry.to_bytes() {
            Ok(bytes) => bytes,
            Err(error) => return Ok(Err(error)),
        };
        let answer = Answer::default();
        let key = key_of(&self.layer, entry);
        let record = BaseRecord::with_opaque_to(&self.topic, Box::new(Arc::clone(&answer)));
        if let Err((error, _)) = self.writer.send(record.partition(PARTITION).key(&key).payload(&bytes)) {
            return Ok(Err(error.to_string()));
        }
        let taken = loop {
            self.writer.poll(TURN);
            if let Some(taken) = answer.lock().take() {
                break taken;
            }
            if Instant::now() >= deadline {
                // Written later it would be of no use to anybody.
                self.writer.purge(PurgeConfig::default().queue());
                return Ok(Err("the record of the lease was not acknowledged in time".to_owned()));
            }
        };
        match taken {
            // Another log has begun under the same name.
            Ok(offset) if offset < self.position => Err(Broken(format!(
                "a record came at {offset}, where {} was read before",
                self.position
            ))),
            Ok(offset) if self.read(Some(offset + 1), deadline)? => Ok(Ok(offset)),
            Ok(_) => Ok(Err(
                "the record of the lease was written, but not read back in time".to_owned()
            )),
            Err(error) => Ok(Err(error.to_string())),
        }
    }

    /// Takes the claim of this owner away: what became of it is known.
    pub(super) fn forget_claim(&self, owner: &str) {
        let key = claim_key(&self.layer, owner);
        let record: BaseRecord<'_, str, [u8], _> = BaseRecord::with_opaque_to(&self.topic, Box::new(Answer::default()));
        // What stays is a claim that does not count.
        let _ = self.writer.send(record.partition(PARTITION).key(&key));
    }

    /// Shows the tools of Kafka, by the position of the group, who reads here and how far. Nothing rests on it.
    pub(super) fn show_position(&self) {
        let mut list = TopicPartitionList::new();
        let committed = list
            .add_partition_offset(&self.topic, PARTITION, Offset::Offset(self.position))
            .and_then(|()| self.reader.commit(&list, CommitMode::Async));
        if let Err(error) = committed {
            tracing::debug!(%error, topic = %self.topic, "the position of the group is not shown");
        }
    }
}

/// Of claims each writer has its own, of all else there is the last of the layer.
fn key_of(layer: &str, entry: &Entry) -> String {
    match entry.act {
        Act::Claim { .. } => claim_key(layer, &entry.owner),
        Act::Renew | Act::Release => layer.to_owned(),
    }
}

fn claim_key(layer: &str, owner: &str) -> String {
    format!("{layer}/{owner}")
}

/// What it says, if that is of this layer.
fn of_layer(layer: &str, message: &BorrowedMessage<'_>) -> Option<Entry> {
    let key = std::str::from_utf8(message.key()?).ok()?;
    let rest = key.strip_prefix(layer)?;
    if !rest.is_empty() && !rest.starts_with('/') {
        return None;
    }
    // One without a payload takes away a claim of which its writer knows what became.
    let entry = Entry::parse(message.payload()?);
    if entry.is_none() {
        tracing::debug!(offset = message.offset(), key, "this is no record of a lease");
    }
    entry
}

fn appended_ms(timestamp: Timestamp) -> Option<i64> {
    match timestamp {
        Timestamp::LogAppendTime(appended_ms) => Some(appended_ms),
        Timestamp::CreateTime(_) | Timestamp::NotAvailable => None,
    }
}

/// Whether the client cannot go on by itself.
fn is_broken(error: &KafkaError, is_fatal: bool) -> bool {
    is_fatal
        || matches!(
            error.rdkafka_error_code(),
            Some(
                RDKafkaErrorCode::UnknownTopicOrPartition
                    | RDKafkaErrorCode::UnknownTopic
                    | RDKafkaErrorCode::UnknownPartition
                    | RDKafkaErrorCode::OffsetOutOfRange
                    | RDKafkaErrorCode::AutoOffsetReset
            )
        )
}
