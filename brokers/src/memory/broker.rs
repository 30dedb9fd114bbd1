//! One client of a memory hub.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use async_trait::async_trait;
use blaze_domain::MAX_PAYLOAD_BYTES;
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::{Channel, MemoryHub};
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Content, Health, Later, PublishOutcome,
    Publisher, PublisherOptions, StatusCell, SubscribeOptions, Subscription, SubscriptionSender,
};

/// A client of a [`MemoryHub`]; made by [`MemoryHub::broker`].
pub struct MemoryBroker {
    hub: MemoryHub,
    client: Arc<Client>,
}

/// What a client's publishers share with it.
pub(super) struct Client {
    closed: AtomicBool,
    status: StatusCell,
    /// To close them; those that ended are forgotten when the list has doubled.
    subscriptions: Mutex<Vec<SubscriptionSender>>,
}

impl Client {
    pub(super) fn new(health: Health, detail: String) -> Self {
        Self {
            closed: AtomicBool::new(false),
            status: StatusCell::new(health, detail),
            subscriptions: Mutex::default(),
        }
    }

    /// Tells a change of the hub.
    pub(super) fn set_health(&self, health: Health, detail: &str) {
        self.status.set(health, detail);
    }

    fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Takes note of a subscription, to close it. Returns false when the client was closed
    /// meanwhile.
    fn note(&self, sender: SubscriptionSender) -> bool {
        let mut subscriptions = self.subscriptions.lock();
        if self.is_closed() {
            return false;
        }
        if subscriptions.len() == subscriptions.capacity() {
            subscriptions.retain(|subscription| !subscription.is_closed());
        }
        subscriptions.push(sender);
        true
    }

    fn close(&self) {
        let subscriptions = {
            let mut subscriptions = self.subscriptions.lock();
            self.closed.store(true, Ordering::Release);
            std::mem::take(&mut *subscriptions)
        };
        for subscription in subscriptions {
            subscription.close();
        }
        self.set_health(Health::Closed, "closed");
    }
}

impl MemoryBroker {
    pub(super) fn new(hub: MemoryHub, client: Arc<Client>) -> Self {
        Self { hub, client }
    }
}

impl Drop for MemoryBroker {
    fn drop(&mut self) {
        self.client.close();
    }
}

#[async_trait]
impl Broker for MemoryBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Memory
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.client.status.subscribe()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        if self.client.is_closed() {
            return Err(BrokerError::Closed);
        }
        Ok(Arc::new(MemoryPublisher {
            channel: self.hub.channel(channel)?,
            hub: self.hub.clone(),
            client: Arc::clone(&self.client),
            depth: options.depth,
        }))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        if self.client.is_closed() {
            return Err(BrokerError::Closed);
        }
        if !self.hub.is_up() {
            return Err(BrokerError::Away(self.hub.health().1));
        }
        let (sender, subscription) = self.hub.subscribe(channel, options)?;
        if self.client.note(sender) { Ok(subscription) } else { Err(BrokerError::Closed) }
    }

    async fn close(&self) {
        // What was taken is with its readers already.
        self.client.close();
    }
}

struct MemoryPublisher {
    channel: Arc<Channel>,
    hub: MemoryHub,
    client: Arc<Client>,
    depth: u32,
}

impl MemoryPublisher {
    fn refusal(&self, payload: &Bytes) -> Option<PublishOutcome> {
        if self.client.is_closed() || !self.hub.is_up() {
            Some(PublishOutcome::Dropped)
        } else if payload.len() > MAX_PAYLOAD_BYTES {
            Some(PublishOutcome::TooLarge)
        } else {
            None
        }
    }
}

impl Publisher for MemoryPublisher {
    fn publish(&self, frame: &Frame, _deadline: Option<Instant>) -> PublishOutcome {
        if let Some(refusal) = self.refusal(frame.payload()) {
            return refusal;
        }
        self.hub.deliver(&self.channel, Content::Frame(frame.clone()), self.depth);
        PublishOutcome::Taken
    }

    /// As [`Publisher::publish_bare`]. A payload without a header has no writer, so it is not kept
    /// for late joiners.
    fn publish_bare(&self, payload: &Bytes, _deadline: Option<Instant>) -> PublishOutcome {
        if let Some(refusal) = self.refusal(payload) {
            return refusal;
        }
        let content = Content::of(self.channel.name.is_reserved(), payload.clone());
        self.hub.deliver(&self.channel, content, self.depth);
        PublishOutcome::Taken
    }

    fn later(&self) -> Later {
        Later::default()
    }
}
