//! What a worker of BlazeConfig does on its Kafka, beside messages: topics, and notices that stay
//! in them, one per key.
//!
//! A notice is a record with a key, whose value is the payload as it is; a record without a value
//! takes it away. It counts as written when the server has acknowledged it. What it has not within
//! some seconds is given up, so that the newest takes its place.

use std::collections::BTreeSet;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::{DropReason, MAX_PAYLOAD_BYTES};
use tokio::sync::oneshot;

use super::admin::Purpose;
use super::inner::{Inner, MAX_CHANNELS};
use super::names::{Names, OF_WORKER};
use super::producer::Producer;
use super::settings::Lot;
use super::topic_creator::{TopicCreator, is_final};
use super::topics::Topic;
use crate::outbox::Fate;
use crate::port::BrokerError;
use crate::worker_side::{KeyedMessage, WorkerSide, WriteError};

/// Makes the topics of a worker.
pub(super) fn creator(names: &Names) -> TopicCreator {
    let needed = OF_WORKER.iter();
    TopicCreator::new(needed.map(|channel| (names.reserved(channel), Purpose::Messages)))
}

/// What the worker is given.
pub(super) struct KafkaWorkerSide {
    pub(super) inner: Arc<Inner>,
    pub(super) creator: Arc<TopicCreator>,
}

impl KafkaWorkerSide {
    /// The topic of a message; `None`: there is nothing to be written.
    fn topic_of(&self, message: &KeyedMessage) -> Result<Option<Arc<Topic>>, WriteError> {
        let name = self.inner.names.topic(&message.channel)?;
        let refuse = |reason: String| {
            Err(WriteError::from(BrokerError::Name {
                channel: message.channel.to_string(),
                reason,
            }))
        };
        let wait = |reason: String| {
            Err(WriteError::NotYet { channels: BTreeSet::from([message.channel.clone()]), reason })
        };
        let known = self
            .creator
            .with(&name, |prepared| Some((prepared.topic.clone()?, prepared.refusal())));
        match known.flatten() {
            Some((topic, _)) if topic.partitions().is_some() => Ok(Some(topic)),
            Some((_, refusal)) => match refusal {
                Some(code) if is_final(code) => {
                    refuse(format!("the server does not make its topic {name}: {code}"))
                }
                Some(code) => wait(format!("the server cannot make its topic {name} now: {code}")),
                None => wait(format!("topic {name} is being made")),
            },
            None if message.value.is_none() => Ok(None),
            None => {
                refuse("it was not prepared, or its topic has the name of another one".to_owned())
            }
        }
    }

    fn producer(&self) -> Result<Arc<Producer>, BrokerError> {
        self.inner.producer(Lot::default())
    }
}

fn bytes_of(message: &KeyedMessage) -> usize {
    message.value.as_ref().map_or(0, bytes::Bytes::len)
}

fn too_large(message: &KeyedMessage) -> WriteError {
    WriteError::TooLarge { channel: message.channel.clone(), bytes: bytes_of(message) }
}

#[async_trait]
impl WorkerSide for KafkaWorkerSide {
    fn prepare(&self, channel: &ChannelName) -> Result<(), BrokerError> {
        if self.creator.count() >= MAX_CHANNELS {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        self.creator.prepare(&self.inner, channel, Purpose::Notices, 1)
    }

    fn release(&self, channel: &ChannelName) {
        if let Ok(name) = self.inner.names.topic(channel) {
            self.creator.release(&name);
        }
    }

    async fn write(&self, messages: &[KeyedMessage]) -> Result<(), WriteError> {
        if self.inner.is_closed() {
            return Err(BrokerError::Closed.into());
        }
        if !self.inner.shared.gate.is_open() {
            return Err(BrokerError::Away(self.inner.status.borrow().detail.clone()).into());
        }
        let producer = self.producer()?;
        let (mut ready, mut missing) = (Vec::with_capacity(messages.len()), BTreeSet::new());
        let mut waits_for = String::new();
        // Nothing is written before all can be, so that what is tried again keeps its order.
        for message in messages {
            if bytes_of(message) > MAX_PAYLOAD_BYTES {
                return Err(too_large(message));
            }
            match self.topic_of(message) {
                Ok(topic) => ready.extend(topic.map(|topic| (message, topic))),
                Err(WriteError::NotYet { channels, reason }) => {
                    missing.extend(channels);
                    waits_for = reason;
                }
                Err(error) => return Err(error),
            }
        }
        if !missing.is_empty() {
            return Err(WriteError::NotYet { channels: missing, reason: waits_for });
        }
        let mut answers = Vec::with_capacity(ready.len());
        for (message, topic) in ready {
            let (done, answer) = oneshot::channel();
            producer.send_keyed(&topic, None, &message.key, message.value.as_ref(), done);
            answers.push((message, answer));
        }
        let mut written = Ok(());
        for (message, answer) in answers {
            let error = match answer.await {
                Ok(Fate::Delivered) => continue,
                Ok(Fate::Dropped(DropReason::TooLarge)) => too_large(message),
                Ok(Fate::Dropped(_)) | Err(_) => BrokerError::Away(format!(
                    "{}: the server did not acknowledge it",
                    message.channel
                ))
                .into(),
            };
            written = written.and(Err(error));
        }
        written
    }
}
