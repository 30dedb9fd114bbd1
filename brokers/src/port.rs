//! What BlazeFlow and the SDK know of a message system.
//!
//! ```text
//! publish:    Publisher::publish ──► bounded queue of the adapter ──► server
//! subscribe:  server ──► adapter ──► bounded ring ──► Subscription
//! ```
//!
//! Publishing never waits: an adapter that cannot keep up drops the oldest of its queue and counts
//! it. A [`Subscription`] does the same when its reader is slow.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::{DropReason, FlowId, WriterId};
use blaze_proto::{Frame, FrameError};
use bytes::Bytes;
use tokio::sync::watch;

pub use crate::subscription::{
    MAX_KEPT_BYTES, MAX_KEPT_MESSAGES, MessageSink, Subscription, SubscriptionSender, subscription,
};
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
