//! How fast the Redis adapter is against a server: `cargo run --release --example redis_speed -- redis://127.0.0.1:6379`.
//!
//! ```text
//! publish         one publisher, messages of 1 kB, nobody reads
//! publish+read    the same, and one reader on a client of its own
//! small beside large   delay of 200 Hz of 1 kB, alone and beside 30 Hz of 1 MB
//! ```

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a measuring tool")]

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::redis::RedisBroker;
use blaze_brokers::{
    Broker, Content, Health, PublishOutcome, Publisher, PublisherOptions, Role, SubscribeOptions, Subscription,
};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{NodeBroker, NodeFile};
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

const RUN: Duration = Duration::from_secs(5);
/// The producer keeps this many messages in the queue at most, so that none is dropped.
const AHEAD: u64 = 8_192;

fn main() {
    let url = std::env::args()
        .nth(1)
        .unwrap_or_else(|| "redis://127.0.0.1:6379".to_owned());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let (source, sink) = (open(&url).await, open(&url).await);
        println!("server: {}", source.status().borrow().detail);
        println!("publish: {}", throughput(&source, None).await);
        println!("publish+read: {}", throughput(&source, Some(&sink)).await);
        println!("small alone: {}", delays(&source, &sink, false).await);
        println!("small beside large: {}", delays(&source, &sink, true).await);
        source.close().await;
        sink.close().await;
    });
}

async fn open(url: &str) -> RedisBroker {
    let tree = serde_json::json!({ "brokers": { "node": { "redis": { "url": url } } } });
    let Some(NodeBroker::Redis(section)) = NodeFile::read(&tree).unwrap().0.brokers.node else {
        unreachable!("the tree names redis")
    };
    let broker = RedisBroker::open(&section, &Role::Service).unwrap();
    let mut status = broker.status();
    tokio::time::timeout(
        Duration::from_secs(5),
        status.wait_for(|status| status.health == Health::Up),
    )
    .await
    .unwrap()
    .unwrap();
    broker
}

fn channel(name: &str) -> ChannelName {
    name.parse().unwrap()
}

fn frame(sequence: u64, payload: &Bytes) -> Frame {
    let origin = Origin {
        layer: "edge".to_owned(),
        node: "robot-1".to_owned(),
        service: "speed".to_owned(),
        instance: "0".to_owned(),
        epoch: 1,
    };
    let header = Header::new("speed", origin, WriterId([1; 16]), sequence, 1_700_000_000_000_000_000);
    Frame::new(&header, payload.clone()).unwrap()
}

async fn throughput(source: &RedisBroker, sink: Option<&RedisBroker>) -> String {
    let name = channel("speed/one");
    let reader = match sink {
        Some(sink) => Some(sink.subscribe(&name, SubscribeOptions::default()).await.unwrap()),
        None => None,
    };
    let publisher = source.publisher(&name, PublisherOptions::default()).unwrap();
    let counting = reader.map(|reader| tokio::task::spawn_blocking(move || count(reader)));
    let (sent, took) = tokio::task::spawn_blocking(move || produce(publisher.as_ref()))
        .await
        .unwrap();
    let rate = sent as f64 / took.as_secs_f64();
    match counting {
        None => format!("{rate:.0} messages/s ({sent} in {took:.2?})"),
        Some(counting) => {
            let (received, dropped) = counting.await.unwrap();
            format!("{rate:.0} messages/s ({sent} sent, {received} received, {dropped} dropped by the reader's ring)")
        }
    }
}

/// Publishes for a while; returns how many the server confirmed, and in what time.
fn produce(publisher: &dyn Publisher) -> (u64, Duration) {
    let payload = Bytes::from(vec![b'x'; 1_000]);
    let start = Instant::now();
    let mut sequence = 0;
    while start.elapsed() < RUN {
        while publisher.later().queued > AHEAD {
            std::thread::yield_now();
        }
        for _ in 0..64 {
            sequence += 1;
            assert_eq!(
                publisher.publish(&frame(sequence, &payload), None),
                PublishOutcome::Taken
            );
        }
    }
    while publisher.later().queued > 0 {
        std::thread::yield_now();
    }
    assert_eq!(publisher.later().dropped(), 0);
    (sequence, start.elapsed())
}

/// Reads until nothing comes for a second.
fn count(mut reader: Subscription) -> (u64, u64) {
    tokio::runtime::Handle::current().block_on(async move {
        let (mut received, mut batch) = (0, Vec::new());
        while let Ok(count) = tokio::time::timeout(Duration::from_secs(1), reader.receive(&mut batch, 256)).await {
            received += count as u64;
            batch.clear();
        }
        (received, reader.take_dropped())
    })
}

/// Delays of small messages from publishing to reading.
async fn delays(source: &RedisBroker, sink: &RedisBroker, with_large: bool) -> String {
    let name = channel("speed/small");
    let mut reader = sink.subscribe(&name, SubscribeOptions::default()).await.unwrap();
    let publisher = source.publisher(&name, PublisherOptions::default()).unwrap();
    let large = if with_large {
        Some(stream_large(source, sink).await)
    } else {
        None
    };
    let base = Instant::now();
    let mut ticks = tokio::time::interval(Duration::from_millis(5));
    let mut found: Vec<Duration> = Vec::new();
    let mut batch = Vec::new();
    while base.elapsed() < RUN {
        tokio::select! {
            _ = ticks.tick() => {
                let mut payload = vec![0; 1_000];
                payload[..8].copy_from_slice(&u64::try_from(base.elapsed().as_nanos()).unwrap().to_le_bytes());
                publisher.publish(&frame(1, &Bytes::from(payload)), None);
            }
            _ = reader.receive(&mut batch, 64) => {
                for message in batch.drain(..) {
                    if let Content::Frame(frame) = message.content {
                        let sent = u64::from_le_bytes(frame.payload()[..8].try_into().unwrap());
                        found.push(message.at.duration_since(base).saturating_sub(Duration::from_nanos(sent)));
                    }
                }
            }
        }
    }
    let large = match large {
        Some(large) => format!(", {} large ones beside", large.await.unwrap()),
        None => String::new(),
    };
    found.sort();
    let at = |part: f64| found[((found.len() - 1) as f64 * part) as usize];
    format!(
        "p50 {:.2?}, p99 {:.2?}, most {:.2?} of {}{large}",
        at(0.5),
        at(0.99),
        at(1.0),
        found.len()
    )
}

/// 30 Hz of 1 MB; gives how many arrived.
async fn stream_large(source: &RedisBroker, sink: &RedisBroker) -> tokio::task::JoinHandle<u64> {
    let name = channel("speed/large");
    let options = SubscribeOptions {
        large: true,
        ..SubscribeOptions::default()
    };
    let reader = sink.subscribe(&name, options).await.unwrap();
    let large = PublisherOptions {
        large: true,
        ..PublisherOptions::default()
    };
    let publisher: Arc<dyn Publisher> = source.publisher(&name, large).unwrap();
    let thread = std::thread::spawn(move || {
        let payload = Bytes::from(vec![b'x'; 1_000_000]);
        let start = Instant::now();
        for sequence in 1.. {
            if start.elapsed() >= RUN {
                break;
            }
            publisher.publish(&frame(sequence, &payload), None);
            std::thread::sleep(Duration::from_millis(33));
        }
    });
    tokio::task::spawn_blocking(move || {
        let (received, _) = count(reader);
        let _ = thread.join();
        received
    })
}
