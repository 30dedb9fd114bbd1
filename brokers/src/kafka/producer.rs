//! Writing: what publishers hand over waits in an outbox, of which little at a time is with librdkafka.
//!
//! ```text
//! publish ─► outbox (bounds, deadlines) ─► feeder task ─► librdkafka (≤ 1 MiB not acknowledged) ─► server
//!                                             ▲                    │
//!                                             └── room ── delivery callback (poll thread): settles, measures the clock
//! ```
//!
//! Little is with librdkafka because from there nothing can be taken back: it has no deadline of a message's own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::ClientContext;
use rdkafka::config::RDKafkaLogLevel;
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::message::{DeliveryResult, Message as _, OwnedHeaders, Timestamp};
use rdkafka::producer::{BaseProducer, BaseRecord, NoCustomPartitioner, Producer as _, ProducerContext};
use tokio::sync::{Notify, oneshot};
use tokio_util::sync::CancellationToken;

use super::bell::Bell;
use super::clock::BrokerClock;
use super::context::{self, LastError};
use super::record;
use super::settings::{Lot, Settings};
use super::topics::Topic;
use crate::outbox::{Body, Fate, Lane, Outbox, OutboxLimits, Receipt, Waiting};

/// Most bytes that are with librdkafka and not acknowledged; one larger message may be.
const WINDOW: usize = 1024 * 1024;
/// Messages that are handed over at once.
const BATCH: usize = 1024;
/// With so many bytes in flight, what comes waits until less are. librdkafka sends what it has as soon as it looks, but of one
/// partition no more while five messages are not acknowledged, and until then it looks without a pause: what it has not it
/// need not look for, and goes in one request.
const CROWD: usize = 64 * 1024;
/// How long the poll thread is with the client while something is in flight: closing waits for that. The client library
/// ends each such visit with up to a millisecond of busy waiting.
const POLL: Duration = Duration::from_millis(200);
/// How often the poll thread looks for errors while nothing is.
const IDLE: Duration = Duration::from_millis(500);
/// How often messages that wait are looked at for their deadlines.
const EXPIRY: Duration = Duration::from_millis(100);
/// How long to wait before a client is made again that could not be made.
const REMAKE: Duration = Duration::from_millis(500);

const LIMITS: OutboxLimits = OutboxLimits {
    lane_messages: 65_536,
    lane_bytes: 32 * 1024 * 1024,
    total_bytes: 64 * 1024 * 1024,
};

/// When nothing may be handed over.
#[derive(Debug, Default)]
pub(super) struct Gate {
    up: AtomicBool,
    stood_back: AtomicBool,
}

impl Gate {
    /// The server answers, or does not.
    pub(super) fn set_up(&self, up: bool) {
        self.up.store(up, Ordering::Release);
    }

    /// The scope belongs to another flow, or to us.
    pub(super) fn set_stood_back(&self, stood_back: bool) {
        self.stood_back.store(stood_back, Ordering::Release);
    }

    /// Whether the scope belongs to another flow.
    pub(super) fn is_stood_back(&self) -> bool {
        self.stood_back.load(Ordering::Acquire)
    }

    /// Whether the server answers.
    pub(super) fn is_open(&self) -> bool {
        self.up.load(Ordering::Acquire)
    }

    /// Whether a topic is used now.
    pub(super) fn lets(&self, stays_open: bool) -> bool {
        stays_open || !self.is_stood_back()
    }
}

/// How a record gets its key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Keying {
    /// Its writer; and its place, where the topic keeps the last `depth` of each. Bare payloads have none.
    Writer {
        /// What the topic keeps of each writer.
        depth: u32,
    },
    /// The `id` of the answer that it is.
    AnswerId,
}

/// Where a lane's messages go.
#[derive(Debug)]
pub(super) struct Target {
    pub(super) topic: Arc<Topic>,
    pub(super) keying: Keying,
}

/// What comes back from librdkafka with the acknowledgement.
pub(super) enum Delivery {
    /// A message of a publisher.
    Message {
        receipt: Receipt,
        topic: Arc<Topic>,
        bytes: usize,
        sent: Instant,
        /// Ends with the last message of the batch.
        batch: Arc<Batch>,
    },
    /// A value of a key; told whether the server has it.
    Keyed {
        done: oneshot::Sender<bool>,
        sent: Instant,
        batch: Arc<Batch>,
    },
}

/// Messages that were handed over together.
pub(super) struct Batch(Arc<WriteContext>);

impl Batch {
    fn begin(context: &Arc<WriteContext>) -> Arc<Self> {
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
pub(super) struct WriteContext {
    /// Bytes that are with librdkafka and not acknowledged.
    in_flight: AtomicUsize,
    /// Batches of which something is.
    batches: AtomicUsize,
    /// Wakes the poll thread.
    bell: Bell,
    room: Notify,
    fatal: AtomicBool,
    clock: Arc<Mutex<BrokerClock>>,
    last_error: Arc<LastError>,
}

/// One client calls back, but its successor goes on with the same numbers.
struct SharedContext(Arc<WriteContext>);

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
                self.0.in_flight.fetch_sub(bytes, Ordering::AcqRel);
                // The feeder may come when the room is counted.
                drop(batch);
                sent
            }
            Delivery::Keyed {
                done,
                sent,
                batch: _batch,
            } => {
                // Nobody waits any more when the broker is closed.
                let _ = done.send(result.is_ok());
                sent
            }
        };
        if let Some(appended) = appended {
            self.0.clock.lock().acknowledged(sent, now, appended);
        }
    }
}

impl WriteContext {
    fn failed(&self, error: &KafkaError, topic: &Topic) -> Fate {
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

type Client = BaseProducer<SharedContext>;

/// One client that writes, and what waits for it.
pub(super) struct Producer {
    lot: Lot,
    settings: Settings,
    outbox: Arc<Outbox<Target>>,
    client: Mutex<Option<Arc<Client>>>,
    context: Arc<WriteContext>,
    gate: Arc<Gate>,
}

impl Producer {
    /// Makes the client, its task and its thread.
    pub(super) fn start(
        lot: Lot,
        settings: &Settings,
        gate: &Arc<Gate>,
        clock: &Arc<Mutex<BrokerClock>>,
        last_error: &Arc<LastError>,
        supervisor: &Supervisor,
        stop: &CancellationToken,
    ) -> Result<Arc<Self>, String> {
        let producer = Arc::new(Self {
            lot,
            settings: settings.clone(),
            outbox: Outbox::new(LIMITS),
            client: Mutex::new(None),
            context: Arc::new(WriteContext {
                in_flight: AtomicUsize::new(0),
                batches: AtomicUsize::new(0),
                bell: Bell::default(),
                room: Notify::new(),
                fatal: AtomicBool::new(false),
                clock: Arc::clone(clock),
                last_error: Arc::clone(last_error),
            }),
            gate: Arc::clone(gate),
        });
        *producer.client.lock() = Some(producer.make_client().map_err(|error| error.to_string())?);
        let poller = {
            let (producer, stop) = (Arc::clone(&producer), stop.clone());
            move || producer.poll(&stop)
        };
        supervisor
            .spawn_thread(lot.as_str(), TaskPolicy::MayEnd, poller)
            .map_err(|error| error.to_string())?;
        let (feeder, stop) = (Arc::clone(&producer), stop.clone());
        supervisor.spawn(lot.as_str(), TaskPolicy::MayEnd, async move { feeder.feed(stop).await });
        Ok(producer)
    }

    fn make_client(&self) -> Result<Arc<Client>, KafkaError> {
        let context = SharedContext(Arc::clone(&self.context));
        self.settings
            .producer(self.lot)
            .create_with_context(context)
            .map(Arc::new)
    }

    /// A queue for a publisher.
    pub(super) fn lane(&self, target: Target) -> Lane<Target> {
        self.outbox.lane(target, Some(self.lot.longest_wait()))
    }

    /// Something may have become possible.
    pub(super) fn wake(&self) {
        self.context.room.notify_one();
    }

    /// Drops all that waits.
    pub(super) fn clear(&self) {
        self.outbox.clear(DropReason::BrokerError);
    }

    /// Takes nothing more from publishers.
    pub(super) fn close_outbox(&self) {
        self.outbox.close();
    }

    /// Lets the poll thread look whether it is over.
    pub(super) fn end(&self) {
        self.clear();
        self.context.bell.ring();
    }

    /// Whether everything that was taken has been settled.
    pub(super) fn is_drained(&self) -> bool {
        self.outbox.is_empty() && self.context.in_flight.load(Ordering::Acquire) == 0
    }

    async fn feed(&self, stop: CancellationToken) {
        let mut taken = Vec::with_capacity(BATCH);
        let mut scratch = String::new();
        // Made once: one that begins anew with each message would never end where there are many.
        let mut expiry = tokio::time::interval(EXPIRY);
        expiry.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        while !stop.is_cancelled() {
            self.hand_over(&mut taken, &mut scratch);
            let waits = !self.outbox.is_empty();
            tokio::select! {
                () = stop.cancelled() => break,
                () = self.outbox.filled() => {}
                () = self.context.room.notified() => {}
                _ = expiry.tick(), if waits => self.outbox.expire(Instant::now()),
            }
        }
        self.clear();
    }

    /// Hands over as much as there is room for.
    fn hand_over(&self, taken: &mut Vec<Waiting<Target>>, scratch: &mut String) {
        while self.gate.is_open() {
            let in_flight = self.context.in_flight.load(Ordering::Acquire);
            if in_flight >= CROWD {
                return;
            }
            let Some(client) = self.client.lock().clone() else {
                return;
            };
            let is_ready = |to: &Target| to.topic.partitions().is_some() && self.gate.lets(to.topic.stays_open);
            let room = WINDOW - in_flight;
            self.outbox
                .take_ready(Instant::now(), BATCH, room, in_flight == 0, is_ready, taken);
            if taken.is_empty() {
                return;
            }
            let batch = Batch::begin(&self.context);
            // All at once, as librdkafka begins to send what it has with the first.
            let ready: Vec<Ready> = taken
                .drain(..)
                .map(|waiting| Ready::new(waiting, &batch, scratch))
                .collect();
            drop(batch);
            for ready in ready {
                self.send(&client, ready);
            }
        }
    }

    fn send(&self, client: &Client, ready: Ready) {
        let (topic, bytes) = (ready.topic, ready.bytes);
        let mut record =
            BaseRecord::<str, [u8], _>::with_opaque_to(&topic.name, ready.delivery).payload(&ready.payload);
        record.key = ready.key.as_deref();
        record.partition = ready.partition;
        record.headers = ready.headers;
        self.context.in_flight.fetch_add(bytes, Ordering::AcqRel);
        if let Err((error, record)) = client.send(record)
            && let Delivery::Message { receipt, .. } = *record.delivery_opaque
        {
            receipt.settle(self.context.failed(&error, &topic));
            self.context.in_flight.fetch_sub(bytes, Ordering::AcqRel);
        }
    }

    /// Writes the value of a key, or takes it away; `done` is told whether the server has it.
    pub(super) fn send_keyed(
        &self,
        topic: &str,
        partition: Option<i32>,
        key: &str,
        value: Option<&Bytes>,
        done: oneshot::Sender<bool>,
    ) {
        let Some(client) = self.client.lock().clone() else {
            return;
        };
        let delivery = Box::new(Delivery::Keyed {
            done,
            sent: Instant::now(),
            batch: Batch::begin(&self.context),
        });
        let mut record = BaseRecord::<str, [u8], _>::with_opaque_to(topic, delivery).key(key);
        record.partition = partition;
        record.payload = value.map(|value| &value[..]);
        // What is refused is dropped here with its `done`, which tells as well.
        if let Err((error, _)) = client.send(record) {
            tracing::debug!(topic, key, %error, "a value was not taken");
        }
    }

    /// Runs the callbacks until the end, and makes the client anew after a fatal error.
    fn poll(&self, stop: &CancellationToken) {
        while !stop.is_cancelled() {
            let client = self.client.lock().clone();
            if let Some(client) = &client {
                if self.context.batches.load(Ordering::Acquire) > 0 {
                    client.poll(POLL);
                } else {
                    self.context.bell.wait(IDLE);
                    client.poll(Duration::ZERO);
                }
                let fatal = client.client().fatal_error();
                if fatal.is_none() && !self.context.fatal.load(Ordering::Acquire) {
                    continue;
                }
                let reason = fatal.map_or_else(|| "unknown".to_owned(), |(code, text)| format!("{code}: {text}"));
                tracing::warn!(producer = self.lot.as_str(), reason, "the Kafka producer is made anew");
            }
            self.context.fatal.store(false, Ordering::Release);
            // What the old client held fails as it is dropped, and is not sent again.
            *self.client.lock() = None;
            drop(client);
            match self.make_client() {
                Ok(client) => *self.client.lock() = Some(client),
                Err(error) => {
                    self.context.last_error.note(error.to_string());
                    std::thread::sleep(REMAKE);
                }
            }
            self.wake();
        }
        let client = self.client.lock().take();
        drop(client);
    }
}

/// A message as the client takes it.
struct Ready {
    topic: Arc<Topic>,
    bytes: usize,
    payload: Bytes,
    key: Option<String>,
    partition: Option<i32>,
    headers: Option<OwnedHeaders>,
    delivery: Box<Delivery>,
}

impl Ready {
    fn new(waiting: Waiting<Target>, batch: &Arc<Batch>, scratch: &mut String) -> Self {
        let (bytes, target, sent) = (waiting.size(), Arc::clone(&waiting.to), Instant::now());
        let (payload, key, partition, headers);
        match &waiting.body {
            Body::Frame(frame) => {
                let frame = Waiting::<Target>::aged(frame, waiting.since, sent);
                let depth = match target.keying {
                    Keying::Writer { depth } => depth,
                    Keying::AnswerId => 0,
                };
                partition =
                    (depth > 0).then(|| record::partition_of(frame.writer(), target.topic.partitions().unwrap_or(1)));
                key = Some(record::key(frame.writer(), frame.sequence(), depth));
                headers = Some(record::headers(&frame, scratch));
                payload = frame.payload().clone();
            }
            Body::Bare(bytes) => {
                partition = None;
                key = match target.keying {
                    Keying::Writer { .. } => None,
                    Keying::AnswerId => answer_id(bytes),
                };
                headers = None;
                payload = bytes.clone();
            }
        }
        let topic = Arc::clone(&target.topic);
        let delivery = Box::new(Delivery::Message {
            receipt: waiting.into_receipt(),
            topic: Arc::clone(&topic),
            bytes,
            sent,
            batch: Arc::clone(batch),
        });
        Self {
            topic,
            bytes,
            payload,
            key,
            partition,
            headers,
            delivery,
        }
    }
}

/// The record key of an answer: clients look for theirs by it.
fn answer_id(payload: &[u8]) -> Option<String> {
    let value: serde_json::Value = serde_json::from_slice(payload).ok()?;
    let answers = value.as_array().map_or(std::slice::from_ref(&value), Vec::as_slice);
    answers
        .iter()
        .find_map(|answer| answer.get("id")?.as_str())
        .map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_have_their_id_as_the_key() {
        for (payload, id) in [
            (r#"{"id":"7","ok":true}"#, Some("7")),
            (r#"[{"ok":true},{"id":"8"},{"id":"9"}]"#, Some("8")),
            (r#"{"id":7}"#, None),
            ("[]", None),
            ("no JSON", None),
        ] {
            assert_eq!(answer_id(payload.as_bytes()).as_deref(), id, "{payload}");
        }
    }

    #[test]
    fn a_gate_lets_only_the_meeting_place_through_while_the_scope_is_anothers() {
        let gate = Gate::default();
        assert!(gate.lets(false) && !gate.is_open());
        gate.set_stood_back(true);
        assert!(!gate.lets(false) && gate.lets(true));
    }
}
