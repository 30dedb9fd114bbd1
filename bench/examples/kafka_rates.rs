//! Rates, latencies and idle cost of the Kafka adapter, against a server: `kafka_rates HOST:PORT [MESSAGES] [LINGER_MS]`.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a measurement stops at the first surprise"
)]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use blaze_brokers::kafka::KafkaBroker;
use blaze_brokers::{
    Broker, Content, Health, PublishOutcome, Publisher, PublisherOptions, Role, SubscribeOptions, Subscription,
};
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{LayerBroker, NodeFile};
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use bytes::Bytes;

const PAYLOAD: usize = 1000;

struct Bench {
    broker: KafkaBroker,
    run: String,
}

fn now_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    u64::try_from(since.as_nanos()).unwrap()
}

fn frame(channel: &ChannelName, writer: u8, sequence: u64, payload: Bytes) -> Frame {
    let origin = Origin {
        layer: "fog".to_owned(),
        node: "server-1".to_owned(),
        ..Origin::default()
    };
    let header = Header {
        encoding: "application/octet-stream".to_owned(),
        ..Header::new(channel.as_str(), origin, WriterId([writer; 16]), sequence, now_ns())
    };
    Frame::new(&header, payload).unwrap()
}

fn cpu() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    let ticks: u64 = fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap();
    Duration::from_millis(ticks * 10)
}

impl Bench {
    async fn open(bootstrap: &str, linger_ms: &str) -> Self {
        let tree = serde_json::json!({
            "layer": {"name": "fog", "kind": "fog"},
            "node": {"name": "server-1"},
            "brokers": {"layer": {"kafka": {"bootstrap": [bootstrap], "properties": {"linger.ms": linger_ms}}}},
        });
        let (file, _) = NodeFile::read(&tree).unwrap();
        let Some(LayerBroker::Kafka(section)) = &file.brokers.layer else {
            unreachable!("the file above names Kafka");
        };
        let role = Role::Flow {
            flow: file.flow_id().unwrap(),
            epoch: 1,
        };
        let start = Instant::now();
        let broker = KafkaBroker::open(section, &role).unwrap();
        let mut status = broker.status();
        status.wait_for(|status| status.health == Health::Up).await.unwrap();
        println!("up after {:?}: {}", start.elapsed(), status.borrow().detail);
        Self {
            broker,
            run: format!("bench-{}", std::process::id()),
        }
    }

    async fn topic(&self, name: &str, large: bool) -> (ChannelName, Arc<dyn Publisher>, Subscription) {
        let channel: ChannelName = format!("{}/{name}", self.run).parse().unwrap();
        let start = Instant::now();
        self.broker.flow_side().unwrap().prepare(&channel, 0).unwrap();
        let options = SubscribeOptions {
            max_messages: 1_000_000,
            max_bytes: 2_000_000_000,
            large,
            ..SubscribeOptions::default()
        };
        let subscription = loop {
            match self.broker.subscribe(&channel, options).await {
                Ok(subscription) => break subscription,
                Err(_) => tokio::time::sleep(Duration::from_millis(5)).await,
            }
        };
        println!("topic {name} made and subscribed after {:?}", start.elapsed());
        let options = PublisherOptions {
            reliable: true,
            large,
            ..PublisherOptions::default()
        };
        let publisher = self.broker.publisher(&channel, options).unwrap();
        (channel, publisher, subscription)
    }

    async fn throughput(&self, messages: u64) {
        let (channel, publisher, mut subscription) = self.topic("rate", false).await;
        let (start, cpu_before) = (Instant::now(), cpu());
        let sender = Arc::clone(&publisher);
        let thread = std::thread::spawn(move || {
            let payload = Bytes::from(vec![7; PAYLOAD]);
            for sequence in 1..=messages {
                while sender.later().queued > 20_000 {
                    std::thread::sleep(Duration::from_micros(200));
                }
                let outcome = sender.publish(&frame(&channel, 1, sequence, payload.clone()), None);
                assert_eq!(outcome, PublishOutcome::Taken);
            }
            while sender.later().queued > 0 {
                std::thread::sleep(Duration::from_micros(200));
            }
            start.elapsed()
        });
        let (mut received, mut last) = (0, 0);
        let mut batch = Vec::new();
        while received < messages {
            let wait = subscription.receive(&mut batch, 1024);
            if tokio::time::timeout(Duration::from_secs(10), wait).await.is_err() {
                break;
            }
            for message in batch.drain(..) {
                let Content::Frame(frame) = message.content else {
                    continue;
                };
                assert_eq!(frame.sequence(), last + 1);
                last = frame.sequence();
                received += 1;
            }
        }
        let all = start.elapsed();
        let acknowledged = thread.join().unwrap();
        let rate = |time: Duration| messages as f64 / time.as_secs_f64();
        println!(
            "{messages} messages of {PAYLOAD} B: acknowledged {:.0}/s, received {received} at {:.0}/s, own CPU {:?}; {:?}",
            rate(acknowledged),
            rate(all),
            cpu() - cpu_before,
            publisher.later()
        );
    }

    async fn latency(&self, name: &str, payload: usize, hz: u32, count: u64) {
        let (channel, publisher, mut subscription) = self.topic(name, payload > 65_536).await;
        let mut ticks = tokio::time::interval(Duration::from_secs(1) / hz);
        let payload = Bytes::from(vec![7; payload]);
        let mut sent = BTreeMap::new();
        let mut latencies = Vec::new();
        let mut ages = Vec::new();
        let mut batch = Vec::new();
        let (mut sequence, cpu_before, start) = (0, cpu(), Instant::now());
        while latencies.len() < usize::try_from(count).unwrap() && start.elapsed() < Duration::from_secs(60) {
            tokio::select! {
                _ = ticks.tick(), if sequence < count => {
                    sequence += 1;
                    sent.insert(sequence, Instant::now());
                    publisher.publish(&frame(&channel, 1, sequence, payload.clone()), None);
                }
                _ = subscription.receive(&mut batch, 64) => {
                    for message in batch.drain(..) {
                        let Content::Frame(frame) = message.content else { continue };
                        latencies.push(sent[&frame.sequence()].elapsed());
                        ages.push(message.broker_age_us);
                    }
                }
            }
        }
        let share = (cpu() - cpu_before).as_secs_f64() / start.elapsed().as_secs_f64();
        latencies.sort_unstable();
        ages.sort_unstable();
        let at = |share: usize| latencies[(latencies.len() - 1) * share / 100];
        println!(
            "{name}: {} of {count} at {hz} Hz: p50 {:?}, p99 {:?}, longest {:?}; broker age p50 {} µs; own CPU {:.1} %",
            latencies.len(),
            at(50),
            at(99),
            at(100),
            ages[ages.len() / 2],
            share * 100.0
        );
    }

    async fn idle(&self) {
        let _held = self.topic("idle", false).await;
        let (before, start) = (cpu(), Instant::now());
        tokio::time::sleep(Duration::from_secs(10)).await;
        let threads = std::fs::read_dir("/proc/self/task").unwrap().count();
        let share = (cpu() - before).as_secs_f64() / start.elapsed().as_secs_f64();
        println!("idle: own CPU {:.2} %, {threads} threads", share * 100.0);
    }
}

#[tokio::main]
async fn main() {
    let mut arguments = std::env::args().skip(1);
    let bootstrap = arguments.next().expect("HOST:PORT");
    let messages = arguments.next().map_or(300_000, |text| text.parse().expect("a number"));
    let linger = arguments.next().unwrap_or_else(|| "0".to_owned());
    let bench = Bench::open(&bootstrap, &linger).await;
    if std::env::args().count() < 5 {
        bench.idle().await;
    }
    bench.latency("small", 400, 50, 500).await;
    bench.latency("image", 1_000_000, 10, 60).await;
    bench.throughput(messages).await;
    bench.throughput(messages).await;
    let start = Instant::now();
    bench.broker.close().await;
    println!("closed after {:?}", start.elapsed());
}
