//! Writing: what publishers hand over waits in an outbox, of which little at a time is with
//! librdkafka.
//!
//! ```text
//! publish ─► outbox (bounds, deadlines) ─► feeding thread ─► librdkafka (≤ 1 MiB not acknowledged) ─► server
//!                                             ▲                    │
//!                                             └── ring ── delivery callback (poll threads): settles, measures the clock
//! ```
//!
//! Little is with librdkafka because from there nothing can be taken back: it has no deadline of a
//! message's own. What comes while messages of its topic are not acknowledged waits and goes
//! together, so that messages that come one by one and often do not each make a request.
//!
//! There are two clients. librdkafka takes what it gets as it comes: of messages that are handed
//! over together the first few make a request, and the others wait for its answer, as with an
//! idempotent producer only five messages of a partition are under way; until then it looks for
//! them without a pause, which takes half a processor. Few messages go to a client that sends at
//! once, and cannot be too many; more go to one that gathers them.

mod delivery;
mod ready;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use blaze_runtime::supervisor::TaskPolicy;
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::error::KafkaError;
use rdkafka::producer::{BaseProducer, BaseRecord, Producer as _};
use tokio::sync::oneshot;

use super::inner::Shared;
use super::settings::Lot;
use super::topics::{Topic, Which};
use super::waker::ThreadWaker;
use crate::outbox::{Fate, Lane, Outbox, OutboxLimits, Waiting};
use crate::wake::wait;
use delivery::{Delivery, Sent, SharedContext, WriteContext};
use ready::Ready;
pub(super) use ready::{Keying, Target};

/// Most bytes that are with librdkafka and not acknowledged; one larger message may be.
const WINDOW: usize = 1024 * 1024;
/// Messages that are handed over at once: no more than librdkafka gets while the gathering client
/// waits, or it would look for the rest without a pause.
const BATCH: usize = 256;
/// How long the gathering client waits for more. Handing a batch over takes up to 0.3 ms, and longer
/// where others have the processor: with 0.5 ms one batch in thirty was split, with 1 ms one in
/// three hundred.
const GATHER: Duration = Duration::from_millis(1);
/// How long the poll thread is with the client while something is in flight: closing waits for
/// that. The client library ends each such visit with up to a millisecond of busy waiting.
const POLL: Duration = Duration::from_millis(200);
/// How often the poll threads look for errors while nothing is.
const IDLE: Duration = Duration::from_secs(2);
/// How long nothing must have been in flight until what is sent next is looked for in between
/// pauses, and how often.
const CALM: Duration = Duration::from_millis(10);
const PAUSES: usize = 8;
const PAUSE: Duration = Duration::from_millis(1);
/// How long clients that are to be made anew may still be answered.
const SETTLE: Duration = Duration::from_secs(2);
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

struct Clients {
    prompt: Client,
    gathering: Client,
}

impl Clients {
    fn get(&self, which: Which) -> &Client {
        match which {
            Which::Prompt => &self.prompt,
            Which::Gathering => &self.gathering,
        }
    }
}

/// Two clients that write, and what waits for them.
pub(super) struct Producer {
    lot: Lot,
    outbox: Arc<Outbox<Target>>,
    clients: Mutex<Option<Arc<Clients>>>,
    context: Arc<WriteContext>,
    /// Messages are between the outbox and the client.
    handing_over: AtomicBool,
}

impl Producer {
    /// Makes the clients and the threads.
    pub(super) fn start(lot: Lot, shared: &Arc<Shared>) -> Result<Arc<Self>, String> {
        let producer = Arc::new(Self::new(lot, shared)?);
        let run = |work: fn(&Self)| {
            let producer = Arc::clone(&producer);
            let started =
                shared
                    .supervisor
                    .spawn_thread(lot.as_str(), TaskPolicy::MayEnd, move || work(&producer));
            started.map(drop).map_err(|error| error.to_string())
        };
        run(Self::feed)?;
        run(Self::poll_gathering)?;
        run(Self::poll)?;
        Ok(producer)
    }

    fn new(lot: Lot, shared: &Arc<Shared>) -> Result<Self, String> {
        let outbox = Outbox::new(LIMITS);
        let producer = Self {
            lot,
            outbox: Arc::clone(&outbox),
            clients: Mutex::new(None),
            context: Arc::new(WriteContext {
                lot,
                shared: Arc::clone(shared),
                in_flight: AtomicUsize::new(0),
                outbox,
                prompt: ThreadWaker::default(),
                gathering: ThreadWaker::default(),
                wants_new_clients: AtomicBool::new(false),
                warned: Mutex::new(None),
            }),
            handing_over: AtomicBool::new(false),
        };
        *producer.clients.lock() =
            Some(producer.make_clients().map_err(|error| error.to_string())?);
        Ok(producer)
    }

    fn shared(&self) -> &Shared {
        &self.context.shared
    }

    /// Lets the client connect and get its number from the server. By itself it tries so twice a
    /// second, and each try asks a connection at random, whether that is up or not; but also with
    /// each answer that it gets.
    fn warm_up(&self, which: Which) {
        let Some(clients) = self.clients.lock().clone() else {
            return;
        };
        let client = clients.get(which);
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

    fn make_clients(&self) -> Result<Arc<Clients>, KafkaError> {
        let make = |gathers| {
            let context = SharedContext(Arc::clone(&self.context));
            self.shared().settings.producer(self.lot, gathers).create_with_context(context)
        };
        Ok(Arc::new(Clients { prompt: make(None)?, gathering: make(Some(GATHER))? }))
    }

    /// Whether both clients get an answer of the server. Waits for it.
    pub(super) fn is_answered(&self, topic: &str, timeout: Duration) -> bool {
        let Some(clients) = self.clients.lock().clone() else {
            return true;
        };
        [&clients.prompt, &clients.gathering]
            .iter()
            .all(|client| client.client().fetch_metadata(Some(topic), timeout).is_ok())
    }

    /// Lets the poll thread begin anew with clients that know nothing. What the old ones hold is
    /// dropped and counted.
    pub(super) fn remake(&self) {
        self.context.ask_for_new_clients();
    }

    /// A queue for a publisher.
    pub(super) fn lane(&self, target: Target) -> Lane<Target> {
        self.outbox.lane(target, Some(self.lot.longest_wait()))
    }

    /// Something may have become possible.
    pub(super) fn wake(&self) {
        self.outbox.ring();
    }

    /// Drops all that waits.
    pub(super) fn clear(&self) {
        self.outbox.clear(DropReason::BrokerError);
    }

    /// Takes nothing more from publishers.
    pub(super) fn close_outbox(&self) {
        self.outbox.close();
    }

    /// Lets the threads look whether it is over.
    pub(super) fn end(&self) {
        self.clear();
        self.outbox.ring();
        self.context.prompt.wake();
        self.context.gathering.wake();
    }

    /// Whether everything that was taken has been settled. Looked for in the order in which
    /// messages go.
    pub(super) fn is_drained(&self) -> bool {
        self.outbox.is_empty()
            && !self.handing_over.load(Ordering::Acquire)
            && self.context.in_flight.load(Ordering::Acquire) == 0
    }

    fn feed(&self) {
        let mut taken = Vec::with_capacity(BATCH);
        let mut scratch = String::new();
        let mut looked = Instant::now();
        while !self.shared().stop.is_cancelled() {
            self.hand_over(&mut taken, &mut scratch);
            let waits = !self.outbox.is_empty();
            wait(self.outbox.filled(), if waits { EXPIRY } else { IDLE });
            let now = Instant::now();
            if now.saturating_duration_since(looked) >= EXPIRY {
                looked = now;
                self.outbox.expire(now);
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
        while self.shared().gate.is_open()
            && !self.context.wants_new_clients.load(Ordering::Acquire)
        {
            let in_flight = self.context.in_flight.load(Ordering::Acquire);
            if in_flight >= WINDOW {
                return;
            }
            let Some(clients) = self.clients.lock().clone() else {
                return;
            };
            // Topics with small batches have one turn in each take: what of them is handed over
            // goes together.
            let mut limited: Vec<Arc<str>> = Vec::new();
            let now = Instant::now();
            let allowance = |to: &Target| {
                let topic = &to.topic;
                let open =
                    topic.partitions().is_some() && self.shared().gate.lets(topic.stays_open);
                let allowed = topic.allowance(self.lot, now).filter(|_| open)?;
                if allowed != usize::MAX {
                    if limited.contains(&topic.name) {
                        return None;
                    }
                    limited.push(Arc::clone(&topic.name));
                }
                Some(allowed)
            };
            let room = WINDOW - in_flight;
            self.outbox.take_ready(now, BATCH, room, in_flight == 0, allowance, taken);
            if taken.is_empty() {
                return;
            }
            taken.iter().for_each(|waiting| waiting.to.topic.announce(self.lot));
            // All at once, as librdkafka begins to look at what it has with the first.
            let ready: Vec<Ready> =
                taken.drain(..).map(|waiting| Ready::new(self.lot, waiting, scratch)).collect();
            let begin = Instant::now();
            let mut gathers = false;
            for ready in ready {
                let topic = Arc::clone(&ready.delivery.topic);
                let mut record = BaseRecord::with_opaque_to(&topic.name, ready.delivery)
                    .payload(&ready.payload[..]);
                record.key = ready.key.as_deref();
                record.partition = ready.partition;
                record.headers = ready.headers;
                let which = record.delivery_opaque.which;
                gathers |= which == Which::Gathering;
                self.send(clients.get(which), record);
            }
            self.context.prompt.wake();
            if gathers {
                self.context.gathering.wake();
                // By itself it would look a millisecond later. What comes meanwhile goes with the
                // next.
                std::thread::sleep(GATHER.saturating_sub(begin.elapsed()));
                // No wait: it only wakes the client.
                let _ = clients.gathering.flush(Duration::ZERO);
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
        // Dropped, `done` says that it was not taken.
        if self.context.wants_new_clients.load(Ordering::Acquire) {
            return;
        }
        let Some(clients) = self.clients.lock().clone() else {
            return;
        };
        topic.announce(self.lot);
        let sent = Instant::now();
        let which = topic.depart(self.lot, sent);
        let delivery = Box::new(Delivery {
            receipt: Sent::Keyed(done),
            topic: Arc::clone(topic),
            bytes: key.len() + value.map_or(0, Bytes::len) + 1,
            sent,
            which,
        });
        let mut record = BaseRecord::with_opaque_to(&topic.name, delivery).key(key);
        record.partition = partition;
        record.payload = value.map(|value| &value[..]);
        self.send(clients.get(which), record);
        self.context.waker(which).wake();
    }

    /// Runs the callbacks of the gathering client until the end.
    fn poll_gathering(&self) {
        self.warm_up(Which::Gathering);
        let mut calm = true;
        while !self.shared().stop.is_cancelled() {
            let clients = self.clients.lock().clone();
            match clients {
                Some(clients) => serve(&clients.gathering, &self.context.gathering, &mut calm),
                None => self.context.gathering.wait(IDLE),
            }
        }
    }

    /// Runs the callbacks until the end, and makes the clients anew after a fatal error and when
    /// that is asked for.
    fn poll(&self) {
        let stop = &self.shared().stop;
        self.warm_up(Which::Prompt);
        let mut calm = true;
        while !stop.is_cancelled() {
            let clients = self.clients.lock().clone();
            let mut is_fatal = false;
            if let Some(clients) = &clients {
                serve(&clients.prompt, &self.context.prompt, &mut calm);
                let fatal = clients.prompt.client().fatal_error();
                let fatal = fatal.or_else(|| clients.gathering.client().fatal_error());
                is_fatal = fatal.is_some();
                if !is_fatal && !self.context.wants_new_clients.load(Ordering::Acquire) {
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
                if !is_fatal {
                    self.settle(&clients.prompt);
                }
            }
            match self.make_clients() {
                // What the old ones held fails as they are dropped, and is not sent again.
                Ok(made) => *self.clients.lock() = Some(made),
                Err(error) => {
                    self.shared().last_error.note(error.to_string());
                    if is_fatal {
                        *self.clients.lock() = None;
                    }
                    std::thread::sleep(REMAKE);
                }
            }
            self.context.wants_new_clients.store(false, Ordering::Release);
            // It may hold the old ones, too.
            self.context.gathering.wake();
            drop(clients);
            self.wake();
        }
        let clients = self.clients.lock().take();
        drop(clients);
    }

    /// Gives what is in flight a while to be answered; nothing more is handed over meanwhile.
    fn settle(&self, prompt: &Client) {
        let until = Instant::now() + SETTLE;
        let waits = || self.context.in_flight.load(Ordering::Acquire) > 0;
        while waits() && Instant::now() < until && !self.shared().stop.is_cancelled() {
            std::thread::sleep(PAUSE);
            prompt.poll(Duration::ZERO);
        }
    }
}

/// Runs callbacks of a client while something is in flight, else waits for a wake-up. `calm`:
/// whether nothing was for a while.
fn serve(client: &Client, waker: &ThreadWaker, calm: &mut bool) {
    if client.in_flight_count() == 0 {
        let since = Instant::now();
        waker.wait(IDLE);
        *calm = since.elapsed() >= CALM;
        // Also errors.
        client.poll(Duration::ZERO);
        return;
    }
    // The client spins through the last millisecond of a wait, which it never ends early: much for
    // a single message.
    for _ in 0..if std::mem::take(calm) { PAUSES } else { 0 } {
        std::thread::sleep(PAUSE);
        client.poll(Duration::ZERO);
        if client.in_flight_count() == 0 {
            return;
        }
    }
    client.poll(POLL);
}
