//! A steady stream from a plain Redis publisher to a plain Kafka consumer, watched by two threads.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use crate::network::{Host, inside};
use crate::plain::{self, KafkaReader};

/// Messages per second.
pub const RATE_HZ: u64 = 50;

/// One arrival.
#[derive(Debug, Clone, Copy)]
pub struct Arrival {
    /// Number of the message.
    pub number: u64,
    /// When it came.
    pub at: Instant,
    /// How long it took.
    pub took: Duration,
    /// Size of its payload.
    pub bytes: usize,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    published: AtomicU64,
    arrivals: Mutex<Vec<Arrival>>,
}

/// The stream; it ends when dropped.
pub struct Stream {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl Stream {
    /// Publishes payloads of that size on a Redis channel at [`RATE_HZ`] and reads a Kafka topic.
    /// Both ends wait out a server that is away.
    ///
    /// # Errors
    /// When the topic is not there within ten seconds.
    pub fn start(
        redis: &str,
        channel: &str,
        kafka: &str,
        topic: &str,
        bytes: usize,
    ) -> anyhow::Result<Self> {
        let reader = KafkaReader::from_end(kafka, topic)?;
        let (redis, channel) = (redis.to_owned(), channel.to_owned());
        Ok(Self::with(reader, move |shared, base| {
            publish(shared, base, &redis, &channel, bytes);
        }))
    }

    /// The same between two hosts of a network, each beside its server.
    ///
    /// # Errors
    /// As [`Stream::start`], and when a host has gone.
    pub fn between(
        (from, redis, channel): (&Host, &str, &str),
        (to, kafka, topic): (&Host, &str, &str),
        bytes: usize,
    ) -> anyhow::Result<Self> {
        let reader = inside(&to.namespace, || KafkaReader::from_end(kafka, topic))?;
        let (namespace, redis, channel) =
            (from.namespace.clone(), redis.to_owned(), channel.to_owned());
        Ok(Self::with(reader, move |shared, base| {
            // Without the namespace nothing is published, which whoever waits for it will tell.
            let _ = inside(&namespace, || {
                publish(shared, base, &redis, &channel, bytes);
                Ok(())
            });
        }))
    }

    fn with(reader: KafkaReader, publish: impl FnOnce(&Shared, Instant) + Send + 'static) -> Self {
        let shared = Arc::<Shared>::default();
        let base = Instant::now();
        let (of_source, of_sink) = (Arc::clone(&shared), Arc::clone(&shared));
        let source = std::thread::spawn(move || publish(&of_source, base));
        let sink = std::thread::spawn(move || {
            while !of_sink.stop.load(Ordering::Relaxed) {
                let Some(record) = reader.next(Duration::from_millis(50)) else {
                    continue;
                };
                let at = Instant::now();
                if let Some((number, sent)) = parse(&record.payload) {
                    of_sink.arrivals.lock().push(Arrival {
                        number,
                        at,
                        took: at.saturating_duration_since(base + Duration::from_nanos(sent)),
                        bytes: record.payload.len(),
                    });
                }
            }
        });
        Self { shared, threads: vec![source, sink] }
    }

    /// Messages that a server took from the publisher.
    #[must_use]
    pub fn published(&self) -> u64 {
        self.shared.published.load(Ordering::Relaxed)
    }

    /// What arrived so far.
    #[must_use]
    pub fn arrivals(&self) -> Vec<Arrival> {
        self.shared.arrivals.lock().clone()
    }

    /// The last arrival.
    #[must_use]
    pub fn last(&self) -> Option<Arrival> {
        self.shared.arrivals.lock().last().copied()
    }

    /// Waits until something that was sent after now arrives. Returns how long it took.
    ///
    /// # Errors
    /// When nothing does in time.
    pub fn wait_fresh(&self, deadline: Duration) -> anyhow::Result<Duration> {
        let begin = Instant::now();
        loop {
            if self.last().is_some_and(|last| last.at > begin && last.at - last.took > begin) {
                return Ok(begin.elapsed());
            }
            anyhow::ensure!(begin.elapsed() < deadline, "nothing new arrives within {deadline:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Numbers that came more than once, and how often a smaller one came after a larger.
    #[must_use]
    pub fn faults(&self) -> (Vec<u64>, u64) {
        let arrivals = self.arrivals();
        let mut seen: BTreeMap<u64, u32> = BTreeMap::new();
        for arrival in &arrivals {
            *seen.entry(arrival.number).or_default() += 1;
        }
        let twice =
            seen.into_iter().filter(|(_, count)| *count > 1).map(|(number, _)| number).collect();
        let reordered =
            arrivals.windows(2).filter(|pair| pair[1].number < pair[0].number).count() as u64;
        (twice, reordered)
    }

    /// The longest time without an arrival that has a part between two moments.
    #[must_use]
    pub fn gap(&self, from: Instant, to: Instant) -> Duration {
        let arrivals = self.arrivals();
        let pairs = arrivals.windows(2).filter(|pair| pair[1].at > from && pair[0].at < to);
        let gaps = pairs.map(|pair| pair[1].at.saturating_duration_since(pair[0].at));
        gaps.max().unwrap_or(Duration::MAX)
    }

    /// Of the messages that were sent between two moments: how long the slowest hundredth took at
    /// least.
    #[must_use]
    pub fn p99(&self, from: Instant, to: Instant) -> Option<Duration> {
        let mut took: Vec<Duration> = self
            .arrivals()
            .into_iter()
            .filter(|arrival| (from..to).contains(&(arrival.at - arrival.took)))
            .map(|arrival| arrival.took)
            .collect();
        took.sort_unstable();
        took.get((took.len() * 99 / 100).min(took.len().checked_sub(1)?)).copied()
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn publish(shared: &Shared, base: Instant, redis: &str, channel: &str, bytes: usize) {
    let mut connection = None;
    let mut number = 0;
    let begin = Instant::now();
    while !shared.stop.load(Ordering::Relaxed) {
        number += 1;
        let mut payload = format!("{number} {} ", base.elapsed().as_nanos()).into_bytes();
        payload.resize(bytes.max(payload.len()), b'.');
        if connection.is_none() {
            connection = plain::connect(redis).ok();
            if let Some(connection) = &connection {
                let _ = connection.set_read_timeout(Some(Duration::from_millis(200)));
                let _ = connection.set_write_timeout(Some(Duration::from_millis(200)));
            }
        }
        let sent = connection
            .as_mut()
            .map(|connection| redis::cmd("PUBLISH").arg(channel).arg(&payload).exec(connection));
        match sent {
            Some(Ok(())) => {
                shared.published.fetch_add(1, Ordering::Relaxed);
            }
            _ => connection = None,
        }
        let next = begin + Duration::from_nanos(number * (1_000_000_000 / RATE_HZ));
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
}

fn parse(payload: &[u8]) -> Option<(u64, u64)> {
    let text = String::from_utf8_lossy(payload);
    let mut words = text.split(' ');
    Some((words.next()?.parse().ok()?, words.next()?.parse().ok()?))
}
