//! Writing: what publishers hand over waits in an outbox, of which little at a time is with
//! librdkafka.
//!
//! ```text
//! publish ─► outbox (bounds, deadlines) ─► feeder task ─► librdkafka (≤ 1 MiB, and ≤ 2 flights of a topic) ─► server
//!                                             ▲                    │
//!                                             └── room ── delivery callback (poll thread): settles, measures the clock
//! ```
//!
//! Little is with librdkafka because from there nothing can be taken back: it has no deadline of a
//! message's own. And what comes while two flights of its topic are under way goes as one, so that
//! messages that come one by one and often do not each make a request.

mod delivery;
mod ready;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use blaze_runtime::supervisor::TaskPolicy;
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::error::KafkaError;
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};
use tokio::sync::{Notify, oneshot};

use super::inner::Shared;
use super::settings::Lot;
use super::topics::{Flight, Topic};
use super::waker::ThreadWaker;
use crate::outbox::{Fate, Lane, Outbox, OutboxLimits, Waiting};
use delivery::{Delivery, Sent, SharedContext, WriteContext};
use ready::Ready;
pub(super) use ready::{Keying, Target};

/// Most bytes that are with librdkafka and not acknowledged; one larger message may be.
const WINDOW: usize = 1024 * 1024;
/// Messages that are handed over at once.
const BATCH: usize = 1024;
/// With so many bytes in flight, what comes waits until less are. librdkafka sends what it has as
/// soon as it looks, but of one partition no more while five messages are not acknowledged, and
/// until then it looks without a pause: what it has not it need not look for, and goes in one
/// request.
const CROWD: usize = 64 * 1024;
/// How long the poll thread is with the client while something is in flight: closing waits for
/// that. The client library ends each such visit with up to a millisecond of busy waiting.
const POLL: Duration = Duration::from_millis(200);
/// How often the poll thread looks for errors while nothing is.
const IDLE: Duration = Duration::from_millis(500);
/// How long a new client waits for its first answer.
const WARM_UP: Duration = Duration::from_secs(1);
/// How many answers it waits for.
const WARM_UPS: usize = 6;
/// How long it runs in between.
const WARM_UP_PAUSE: Duration = Duration::from_millis(15);
/// How often messages that wait are looked at for their deadlines.
const EXPIRY: Duration = Duration::from_millis(100);
/// How long to wait before a client is made again that could not be made.
const REMAKE: Duration = Duration::from_millis(500);

const LIMITS: OutboxLimits = OutboxLimits {
    lane_messages: 65_536,
    lane_bytes: 32 * 1024 * 1024,
    total_bytes: 64 * 1024 * 1024,
};

type Client = BaseProducer<SharedContext>;

/// One client that writes, and what waits for it.
pub(super) struct Producer {
    lot: Lot,
    outbox: Arc<Outbox<Target>>,
    client: Mutex<Option<Arc<Client>>>,
    context: Arc<WriteContext>,
    /// Messages are between the outbox and the client.
    handing_over: AtomicBool,
}

impl Producer {
    /// Makes the client, its task and its thread.
    pub(super) fn start(lot: Lot, shared: &Arc<Shared>) -> Result<Arc<Self>, String> {
        let producer = Arc::new(Self::new(lot, shared)?);
        let (polled, fed) = (Arc::clone(&producer), Arc::clone(&producer));
        let supervisor = &shared.supervisor;
        supervisor
            .spawn_thread(lot.as_str(), TaskPolicy::MayEnd, move || polled.poll())
            .map_err(|error| error.to_string())?;
        supervisor.spawn(lot.as_str(), TaskPolicy::MayEnd, async move { fed.feed().await });
        Ok(producer)
    }

    fn new(lot: Lot, shared: &Arc<Shared>) -> Result<Self, String> {
        let producer = Self {
            lot,
            outbox: Outbox::new(LIMITS),
            client: Mutex::new(None),
            context: Arc::new(WriteContext {
                shared: Arc::clone(shared),
                in_flight: AtomicUsize::new(0),
                waker: ThreadWaker::default(),
                room: Notify::new(),
                fatal: AtomicBool::new(false),
                warned: Mutex::new(None),
            }),
            handing_over: AtomicBool::new(false),
        };
        *producer.client.lock() = Some(producer.make_client().map_err(|error| error.to_string())?);
        Ok(producer)
    }

    fn shared(&self) -> &Shared {
        &self.context.shared
    }

    /// Lets the client connect and get its number from the server. By itself it tries so twice a
    /// second, and each try asks a connection at random, whether that is up or not; but also with
    /// each answer that it gets.
    fn warm_up(&self) {
        let Some(client) = self.client.lock().clone() else {
            return;
        };
        for _ in 0..WARM_UPS {
            if self.shared().stop.is_cancelled() {
                return;
            }
            if let Err(error) = client.client().fetch_metadata(None, WARM_UP) {
                tracing::debug!(producer = self.lot.as_str(), %error, "not connected beforehand");
                return;
            }
            client.poll(WARM_UP_PAUSE);
        }
    }

    fn make_client(&self) -> Result<Arc<Client>, KafkaError> {
        let context = SharedContext(Arc::clone(&self.context));
        self.shared().settings.producer(self.lot).create_with_context(context).map(Arc::new)
    }

    /// Whether the client gets an answer of the server. Waits for it.
    pub(super) fn is_answered(&self, topic: &str, timeout: Duration) -> bool {
        let client = self.client.lock().clone();
        client.is_none_or(|client| client.client().fetch_metadata(Some(topic), timeout).is_ok())
    }

    /// Lets the poll thread begin anew with a client that knows nothing. What the old one holds is
    /// dropped and counted.
    pub(super) fn remake(&self) {
        self.context.fatal.store(true, Ordering::Release);
        self.context.waker.wake();
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
        self.context.waker.wake();
    }

    /// Whether everything that was taken has been settled. Looked for in the order in which
    /// messages go.
    pub(super) fn is_drained(&self) -> bool {
        self.outbox.is_empty()
            && !self.handing_over.load(Ordering::Acquire)
            && self.context.in_flight.load(Ordering::Acquire) == 0
    }

    async fn feed(&self) {
        let stop = &self.shared().stop;
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
        // Before anything leaves the outbox, so that nothing is overlooked that is not in flight
        // yet.
        self.handing_over.store(true, Ordering::Release);
        self.hand_over_what_fits(taken, scratch);
        self.handing_over.store(false, Ordering::Release);
    }

    fn hand_over_what_fits(&self, taken: &mut Vec<Waiting<Target>>, scratch: &mut String) {
        while self.shared().gate.is_open() {
            let in_flight = self.context.in_flight.load(Ordering::Acquire);
            if in_flight >= CROWD {
                return;
            }
            let Some(client) = self.client.lock().clone() else {
                return;
            };
            // Topics with small batches have one turn in each take: what of them is handed over
            // goes together.
            let mut limited: Vec<Arc<str>> = Vec::new();
            let mut flights: HashMap<*const Topic, Arc<Flight>> = HashMap::new();
            let now = Instant::now();
            let allowance = |to: &Target| {
                let topic = &to.topic;
                let open =
                    topic.partitions().is_some() && self.shared().gate.lets(topic.stays_open);
                let allowed = topic.allowance().filter(|_| open)?;
                if allowed != usize::MAX {
                    if limited.contains(&topic.name) {
                        return None;
                    }
                    limited.push(Arc::clone(&topic.name));
                }
                if let Entry::Vacant(none) = flights.entry(Arc::as_ptr(topic)) {
                    none.insert(topic.depart(now)?);
                }
                Some(allowed)
            };
            let room = WINDOW - in_flight;
            self.outbox.take_ready(now, BATCH, room, in_flight == 0, allowance, taken);
            if taken.is_empty() {
                return;
            }
            // All at once, as librdkafka begins to send what it has with the first.
            let ready = taken.drain(..).map(|waiting| {
                let flight = flights.get(&Arc::as_ptr(&waiting.to.topic)).cloned();
                Ready::new(waiting, flight, scratch)
            });
            let ready: Vec<Ready> = ready.collect();
            drop(flights);
            for ready in ready {
                let topic = Arc::clone(&ready.delivery.topic);
                let mut record = BaseRecord::with_opaque_to(&topic.name, ready.delivery)
                    .payload(&ready.payload[..]);
                record.key = ready.key.as_deref();
                record.partition = ready.partition;
                record.headers = ready.headers;
                self.send(&client, record);
            }
        }
    }

    fn send(&self, client: &Client, record: BaseRecord<'_, str, [u8], Box<Delivery>>) {
        self.context.begin(&record.delivery_opaque);
        if let Err((error, record)) = client.send(record) {
            self.context.settle(*record.delivery_opaque, Some(&error));
        }
    }

    /// Writes the value of a key, or takes it away; `done` gets what became of it.
    pub(super) fn send_keyed(
        &self,
        topic: &Arc<Topic>,
        partition: Option<i32>,
        key: &str,
        value: Option<&Bytes>,
        done: oneshot::Sender<Fate>,
    ) {
        let Some(client) = self.client.lock().clone() else {
            return;
        };
        let delivery = Box::new(Delivery {
            receipt: Sent::Keyed(done),
            topic: Arc::clone(topic),
            bytes: key.len() + value.map_or(0, Bytes::len) + 1,
            sent: Instant::now(),
            flight: None,
        });
        let mut record = BaseRecord::with_opaque_to(&topic.name, delivery).key(key);
        record.partition = partition;
        record.payload = value.map(|value| &value[..]);
        self.send(&client, record);
    }

    /// Runs the callbacks until the end, and makes the client anew after a fatal error.
    fn poll(&self) {
        let stop = &self.shared().stop;
        self.warm_up();
        while !stop.is_cancelled() {
            let client = self.client.lock().clone();
            if let Some(client) = &client {
                if self.context.in_flight.load(Ordering::Acquire) > 0 {
                    client.poll(POLL);
                } else {
                    self.context.waker.wait(IDLE);
                    client.poll(Duration::ZERO);
                }
                let fatal = client.client().fatal_error();
                if fatal.is_none() && !self.context.fatal.load(Ordering::Acquire) {
                    continue;
                }
                let reason = fatal.map_or_else(
                    || "it gets no answer".to_owned(),
                    |(code, text)| format!("{code}: {text}"),
                );
                tracing::warn!(
                    producer = self.lot.as_str(),
                    reason,
                    "the Kafka producer is made anew"
                );
            }
            self.context.fatal.store(false, Ordering::Release);
            // What the old client held fails as it is dropped, and is not sent again.
            *self.client.lock() = None;
            drop(client);
            match self.make_client() {
                Ok(client) => *self.client.lock() = Some(client),
                Err(error) => {
                    self.shared().last_error.note(error.to_string());
                    std::thread::sleep(REMAKE);
                }
            }
            self.wake();
        }
        let client = self.client.lock().take();
        drop(client);
    }
}
