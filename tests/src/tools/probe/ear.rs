//! Listening.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use blaze_domain::TopicName;
use blaze_sdk::{Lease, Message, Request, ServiceManager, SubscribeOptions, Subscription};
use parking_lot::Mutex;

use super::{LARGE_BYTES, Options, Topic};

/// Latencies that are kept between two lines of output.
const MAX_LATENCIES: usize = 10_000;

/// Prints a row each second until the end of its time.
pub(crate) async fn listen(service: &ServiceManager, options: &Options) -> anyhow::Result<()> {
    let mut ears = Vec::new();
    for topic in &options.topic {
        ears.push(Ear::open(service, topic).await?);
    }
    for _ in 0..options.duration {
        tokio::time::sleep(Duration::from_secs(1)).await;
        let topics: Vec<_> = ears.iter().map(Ear::row).collect();
        println!("{}", serde_json::json!({ "kind": "row", "topics": topics }));
    }
    Ok(())
}

/// One topic that is listened to.
struct Ear {
    topic: TopicName,
    subscription: Subscription,
    heard: Arc<Heard>,
    _lease: Lease,
}

#[derive(Default)]
struct Heard {
    latencies_us: Mutex<Vec<u64>>,
    /// Sequence of the last message; of its writer, so only of use where there is one.
    last: AtomicU64,
}

impl Ear {
    async fn open(service: &ServiceManager, topic: &Topic) -> anyhow::Result<Self> {
        let heard = Arc::<Heard>::default();
        let kept = Arc::clone(&heard);
        let subscribe =
            SubscribeOptions { large: topic.bytes >= LARGE_BYTES, ..SubscribeOptions::default() };
        let hear = move |message: Message| {
            kept.last.store(message.sequence().unwrap_or(0), Ordering::Relaxed);
            let mut latencies = kept.latencies_us.lock();
            if latencies.len() < MAX_LATENCIES {
                latencies.extend(latency_us(&message));
            }
        };
        let request = Request {
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            ..Request::new(topic.name.clone())
        };
        // On Kafka the flow makes the topic when it takes the request, so the request comes first.
        let lease = service.flow().request(request).await?;
        Ok(Self {
            topic: topic.name.clone(),
            subscription: service.broker().subscribe(&topic.name, subscribe, hear).await?,
            heard,
            _lease: lease,
        })
    }

    /// Totals, and the latencies since the last call.
    fn row(&self) -> serde_json::Value {
        let stats = self.subscription.stats();
        serde_json::json!({
            "topic": self.topic.as_str(),
            "received": stats.delivered,
            "lost": stats.lost,
            "duplicated": stats.duplicated,
            "reordered": stats.reordered,
            "last": self.heard.last.load(Ordering::Relaxed),
            "latencies_us": std::mem::take(&mut *self.heard.latencies_us.lock()),
        })
    }
}

fn latency_us(message: &Message) -> Option<u64> {
    let on_the_way = SystemTime::now().duration_since(message.publish_time()?).ok()?;
    u64::try_from(on_the_way.as_micros()).ok()
}
