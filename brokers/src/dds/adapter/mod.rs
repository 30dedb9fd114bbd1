//! What adapters on DDS share: topics are written and read by a participant that is built anew when
//! RustDDS dies. What differs (names, types, what a sample holds) is a [`Dialect`].
//!
//! ```text
//! publisher ─► outbox ─► Sender ─► Slot (a DDS writer) ─► RustDDS ─► network
//! network ─► RustDDS ─► reading threads (small, large) ─► Channel (one or two DDS readers) ─► readers' rings, sinks
//! Sender: in the publisher's thread while little is written, else in one of its own
//! lifecycle thread: participant, writers, readers; presence of others; builds all anew when RustDDS dies
//! ```
//!
//! There is no server: the broker is up while a participant stands on the interface. A participant
//! that dies without a good-bye would hold the windows of all reliable writers for as long as its
//! lease; `presence` finds it, and `farewell` says good-bye in its name, to the own participant
//! only.

mod channel;
mod deliver;
mod doubtful;
mod kept;
mod life;
mod make;
mod near;
mod presence;
mod probe;
mod seen;
mod send;
mod shared;
mod slot;

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use blaze_domain::{DropReason, WriterId};
use parking_lot::Mutex;
use rustdds::WriteOptionsBuilder;
use tokio::sync::watch;

use super::participant::TimingQos;
use super::reader::StoppableThread;
use super::{
    Cdr, DdsError, EndpointId, Endpoints, GuidPrefix, Participant, ParticipantConfig, Sample,
    Writer, Written,
};
use crate::outbox::{Admission as OutboxAdmission, Body, LanePublisher};
use crate::port::{
    BrokerError, BrokerStatus, Content, PublisherOptions, SubscribeOptions, Subscription,
    SubscriptionSender,
};
use send::Target;
use shared::Shared;

pub(crate) use channel::MAX_CHANNELS;
pub(crate) use deliver::nanos;
pub(crate) use doubtful::LONGEST_DOUBT;
pub(crate) use make::Others;
pub(crate) use send::MAX_ORIGINS;
pub use shared::MAX_QUEUE_BYTES;

/// How long closing delivers what was taken.
const DRAIN: Duration = Duration::from_secs(1);
/// How long readers have to take what they have acknowledged, before its writer goes: RustDDS
/// forgets what was not read of a writer that has gone.
const LINGER: Duration = Duration::from_millis(150);
/// How long a message may wait for RustDDS.
const LONGEST_WAIT: Duration = Duration::from_secs(5);
/// The same of one that must not be lost.
const RELIABLE_WAIT: Duration = Duration::from_secs(120);
/// How long a subscription may take to be made.
const SUBSCRIBE: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(5);

/// A DDS topic, as its readers and writers are made.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Topic {
    pub(crate) name: Arc<str>,
    /// The topic as users name it.
    pub(crate) user: Arc<str>,
    pub(crate) type_name: Arc<str>,
    pub(crate) timing: TimingQos,
}

/// A message as RustDDS is given it.
pub(crate) struct Encoded {
    pub(crate) cdr: Cdr,
    pub(crate) options: WriteOptionsBuilder,
}

/// Whether samples of a writer are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Admission {
    Yes,
    No,
    /// It is not known yet: they wait, at most [`LONGEST_DOUBT`].
    Later,
}

/// A message that a sample holds.
pub(crate) struct Decoded {
    pub(crate) content: Content,
    /// How long it was on its way at least, where the sample tells.
    pub(crate) age_us: u64,
}

/// Why a sample is no message.
pub(crate) enum NoMessage {
    Malformed,
    /// It is for readers of other participants.
    NotForUs,
}

/// What one adapter does differently from others.
pub(crate) trait Dialect: Send + Sync + 'static {
    /// The participant that it needs.
    fn participant(&self, domain: u16, address: Ipv4Addr) -> ParticipantConfig;

    /// What a new participant does beside readers and writers of topics.
    ///
    /// # Errors
    /// [`DdsError`] when RustDDS refuses or has died.
    fn companion(
        &self,
        participant: &Participant,
        now: Instant,
    ) -> Result<Box<dyn Companion>, DdsError>;

    /// The topic on which participants of this kind tell that they live.
    fn sign_topic(&self) -> Option<&'static str> {
        None
    }

    /// All readers and writers that others have.
    fn note_endpoints(&self, endpoints: &Endpoints);

    /// A reader of a topic that meets reliable writers stands, or no longer. All have gone with
    /// their participant when there is a new [companion](Self::companion).
    fn note_reader(&self, _topic: &Topic, _reader: EndpointId, _stands: bool) {}

    /// Whether samples of a writer are read as a topic's. It may not have been found yet.
    fn admission(&self, _topic: &Topic, _writer: &EndpointId) -> Admission {
        Admission::Yes
    }

    /// What a sample of another participant holds, or what an own writer keeps.
    ///
    /// # Errors
    /// Why it is no message.
    fn decode(&self, topic: &Topic, sample: &Sample) -> Result<Decoded, NoMessage>;

    /// The sample of a message. `durable`: it is kept for late joiners.
    ///
    /// # Errors
    /// Why it is dropped.
    fn encode(&self, topic: &Topic, message: &Body, durable: bool) -> Result<Encoded, DropReason>;

    /// Hands a message to its writer.
    ///
    /// # Errors
    /// Why it is dropped.
    fn write(
        &self,
        topic: &Topic,
        message: &Body,
        durable: bool,
        writer: &Writer,
    ) -> Result<Written, DropReason> {
        let Encoded { cdr, options } = self.encode(topic, message, durable)?;
        Ok(writer.write_cdr(cdr, options))
    }

    /// What own readers of a topic get of a message that this participant writes, if anything.
    fn own(&self, topic: &Topic, message: &Body) -> Option<Content>;
}

/// What belongs to one life of a participant, beside readers and writers of topics.
pub(crate) trait Companion: Send {
    /// Is called some times a second. Returns whether others have given this participant up.
    fn tick(&mut self, now: Instant, own: GuidPrefix, others: &Others<'_>) -> bool;
}

/// What a broker has counted since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DdsCounts {
    /// Samples that were malformed, each once, and not those from before its topic was read.
    pub malformed: u64,
    /// How often RustDDS died and was built anew.
    pub rebuilds: u64,
    /// Participants to whom good-bye was said in their absence.
    pub expelled: u64,
    /// Bytes of samples that wait now until it is known whether they are read.
    pub undecided_bytes: usize,
}

/// A participant with its threads.
pub(crate) struct Adapter {
    shared: Arc<Shared>,
    threads: Mutex<Vec<StoppableThread>>,
}

impl Adapter {
    /// Starts in the background: the status tells how far it is. An interface that is missing is no
    /// error: it is looked for each second.
    ///
    /// # Errors
    /// [`DdsError`] where there is no thread for it.
    pub(crate) fn open(
        dialect: Arc<dyn Dialect>,
        domain: u16,
        address: Ipv4Addr,
    ) -> Result<Self, DdsError> {
        let shared = Shared::new(dialect, domain, address);
        let threads = vec![
            life::start(&shared)?,
            send::start(&shared)?,
            channel::start(&shared, false)?,
            channel::start(&shared, true)?,
        ];
        Ok(Self { shared, threads: Mutex::new(threads) })
    }

    pub(crate) fn counts(&self) -> DdsCounts {
        let undecided_bytes = self.shared.channels.undecided_bytes();
        DdsCounts { undecided_bytes, ..*self.shared.counts.lock() }
    }

    pub(crate) fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.shared.status.subscribe()
    }

    /// Ends or blocks the event loop of RustDDS, for tests of what follows.
    #[cfg(feature = "fault-injection")]
    pub(crate) fn inject(&self, fault: super::Fault) {
        *self.shared.fault.lock() = Some(fault);
        self.shared.wake_lifecycle();
    }

    /// Whether topics can be read and written now.
    pub(crate) fn check_up(&self) -> Result<(), BrokerError> {
        self.check_open()?;
        if self.shared.is_up() { Ok(()) } else { Err(self.shared.away()) }
    }

    /// Whether the participant stands. While it closes it still writes.
    pub(crate) fn is_up(&self) -> bool {
        self.shared.is_up()
    }

    /// The error of one that does not stand.
    pub(crate) fn away(&self) -> BrokerError {
        self.shared.away()
    }

    fn check_open(&self) -> Result<(), BrokerError> {
        if self.shared.closing.load(Ordering::Acquire) {
            return Err(BrokerError::Closed);
        }
        Ok(())
    }

    /// Samples that wait because it was not known whether they are read are looked at again.
    pub(crate) fn look_again(&self) {
        self.shared.channels.look_again();
    }

    /// Writes a topic.
    pub(crate) fn publisher(
        &self,
        topic: Topic,
        options: PublisherOptions,
    ) -> Result<TopicPublisher, BrokerError> {
        self.check_open()?;
        let longest_wait =
            if options.reliable || options.depth > 0 { RELIABLE_WAIT } else { LONGEST_WAIT };
        Ok(self.publisher_of(Target::new(&self.shared, topic, options), longest_wait))
    }

    /// Writes a topic with one writer for all that is published, which keeps the last `depth` for
    /// late joiners, whoever wrote them.
    pub(crate) fn keeping(&self, topic: Topic, depth: u32) -> TopicPublisher {
        self.publisher_of(Target::keeping(&self.shared, topic, depth), RELIABLE_WAIT)
    }

    fn publisher_of(&self, target: Target, longest_wait: Duration) -> TopicPublisher {
        LanePublisher {
            lane: self.shared.outbox.lane(target, Some(longest_wait)),
            admission: Arc::clone(&self.shared),
        }
    }

    /// Reads a topic for somebody who reads others, too.
    pub(crate) fn read(
        &self,
        topic: Topic,
        sender: SubscriptionSender,
        options: SubscribeOptions,
    ) -> Result<(), BrokerError> {
        // It is made by the lifecycle thread; nobody waits for that.
        self.shared.channels.add(topic, sender, options)?;
        self.shared.wake_lifecycle();
        Ok(())
    }

    /// Ends what [`read`](Self::read) began.
    pub(crate) fn stop_reading(&self, topic: &Topic, sender: &SubscriptionSender) {
        self.shared.channels.remove(topic, sender);
    }

    /// Reads a topic.
    pub(crate) async fn subscribe(
        &self,
        topic: Topic,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.check_up()?;
        let (sender, subscription) = crate::port::subscription(options);
        let made = self.shared.channels.add(topic, sender, options)?;
        self.shared.wake_lifecycle();
        match tokio::time::timeout(SUBSCRIBE, made).await {
            Ok(Ok(())) => Ok(subscription),
            Ok(Err(_)) => Err(BrokerError::Closed),
            Err(_) => Err(BrokerError::Away("RustDDS made no reader in time".to_owned())),
        }
    }

    /// Delivers what was taken, as far as that goes within a second, and ends all threads.
    pub(crate) async fn close(&self) {
        if self.shared.closing.swap(true, Ordering::AcqRel) {
            return;
        }
        let until = Instant::now() + DRAIN;
        let up = || self.shared.is_up();
        while up()
            && Instant::now() < until
            && !(self.shared.is_drained() && self.shared.slots.are_acknowledged())
        {
            tokio::time::sleep(LOOK).await;
        }
        if up() {
            tokio::time::sleep(LINGER).await;
        }
        self.shared.end();
        let threads = std::mem::take(&mut *self.threads.lock());
        // Joins the threads: the good-bye takes a moment.
        let _ = tokio::task::spawn_blocking(move || drop(threads)).await;
    }
}

impl Drop for Adapter {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Release);
        self.shared.end();
        for thread in std::mem::take(&mut *self.threads.lock()) {
            drop(thread.unwaited());
        }
    }
}

/// Writes one topic.
pub(crate) type TopicPublisher = LanePublisher<Target, Arc<Shared>>;

impl TopicPublisher {
    /// Nothing is written before what waits for another writer now.
    pub(crate) fn wait_for(&self, other: &Self) {
        self.lane.to().wait_for(other.lane.backlog());
    }

    /// Makes the writer of an origin of a transient_local topic before it has a message.
    pub(crate) fn prepare(&self, origin: WriterId) {
        self.lane.to().slot_of_origin(&self.admission, origin);
    }

    /// Whether its writers stand, and have met so many readers, where that takes less than `limit`.
    pub(crate) fn has_met(&self, readers: usize, now: Instant, limit: Duration) -> bool {
        self.lane.to().has_met(readers, now, limit)
    }
}

impl OutboxAdmission for Arc<Shared> {
    fn is_shut(&self) -> bool {
        self.is_down()
    }

    fn write_at_once(&self) -> bool {
        send::write_at_once(self)
    }
}
