//! Numbered messages from one broker to another, and what becomes of each.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use blaze_proto::Frame;
use blaze_tests::ledger::{Fate, Identity, Ledger};
use blaze_tests::plain::{KafkaReader, KafkaWriter, RedisReader};
use blaze_tests::wait;
use bytes::Bytes;
use parking_lot::Mutex;

use crate::real::support::SOON;

/// One direction: a thread that publishes and one that listens.
pub(crate) struct Numbered {
    pub(crate) log: Arc<Mutex<Ledger>>,
    publishing: Arc<AtomicBool>,
    listening: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Numbered {
    /// Publishes payloads of this size, one in each period.
    pub(crate) fn start(
        period: Duration,
        bytes: usize,
        mut publish: impl FnMut(&[u8]) -> bool + Send + 'static,
        mut listen: impl FnMut() -> Option<(Identity, Vec<u8>)> + Send + 'static,
    ) -> Self {
        let log = Arc::<Mutex<Ledger>>::default();
        let (publishing, listening) =
            (Arc::new(AtomicBool::new(true)), Arc::new(AtomicBool::new(true)));
        let (kept, goes_on) = (Arc::clone(&log), Arc::clone(&listening));
        let sink = std::thread::spawn(move || {
            while goes_on.load(Ordering::Relaxed) {
                if let Some((identity, payload)) = listen() {
                    kept.lock().take(identity, &payload, Instant::now());
                }
            }
        });
        let (kept, goes_on) = (Arc::clone(&log), Arc::clone(&publishing));
        let source = std::thread::spawn(move || {
            let mut next = Instant::now();
            for number in 1.. {
                if !goes_on.load(Ordering::Relaxed) {
                    break;
                }
                let payload = format!("{number} {}", ".".repeat(bytes));
                let at = Instant::now();
                if publish(payload.as_bytes()) {
                    kept.lock().publish(number, at);
                }
                next += period;
                std::thread::sleep(next.saturating_duration_since(Instant::now()));
            }
        });
        Self { log, publishing, listening, threads: vec![sink, source] }
    }

    /// From a topic of Kafka to a channel of Redis.
    pub(crate) fn from_kafka(
        (kafka, topic): (&str, String),
        (redis, channel): (&str, &str),
        period: Duration,
        bytes: usize,
    ) -> anyhow::Result<Self> {
        let mut reader = RedisReader::new(redis, channel)?;
        // Made by the flow when the advertise was accepted.
        drop(KafkaReader::from_end(kafka, &topic)?);
        let writer = KafkaWriter::new(kafka)?;
        let publish = move |payload: &[u8]| writer.produce_later(&topic, payload).is_ok();
        Ok(Self::start(period, bytes, publish, move || {
            let frame = Frame::parse(Bytes::from(reader.poll().ok()??)).ok()?;
            let identity = (frame.writer().to_string(), frame.sequence());
            Some((identity, frame.payload().to_vec()))
        }))
    }

    /// Waits until something that was published after a moment has come.
    pub(crate) fn wait_fresh(&self, after: Instant, what: &str) -> anyhow::Result<()> {
        let has_come = || {
            let log = self.log.lock();
            let first = log.published().iter().find(|(_, at)| *at > after);
            first.is_some_and(|(first, _)| log.last_arrived() >= Some(*first))
        };
        wait::until(what, SOON, has_come, || {
            format!("last came {:?}", self.log.lock().last_arrived())
        })?;
        Ok(())
    }

    /// Stops publishing, waits for the last message, and counts from the first that came on.
    pub(crate) fn finish(&self) -> anyhow::Result<Fate> {
        self.publishing.store(false, Ordering::Relaxed);
        let ends = || {
            let log = self.log.lock();
            (log.last_published(), log.last_arrived())
        };
        let has_come = || {
            let (published, arrived) = ends();
            published == arrived
        };
        wait::until("the last message arrives", SOON, has_come, || format!("{:?}", ends()))?;
        let log = self.log.lock();
        let first = log.arrived().first().map_or(1, |(number, _)| *number);
        Ok(log.fate(|number, _| number >= first))
    }
}

impl Drop for Numbered {
    fn drop(&mut self) {
        self.publishing.store(false, Ordering::Relaxed);
        self.listening.store(false, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}
