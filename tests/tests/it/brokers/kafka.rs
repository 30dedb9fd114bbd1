//! The Kafka adapter against a real broker.

mod accounts;
mod identities;
mod offsets;
mod outages;
mod plain;
mod rules;
mod topics;
mod worker;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_brokers::kafka::KafkaBroker;
use blaze_brokers::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Content, FlowSide, Health, PublishOutcome,
    Publisher, PublisherOptions, Received, Role, SubscribeOptions, Subscription,
};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::KafkaBroker as Section;
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use blaze_tests::servers::{KafkaOptions, KafkaServer, unique_name};
use bytes::Bytes;
use tokio::sync::watch;

use super::support::wait_for;
pub(super) use super::support::{DEADLINE, WITH_KEPT};

/// How long silence must last to count as silence.
pub(crate) const SILENCE: Duration = Duration::from_millis(500);

/// A server of a test's own.
pub(crate) fn start_server() -> KafkaServer {
    KafkaServer::start(KafkaOptions::default()).unwrap()
}

pub(crate) fn section(server: &KafkaServer, prefix: &str) -> Section {
    Section {
        bootstrap: vec![server.bootstrap()],
        prefix: prefix.to_owned(),
        password_file: None,
        properties: BTreeMap::new(),
    }
}

pub(crate) fn flow_role() -> Role {
    Role::Flow { flow: "fog/server-1".parse().unwrap(), epoch: 1 }
}

pub(crate) fn open(server: &KafkaServer, role: &Role) -> KafkaBroker {
    KafkaBroker::open(&section(server, ""), role).unwrap()
}

/// Waits until a client says so; returns how long it took.
pub(crate) async fn health(broker: &dyn Broker, health: Health) -> Duration {
    let start = Instant::now();
    wait_for(broker, health).await;
    start.elapsed()
}

/// The flow's client of a server, and channels that it makes for others.
pub(crate) struct Flow {
    pub(crate) broker: KafkaBroker,
    pub(crate) side: Arc<dyn FlowSide>,
    bootstrap: String,
}

impl Flow {
    pub(crate) async fn open(server: &KafkaServer) -> Self {
        let broker = open(server, &flow_role());
        health(&broker, Health::Up).await;
        let side = broker.flow_side().unwrap();
        let bootstrap = server.bootstrap();
        Self { broker, side, bootstrap }
    }

    /// A channel of a new name, which the server has when this returns.
    pub(crate) async fn channel(&self, stem: &str, depth: u32) -> ChannelName {
        let channel: ChannelName = unique_name(stem).parse().unwrap();
        self.side.prepare(&channel, depth).unwrap();
        let bootstrap = self.bootstrap.clone();
        let topic = channel.as_str().replace('/', ".");
        eventually("the topic is made", async || plain::has_topic(&bootstrap, &topic)).await;
        channel
    }
}

/// Subscribes as soon as the server has the topic.
pub(crate) async fn subscribe(
    broker: &dyn Broker,
    channel: &ChannelName,
    options: SubscribeOptions,
) -> Reader {
    let until = Instant::now() + DEADLINE;
    loop {
        match broker.subscribe(channel, options).await {
            Ok(subscription) => {
                return Reader { subscription, waiting: Vec::new() };
            }
            Err(BrokerError::Away(_)) if Instant::now() < until => {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
            Err(error) => panic!("{channel}: {error}"),
        }
    }
}

pub(crate) async fn reader(broker: &dyn Broker, channel: &ChannelName) -> Reader {
    subscribe(broker, channel, SubscribeOptions::default()).await
}

/// A subscription with deadlines.
pub(crate) struct Reader {
    subscription: Subscription,
    waiting: Vec<Received>,
}

impl Reader {
    pub(crate) async fn next(&mut self) -> Received {
        match self.next_within(DEADLINE).await {
            Some(received) => received,
            None => panic!("nothing was received"),
        }
    }

    pub(crate) async fn next_within(&mut self, time: Duration) -> Option<Received> {
        if self.waiting.is_empty() {
            let mut batch = Vec::new();
            let _ = tokio::time::timeout(time, self.subscription.receive(&mut batch, 256)).await;
            batch.reverse();
            self.waiting = batch;
        }
        self.waiting.pop()
    }

    pub(crate) async fn next_frame(&mut self) -> Frame {
        match self.next().await.content {
            Content::Frame(frame) => frame,
            other => panic!("a frame was expected, but it was {other:?}"),
        }
    }

    pub(crate) async fn next_bare(&mut self) -> (Bytes, Option<(WriterId, u64)>) {
        match self.next().await.content {
            Content::Bare { payload, identity } => (payload, identity),
            other => panic!("a bare payload was expected, but it was {other:?}"),
        }
    }

    pub(crate) async fn is_silent(&mut self) -> bool {
        self.next_within(SILENCE).await.is_none()
    }
}

pub(crate) fn frame(channel: &ChannelName, writer: u8, sequence: u64) -> Frame {
    let header = Header {
        encoding: "text/plain".to_owned(),
        ..Header::new(channel.as_str(), Origin::default(), WriterId([writer; 16]), sequence, 1)
    };
    Frame::new(&header, Bytes::from(sequence.to_string())).unwrap()
}

pub(crate) fn publisher(
    broker: &dyn Broker,
    channel: &ChannelName,
    depth: u32,
) -> Arc<dyn Publisher> {
    let options = PublisherOptions { depth, reliable: true, large: false };
    broker.publisher(channel, options).unwrap()
}

pub(crate) fn publish(publisher: &dyn Publisher, frame: &Frame) {
    assert_eq!(publisher.publish(frame, None), PublishOutcome::Taken);
}

/// Waits on a condition.
pub(crate) async fn eventually(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let until = Instant::now() + DEADLINE;
    while !holds().await {
        assert!(Instant::now() < until, "{what}: not in time");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// A service's client, for which the flow makes each channel that it uses.
pub(crate) struct Prepared {
    pub(crate) client: KafkaBroker,
    pub(crate) side: Arc<dyn FlowSide>,
}

#[async_trait]
impl Broker for Prepared {
    fn kind(&self) -> BrokerKind {
        self.client.kind()
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.client.status()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        self.side.prepare(channel, options.depth)?;
        self.client.publisher(channel, options)
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.side.prepare(channel, 0)?;
        let until = Instant::now() + Duration::from_secs(10);
        loop {
            let done = self.client.subscribe(channel, options).await;
            if !matches!(done, Err(BrokerError::Away(_))) || Instant::now() > until {
                return done;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    async fn close(&self) {
        self.client.close().await;
    }
}
