//! Publishing on a topic.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::PublishOutcome;
use blaze_domain::control::{MAX_ENCODING_BYTES, MAX_TYPE_BYTES};
use blaze_domain::{
    DropReason, MAX_PAYLOAD_BYTES, Origin, Priority, Reliability, TopicName, WriterId,
};
use blaze_proto::{Frame, Header};
use bytes::Bytes;
use parking_lot::Mutex;

use crate::SdkError;
use crate::monitor::{Counted, Counting, Counts, Topics};

/// What a publisher says of all its messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublishOptions {
    /// Media type of the payloads, at most 200 bytes.
    pub encoding: String,
    /// Whether lost messages are sent again.
    pub reliability: Reliability,
    /// Messages kept for late joiners; 0 = volatile. Advertise the same depth as transient_local.
    pub depth: u32,
    /// How long a message is of use, 1 ms to 49 days; zero = for ever.
    pub lifespan: Duration,
    /// Class on the inter scope; absent = by size.
    pub priority: Option<Priority>,
    /// RIHS01 hash of the ROS type, or empty.
    pub type_hash: String,
    /// Messages may be large (above some 64 KB): a connection of their own, where that matters.
    pub large: bool,
}

impl Default for PublishOptions {
    fn default() -> Self {
        Self {
            encoding: "application/octet-stream".to_owned(),
            reliability: Reliability::BestEffort,
            depth: 0,
            lifespan: Duration::ZERO,
            priority: None,
            type_hash: String::new(),
            large: false,
        }
    }
}

impl PublishOptions {
    pub(crate) fn check(&self) -> Result<(), SdkError> {
        let words = [
            ("encoding", &self.encoding, MAX_ENCODING_BYTES),
            ("type_hash", &self.type_hash, MAX_TYPE_BYTES),
        ];
        for (option, word, most) in words {
            if word.len() > most {
                return Err(SdkError::Option {
                    option,
                    reason: format!("has {} bytes, at most {most} are allowed", word.len()),
                });
            }
        }
        Ok(())
    }
}

/// Writes one topic under an identity of its own; clones share it. Never waits.
#[derive(Clone)]
pub struct Publisher {
    shared: Arc<Shared>,
    /// Until the last clone is dropped.
    _counting: Arc<Counting>,
}

struct Shared {
    to: Arc<dyn blaze_brokers::Publisher>,
    topic: TopicName,
    writer: WriterId,
    /// How long a message is of use; zero = for ever.
    lifespan: Duration,
    /// Locked until the broker has the message, so that sequences reach it in order.
    next: Mutex<Next>,
}

struct Next {
    /// What all messages have in common, and the last sequence.
    header: Header,
    /// Messages that the broker did not take.
    dropped: u64,
    too_large: u64,
}

impl Publisher {
    pub(crate) fn new(
        topic: &TopicName,
        origin: Origin,
        options: &PublishOptions,
        to: Arc<dyn blaze_brokers::Publisher>,
        topics: &Arc<Topics>,
    ) -> Self {
        let writer = WriterId(rand::random());
        let lifespan_ms = lifespan_ms(options.lifespan);
        let header = Header {
            encoding: options.encoding.clone(),
            lifespan_ms,
            priority: options.priority,
            type_hash: options.type_hash.clone(),
            reliable: options.reliability == Reliability::Reliable,
            depth: options.depth,
            ..Header::new(topic.as_str(), origin, writer, 0, 0)
        };
        let shared = Arc::new(Shared {
            to,
            topic: topic.clone(),
            writer,
            lifespan: options.lifespan,
            next: Mutex::new(Next { header, dropped: 0, too_large: 0 }),
        });
        let counting = topics.count(topic, Arc::clone(&shared) as Arc<dyn Counted>);
        Self { shared, _counting: Arc::new(counting) }
    }

    /// Publishes a payload of at most 16 MiB, now. A message that is [`PublishOutcome::Dropped`]
    /// has used up a sequence, so that subscribers see the loss; one that is
    /// [`PublishOutcome::TooLarge`] has not.
    pub fn publish(&self, payload: Bytes) -> PublishOutcome {
        self.publish_at(payload, SystemTime::now())
    }

    /// As [`Publisher::publish`], with the time at which the payload was measured.
    pub fn publish_at(&self, payload: Bytes, time: SystemTime) -> PublishOutcome {
        if payload.len() > MAX_PAYLOAD_BYTES {
            self.shared.next.lock().too_large += 1;
            return PublishOutcome::TooLarge;
        }
        let since_epoch = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let deadline =
            (self.shared.lifespan > Duration::ZERO).then(|| Instant::now() + self.shared.lifespan);
        let mut next = self.shared.next.lock();
        let Next { header, dropped, too_large } = &mut *next;
        header.sequence += 1;
        header.publish_time_ns = u64::try_from(since_epoch.as_nanos()).unwrap_or(u64::MAX);
        match Frame::new(header, payload) {
            Ok(frame) => {
                let outcome = self.shared.to.publish(&frame, deadline);
                match outcome {
                    PublishOutcome::Taken => {}
                    PublishOutcome::Dropped => *dropped += 1,
                    PublishOutcome::TooLarge => {
                        // Nobody will ever see this number: subscribers must not take it for a
                        // loss.
                        header.sequence -= 1;
                        *too_large += 1;
                    }
                }
                outcome
            }
            Err(error) => {
                // The options were checked, so this is a fault of the SDK; the publisher goes on.
                header.sequence -= 1;
                *too_large += 1;
                tracing::error!(
                    topic = %self.shared.topic,
                    %error,
                    "a message could not be framed",
                );
                PublishOutcome::TooLarge
            }
        }
    }

    /// The topic.
    #[must_use]
    pub fn topic(&self) -> &TopicName {
        &self.shared.topic
    }

    /// The identity under which it publishes: random, new for each publisher.
    #[must_use]
    pub fn writer(&self) -> WriterId {
        self.shared.writer
    }

    /// Sequence of the last message; 0 = none yet.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.shared.next.lock().header.sequence
    }

    /// Messages that were taken and have neither reached the broker nor been dropped yet.
    #[must_use]
    pub fn queued(&self) -> u64 {
        self.shared.to.later().queued
    }

    /// Messages that were taken and then dropped, because the broker was slow or away.
    #[must_use]
    pub fn dropped_later(&self) -> u64 {
        self.shared.to.later().dropped()
    }
}

impl Counted for Shared {
    fn counts(&self) -> Counts {
        let mut dropped = BTreeMap::from(self.to.later().by_reason());
        let next = self.next.lock();
        *dropped.entry(DropReason::BrokerError).or_default() += next.dropped;
        *dropped.entry(DropReason::TooLarge).or_default() += next.too_large;
        // One that was dropped at once has used up a sequence.
        let given = next.header.sequence - next.dropped;
        Counts { messages: BTreeMap::from([("publish", given)]), dropped, callbacks: None }
    }
}

/// Milliseconds of a lifespan; less than one counts as one, because 0 means for ever.
pub(crate) fn lifespan_ms(lifespan: Duration) -> u32 {
    if lifespan.is_zero() {
        0
    } else {
        u32::try_from(lifespan.as_millis()).unwrap_or(u32::MAX).max(1)
    }
}
