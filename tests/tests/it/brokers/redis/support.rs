//! Servers, clients, frames and waits.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_brokers::redis::{MAX_QUEUE_BYTES, RedisBroker};
use blaze_brokers::{
    Broker, Content, Health, PublishOutcome, Publisher, PublisherOptions, Received, Role,
    SubscribeOptions, Subscription,
};
use blaze_conformance::broker::{Capabilities, Fixture};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{NodeBroker, NodeFile, RedisBroker as Section};
use blaze_proto::Frame;
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};

use super::super::support::WITH_KEPT;
pub(super) use super::super::support::{DEADLINE, eventually, wait_for, writer};

/// How long silence must last to count as silence.
pub(super) const SILENCE: Duration = Duration::from_millis(300);

/// A server of one test.
pub(super) struct Server {
    pub(super) server: RedisServer,
}

impl Server {
    pub(super) fn start(kind: RedisKind) -> Self {
        Self::with(kind, RedisOptions::default())
    }

    pub(super) fn with(kind: RedisKind, options: RedisOptions) -> Self {
        Self { server: RedisServer::start(kind, options).unwrap() }
    }

    pub(super) fn section(&self) -> Section {
        section(&self.server.url())
    }

    /// A service's client that is connected.
    pub(super) async fn service(&self) -> RedisBroker {
        let broker = RedisBroker::open(&self.section(), &Role::Service).unwrap();
        wait_for(&broker, Health::Up).await;
        broker
    }

    /// A flow's client; it need not own the scope yet.
    pub(super) fn flow(&self, flow: &str, epoch: u64) -> RedisBroker {
        let role = Role::Flow { flow: flow.parse().unwrap(), epoch };
        RedisBroker::open(&self.section(), &role).unwrap()
    }

    pub(super) fn cli(&self, arguments: &[&str]) -> String {
        self.server.cli(arguments).unwrap()
    }

    fn clients(&self) -> Vec<String> {
        let list = self.cli(&["CLIENT", "LIST"]);
        let others = |line: &&str| !line.is_empty() && !line.contains("cmd=client");
        list.lines().filter(others).map(str::to_owned).collect()
    }
}

#[async_trait]
impl Fixture for Server {
    fn capabilities(&self) -> Capabilities {
        Capabilities { queue_bytes: MAX_QUEUE_BYTES, channels: 2_000, ..Capabilities::default() }
    }

    async fn broker(&self) -> Result<Arc<dyn Broker>, String> {
        match RedisBroker::open(&self.section(), &Role::Service) {
            Ok(broker) => Ok(Arc::new(broker)),
            Err(error) => Err(error.to_string()),
        }
    }

    async fn stop_server(&self) -> Result<(), String> {
        self.server.kill().map_err(|error| error.to_string())
    }

    async fn start_server(&self) -> Result<(), String> {
        self.server.restart().map_err(|error| error.to_string())
    }

    async fn readers_of(&self, channel: &ChannelName) -> Option<usize> {
        let answer = self.cli(&["PUBSUB", "NUMSUB", channel.as_str()]);
        answer.lines().nth(1)?.trim().parse().ok()
    }

    async fn leftovers(&self) -> Vec<String> {
        // The server sees the end of a connection a moment later.
        let until = Instant::now() + DEADLINE;
        loop {
            let clients = self.clients();
            if clients.is_empty() || Instant::now() > until {
                return clients;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

pub(super) fn section(url: &str) -> Section {
    section_of(&serde_json::json!({ "url": url }))
}

/// A section as the node file would give it.
pub(super) fn section_of(redis: &serde_json::Value) -> Section {
    let tree = serde_json::json!({ "brokers": { "node": { "redis": redis } } });
    match NodeFile::read(&tree).unwrap().0.brokers.node {
        Some(NodeBroker::Redis(section)) => section,
        other => panic!("{other:?}"),
    }
}

pub(super) fn channel(name: &str) -> ChannelName {
    name.parse().unwrap()
}

pub(super) fn frame(number: u8, sequence: u64, bytes: usize) -> Frame {
    super::super::support::frame("test", number, sequence, bytes)
}

pub(super) fn publisher(broker: &dyn Broker, name: &str, depth: u32) -> Arc<dyn Publisher> {
    let options = PublisherOptions { depth, ..PublisherOptions::default() };
    broker.publisher(&channel(name), options).unwrap()
}

/// Publishes and insists that it is taken.
pub(super) fn publish(publisher: &dyn Publisher, number: u8, sequence: u64) {
    assert_eq!(publisher.publish(&frame(number, sequence, 100), None), PublishOutcome::Taken);
}

/// Waits until the server has all that was taken.
pub(super) async fn settled(publisher: &dyn Publisher) {
    eventually("all is at the server", || (publisher.later().queued == 0).then_some(())).await;
    assert_eq!(publisher.later().dropped(), 0, "{:?}", publisher.later());
}

pub(super) async fn subscribe(broker: &dyn Broker, name: &str) -> Subscription {
    broker.subscribe(&channel(name), SubscribeOptions::default()).await.unwrap()
}

pub(super) async fn subscribe_with_kept(broker: &dyn Broker, name: &str) -> Subscription {
    broker.subscribe(&channel(name), WITH_KEPT).await.unwrap()
}

/// The next message.
pub(super) async fn next(subscription: &mut Subscription) -> Received {
    let mut batch = Vec::new();
    let received = tokio::time::timeout(DEADLINE, subscription.receive(&mut batch, 1)).await;
    assert_eq!(received, Ok(1), "a message within {DEADLINE:?}");
    batch.pop().unwrap()
}

/// Writer and sequence of the next message.
pub(super) async fn next_number(subscription: &mut Subscription) -> (u8, u64) {
    match next(subscription).await.content {
        Content::Frame(frame) => (frame.writer().0[0], frame.sequence()),
        other => panic!("{other:?}"),
    }
}

/// What comes until nothing comes any more.
pub(super) async fn numbers_until_silence(subscription: &mut Subscription) -> Vec<u64> {
    let mut batch = Vec::new();
    while tokio::time::timeout(SILENCE, subscription.receive(&mut batch, 1000))
        .await
        .is_ok_and(|count| count > 0)
    {}
    let number = |message: &Received| match &message.content {
        Content::Frame(frame) => frame.sequence(),
        other => panic!("{other:?}"),
    };
    batch.iter().map(number).collect()
}
