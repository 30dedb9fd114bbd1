//! The memory adapter, by the rules for all adapters and some of its own.

use std::sync::Arc;

use async_trait::async_trait;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Content, PublishOutcome, PublisherOptions, SubscribeOptions};
use blaze_conformance::broker::{Capabilities, Fixture};
use blaze_domain::names::ChannelName;
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

use super::support::WITH_KEPT;

struct Memory {
    hub: MemoryHub,
}

impl Memory {
    async fn start() -> Self {
        Self { hub: MemoryHub::new("conformance") }
    }
}

#[async_trait]
impl Fixture for Memory {
    fn capabilities(&self) -> Capabilities {
        Capabilities { queue_bytes: 0, channels: 5_000, ..Capabilities::default() }
    }

    async fn broker(&self) -> Result<Arc<dyn Broker>, String> {
        Ok(Arc::new(self.hub.broker()))
    }

    async fn stop_server(&self) -> Result<(), String> {
        self.hub.cut();
        Ok(())
    }

    async fn start_server(&self) -> Result<(), String> {
        self.hub.restore();
        Ok(())
    }

    async fn readers_of(&self, channel: &ChannelName) -> Option<usize> {
        Some(self.hub.subscriptions_of(channel))
    }

    async fn leftovers(&self) -> Vec<String> {
        let stats = self.hub.stats();
        (stats.subscriptions > 0)
            .then(|| format!("{} subscriptions", stats.subscriptions))
            .into_iter()
            .collect()
    }
}

blaze_conformance::broker_conformance_tests!(Memory::start());

fn channel(name: &str) -> ChannelName {
    name.parse().unwrap()
}

fn frame(sequence: u64, payload: Bytes) -> Frame {
    let header = Header::new("t", Origin::default(), WriterId([1; 16]), sequence, 0);
    Frame::new(&header, payload).unwrap()
}

#[tokio::test]
async fn payloads_are_shared_not_copied() {
    let hub = MemoryHub::new("shared");
    let broker = hub.broker();
    let mut subscription =
        broker.subscribe(&channel("t"), SubscribeOptions::default()).await.unwrap();
    let publisher = broker.publisher(&channel("t"), PublisherOptions::default()).unwrap();
    let payload = Bytes::from(vec![7; 1_000_000]);
    assert_eq!(publisher.publish(&frame(1, payload.clone()), None), PublishOutcome::Taken);
    let mut batch = Vec::new();
    subscription.receive(&mut batch, 1).await;
    let Content::Frame(found) = &batch[0].content else {
        panic!("{batch:?}");
    };
    assert_eq!(found.payload().as_ptr(), payload.as_ptr());
}

#[tokio::test]
async fn channels_that_nobody_uses_are_forgotten() {
    let hub = MemoryHub::new("churn");
    let broker = hub.broker();
    for number in 0..10_000 {
        let name = channel(&format!("churn/{number}"));
        drop(broker.publisher(&name, PublisherOptions::default()).unwrap());
        drop(broker.subscribe(&name, SubscribeOptions::default()).await.unwrap());
    }
    let stats = hub.stats();
    assert!(stats.channels <= 64, "{stats:?}");
    assert_eq!(stats.subscriptions, 0);
}

#[tokio::test]
async fn kept_messages_tell_how_long_they_lay_there() {
    let hub = MemoryHub::new("kept");
    let broker = hub.broker();
    let options = PublisherOptions { depth: 1, ..PublisherOptions::default() };
    let publisher = broker.publisher(&channel("t"), options).unwrap();
    let before = std::time::Instant::now();
    publisher.publish(&frame(1, Bytes::new()), None);
    let published = std::time::Instant::now();
    while published.elapsed() < std::time::Duration::from_millis(5) {
        tokio::task::yield_now().await;
    }
    let mut subscription = broker.subscribe(&channel("t"), WITH_KEPT).await.unwrap();
    let mut batch = Vec::new();
    subscription.receive(&mut batch, 1).await;
    let age = u128::from(batch[0].broker_age_us);
    assert!((5_000..=before.elapsed().as_micros()).contains(&age), "{age}");
}
