//! What becomes of messages that are with the client.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use blaze_domain::DropReason;
use parking_lot::Mutex;
use rdkafka::ClientContext;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::message::{DeliveryResult, Message as _, Timestamp};
use rdkafka::producer::{NoCustomPartitioner, ProducerContext};
use tokio::sync::{Notify, oneshot};

use crate::kafka::bell::Bell;
use crate::kafka::clock::BrokerClock;
use crate::kafka::context::{self, LastError};
use crate::kafka::topics::Topic;
use crate::outbox::{Fate, Receipt};

/// What comes back from librdkafka with the acknowledgement.
pub(in crate::kafka) enum Delivery {
    /// A message of a publisher.
    Message {
        receipt: Receipt,
        topic: Arc<Topic>,
        bytes: usize,
        sent: Instant,
        /// Ends with the last message of the batch.
        batch: Arc<Batch>,
    },
    /// A value of a key; told what became of it.
    Keyed {
        done: oneshot::Sender<Fate>,
        topic: Arc<Topic>,
        sent: Instant,
        batch: Arc<Batch>,
    },
}

/// Messages that were handed over together.
pub(in crate::kafka) struct Batch(Arc<WriteContext>);

impl Batch {
    pub(in crate::kafka) fn begin(context: &Arc<WriteContext>) -> Arc<Self> {
        context.batches.fetch_add(1, Ordering::AcqRel);
        context.bell.ring();
        Arc::new(Self(Arc::clone(context)))
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        self.0.batches.fetch_sub(1, Ordering::AcqRel);
        self.0.room.notify_one();
    }
}

/// What the client calls back.
pub(in crate::kafka) struct WriteContext {
    /// Bytes that are with librdkafka and not acknowledged.
    pub(in crate::kafka) in_flight: AtomicUsize,
    /// Batches of which something is.
    pub(in crate::kafka) batches: AtomicUsize,
    /// Wakes the poll thread.
    pub(in crate::kafka) bell: Bell,
    pub(in crate::kafka) room: Notify,
    pub(in crate::kafka) fatal: AtomicBool,
    pub(in crate::kafka) clock: Arc<Mutex<BrokerClock>>,
    pub(in crate::kafka) last_error: Arc<LastError>,
}

/// One client calls back, but its successor goes on with the same numbers.
pub(in crate::kafka) struct SharedContext(pub(in crate::kafka) Arc<WriteContext>);

impl ClientContext for SharedContext {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        context::log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        if error.rdkafka_error_code() == Some(RDKafkaErrorCode::Fatal) {
            self.0.fatal.store(true, Ordering::Release);
        }
        self.0.last_error.note(format!("{error}: {reason}"));
    }
}

impl ProducerContext<NoCustomPartitioner> for SharedContext {
    type DeliveryOpaque = Box<Delivery>;

    fn delivery(&self, result: &DeliveryResult<'_>, delivery: Box<Delivery>) {
        let now = Instant::now();
        let appended = match result {
            Ok(message) => match message.timestamp() {
                Timestamp::LogAppendTime(at) => Some(at),
                Timestamp::CreateTime(_) | Timestamp::NotAvailable => None,
            },
            Err(_) => None,
        };
        let sent = match *delivery {
            Delivery::Message {
                receipt,
                topic,
                bytes,
                sent,
                batch,
            } => {
                let fate = match result {
                    Ok(_) => Fate::Delivered,
                    Err((error, _)) => self.0.failed(error, &topic),
                };
                receipt.settle(fate);
                topic.note_in_flight(false);
                self.0.in_flight.fetch_sub(bytes, Ordering::AcqRel);
                // The feeder may come when the room is counted.
                drop(batch);
                sent
            }
            Delivery::Keyed {
                done,
                topic,
                sent,
                batch: _batch,
            } => {
                let fate = match result {
                    Ok(_) => Fate::Delivered,
                    Err((error, _)) => self.0.failed(error, &topic),
                };
                // Nobody waits any more when the broker is closed.
                let _ = done.send(fate);
                sent
            }
        };
        if let Some(appended) = appended {
            self.0.clock.lock().acknowledged(sent, now, appended);
        }
    }
}

impl WriteContext {
    pub(in crate::kafka) fn failed(&self, error: &KafkaError, topic: &Topic) -> Fate {
        let code = error.rdkafka_error_code();
        if matches!(
            code,
            Some(
                RDKafkaErrorCode::UnknownTopic
                    | RDKafkaErrorCode::UnknownPartition
                    | RDKafkaErrorCode::UnknownTopicOrPartition
            )
        ) {
            topic.vanished();
        }
        if reason_of(code) == DropReason::TooLarge {
            topic.doubt_limit();
        }
        if matches!(code, Some(RDKafkaErrorCode::Fatal)) {
            self.fatal.store(true, Ordering::Release);
        }
        tracing::debug!(topic = %topic.name, %error, "a message was not taken");
        Fate::Dropped(reason_of(code))
    }
}

fn reason_of(code: Option<RDKafkaErrorCode>) -> DropReason {
    match code {
        Some(RDKafkaErrorCode::MessageSizeTooLarge | RDKafkaErrorCode::MessageBatchTooLarge) => DropReason::TooLarge,
        _ => DropReason::BrokerError,
    }
}
