//! What BlazeFlow and the SDK know of a message system.
//!
//! ```text
//! publish:    Publisher::publish ──► bounded queue of the adapter ──► server
//! subscribe:  server ──► adapter ──► SubscriptionSender ──► bounded ring ──► Subscription::receive (batches)
//!                                                                       └──► or a sink, Subscription::forward
//! ```
//!
//! Publishing never waits: an adapter that cannot keep up drops the oldest of its queue and counts
//! it. A subscription is a ring that drops its oldest when its reader is slow; the reader learns
//! how many it missed.

use std::any::Any;
use std::collections::VecDeque;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::{DropReason, FlowId, WriterId};
use blaze_proto::{Frame, FrameError};
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

use crate::worker_side::WorkerSide;

/// Which message system an adapter speaks to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BrokerKind {
    /// Within one process.
    Memory,
    /// Redis or Valkey publish and subscribe.
    Redis,
    /// Kafka.
    Kafka,
    /// DDS layer scope.
    Dds,
    /// ROS 2 over DDS.
    Ros2,
}

impl BrokerKind {
    /// The word in admin JSON and routes.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Redis => "redis",
            Self::Kafka => "kafka",
            Self::Dds => "dds",
            Self::Ros2 => "ros2",
        }
    }
}

impl fmt::Display for BrokerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Whether the server answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Health {
    /// Not yet connected.
    Connecting,
    /// It answers.
    Up,
    /// It did answer and does not any more.
    Down,
    /// It answers, but the scope belongs to another flow, which the detail names: nothing is read
    /// or written.
    InUse,
    /// Closed by us; final.
    Closed,
}

/// What an adapter says of its server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrokerStatus {
    /// Whether the server answers.
    pub health: Health,
    /// For people: server and version, or the last error.
    pub detail: String,
    /// When `health` last changed.
    pub since: Instant,
}

/// The status as an adapter tells it.
#[derive(Debug)]
pub(crate) struct StatusCell(watch::Sender<BrokerStatus>);

impl StatusCell {
    pub(crate) fn new(health: Health, detail: String) -> Self {
        let since = Instant::now();
        Self(watch::Sender::new(BrokerStatus { health, detail, since }))
    }

    /// Tells a change; a closed broker stays closed. Returns whether the health is another one,
    /// where anything is.
    pub(crate) fn set(&self, health: Health, detail: &str) -> Option<bool> {
        let mut turned = false;
        let is_changed = self.0.send_if_modified(|status| {
            turned = status.health != health && status.health != Health::Closed;
            let changes = turned || (status.health == health && status.detail != detail);
            if changes {
                status.health = health;
                detail.clone_into(&mut status.detail);
            }
            if turned {
                status.since = Instant::now();
            }
            changes
        });
        is_changed.then_some(turned)
    }

    pub(crate) fn borrow(&self) -> watch::Ref<'_, BrokerStatus> {
        self.0.borrow()
    }

    pub(crate) fn subscribe(&self) -> watch::Receiver<BrokerStatus> {
        self.0.subscribe()
    }
}

/// Why a broker refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BrokerError {
    /// The broker was closed by us.
    #[error("the broker is closed")]
    Closed,
    /// The server does not answer.
    #[error("the broker is away: {0}")]
    Away(String),
    /// The broker cannot express the channel's name.
    #[error("channel {channel}: {reason}")]
    Name {
        /// The channel.
        channel: String,
        /// Why not.
        reason: String,
    },
    /// The server has a channel of another name that it does not tell apart from this one.
    #[error("channel {channel}: its name and that of {other} are one to the broker")]
    Collision {
        /// The channel.
        channel: String,
        /// Name of the other on the server.
        other: String,
    },
    /// More channels than the adapter holds.
    #[error("more than {0} channels")]
    TooManyChannels(usize),
}

/// One message as an adapter found it.
#[derive(Debug, Clone)]
pub enum Content {
    /// A message with a header.
    Frame(Frame),
    /// A payload without a header, and the identity that its place on the server gives it, if that
    /// is stable.
    Bare {
        /// The payload as it is.
        payload: Bytes,
        /// Writer and sequence, where the server has a stable position (Kafka); otherwise the flow
        /// numbers it.
        identity: Option<(WriterId, u64)>,
    },
    /// It begins with `BLZ1` and is no frame.
    Malformed {
        /// What is wrong with it.
        error: FrameError,
        /// Its size.
        bytes: usize,
    },
}

impl Content {
    /// What the bytes of one message are: on a reserved channel JSON, never a frame.
    #[must_use]
    pub fn of(is_reserved: bool, payload: Bytes) -> Self {
        if is_reserved {
            return Self::Bare { payload, identity: None };
        }
        Self::from_bytes(payload)
    }

    /// What the bytes of one message are, on a broker that keeps frames as one value.
    #[must_use]
    pub fn from_bytes(bytes: Bytes) -> Self {
        if !blaze_proto::frame::claims_to_be_a_frame(&bytes) {
            return Self::Bare { payload: bytes, identity: None };
        }
        let size = bytes.len();
        match Frame::parse(bytes) {
            Ok(frame) => Self::Frame(frame),
            Err(error) => Self::Malformed { error, bytes: size },
        }
    }

    /// Bytes that it holds in memory.
    #[must_use]
    pub fn size(&self) -> usize {
        match self {
            Self::Frame(frame) => frame.received_len(),
            Self::Bare { payload, .. } => payload.len(),
            Self::Malformed { bytes, .. } => *bytes,
        }
    }
}

/// A message and when the adapter took it from the server.
#[derive(Debug, Clone)]
pub struct Received {
    /// The message.
    pub content: Content,
    /// When it was taken (monotonic clock).
    pub at: Instant,
    /// Microseconds that it lay on the server before, where the server tells (Kafka append time).
    pub broker_age_us: u64,
    /// It was published before the subscription and kept for late joiners.
    pub kept: bool,
    /// Where it lies on the server, if that keeps messages in places (Kafka).
    pub place: Option<ConsumerOffset>,
}

impl Received {
    /// A message that was published just now, on a server without places.
    #[must_use]
    pub fn live(content: Content, at: Instant) -> Self {
        Self { content, at, broker_age_us: 0, kept: false, place: None }
    }

    /// A message that was retained for late joiners, on a server without places.
    #[must_use]
    pub fn kept(content: Content, at: Instant, broker_age_us: u64) -> Self {
        Self { broker_age_us, kept: true, ..Self::live(content, at) }
    }
}

/// Partition and offset of a message on a server that keeps messages (Kafka).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConsumerOffset {
    /// Number of the partition, from 0.
    pub partition: usize,
    /// Its offset there; the next message has a larger one.
    pub offset: i64,
    /// When the server took it, in milliseconds of the server's clock since 1970; `None` where it
    /// does not tell.
    pub appended_ms: Option<i64>,
}

/// Where a subscription begins, on a server that keeps messages; others begin now.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Begin {
    /// With what is published from now on.
    #[default]
    Now,
    /// At these offsets, by partition; further partitions now. An offset that the server does not
    /// have is moved to the nearest.
    At(Arc<[i64]>),
    /// With the first message that the server took at that time of its clock (milliseconds
    /// since 1970) or later, but never behind these offsets, by partition.
    Since {
        /// The time.
        appended_ms: i64,
        /// No later than here; partitions that are missing have no such bound.
        latest: Arc<[i64]>,
    },
}

/// What a publisher is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct PublisherOptions {
    /// Samples to keep per writer for late joiners; 0 = volatile.
    pub depth: u32,
    /// Repair what is lost, where the broker can.
    pub reliable: bool,
    /// Messages may be large: a connection of their own, where that matters.
    pub large: bool,
}

/// Bounds and kind of a subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SubscribeOptions {
    /// Most messages that wait for the reader; the oldest give way.
    pub max_messages: usize,
    /// Most bytes that wait for the reader; the oldest give way, but one message always fits.
    pub max_bytes: usize,
    /// Messages may be large: a connection of their own, where that matters.
    pub large: bool,
    /// Begin with what the broker keeps for late joiners (transient_local).
    pub with_kept: bool,
}

impl Default for SubscribeOptions {
    fn default() -> Self {
        Self { max_messages: 4096, max_bytes: 64 * 1024 * 1024, large: false, with_kept: false }
    }
}

/// What became of a message that was handed to a publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PublishOutcome {
    /// Taken; the adapter delivers it.
    Taken,
    /// The broker is away or closed: dropped.
    Dropped,
    /// Larger than the broker carries: dropped.
    TooLarge,
}

/// What became of messages after a publisher had taken them, since it was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Later {
    /// Neither at the server nor dropped yet.
    pub queued: u64,
    /// Gave way to newer ones in a full queue.
    pub queue_full: u64,
    /// Their time was over before the server could take them.
    pub lifespan: u64,
    /// Refused by the server because of their size.
    pub too_large: u64,
    /// Refused by the server for another reason, or lost with the connection.
    pub broker_error: u64,
}

impl Later {
    /// All that were dropped.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.by_reason().iter().map(|(_, count)| count).sum()
    }

    /// What was dropped, by reason.
    #[must_use]
    pub fn by_reason(&self) -> [(DropReason, u64); 4] {
        [
            (DropReason::QueueFull, self.queue_full),
            (DropReason::Lifespan, self.lifespan),
            (DropReason::TooLarge, self.too_large),
            (DropReason::BrokerError, self.broker_error),
        ]
    }
}

/// Writes one channel. Never waits.
pub trait Publisher: Send + Sync {
    /// Hands over a message with its header. Hops are written as the frame has them; its age grows
    /// by what it waits here. One that the server could not be given before `deadline` is dropped.
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome;

    /// Hands over a payload as it is: for reserved channels and bare ones.
    fn publish_bare(&self, payload: &Bytes, deadline: Option<Instant>) -> PublishOutcome;

    /// Hands over a copy for clients without the frame: the payload as it is, and the header where
    /// the server has a place beside it (Kafka).
    fn publish_copy(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        self.publish_bare(frame.payload(), deadline)
    }

    /// What became of the messages that were taken.
    fn later(&self) -> Later;
}

/// A message system, seen from one process. Dropping it closes it.
#[async_trait]
pub trait Broker: Send + Sync + 'static {
    /// Which message system it is.
    fn kind(&self) -> BrokerKind;

    /// Whether the server answers, and its changes.
    fn status(&self) -> watch::Receiver<BrokerStatus>;

    /// A writer for a channel.
    ///
    /// # Errors
    /// [`BrokerError`] when the channel cannot be written at all; a server that is away is no
    /// error.
    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError>;

    /// Reads a channel from now on; what is published after this call returns is received, in order
    /// per writer, also after the connection was lost and came back. What was published meanwhile
    /// may be missing.
    ///
    /// # Errors
    /// [`BrokerError`] when it cannot be subscribed now.
    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError>;

    /// As [`Broker::subscribe`], from a place on the server. A server that keeps no messages begins
    /// now.
    ///
    /// # Errors
    /// As [`Broker::subscribe`].
    async fn subscribe_from(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
        begin: Begin,
    ) -> Result<Subscription, BrokerError> {
        let _ = begin;
        self.subscribe(channel, options).await
    }

    /// What only the flow of a scope does on its broker; absent where the client is a service's, or
    /// where nothing outlives the process.
    fn flow_side(&self) -> Option<Arc<dyn FlowSide>> {
        None
    }

    /// What only a worker of BlazeConfig does on its broker; absent where a channel is there as
    /// soon as it is used (Redis, memory), and on Kafka where the client is somebody else's.
    fn worker_side(&self) -> Option<Arc<dyn WorkerSide>> {
        None
    }

    /// Delivers what was taken, as far as the server takes it within a second, then closes all
    /// subscriptions.
    async fn close(&self);
}

/// Who uses a broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// A service: it publishes and subscribes.
    Service,
    /// The flow of the scope: it alone makes channels, keeps leases and claims the scope.
    Flow {
        /// Layer and node.
        flow: FlowId,
        /// Its life: larger is newer.
        epoch: u64,
    },
    /// A worker of BlazeConfig: it makes the channels on which services ask and are told, and
    /// disturbs no flow.
    Worker,
}

/// What only the flow of a scope does on its broker, beside messages. Nothing here waits but
/// reading leases.
#[async_trait]
pub trait FlowSide: Send + Sync {
    /// Makes a channel where channels must be made (Kafka), and makes it again when it vanishes,
    /// until it is released. `depth` is what the channel keeps per writer for late joiners; 0 =
    /// nothing.
    ///
    /// # Errors
    /// [`BrokerError::Name`] when the server can have no such channel, [`BrokerError::Collision`]
    /// when it does not tell it apart from another one that it has.
    fn prepare(&self, channel: &ChannelName, depth: u32) -> Result<(), BrokerError>;

    /// Channels that were prepared and then turned out to have the name of somebody else's, which
    /// is given with each; since the last call.
    fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        Vec::new()
    }

    /// Nobody leases a channel any more: it stays as it is.
    fn release(&self, channel: &ChannelName);

    /// All leases that the server keeps, as they are now: key and value.
    ///
    /// # Errors
    /// [`BrokerError`] when the server does not answer.
    async fn load_leases(&self) -> Result<Vec<(String, Bytes)>, BrokerError>;

    /// Keeps a lease, also across outages of the server: what it has lost is written again.
    fn put_lease(&self, key: &str, value: Bytes);

    /// Forgets a lease.
    fn remove_lease(&self, key: &str);

    /// A writer's lease has lapsed: what is kept of it for late joiners goes.
    fn forget_writer(&self, channel: &ChannelName, writer: WriterId);

    /// Another layer's flow was first on this broker (given as text): neither read nor write until
    /// told `None`.
    fn stand_back(&self, for_whom: Option<String>);
}

/// Takes messages of a subscription, and how many were dropped before them because nobody took
/// them in time.
pub type MessageSink = Box<dyn Fn(&mut Vec<Received>, u64) + Send + Sync>;

/// Messages that wait at most for a sink to be called by the thread that brings them. Where more
/// wait, the reader's task calls it, and the thread goes on reading.
const AT_ONCE: usize = 64;

struct Ring {
    queue: Mutex<RingState>,
    readable: Notify,
    dropped: AtomicU64,
    options: SubscribeOptions,
    /// Where messages go that no reader asks for. Who holds it calls the sink, so that messages
    /// stay in order.
    outflow: Mutex<Option<Outflow>>,
}

struct Outflow {
    sink: MessageSink,
    /// Messages that it takes at once.
    limit: usize,
    batch: Vec<Received>,
    /// The sink has panicked.
    panic: Option<Box<dyn Any + Send>>,
}

impl Ring {
    /// Gives the sink what waits. Where another thread does so, that one takes this, too. Returns
    /// whether the reader's task has nothing to do.
    fn drain(&self) -> bool {
        while !self.queue.lock().messages.is_empty() {
            let Some(mut outflow) = self.outflow.try_lock() else { break };
            let Some(outflow) = &mut *outflow else { return false };
            outflow.drain(self);
            if outflow.panic.is_some() {
                return false;
            }
        }
        true
    }
}

impl Outflow {
    fn drain(&mut self, ring: &Ring) {
        let Self { sink, limit, batch, panic } = self;
        while panic.is_none() && ring.queue.lock().take(batch, *limit) > 0 {
            let lost = ring.dropped.swap(0, Ordering::Relaxed);
            let call = AssertUnwindSafe(|| sink(batch, lost));
            *panic = catch_unwind(call).err();
            batch.clear();
        }
    }
}

#[derive(Default)]
struct RingState {
    messages: VecDeque<Received>,
    bytes: usize,
    /// What the bounds are raised by.
    more: More,
    closed: bool,
}

/// Room for what is kept for late joiners, beside the bounds of a subscription, until the reader
/// has taken as much.
#[derive(Default)]
struct More {
    messages: usize,
    bytes: usize,
}

impl More {
    fn raise(&mut self, bytes: usize) {
        self.messages = self.messages.saturating_add(1).min(MAX_KEPT_MESSAGES);
        self.bytes = self.bytes.saturating_add(bytes).min(MAX_KEPT_BYTES);
    }
}

impl RingState {
    /// Takes a message in. Returns how many gave way.
    fn push(&mut self, message: Received, options: &SubscribeOptions) -> u64 {
        let size = message.content.size();
        let max_messages = options.max_messages.saturating_add(self.more.messages);
        let max_bytes = options.max_bytes.saturating_add(self.more.bytes);
        let mut lost = 0;
        while !self.messages.is_empty()
            && (self.messages.len() >= max_messages || self.bytes + size > max_bytes)
        {
            if let Some(oldest) = self.messages.pop_front() {
                self.bytes -= oldest.content.size();
                lost += 1;
            }
        }
        self.bytes += size;
        self.messages.push_back(message);
        lost
    }

    /// Takes up to `limit` messages out. Returns how many.
    fn take(&mut self, batch: &mut Vec<Received>, limit: usize) -> usize {
        let count = self.messages.len().min(limit);
        let mut bytes = 0;
        let taken = self.messages.drain(..count);
        batch.extend(taken.inspect(|message| bytes += message.content.size()));
        self.bytes -= bytes;
        self.more.messages = self.more.messages.saturating_sub(count);
        self.more.bytes = self.more.bytes.saturating_sub(bytes);
        count
    }
}

/// The adapter's end of a subscription.
#[derive(Clone)]
pub struct SubscriptionSender {
    ring: Arc<Ring>,
}

/// The reader's end of a subscription. Dropping it unsubscribes.
pub struct Subscription {
    ring: Arc<Ring>,
    /// Offsets that it begins at, by partition.
    starts: Vec<i64>,
}

/// Messages that are kept for late joiners and handed over beyond the bounds of a subscription, at
/// most: as many as a store holds of the smallest ones.
pub const MAX_KEPT_MESSAGES: usize = 262_144;
/// Their bytes at most (256 MiB), which is what a reader takes of a topic of Kafka.
pub const MAX_KEPT_BYTES: usize = 256 * 1024 * 1024;

/// Both ends of a subscription.
#[must_use]
pub fn subscription(options: SubscribeOptions) -> (SubscriptionSender, Subscription) {
    let ring = Arc::new(Ring {
        queue: Mutex::default(),
        readable: Notify::new(),
        dropped: AtomicU64::new(0),
        options,
        outflow: Mutex::default(),
    });
    (SubscriptionSender { ring: Arc::clone(&ring) }, Subscription { ring, starts: Vec::new() })
}

impl SubscriptionSender {
    /// Hands a message to the reader. Returns whether the subscription still lives.
    pub fn send(&self, message: Received) -> bool {
        self.hand_over([message], false)
    }

    /// Hands messages to the reader that were kept for late joiners, at once. They raise the bounds
    /// until it has taken as many, because it cannot read while they are collected: at most by
    /// [`MAX_KEPT_MESSAGES`] and [`MAX_KEPT_BYTES`]. Returns whether the subscription still lives.
    pub fn send_kept(&self, kept: impl IntoIterator<Item = Received>) -> bool {
        self.hand_over(kept, true)
    }

    /// As [`send`](Self::send), for one who calls [`flush`](Self::flush) soon.
    pub(crate) fn put(&self, message: Received) -> bool {
        self.push([message], false)
    }

    /// Hands over what was put: in this thread, where the reader has a sink and little waits. Called
    /// without any lock that a sink might want.
    pub(crate) fn flush(&self) {
        let is_little = self.ring.queue.lock().messages.len() <= AT_ONCE;
        if !(is_little && self.ring.drain()) {
            self.wake();
        }
    }

    /// Lets the reader look at what waits.
    pub(crate) fn wake(&self) {
        self.ring.readable.notify_one();
    }

    fn hand_over(&self, messages: impl IntoIterator<Item = Received>, raise_bounds: bool) -> bool {
        let lives = self.push(messages, raise_bounds);
        self.wake();
        lives
    }

    fn push(&self, messages: impl IntoIterator<Item = Received>, raise_bounds: bool) -> bool {
        let mut lost = 0;
        {
            let mut state = self.ring.queue.lock();
            if state.closed {
                return false;
            }
            for message in messages {
                if raise_bounds {
                    state.more.raise(message.content.size());
                }
                lost += state.push(message, &self.ring.options);
            }
        }
        self.note_lost(lost);
        true
    }

    /// Counts messages that the reader will never get because it, or whoever reads for it, was too
    /// slow.
    pub fn note_lost(&self, messages: u64) {
        if messages > 0 {
            self.ring.dropped.fetch_add(messages, Ordering::Relaxed);
        }
    }

    /// Whether the reader has gone.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.ring.queue.lock().closed
    }

    /// Whether both hand messages to the same reader.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.ring, &other.ring)
    }

    /// Ends the subscription; the reader still gets what waits.
    pub fn close(&self) {
        self.ring.queue.lock().closed = true;
        self.ring.readable.notify_one();
    }
}

impl Subscription {
    /// The same, said to begin at these offsets.
    #[must_use]
    pub fn starting_at(mut self, starts: Vec<i64>) -> Self {
        self.starts = starts;
        self
    }

    /// Offset of the first message that it can get, by partition; empty where the server has no
    /// places. What is kept for late joiners may lie before; partitions that the topic gets later
    /// are read from their beginning.
    #[must_use]
    pub fn starts(&self) -> &[i64] {
        &self.starts
    }

    /// Waits for messages and takes up to `limit` of them into `batch`. Returns how many; 0 = the
    /// subscription ended. Cancelling it loses nothing.
    pub async fn receive(&mut self, batch: &mut Vec<Received>, limit: usize) -> usize {
        loop {
            {
                let mut state = self.ring.queue.lock();
                let count = state.take(batch, limit);
                if count > 0 {
                    return count;
                }
                if state.closed {
                    return 0;
                }
            }
            self.ring.readable.notified().await;
        }
    }

    /// Gives messages to a sink until the subscription ends, up to `limit` at once. Some adapters
    /// call it in the thread that reads, so that nobody has to be woken; it must not wait for a
    /// peer, nor drop the subscription. After that is dropped, it is not called any more.
    ///
    /// # Panics
    /// Where the sink panics, in whichever thread.
    pub async fn forward(&mut self, limit: usize, sink: MessageSink) {
        let outflow = Outflow { sink, limit, batch: Vec::with_capacity(limit), panic: None };
        *self.ring.outflow.lock() = Some(outflow);
        loop {
            self.ring.drain();
            let is_closed = self.ring.queue.lock().closed;
            // Another thread may have taken something, and is waited for before the end.
            let has_panicked = || self.ring.outflow.lock().as_mut().and_then(|it| it.panic.take());
            if let Some(panic) = has_panicked() {
                resume_unwind(panic);
            }
            if is_closed {
                self.ring.drain();
                return;
            }
            self.ring.readable.notified().await;
        }
    }

    /// Messages dropped because this reader, or whoever reads for it, was slow, since the last
    /// call.
    #[must_use]
    pub fn take_dropped(&self) -> u64 {
        self.ring.dropped.swap(0, Ordering::Relaxed)
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut state = self.ring.queue.lock();
        state.closed = true;
        state.messages.clear();
        state.bytes = 0;
        drop(state);
        // Until its sink has returned, which may be called now.
        let outflow = self.ring.outflow.lock().take();
        drop(outflow);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use futures::FutureExt as _;

    use super::*;

    const SIZE: usize = 10;

    fn message(number: usize) -> Received {
        let payload = Bytes::from(vec![u8::try_from(number % 256).unwrap(); SIZE]);
        Received::live(Content::Bare { payload, identity: None }, Instant::now())
    }

    fn bounded(max_messages: usize, max_bytes: usize) -> (SubscriptionSender, Subscription) {
        subscription(SubscribeOptions { max_messages, max_bytes, ..SubscribeOptions::default() })
    }

    /// The first bytes of what waits, up to a limit.
    fn take(subscription: &mut Subscription, limit: usize) -> Vec<u8> {
        let mut batch = Vec::new();
        let _ = subscription.receive(&mut batch, limit).now_or_never();
        let first = |received: Received| match received.content {
            Content::Bare { payload, .. } => payload[0],
            other => panic!("{other:?}"),
        };
        batch.into_iter().map(first).collect()
    }

    #[test]
    fn what_is_kept_raises_the_bounds_until_it_is_read() {
        for (max_messages, max_bytes) in [(3, usize::MAX), (usize::MAX, 3 * SIZE)] {
            let (sender, mut subscription) = bounded(max_messages, max_bytes);
            assert!(sender.send_kept((0..10).map(message)));
            for number in 10..13 {
                sender.send(message(number));
            }
            assert_eq!(subscription.take_dropped(), 0);
            assert_eq!(take(&mut subscription, 6), [0, 1, 2, 3, 4, 5]);
            // Seven wait, and of what was kept four more may.
            sender.send(message(13));
            assert_eq!(subscription.take_dropped(), 1);
            assert_eq!(take(&mut subscription, 100), [7, 8, 9, 10, 11, 12, 13]);
            for number in 14..18 {
                sender.send(message(number));
            }
            assert_eq!(subscription.take_dropped(), 1, "the bounds are those of before");
            assert_eq!(take(&mut subscription, 100), [15, 16, 17]);
        }
    }

    #[test]
    fn what_others_lost_for_a_reader_counts() {
        let (sender, subscription) = bounded(3, usize::MAX);
        sender.note_lost(5);
        assert_eq!((subscription.take_dropped(), subscription.take_dropped()), (5, 0));
        drop(subscription);
        assert!(!sender.send_kept([message(1)]));
    }

    #[test]
    fn what_is_kept_is_bounded() {
        let (sender, mut subscription) = bounded(1, usize::MAX);
        sender.send_kept((0..MAX_KEPT_MESSAGES + 3).map(message));
        assert_eq!(subscription.take_dropped(), 2);
        assert_eq!(take(&mut subscription, usize::MAX).len(), MAX_KEPT_MESSAGES + 1);
    }

    /// A subscription with a sink, which notes the first bytes, what was lost, and its thread.
    type Noted = Arc<Mutex<Vec<(Vec<u8>, u64, thread::ThreadId)>>>;

    fn forwarding(
        max_messages: usize,
    ) -> (SubscriptionSender, impl Future<Output = ()> + Send, Noted) {
        let (sender, mut subscription) = bounded(max_messages, usize::MAX);
        let noted = Noted::default();
        let notes = Arc::clone(&noted);
        let sink = move |batch: &mut Vec<Received>, lost| {
            let first = batch.iter().map(|received| match &received.content {
                Content::Bare { payload, .. } => payload[0],
                other => panic!("{other:?}"),
            });
            notes.lock().push((first.collect(), lost, thread::current().id()));
        };
        (sender, async move { subscription.forward(2, Box::new(sink)).await }, noted)
    }

    #[test]
    fn a_sink_is_called_where_messages_are_put() {
        let (sender, forward, noted) = forwarding(3);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        for number in 0..4 {
            assert!(sender.send(message(number)));
        }
        assert!((&mut forward).now_or_never().is_none());
        let other = thread::scope(|scope| {
            let flush = || {
                sender.put(message(4));
                sender.flush();
                thread::current().id()
            };
            scope.spawn(flush).join().unwrap()
        });
        let here = thread::current().id();
        let expected = [(vec![1, 2], 1, here), (vec![3], 0, here), (vec![4], 0, other)];
        assert_eq!(*noted.lock(), expected);
        sender.send(message(5));
        sender.close();
        assert!(forward.now_or_never().is_some());
        assert_eq!(noted.lock()[3], (vec![5], 0, here));
    }

    #[test]
    fn without_a_reader_a_sink_gets_nothing() {
        let (sender, forward, noted) = forwarding(3);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        sender.put(message(1));
        drop(forward);
        sender.flush();
        assert!(noted.lock().is_empty() && !sender.put(message(2)));
    }

    #[test]
    fn a_sink_gets_messages_of_each_thread_in_order() {
        const EACH: u8 = 200;
        let (sender, forward, noted) = forwarding(10_000);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        thread::scope(|scope| {
            for offset in [0_u8, 1] {
                let sender = &sender;
                scope.spawn(move || {
                    for number in 0..EACH / 2 {
                        sender.put(message(usize::from(2 * number + offset)));
                        sender.flush();
                    }
                });
            }
        });
        let noted = noted.lock();
        let all: Vec<u8> = noted.iter().flat_map(|(numbers, ..)| numbers.iter().copied()).collect();
        for offset in [0, 1] {
            let of_thread: Vec<u8> = all.iter().copied().filter(|it| it % 2 == offset).collect();
            assert_eq!(of_thread, (0..EACH).filter(|it| it % 2 == offset).collect::<Vec<u8>>());
        }
    }

    #[test]
    fn a_panic_of_a_sink_ends_in_the_task_of_the_reader() {
        let (sender, mut subscription) = bounded(10, usize::MAX);
        let sink = |batch: &mut Vec<Received>, _| assert!(batch.is_empty(), "as it is meant to");
        let mut forward = Box::pin(subscription.forward(2, Box::new(sink)));
        assert!((&mut forward).now_or_never().is_none());
        sender.put(message(1));
        sender.flush();
        assert!(catch_unwind(AssertUnwindSafe(|| forward.now_or_never())).is_err());
    }

    #[test]
    fn where_much_waits_the_thread_that_brings_it_goes_on() {
        let (sender, forward, noted) = forwarding(10_000);
        let mut forward = Box::pin(forward);
        assert!((&mut forward).now_or_never().is_none());
        for number in 0..=AT_ONCE {
            sender.put(message(number));
        }
        sender.flush();
        assert!(noted.lock().is_empty());
        assert!((&mut forward).now_or_never().is_none());
        assert_eq!(noted.lock().iter().map(|(batch, ..)| batch.len()).sum::<usize>(), AT_ONCE + 1);
    }
}
