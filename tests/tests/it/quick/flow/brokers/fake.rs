//! A broker with a server outside of the flow: messages in a memory hub, leases in a map that
//! outlives flows.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use async_trait::async_trait;
use blaze_brokers::memory::{MemoryBroker, MemoryHub};
use blaze_brokers::{
    Broker, BrokerError, BrokerKind, BrokerStatus, FlowSide, Health, Later, PublishOutcome,
    Publisher, PublisherOptions, SubscribeOptions, Subscription,
};
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;

/// The server: it outlives the brokers that connect to it.
#[derive(Clone)]
pub(crate) struct Server {
    pub(crate) hub: MemoryHub,
    kind: BrokerKind,
    state: Arc<Mutex<State>>,
}

#[derive(Default)]
struct State {
    leases: BTreeMap<String, Bytes>,
    writes: u64,
    /// Reading leases fails.
    mute: bool,
    channels: BTreeMap<String, u32>,
    /// Channels that cannot be written, and why.
    refused: BTreeMap<String, BrokerError>,
    /// What publishers of a channel say of messages that they took.
    later: BTreeMap<String, Later>,
    publishers: BTreeMap<String, usize>,
}

impl Server {
    pub(crate) fn new(kind: BrokerKind) -> Self {
        Self { hub: MemoryHub::new(kind.as_str()), kind, state: Arc::default() }
    }

    /// A flow's connection.
    pub(crate) fn connect(&self) -> Arc<FakeBroker> {
        let inner = self.hub.broker();
        let status = watch::Sender::new(inner.status().borrow().clone());
        Arc::new(FakeBroker {
            server: self.clone(),
            inner,
            side: Arc::new(Side { server: self.clone(), status, standing_back: Mutex::default() }),
        })
    }

    /// The leases that it keeps.
    pub(crate) fn leases(&self) -> BTreeMap<String, Bytes> {
        self.state.lock().leases.clone()
    }

    pub(crate) fn put_lease(&self, key: &str, value: &str) {
        self.state.lock().leases.insert(key.to_owned(), Bytes::from(value.to_owned()));
    }

    /// How often a lease was put or removed.
    pub(crate) fn writes(&self) -> u64 {
        self.state.lock().writes
    }

    /// Whether reading leases fails.
    pub(crate) fn set_mute(&self, mute: bool) {
        self.state.lock().mute = mute;
    }

    pub(crate) fn channels(&self) -> BTreeSet<String> {
        self.state.lock().channels.keys().cloned().collect()
    }

    /// Whether a channel can be written.
    pub(crate) fn refuse(&self, channel: &str, refused: bool) {
        let mut state = self.state.lock();
        if refused {
            let error = BrokerError::Name {
                channel: channel.to_owned(),
                reason: "the server has no such names".to_owned(),
            };
            state.refused.insert(channel.to_owned(), error);
        } else {
            state.refused.remove(channel);
        }
    }

    pub(crate) fn set_later(&self, channel: &str, later: Later) {
        self.state.lock().later.insert(channel.to_owned(), later);
    }

    /// Publishers of a channel that were made.
    pub(crate) fn publishers(&self, channel: &str) -> usize {
        self.state.lock().publishers.get(channel).copied().unwrap_or(0)
    }
}

pub(crate) struct FakeBroker {
    server: Server,
    inner: MemoryBroker,
    side: Arc<Side>,
}

struct Side {
    server: Server,
    status: watch::Sender<BrokerStatus>,
    standing_back: Mutex<Option<String>>,
}

impl FakeBroker {
    /// Says something else of the server.
    pub(crate) fn set_health(&self, health: Health, detail: &str) {
        self.side.set_health(health, detail);
    }

    pub(crate) fn standing_back(&self) -> Option<String> {
        self.side.standing_back.lock().clone()
    }
}

impl Side {
    fn set_health(&self, health: Health, detail: &str) {
        self.status.send_replace(BrokerStatus {
            health,
            detail: detail.to_owned(),
            since: Instant::now(),
        });
    }
}

#[async_trait]
impl Broker for FakeBroker {
    fn kind(&self) -> BrokerKind {
        self.server.kind
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.side.status.subscribe()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        let mut state = self.server.state.lock();
        if let Some(error) = state.refused.get(channel.as_str()) {
            return Err(error.clone());
        }
        *state.publishers.entry(channel.to_string()).or_default() += 1;
        drop(state);
        Ok(Arc::new(FakePublisher {
            server: self.server.clone(),
            channel: channel.to_string(),
            inner: self.inner.publisher(channel, options)?,
        }))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.inner.subscribe(channel, options).await
    }

    fn flow_side(&self) -> Option<Arc<dyn FlowSide>> {
        Some(Arc::clone(&self.side) as Arc<dyn FlowSide>)
    }

    async fn close(&self) {
        self.inner.close().await;
    }
}

#[async_trait]
impl FlowSide for Side {
    fn prepare(&self, channel: &ChannelName, depth: u32) -> Result<(), BrokerError> {
        self.server.state.lock().channels.insert(channel.to_string(), depth);
        Ok(())
    }

    fn release(&self, channel: &ChannelName) {
        self.server.state.lock().channels.remove(channel.as_str());
    }

    async fn load_leases(&self) -> Result<Vec<(String, Bytes)>, BrokerError> {
        let state = self.server.state.lock();
        if state.mute {
            return Err(BrokerError::Away("no answer".to_owned()));
        }
        Ok(state.leases.clone().into_iter().collect())
    }

    fn put_lease(&self, key: &str, value: Bytes) {
        let mut state = self.server.state.lock();
        state.writes += 1;
        state.leases.insert(key.to_owned(), value);
    }

    fn remove_lease(&self, key: &str) {
        let mut state = self.server.state.lock();
        state.writes += 1;
        state.leases.remove(key);
    }

    fn forget_writer(&self, channel: &ChannelName, writer: WriterId) {
        self.server.hub.forget_writer(channel, writer);
    }

    fn stand_back(&self, for_whom: Option<String>) {
        match &for_whom {
            Some(other) => self.set_health(Health::InUse, &format!("{other} uses it")),
            None => self.set_health(Health::Up, "free"),
        }
        *self.standing_back.lock() = for_whom;
    }
}

struct FakePublisher {
    server: Server,
    channel: String,
    inner: Arc<dyn Publisher>,
}

impl Publisher for FakePublisher {
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        self.inner.publish(frame, deadline)
    }

    fn publish_bare(&self, payload: &Bytes, deadline: Option<Instant>) -> PublishOutcome {
        self.inner.publish_bare(payload, deadline)
    }

    fn later(&self) -> Later {
        self.server.state.lock().later.get(&self.channel).copied().unwrap_or_default()
    }
}
