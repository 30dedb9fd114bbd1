//! A message as a callback gets it.

use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::{Content, Received};
use blaze_domain::{Origin, Priority, Scope, TopicName, WriterId};
use blaze_proto::Frame;
use bytes::Bytes;

/// A message that arrived on a subscription. Cheap to clone; the payload is shared.
#[derive(Debug, Clone)]
pub struct Message {
    topic: TopicName,
    body: Body,
    /// Scope of the broker that it came from.
    scope: Scope,
    received_at: Instant,
    broker_age: Duration,
}

#[derive(Debug, Clone)]
enum Body {
    Framed(Frame),
    Bare { payload: Bytes, identity: Option<(WriterId, u64)> },
}

impl Message {
    /// `None` for what claims to be a frame and is none.
    pub(crate) fn new(topic: &TopicName, scope: Scope, received: Received) -> Option<Self> {
        let body = match received.content {
            Content::Frame(frame) => Body::Framed(frame),
            Content::Bare { payload, identity } => Body::Bare { payload, identity },
            Content::Malformed { .. } => return None,
        };
        Some(Self {
            topic: topic.clone(),
            body,
            scope,
            received_at: received.at,
            broker_age: Duration::from_micros(received.broker_age_us),
        })
    }

    /// The payload.
    #[must_use]
    pub fn payload(&self) -> &Bytes {
        match &self.body {
            Body::Framed(frame) => frame.payload(),
            Body::Bare { payload, .. } => payload,
        }
    }

    /// The topic that was subscribed.
    #[must_use]
    pub fn topic(&self) -> &TopicName {
        &self.topic
    }

    /// The header, unless the message came without one from a publisher that does not use an SDK.
    #[must_use]
    pub fn frame(&self) -> Option<&Frame> {
        match &self.body {
            Body::Framed(frame) => Some(frame),
            Body::Bare { .. } => None,
        }
    }

    /// Where it was born; all parts are empty for a message without a header.
    #[must_use]
    pub fn origin(&self) -> Origin {
        self.frame().map(Frame::origin).unwrap_or_default()
    }

    /// The publisher, where it is known.
    #[must_use]
    pub fn writer(&self) -> Option<WriterId> {
        self.identity().map(|(writer, _)| writer)
    }

    /// The number that the publisher gave it (1, 2, 3 …), where it is known.
    #[must_use]
    pub fn sequence(&self) -> Option<u64> {
        self.identity().map(|(_, sequence)| sequence)
    }

    pub(crate) fn identity(&self) -> Option<(WriterId, u64)> {
        match &self.body {
            Body::Framed(frame) => Some((frame.writer(), frame.sequence())),
            Body::Bare { identity, .. } => *identity,
        }
    }

    /// When it was published, by the clock of the publisher's machine. For display: clocks differ;
    /// use [`Message::age`] to judge how old it is.
    #[must_use]
    pub fn publish_time(&self) -> Option<SystemTime> {
        let since_epoch = Duration::from_nanos(self.frame()?.publish_time_ns());
        SystemTime::UNIX_EPOCH.checked_add(since_epoch)
    }

    /// How long ago it was published: what the flows on the way measured, and the time since it
    /// arrived here.
    #[must_use]
    pub fn age(&self) -> Duration {
        self.age_at(Instant::now(), SystemTime::now())
    }

    pub(crate) fn age_at(&self, now: Instant, wall: SystemTime) -> Duration {
        let on_the_way = Duration::from_micros(self.frame().map_or(0, Frame::age_us));
        let measured = on_the_way
            .saturating_add(self.broker_age)
            .saturating_add(now.saturating_duration_since(self.received_at));
        // On one node publisher and subscriber share a clock, and no flow measured what came
        // directly.
        let of_this_node =
            (self.scope == Scope::Node && self.hops() == 0).then(|| self.publish_time()).flatten();
        let by_clock = of_this_node.and_then(|published| wall.duration_since(published).ok());
        measured.max(by_clock.unwrap_or_default())
    }

    /// Media type of the payload; empty for a message without a header.
    #[must_use]
    pub fn encoding(&self) -> &str {
        self.frame().map_or("", Frame::encoding)
    }

    /// RIHS01 hash of its ROS type, or empty.
    #[must_use]
    pub fn type_hash(&self) -> &str {
        self.frame().map_or("", Frame::type_hash)
    }

    /// How many times a flow wrote it to a scope; 0 = it came from this broker directly.
    #[must_use]
    pub fn hops(&self) -> u32 {
        self.frame().map_or(0, Frame::hops)
    }

    /// The class that its publisher gave it, if it gave one.
    #[must_use]
    pub fn priority(&self) -> Option<Priority> {
        self.frame().and_then(Frame::priority)
    }

    /// Whether its publisher offers it as reliable.
    #[must_use]
    pub fn is_reliable(&self) -> bool {
        self.frame().is_some_and(Frame::reliable)
    }

    /// How long it is of use, as its publisher says; zero = for ever.
    #[must_use]
    pub fn lifespan(&self) -> Duration {
        Duration::from_millis(u64::from(self.frame().map_or(0, Frame::lifespan_ms)))
    }

    /// Bytes that it holds in memory.
    pub(crate) fn size(&self) -> usize {
        match &self.body {
            Body::Framed(frame) => frame.received_len(),
            Body::Bare { payload, .. } => payload.len(),
        }
    }
}
