//! What threads, tasks and publishers of one broker share.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use blaze_runtime::supervisor::Supervisor;
use parking_lot::Mutex;
use rdkafka::message::Message as _;
use tokio_util::sync::CancellationToken;

use super::admin::Admin;
use super::clock::BrokerClock;
use super::consumer::{Consumer, Join, Refused, Source};
use super::context::LastError;
use super::directory::{Directory, LookupError, Marks};
use super::flow_side::FlowState;
use super::gate::Gate;
use super::names::{self, Names};
use super::producer::Producer;
use super::read_to_end::ReaderToEnd;
use super::receive::receive;
use super::record;
use super::settings::{Lot, Settings};
use super::topic_creator::TopicCreator;
use super::topics::Topics;
use super::waker::ThreadWaker;
use crate::port::{
    Begin, BrokerError, Health, Received, StatusCell, SubscribeOptions, Subscription, subscription,
};

/// Channels that one client reads at most, and a worker makes.
pub(super) const MAX_CHANNELS: usize = 10_000;
/// How long subscribing may take.
const SUBSCRIBE: Duration = Duration::from_secs(5);
/// How often a server is asked again that names ends which do not hold where a reader is to begin.
const DOUBTS: usize = 10;
/// The pause before each of these questions.
const DOUBT: Duration = Duration::from_millis(200);
/// How long reading what is kept for late joiners may take.
const SUBSCRIBE_KEPT: Duration = Duration::from_secs(15);

/// Which of a kind there is one of.
#[derive(Default)]
pub(super) struct Clients {
    pub(super) producers: HashMap<Lot, Arc<Producer>>,
    pub(super) consumers: HashMap<bool, Arc<Consumer>>,
}

/// What all clients of one broker use.
pub(super) struct Shared {
    pub(super) settings: Settings,
    /// [`Settings::secrets`] that clients were last made with.
    secrets: Mutex<u64>,
    pub(super) gate: Gate,
    pub(super) clock: Mutex<BrokerClock>,
    pub(super) last_error: Arc<LastError>,
    pub(super) supervisor: Supervisor,
    pub(super) stop: CancellationToken,
}

impl Shared {
    pub(super) fn new(settings: Settings) -> Arc<Self> {
        Arc::new(Self {
            secrets: Mutex::new(settings.secrets()),
            settings,
            gate: Gate::default(),
            clock: Mutex::new(BrokerClock::new(Instant::now())),
            last_error: Arc::default(),
            supervisor: Supervisor::new("kafka"),
            stop: CancellationToken::new(),
        })
    }

    /// Whether passwords and certificates are others than at the last call, or the start.
    fn secrets_changed(&self) -> bool {
        let now = self.settings.secrets();
        std::mem::replace(&mut *self.secrets.lock(), now) != now
    }
}

/// What threads, tasks and publishers share.
pub(super) struct Inner {
    pub(super) shared: Arc<Shared>,
    pub(super) names: Names,
    /// Layer of the flow; empty for a service.
    pub(super) layer: String,
    /// The topic that a service asks for to see whether the server answers.
    pub(super) probe: Arc<str>,
    pub(super) directory: Directory,
    pub(super) topics: Topics,
    pub(super) clients: Mutex<Clients>,
    pub(super) flow: Option<Arc<FlowState>>,
    /// Of a worker.
    pub(super) worker: Option<Arc<TopicCreator>>,
    pub(super) cluster: OnceLock<String>,
    pub(super) admin: Mutex<Option<Arc<Admin>>>,
    pub(super) status: StatusCell,
    pub(super) was_up: AtomicBool,
    /// Whether it is in the log that the server did not answer from the beginning.
    pub(super) logged_absence: AtomicBool,
    pub(super) closed: AtomicBool,
    pub(super) waker: ThreadWaker,
}

impl Inner {
    pub(super) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Creates topics, where this client does: it must know all that there are.
    pub(super) fn creator(&self) -> Option<&TopicCreator> {
        let flow = self.flow.as_ref().map(|flow| &flow.creator);
        flow.or(self.worker.as_deref())
    }

    /// The client that makes topics and asks for their settings, made at first use.
    pub(super) fn admin(&self) -> Result<Arc<Admin>, String> {
        let mut admin = self.admin.lock();
        if let Some(admin) = &*admin {
            return Ok(Arc::clone(admin));
        }
        let made = Admin::new(&self.shared.settings, &self.shared.last_error)
            .map_err(|error| error.to_string())?;
        Ok(Arc::clone(admin.insert(Arc::new(made))))
    }

    /// Ends that client. Blocks meanwhile.
    pub(super) fn close_admin(&self) {
        let admin = self.admin.lock().take();
        drop(admin);
    }

    pub(super) fn consumers(&self) -> Vec<Arc<Consumer>> {
        self.clients.lock().consumers.values().cloned().collect()
    }

    pub(super) fn producers(&self) -> Vec<Arc<Producer>> {
        self.clients.lock().producers.values().cloned().collect()
    }

    pub(super) fn producer(&self, lot: Lot) -> Result<Arc<Producer>, BrokerError> {
        let mut clients = self.clients.lock();
        if self.is_closed() {
            return Err(BrokerError::Closed);
        }
        if let Some(producer) = clients.producers.get(&lot) {
            return Ok(Arc::clone(producer));
        }
        let producer = Producer::start(lot, &self.shared).map_err(BrokerError::Away)?;
        clients.producers.insert(lot, Arc::clone(&producer));
        Ok(producer)
    }

    pub(super) fn consumer(&self, large: bool) -> Result<Arc<Consumer>, BrokerError> {
        let mut clients = self.clients.lock();
        if self.is_closed() {
            return Err(BrokerError::Closed);
        }
        if let Some(consumer) = clients.consumers.get(&large) {
            return Ok(Arc::clone(consumer));
        }
        let consumer =
            Consumer::start(large, &self.layer, &self.shared).map_err(BrokerError::Away)?;
        clients.consumers.insert(large, Arc::clone(&consumer));
        Ok(consumer)
    }

    /// Makes all clients anew if passwords and certificates are others than those that they began
    /// with. Blocks while the old ones end.
    pub(super) fn follow_secrets(&self) {
        if !self.shared.secrets_changed() {
            return;
        }
        tracing::info!("passwords or certificates of Kafka are others now: connecting anew");
        if let Err(error) = self.directory.remake() {
            self.shared.last_error.note(error.to_string());
        }
        self.close_admin();
        for producer in self.producers() {
            producer.remake();
        }
        for consumer in self.consumers() {
            if let Err(error) = consumer.remake() {
                self.shared.last_error.note(error);
            }
        }
    }

    pub(super) fn wake_writers(&self) {
        for producer in self.producers() {
            producer.wake();
        }
        if let Some(flow) = &self.flow {
            flow.keyed.wake();
        }
    }

    /// The server answers, or does not.
    pub(super) fn set_server(&self, answers: bool, detail: String) {
        let was_up = self.was_up.swap(answers, Ordering::AcqRel);
        if answers && !was_up {
            tracing::info!(detail, "Kafka answers");
            self.wake_writers();
        } else if !answers && (was_up || !self.logged_absence.swap(true, Ordering::AcqRel)) {
            tracing::warn!(detail, "Kafka does not answer");
        }
        let taken = self.flow.as_ref().and_then(|flow| flow.stood_back.lock().clone());
        let (health, detail) = match (answers, taken) {
            (true, None) => (Health::Up, detail),
            (true, Some(whom)) => (Health::InUse, format!("scope_in_use: {whom}")),
            // Down is what was up before.
            (false, _) if self.status.borrow().health == Health::Connecting => {
                (Health::Connecting, detail)
            }
            (false, _) => (Health::Down, detail),
        };
        self.status.set(health, &detail);
    }

    /// Another flow was first, or has gone.
    pub(super) fn stand_back(&self, back: bool) {
        self.shared.gate.set_stood_back(back);
        if back {
            for consumer in self.consumers() {
                consumer.stand_back();
            }
            for producer in self.producers() {
                producer.clear();
            }
        }
        // Only this change shows at once; that the scope is ours again shows with the server's next
        // answer.
        let status = self.status.borrow().clone();
        if back && matches!(status.health, Health::Up | Health::InUse) {
            self.set_server(true, status.detail);
        }
        self.waker.wake();
        self.wake_writers();
    }

    /// Subscribes, and waits for the server meanwhile.
    pub(super) fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
        begin: &Begin,
    ) -> Result<Subscription, BrokerError> {
        let source = Source {
            channel: channel.clone(),
            topic: self.names.topic(channel)?,
            stays_open: names::stays_open(channel),
        };
        self.check_subscribe(&source)?;
        let wait = if options.with_kept { SUBSCRIBE_KEPT } else { SUBSCRIBE };
        let deadline = Instant::now() + wait;
        let consumer = self.consumer(options.large)?;
        if consumer.count() >= MAX_CHANNELS {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        let info = match self.directory.topic(&source.topic, SUBSCRIBE) {
            Ok(info) => info,
            Err(LookupError::Missing(_)) => {
                let (sender, subscription) = subscription(options);
                consumer.add_awaiting(&source, sender).map_err(|error| refused(&error))?;
                self.waker.wake();
                return Ok(subscription.starting_at(vec![0]));
            }
            Err(error) => return Err(error.into()),
        };
        let marks = self.marks(&source.topic, info.partitions, begin, deadline)?;
        let mut ends: Vec<i64> = marks.iter().map(|mark| mark.high).collect();
        let (sender, subscription) = subscription(options);
        if !options.with_kept {
            let starts = self.starts(&source.topic, &marks, begin)?;
            let join = match begin {
                Begin::Now => Join::Following,
                Begin::At(_) | Begin::Since { .. } => Join::Rewinding,
            };
            consumer
                .add(&source, &info, starts.clone(), sender, join)
                .map_err(|error| refused(&error))?;
            return Ok(subscription.starting_at(starts));
        }
        let mut reader = ReaderToEnd::open(&self.shared, &source.topic, &marks)?;
        loop {
            let starts =
                reader.read(&ends, deadline, &|| self.is_closed(), |message, payload| {
                    let key = message.key()?;
                    // On channels of BlazeAIoT's own, whatever has a key is the last word about it.
                    let is_kept = channel.is_reserved() || record::is_kept(key);
                    is_kept.then(|| receive(channel, message, payload, None, &self.shared.clock))
                })?;
            let mut kept = || -> Vec<Received> {
                reader.take_latest().into_iter().map(|(_, message)| as_kept(message)).collect()
            };
            let join = Join::AfterKept(&mut kept);
            match consumer.add(&source, &info, starts.clone(), sender.clone(), join) {
                // What is kept has been before.
                Ok(()) => return Ok(subscription.starting_at(starts)),
                Err(Refused::Behind(next)) => ends = next,
                Err(error) => return Err(refused(&error)),
            }
        }
    }

    /// Where a topic begins and ends. If that does not hold where a reader is to begin, it is asked
    /// again for a while: a server that stood still for a moment names other ends first, and a
    /// reader that believed them would leave out records.
    fn marks(
        &self,
        topic: &str,
        partitions: usize,
        begin: &Begin,
        deadline: Instant,
    ) -> Result<Vec<Marks>, LookupError> {
        let mut doubts = DOUBTS;
        loop {
            let marks = self.directory.marks(topic, partitions, deadline)?;
            let holds = match begin {
                Begin::At(offsets) => {
                    marks.iter().zip(&**offsets).all(|(mark, offset)| mark.holds(*offset))
                }
                Begin::Now | Begin::Since { .. } => true,
            };
            if holds || doubts == 0 || self.is_closed() {
                return Ok(marks);
            }
            doubts -= 1;
            std::thread::sleep(DOUBT);
        }
    }

    /// Offsets at which a reader begins: those that it asks for, as far as the server has them.
    fn starts(&self, topic: &str, marks: &[Marks], begin: &Begin) -> Result<Vec<i64>, BrokerError> {
        let wanted: Vec<Option<i64>> = match begin {
            Begin::Now => vec![None; marks.len()],
            Begin::At(offsets) => (0..marks.len()).map(|at| offsets.get(at).copied()).collect(),
            Begin::Since { appended_ms, latest } => {
                let found = self.directory.since(topic, marks.len(), *appended_ms, SUBSCRIBE)?;
                let ends = marks.iter().map(|mark| mark.high);
                let bound = |at: usize| latest.get(at).copied().unwrap_or(i64::MAX);
                let first = found.into_iter().zip(ends).enumerate();
                first.map(|(at, (found, end))| Some(found.unwrap_or(end).min(bound(at)))).collect()
            }
        };
        let start = |(mark, wanted): (&Marks, Option<i64>)| match wanted {
            Some(offset) => offset.clamp(mark.low, mark.high.max(mark.low)),
            None => mark.high,
        };
        Ok(marks.iter().zip(wanted).map(start).collect())
    }

    fn check_subscribe(&self, source: &Source) -> Result<(), BrokerError> {
        let status = self.status.borrow().clone();
        match status.health {
            Health::Closed => Err(BrokerError::Closed),
            Health::Up => Ok(()),
            Health::InUse if source.stays_open => Ok(()),
            Health::InUse | Health::Connecting | Health::Down => {
                Err(BrokerError::Away(status.detail))
            }
        }
    }

    /// Takes nothing more.
    pub(super) fn begin_close(&self) {
        self.closed.store(true, Ordering::Release);
        for producer in self.producers() {
            producer.close_outbox();
        }
    }

    pub(super) fn is_drained(&self) -> bool {
        self.producers().iter().all(|producer| producer.is_drained())
            && self.flow.as_ref().is_none_or(|flow| flow.keyed.is_drained())
    }

    /// Ends readers, threads and tasks, without waiting for them.
    pub(super) fn end(&self) {
        self.shared.stop.cancel();
        self.waker.wake();
        for producer in self.producers() {
            producer.end();
        }
        self.status.set(Health::Closed, "closed");
    }
}

fn as_kept(message: Received) -> Received {
    Received { kept: true, ..message }
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
