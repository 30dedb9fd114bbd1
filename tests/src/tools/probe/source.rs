//! Publishing.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_sdk::{Advertise, Lease, PublishOptions, Publisher, ServiceManager};
use bytes::Bytes;
use rand::rngs::StdRng;
use rand::{Rng as _, SeedableRng as _};
use tokio::signal::unix::{SignalKind, signal};

use super::{LARGE_BYTES, Options, Payload, Topic};

const ROW: Duration = Duration::from_secs(1);

/// One topic that is published.
struct Source {
    publisher: Publisher,
    payloads: Vec<Bytes>,
    published: usize,
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
            payloads: payloads(&topic.payload, topic.bytes)?,
            published: 0,
            period: Duration::from_secs_f64(1.0 / topic.hz),
            due: Instant::now(),
            _lease: service.flow().advertise(advertise).await?,
        })
    }
}

/// Payloads that are the same in each run.
fn payloads(kind: &Payload, bytes: usize) -> anyhow::Result<Vec<Bytes>> {
    match kind {
        Payload::Noise => {
            let mut payload = vec![0; bytes];
            StdRng::seed_from_u64(0).fill_bytes(&mut payload);
            Ok(vec![payload.into()])
        }
        Payload::File(path) => {
            let parts = std::fs::read(path).with_context(|| format!("{}", path.display()))?;
            let parts: Vec<Bytes> =
                parts.chunks_exact(bytes.max(1)).map(Bytes::copy_from_slice).collect();
            anyhow::ensure!(!parts.is_empty(), "{} is shorter than {bytes} bytes", path.display());
            Ok(parts)
        }
    }
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
                next.publisher.publish(next.payloads[next.published % next.payloads.len()].clone());
                next.published += 1;
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
    println!("{}", serde_json::json!({ "kind": "row", "ended": ended, "topics": topics }));
}
