//! Publishing.

use std::time::{Duration, Instant};

use blaze_sdk::{Advertise, Lease, PublishOptions, Publisher, ServiceManager};
use bytes::Bytes;
use tokio::signal::unix::{SignalKind, signal};

use crate::{LARGE_BYTES, Options, Payload, Topic};

const ROW: Duration = Duration::from_secs(1);

/// One topic that is published.
struct Source {
    publisher: Publisher,
    payload: Bytes,
    period: Duration,
    due: Instant,
    _lease: Lease,
}

impl Source {
    async fn open(service: &ServiceManager, topic: &Topic) -> anyhow::Result<Self> {
        let terms = PublishOptions {
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            large: topic.bytes >= LARGE_BYTES,
            ..PublishOptions::default()
        };
        let advertise = Advertise {
            rate_hz: Some(topic.hz),
            max_bytes: Some(topic.bytes as u64),
            reliability: topic.reliability,
            lifespan: topic.lifespan,
            ..Advertise::new(topic.name.clone())
        };
        Ok(Self {
            publisher: service.broker().publisher(&topic.name, &terms)?,
            payload: payload(topic.payload, topic.bytes),
            period: Duration::from_secs_f64(1.0 / topic.hz),
            due: Instant::now(),
            _lease: service.flow().advertise(advertise).await?,
        })
    }
}

/// Bytes that are the same in each run.
fn payload(kind: Payload, bytes: usize) -> Bytes {
    // A linear congruential generator (Knuth, MMIX): its upper bits are as good as random here.
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    // Rows of 640 pixels of three bytes.
    let pixel = |at: usize| (at % 1920 / 12 + at / 1920 / 4) as u8;
    let content = (0..bytes).map(|at| match kind {
        Payload::Noise => random(),
        Payload::Image => pixel(at).wrapping_add(random() % 3),
    });
    content.collect::<Vec<u8>>().into()
}

/// Publishes until SIGUSR1 or the end of its time; the leases stay until the end of its time.
pub(crate) async fn publish(service: &ServiceManager, options: &Options) -> anyhow::Result<()> {
    let mut stop = signal(SignalKind::user_defined1())?;
    let end = tokio::time::Instant::now() + Duration::from_secs(options.duration);
    let mut sources = Vec::new();
    for topic in &options.topic {
        sources.push(Source::open(service, topic).await?);
    }
    let mut rows = tokio::time::interval(ROW);
    while let Some(next) = sources.iter_mut().min_by_key(|source| source.due) {
        tokio::select! {
            () = tokio::time::sleep_until(next.due.into()) => {
                next.publisher.publish(next.payload.clone());
                next.due += next.period;
            }
            _ = rows.tick() => print(&sources, false),
            _ = stop.recv() => break,
            () = tokio::time::sleep_until(end) => return Ok(()),
        }
    }
    print(&sources, true);
    tokio::time::sleep_until(end).await;
    Ok(())
}

fn print(sources: &[Source], ended: bool) {
    let topics = sources.iter().map(|source| {
        serde_json::json!({
            "topic": source.publisher.topic().as_str(),
            "sent": source.publisher.sequence(),
            "dropped": source.publisher.dropped_later(),
        })
    });
    let topics: Vec<_> = topics.collect();
    println!(
        "{}",
        serde_json::json!({ "kind": "row", "ended": ended, "topics": topics })
    );
}
