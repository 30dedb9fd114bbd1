//! Kafka as the broker of a layer.
//!
//! ```text
//! publisher ─► outbox ─► Producer (one per kind) ─► server ─► Consumer (small, large) ─► rings of subscriptions
//!                  Directory: metadata, offsets ◄── keeper thread: lives it? topics, positions ──► status
//! ```
//!
//! A channel is a topic; a message is a record whose headers are the message's header, as text ([`record`]). There is no
//! consumer group: each client reads all partitions at positions of its own. Topics are made by the flow of the layer alone
//! ([`flow_side`]); what a service publishes before that waits.

mod admin;
mod bell;
mod clock;
mod consumer;
mod context;
mod directory;
mod flow_side;
mod identity;
mod keeper;
mod keyed;
mod names;
mod producer;
mod read_to_end;
mod record;
mod settings;
mod topics;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::MAX_PAYLOAD_BYTES;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::KafkaBroker as Section;
use blaze_proto::Frame;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::message::Message as _;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::open::OpenError;
use crate::outbox::{Body, Lane};
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, FlowSide, Health, Later, PublishOutcome, Publisher,
    PublisherOptions, Received, Role, SubscribeOptions, Subscription, subscription,
};
use bell::Bell;
use clock::BrokerClock;
use consumer::{Consumer, Refused, Source};
use context::LastError;
use directory::{Directory, LookupError};
use flow_side::{FlowState, KafkaFlowSide};
use names::Names;
use producer::{Gate, Keying, Producer, Target};
use read_to_end::ReaderToEnd;
use settings::{Lot, Settings};
use topics::Topics;

/// Channels that one client reads at most.
const MAX_CHANNELS: usize = 10_000;
/// How long subscribing may take.
const SUBSCRIBE: Duration = Duration::from_secs(5);
/// How long reading what is kept for late joiners may take.
const SUBSCRIBE_KEPT: Duration = Duration::from_secs(15);
/// How long closing waits for what was taken.
const DRAIN: Duration = Duration::from_secs(1);
/// How long closing waits for threads and tasks beyond that.
const END: Duration = Duration::from_secs(3);
/// How often closing looks whether all was taken.
const DRAIN_TURN: Duration = Duration::from_millis(2);

/// A client of a Kafka cluster.
pub struct KafkaBroker {
    inner: Arc<Inner>,
}

/// Which of a kind there is one of.
#[derive(Default)]
struct Clients {
    producers: HashMap<Lot, Arc<Producer>>,
    consumers: HashMap<bool, Arc<Consumer>>,
}

/// Known after the first answer.
#[derive(Default)]
struct Once(Mutex<Option<String>>);

impl Once {
    fn get_or_init_with(&self, make: impl FnOnce() -> Option<String>) -> Option<String> {
        let mut known = self.0.lock();
        if known.is_none() {
            *known = make();
        }
        known.clone()
    }
}

/// What threads, tasks and publishers share.
struct Inner {
    settings: Settings,
    names: Names,
    /// Layer of the flow; empty for a service.
    layer: String,
    /// The topic that a service asks for to see whether the server answers.
    probe: Arc<str>,
    directory: Directory,
    topics: Topics,
    gate: Arc<Gate>,
    clock: Arc<Mutex<BrokerClock>>,
    last_error: Arc<LastError>,
    clients: Mutex<Clients>,
    flow: Option<Arc<FlowState>>,
    cluster: Once,
    status: watch::Sender<BrokerStatus>,
    was_up: AtomicBool,
    closed: AtomicBool,
    bell: Bell,
    supervisor: Supervisor,
    stop: CancellationToken,
}

impl KafkaBroker {
    /// Begins to connect, in the background. Must be called on a Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] for a property that the client library refuses or that may not be set, and for TLS where it is not
    /// built in.
    pub fn open(section: &Section, role: &Role) -> Result<Self, OpenError> {
        let settings = Settings::new(section)?;
        let names = Names::new(&section.prefix).map_err(|reason| OpenError::Setting {
            key: "kafka.prefix".to_owned(),
            reason,
        })?;
        let last_error = Arc::<LastError>::default();
        let refused = |reason: String| OpenError::Setting {
            key: "kafka.properties".to_owned(),
            reason,
        };
        let directory = Directory::new(&settings, &last_error).map_err(|error| refused(error.to_string()))?;
        let topics = Topics::default();
        let (layer, flow) = match role {
            Role::Service => (String::new(), None),
            Role::Flow { flow, .. } => {
                let state = FlowState::new(&names, &topics);
                (flow.layer.to_string(), Some(Arc::new(state)))
            }
        };
        let connecting = BrokerStatus {
            health: Health::Connecting,
            detail: format!("connecting to {}", section.bootstrap.join(", ")),
            since: Instant::now(),
        };
        let inner = Arc::new(Inner {
            probe: names.reserved(ChannelName::control().as_str()),
            settings,
            names,
            layer,
            directory,
            topics,
            gate: Arc::default(),
            clock: Arc::new(Mutex::new(BrokerClock::new(Instant::now()))),
            last_error,
            clients: Mutex::default(),
            flow,
            cluster: Once::default(),
            status: watch::Sender::new(connecting),
            was_up: AtomicBool::new(false),
            closed: AtomicBool::new(false),
            bell: Bell::default(),
            supervisor: Supervisor::new("kafka"),
            stop: CancellationToken::new(),
        });
        let broker = Self { inner };
        broker.start().map_err(refused)?;
        Ok(broker)
    }

    fn start(&self) -> Result<(), String> {
        let inner = &self.inner;
        let keeper = Arc::clone(inner);
        inner
            .supervisor
            .spawn_thread("kafka-keeper", TaskPolicy::MayEnd, move || keeper::run(&keeper))
            .map_err(|error| error.to_string())?;
        let Some(flow) = inner.flow.clone() else { return Ok(()) };
        // A new producer needs up to a second for its number: what is surely used gets it beforehand.
        let small = |reliable| {
            let lot = Lot { reliable, large: false };
            inner.producer(lot).map_err(|error| error.to_string())
        };
        small(false)?;
        let producer = small(true)?;
        let (gate, stop) = (Arc::clone(&inner.gate), inner.stop.clone());
        inner.supervisor.spawn("kafka-leases", TaskPolicy::MayEnd, async move {
            flow.keyed.run(&producer, &gate, &stop).await;
        });
        Ok(())
    }
}

impl Drop for KafkaBroker {
    fn drop(&mut self) {
        self.inner.begin_close();
        self.inner.end();
    }
}

impl Inner {
    fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    fn consumers(&self) -> Vec<Arc<Consumer>> {
        self.clients.lock().consumers.values().cloned().collect()
    }

    fn producers(&self) -> Vec<Arc<Producer>> {
        self.clients.lock().producers.values().cloned().collect()
    }

    fn producer(&self, lot: Lot) -> Result<Arc<Producer>, BrokerError> {
        let mut clients = self.clients.lock();
        if self.is_closed() {
            return Err(BrokerError::Closed);
        }
        if let Some(producer) = clients.producers.get(&lot) {
            return Ok(Arc::clone(producer));
        }
        let producer = Producer::start(
            lot,
            &self.settings,
            &self.gate,
            &self.clock,
            &self.last_error,
            &self.supervisor,
            &self.stop,
        )
        .map_err(BrokerError::Away)?;
        clients.producers.insert(lot, Arc::clone(&producer));
        Ok(producer)
    }

    fn consumer(&self, large: bool) -> Result<Arc<Consumer>, BrokerError> {
        let mut clients = self.clients.lock();
        if self.is_closed() {
            return Err(BrokerError::Closed);
        }
        if let Some(consumer) = clients.consumers.get(&large) {
            return Ok(Arc::clone(consumer));
        }
        let consumer = Consumer::start(
            large,
            &self.layer,
            &self.settings,
            &self.clock,
            &self.last_error,
            &self.supervisor,
            &self.stop,
        )
        .map_err(BrokerError::Away)?;
        clients.consumers.insert(large, Arc::clone(&consumer));
        Ok(consumer)
    }

    fn wake_writers(&self) {
        for producer in self.producers() {
            producer.wake();
        }
        if let Some(flow) = &self.flow {
            flow.keyed.wake();
        }
    }

    /// The server answers, or does not.
    fn set_server(&self, answers: bool, detail: String) {
        let was_up = self.was_up.swap(answers, Ordering::AcqRel);
        if answers && !was_up {
            tracing::info!(detail, "Kafka answers");
            self.wake_writers();
        } else if !answers && was_up {
            tracing::warn!(detail, "Kafka does not answer");
        }
        let taken = self.flow.as_ref().and_then(|flow| flow.stood_back.lock().clone());
        let (health, detail) = match (answers, taken) {
            (true, None) => (Health::Up, detail),
            (true, Some(whom)) => (Health::InUse, format!("scope_in_use: {whom}")),
            (false, _) => (Health::Down, detail),
        };
        self.set_status(health, detail);
    }

    fn set_status(&self, health: Health, detail: String) {
        self.status.send_if_modified(|status| {
            // Down is what was up before.
            let health = match (status.health, health) {
                (Health::Connecting, Health::Down) => Health::Connecting,
                (_, health) => health,
            };
            if status.health == Health::Closed || (status.health == health && status.detail == detail) {
                return false;
            }
            let since = if status.health == health {
                status.since
            } else {
                Instant::now()
            };
            *status = BrokerStatus { health, detail, since };
            true
        });
    }

    /// Another flow was first, or has gone.
    fn stand_back(&self, back: bool) {
        self.gate.set_stood_back(back);
        if back {
            for consumer in self.consumers() {
                consumer.stand_back();
            }
            for producer in self.producers() {
                producer.clear();
            }
        }
        // Only this change shows at once; that the scope is ours again shows with the server's next answer.
        let status = self.status.borrow().clone();
        if back && matches!(status.health, Health::Up | Health::InUse) {
            self.set_server(true, status.detail);
        }
        self.bell.ring();
        self.wake_writers();
    }

    /// Subscribes, and waits for the server meanwhile.
    fn subscribe(&self, channel: &ChannelName, options: SubscribeOptions) -> Result<Subscription, BrokerError> {
        let source = Source {
            channel: channel.clone(),
            topic: self.names.topic(channel)?,
            stays_open: names::stays_open(channel),
        };
        self.check_subscribe(&source)?;
        let wait = if options.with_kept { SUBSCRIBE_KEPT } else { SUBSCRIBE };
        let deadline = Instant::now() + wait;
        let consumer = self.consumer(options.large)?;
        if consumer.topics().len() >= MAX_CHANNELS {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        let info = match self.directory.topic(&source.topic, SUBSCRIBE) {
            Ok(info) => info,
            Err(LookupError::Missing(_)) => {
                let (sender, subscription) = subscription(options);
                consumer
                    .add_awaiting(&source, sender)
                    .map_err(|error| refused(&error))?;
                self.bell.ring();
                return Ok(subscription);
            }
            Err(error) => return Err(error.into()),
        };
        let marks = self.directory.marks(&source.topic, info.partitions, deadline)?;
        let mut ends: Vec<i64> = marks.iter().map(|mark| mark.high).collect();
        let (sender, subscription) = subscription(options);
        if !options.with_kept {
            consumer
                .add(&source, &info, ends, sender, None)
                .map_err(|error| refused(&error))?;
            return Ok(subscription);
        }
        let mut reader = ReaderToEnd::open(&self.settings, &self.last_error, &source.topic, &marks)?;
        loop {
            let starts = reader.read(&ends, deadline, &|| self.is_closed(), |message, payload| {
                let key = message.key()?;
                record::is_kept(key).then(|| consumer::receive(channel, message, payload, None, &self.clock))
            })?;
            let mut kept = || -> Vec<Received> { reader.take_latest().into_iter().map(|(_, kept)| kept).collect() };
            match consumer.add(&source, &info, starts, sender.clone(), Some(&mut kept)) {
                Ok(()) => return Ok(subscription),
                Err(Refused::Behind(next)) => ends = next,
                Err(error) => return Err(refused(&error)),
            }
        }
    }

    fn check_subscribe(&self, source: &Source) -> Result<(), BrokerError> {
        let status = self.status.borrow().clone();
        match status.health {
            Health::Closed => Err(BrokerError::Closed),
            Health::Up => Ok(()),
            Health::InUse if source.stays_open => Ok(()),
            Health::InUse | Health::Connecting | Health::Down => Err(BrokerError::Away(status.detail)),
        }
    }

    /// Takes nothing more.
    fn begin_close(&self) {
        self.closed.store(true, Ordering::Release);
        for producer in self.producers() {
            producer.close_outbox();
        }
    }

    fn is_drained(&self) -> bool {
        self.producers().iter().all(|producer| producer.is_drained())
            && self.flow.as_ref().is_none_or(|flow| flow.keyed.is_drained())
    }

    /// Ends readers, threads and tasks, without waiting for them.
    fn end(&self) {
        self.stop.cancel();
        self.bell.ring();
        for consumer in self.consumers() {
            consumer.close();
        }
        for producer in self.producers() {
            producer.end();
        }
        self.set_status(Health::Closed, "closed".to_owned());
    }
}

impl From<LookupError> for BrokerError {
    fn from(error: LookupError) -> Self {
        match error {
            LookupError::Closed => Self::Closed,
            LookupError::Missing(_) | LookupError::Away(_) => Self::Away(error.to_string()),
        }
    }
}

fn refused(error: &Refused) -> BrokerError {
    match error {
        Refused::Closed => BrokerError::Closed,
        Refused::Failed(reason) => BrokerError::Away(reason.clone()),
        Refused::Behind(_) => BrokerError::Away("the topic moves too fast".to_owned()),
    }
}

#[async_trait]
impl Broker for KafkaBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Kafka
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.inner.status.subscribe()
    }

    fn publisher(&self, channel: &ChannelName, options: PublisherOptions) -> Result<Arc<dyn Publisher>, BrokerError> {
        let inner = &self.inner;
        let name = inner.names.topic(channel)?;
        let producer = inner.producer(Lot {
            reliable: options.reliable,
            large: options.large,
        })?;
        let (topic, new) = inner.topics.of(&name, names::stays_open(channel));
        if new {
            inner.bell.ring();
        }
        let keying = if *channel == ChannelName::shared_reply() {
            Keying::AnswerId
        } else {
            Keying::Writer { depth: options.depth }
        };
        let stays_open = topic.stays_open;
        Ok(Arc::new(KafkaPublisher {
            lane: producer.lane(Target { topic, keying }),
            gate: Arc::clone(&inner.gate),
            stays_open,
        }))
    }

    async fn subscribe(&self, channel: &ChannelName, options: SubscribeOptions) -> Result<Subscription, BrokerError> {
        let (inner, channel) = (Arc::clone(&self.inner), channel.clone());
        let subscribe = tokio::task::spawn_blocking(move || inner.subscribe(&channel, options));
        subscribe.await.unwrap_or_else(|_| Err(BrokerError::Closed))
    }

    fn flow_side(&self) -> Option<Arc<dyn FlowSide>> {
        let state = Arc::clone(self.inner.flow.as_ref()?);
        Some(Arc::new(KafkaFlowSide {
            inner: Arc::clone(&self.inner),
            state,
        }))
    }

    async fn close(&self) {
        let inner = &self.inner;
        inner.begin_close();
        let until = Instant::now() + DRAIN;
        while !inner.is_drained() && Instant::now() < until && !inner.stop.is_cancelled() {
            tokio::time::sleep(DRAIN_TURN).await;
        }
        inner.end();
        let report = inner.supervisor.shutdown(END).await;
        if !report.is_clean() {
            tracing::warn!(?report, "closing Kafka left something behind");
        }
    }
}

struct KafkaPublisher {
    lane: Lane<Target>,
    gate: Arc<Gate>,
    stays_open: bool,
}

impl KafkaPublisher {
    fn push(&self, body: Body, payload: usize, deadline: Option<Instant>) -> PublishOutcome {
        if payload > MAX_PAYLOAD_BYTES {
            return PublishOutcome::TooLarge;
        }
        if !self.gate.lets(self.stays_open) {
            return PublishOutcome::Dropped;
        }
        self.lane.push(body, deadline)
    }
}

impl Publisher for KafkaPublisher {
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        self.push(Body::Frame(frame.clone()), frame.payload().len(), deadline)
    }

    fn publish_bare(&self, payload: &Bytes, deadline: Option<Instant>) -> PublishOutcome {
        self.push(Body::Bare(payload.clone()), payload.len(), deadline)
    }

    fn later(&self) -> Later {
        self.lane.later()
    }
}
