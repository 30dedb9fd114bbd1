//! What a worker of BlazeConfig does on DDS, beside messages: writers that stand before anybody
//! listens, and keep the last notices of their topic for those who come later. There are no keys:
//! what is old gives way to what is new.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use parking_lot::Mutex;

use super::names;
use crate::dds::adapter::{Adapter, MAX_CHANNELS, TopicPublisher};
use crate::port::{BrokerError, PublishOutcome, Publisher as _};
use crate::worker_side::{KeyedMessage, WorkerSide, WriteError};

/// What the writer of a topic keeps for late joiners.
const DEPTH: u32 = 64;

/// What the worker is given.
pub(super) struct DdsWorkerSide {
    adapter: Arc<Adapter>,
    prepared: Mutex<HashMap<ChannelName, Arc<TopicPublisher>>>,
}

impl DdsWorkerSide {
    pub(super) fn new(adapter: &Arc<Adapter>) -> Self {
        Self { adapter: Arc::clone(adapter), prepared: Mutex::default() }
    }

    fn write_one(&self, message: &KeyedMessage) -> Result<(), WriteError> {
        let Some(value) = &message.value else { return Ok(()) };
        let publisher = self.prepared.lock().get(&message.channel).map(Arc::clone);
        let Some(publisher) = publisher else {
            return Err(BrokerError::Name {
                channel: message.channel.to_string(),
                reason: "it was not prepared".to_owned(),
            }
            .into());
        };
        match publisher.publish_bare(value, None) {
            PublishOutcome::Taken => Ok(()),
            PublishOutcome::Dropped => Err(self.adapter.away().into()),
            PublishOutcome::TooLarge => {
                Err(WriteError::TooLarge { channel: message.channel.clone(), bytes: value.len() })
            }
        }
    }
}

#[async_trait]
impl WorkerSide for DdsWorkerSide {
    fn prepare(&self, channel: &ChannelName) -> Result<(), BrokerError> {
        let mut prepared = self.prepared.lock();
        if prepared.contains_key(channel) {
            return Ok(());
        }
        if prepared.len() >= MAX_CHANNELS {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        let publisher = self.adapter.keeping(names::topic(channel), DEPTH);
        prepared.insert(channel.clone(), Arc::new(publisher));
        Ok(())
    }

    fn release(&self, channel: &ChannelName) {
        self.prepared.lock().remove(channel);
    }

    /// RustDDS does not tell which readers have a sample: one counts as written when it waits to be
    /// sent.
    async fn write(&self, messages: &[KeyedMessage]) -> Result<(), WriteError> {
        if !self.adapter.is_up() {
            return Err(self.adapter.away().into());
        }
        messages.iter().try_for_each(|message| self.write_one(message))
    }
}
