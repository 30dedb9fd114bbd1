//! What becomes of messages that are with the client.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use parking_lot::Mutex;
use rdkafka::ClientContext;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::message::{DeliveryResult, Message as _, Timestamp};
use rdkafka::producer::{NoCustomPartitioner, ProducerContext};
use tokio::sync::oneshot;

use super::Target;
use crate::kafka::context;
use crate::kafka::inner::Shared;
use crate::kafka::settings::Lot;
use crate::kafka::topics::{Topic, Which};
use crate::kafka::waker::ThreadWaker;
use crate::outbox::{Fate, Outbox, Receipt};

/// What is lost with the client is said in the log that often at most; the counters have all.
const WARN_EVERY: Duration = Duration::from_secs(1);

/// What comes back from librdkafka with the acknowledgement.
pub(in crate::kafka) struct Delivery {
    pub(in crate::kafka) topic: Arc<Topic>,
    /// Bytes that it counts for while it is in flight.
    pub(in crate::kafka) bytes: usize,
    pub(in crate::kafka) sent: Instant,
    pub(in crate::kafka) receipt: Sent,
    /// The client that has it.
    pub(in crate::kafka) which: Which,
}

/// The party that learns what became of a record.
pub(in crate::kafka) enum Sent {
    /// A message of a publisher.
    Message(Receipt),
    /// A value of a key.
    Keyed(oneshot::Sender<Fate>),
}

/// What the client calls back.
pub(in crate::kafka) struct WriteContext {
    /// What the producer is for.
    pub(in crate::kafka) lot: Lot,
    /// Bytes that are with librdkafka and not acknowledged.
    pub(in crate::kafka) in_flight: AtomicUsize,
    /// Wakes the poll thread of the prompt client.
    pub(in crate::kafka) prompt: ThreadWaker,
    /// Wakes that of the gathering client.
    pub(in crate::kafka) gathering: ThreadWaker,
    /// Where messages wait; its ring wakes the feeding thread.
    pub(in crate::kafka) outbox: Arc<Outbox<Target>>,
    /// The poll thread is to make the clients anew.
    pub(in crate::kafka) wants_new_clients: AtomicBool,
    /// When a loss was last said in the log.
    pub(in crate::kafka) warned: Mutex<Option<Instant>>,
    pub(in crate::kafka) shared: Arc<Shared>,
}

/// One client calls back, but its successor goes on with the same numbers.
pub(in crate::kafka) struct SharedContext(pub(in crate::kafka) Arc<WriteContext>);

impl ClientContext for SharedContext {
    fn log(&self, level: RDKafkaLogLevel, facility: &str, line: &str) {
        context::log(level, facility, line);
    }

    fn error(&self, error: KafkaError, reason: &str) {
        if error.rdkafka_error_code() == Some(RDKafkaErrorCode::Fatal) {
            self.0.ask_for_new_clients();
        }
        self.0.shared.last_error.note_event(&error, reason);
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
        let sent = delivery.sent;
        self.0.settle(*delivery, result.as_ref().err().map(|(error, _)| error));
        if let Some(appended) = appended {
            self.0.shared.clock.lock().acknowledged(sent, now, appended);
        }
    }
}

impl WriteContext {
    /// Nothing more is handed over until the poll thread has made the clients anew.
    pub(in crate::kafka) fn ask_for_new_clients(&self) {
        self.wants_new_clients.store(true, Ordering::Release);
        self.prompt.wake();
    }

    /// What wakes the poll thread of a client.
    pub(in crate::kafka) fn waker(&self, which: Which) -> &ThreadWaker {
        match which {
            Which::Prompt => &self.prompt,
            Which::Gathering => &self.gathering,
        }
    }

    /// A record goes to the client.
    pub(in crate::kafka) fn begin(&self, delivery: &Delivery) {
        self.in_flight.fetch_add(delivery.bytes, Ordering::AcqRel);
    }

    /// A record is no longer with the client: it was delivered, or there is an error.
    pub(in crate::kafka) fn settle(&self, delivery: Delivery, error: Option<&KafkaError>) {
        let Delivery { topic, bytes, receipt, .. } = delivery;
        let is_message = matches!(receipt, Sent::Message(_));
        let fate = error.map_or(Fate::Delivered, |error| self.failed(error, &topic, is_message));
        match receipt {
            Sent::Message(receipt) => receipt.settle(fate),
            // Without a receiver the broker is closed.
            Sent::Keyed(done) => drop(done.send(fate)),
        }
        self.in_flight.fetch_sub(bytes, Ordering::AcqRel);
        if topic.end(self.lot) {
            self.outbox.ring();
        }
    }

    fn failed(&self, error: &KafkaError, topic: &Topic, is_message: bool) -> Fate {
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
            self.ask_for_new_clients();
        }
        let reason = reason_of(code);
        if is_message && reason == DropReason::BrokerError && self.is_warning_due() {
            tracing::warn!(topic = %topic.name, %error, "Kafka did not confirm a message, which is not sent again");
        } else {
            tracing::debug!(topic = %topic.name, %error, ?reason, "a message was not taken");
        }
        Fate::Dropped(reason)
    }

    /// Whether the log has said nothing of losses for a while.
    fn is_warning_due(&self) -> bool {
        let (now, mut warned) = (Instant::now(), self.warned.lock());
        let is_due = warned.is_none_or(|at| now - at >= WARN_EVERY);
        if is_due {
            *warned = Some(now);
        }
        is_due
    }
}

fn reason_of(code: Option<RDKafkaErrorCode>) -> DropReason {
    match code {
        Some(RDKafkaErrorCode::MessageSizeTooLarge | RDKafkaErrorCode::MessageBatchTooLarge) => {
            DropReason::TooLarge
        }
        _ => DropReason::BrokerError,
    }
}
