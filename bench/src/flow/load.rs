//! What is sent, and what is found of it at the other end.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::clients::{Sink, Source};

/// A message without a payload to speak of must hold its number and time.
const HEAD_BYTES: usize = 17;
/// Before figures are taken: connections, caches, class of the topic.
const WARM_UP: Duration = Duration::from_secs(1);
/// After the last message was sent: what is on the way may still arrive.
const DRAIN: Duration = Duration::from_secs(5);
/// Messages on the way at full speed, in bytes: enough to keep every stage busy, too few to overrun
/// any queue.
const WINDOW_BYTES: u64 = 2 * 1024 * 1024;
/// And messages: fewer than a flow holds for one topic that comes faster than it can be read.
const WINDOW_MESSAGES: u64 = 2_048;

/// What is sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Load {
    /// At a rate in Hz, with payloads of so many bytes.
    Paced(f64, usize),
    /// The same, each published by itself, as a service does that publishes what it has at once.
    Single(f64, usize),
    /// As fast as it arrives at the other end.
    Full(usize),
}

impl Load {
    pub(crate) fn all() -> Vec<Self> {
        vec![
            Self::Paced(50.0, 300),
            Self::Paced(50.0, 1_000),
            Self::Paced(10_000.0, 300),
            Self::Paced(10_000.0, 1_000),
            Self::Single(10_000.0, 1_000),
            Self::Full(300),
            Self::Full(1_000),
            Self::Paced(10.0, 1_000_000),
            Self::Full(1_000_000),
        ]
    }

    pub(crate) fn name(self) -> String {
        match self {
            Self::Paced(rate, bytes) => format!("{rate} Hz, {bytes} B"),
            Self::Single(rate, bytes) => format!("{rate} Hz singly, {bytes} B"),
            Self::Full(bytes) => format!("full speed, {bytes} B"),
        }
    }

    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Paced(_, bytes) | Self::Single(_, bytes) | Self::Full(bytes) => bytes,
        }
    }

    pub(crate) fn rate_hz(self) -> Option<f64> {
        match self {
            Self::Paced(rate, _) | Self::Single(rate, _) => Some(rate),
            Self::Full(_) => None,
        }
    }

    /// Messages that are sent together, at most.
    pub(crate) fn together(self) -> usize {
        match self {
            Self::Single(..) => 1,
            Self::Paced(..) | Self::Full(_) => 64,
        }
    }
}

/// What was found.
#[derive(Debug, Clone, Default)]
pub(crate) struct Figures {
    pub(crate) sent: u64,
    pub(crate) lost: u64,
    pub(crate) rate_hz: f64,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) flow_cpu_us_per_message: f64,
}

/// What the sink's thread shares with the source's.
#[derive(Default)]
struct Seen {
    received: AtomicU64,
    end: AtomicBool,
}

/// Sends for that long and counts what arrives.
pub(crate) fn run(
    load: Load,
    duration: Duration,
    source: &mut dyn Source,
    mut sink: Box<dyn Sink>,
    flow_cpu: &dyn Fn() -> anyhow::Result<Duration>,
) -> anyhow::Result<Figures> {
    let base = Instant::now();
    let seen = Arc::<Seen>::default();
    let shared = Arc::clone(&seen);
    let reader = std::thread::spawn(move || -> anyhow::Result<Vec<(u64, u32)>> {
        let mut latencies = Vec::with_capacity(1 << 20);
        while !shared.end.load(Ordering::Relaxed) {
            sink.poll(&mut |payload| {
                let now = base.elapsed().as_nanos() as u64;
                if let Some((number, sent)) = head(payload) {
                    latencies.push((number, (now.saturating_sub(sent) / 1_000) as u32));
                    shared.received.fetch_add(1, Ordering::Relaxed);
                }
            })?;
        }
        Ok(latencies)
    });
    let mut sender = Sender {
        load,
        source,
        base,
        seen: &seen,
        sent: 0,
        filler: vec![b'x'; load.bytes().max(HEAD_BYTES)],
    };
    sender.until_first_arrives()?;
    sender.run_for(WARM_UP.min(duration))?;
    sender.drained();
    let (first, cpu_before, begin) = (sender.sent, flow_cpu()?, Instant::now());
    let received_before = seen.received.load(Ordering::Relaxed);
    sender.run_for(duration)?;
    let sending = begin.elapsed();
    let arrived_meanwhile = seen.received.load(Ordering::Relaxed) - received_before;
    sender.drained();
    let cpu = flow_cpu()?.saturating_sub(cpu_before);
    let sent = sender.sent - first;
    seen.end.store(true, Ordering::Relaxed);
    let latencies = reader.join().map_err(|_| anyhow::anyhow!("the sink panicked"))??;
    let mut mine: Vec<u32> =
        latencies.iter().filter(|(number, _)| *number > first).map(|(_, us)| *us).collect();
    mine.sort_unstable();
    let quantile =
        |q: f64| mine.get(((mine.len() as f64 * q) as usize).min(mine.len().saturating_sub(1)));
    Ok(Figures {
        sent,
        lost: sent.saturating_sub(mine.len() as u64),
        rate_hz: arrived_meanwhile as f64 / sending.as_secs_f64(),
        p50_ms: f64::from(quantile(0.5).copied().unwrap_or_default()) / 1e3,
        p99_ms: f64::from(quantile(0.99).copied().unwrap_or_default()) / 1e3,
        flow_cpu_us_per_message: cpu.as_secs_f64() * 1e6 / (sent.max(1)) as f64,
    })
}

struct Sender<'a> {
    load: Load,
    source: &'a mut dyn Source,
    base: Instant,
    seen: &'a Seen,
    sent: u64,
    filler: Vec<u8>,
}

impl Sender<'_> {
    fn one(&mut self) -> anyhow::Result<()> {
        self.sent += 1;
        let now = self.base.elapsed().as_nanos() as u64;
        self.filler[0] = b'#';
        self.filler[1..9].copy_from_slice(&self.sent.to_le_bytes());
        self.filler[9..17].copy_from_slice(&now.to_le_bytes());
        self.source.send(&self.filler)
    }

    /// Sends one after the other until something arrives: only then does the whole path stand.
    fn until_first_arrives(&mut self) -> anyhow::Result<()> {
        let begin = Instant::now();
        while self.seen.received.load(Ordering::Relaxed) == 0 {
            self.one()?;
            self.source.flush()?;
            std::thread::sleep(Duration::from_millis(20));
            anyhow::ensure!(
                begin.elapsed() < Duration::from_secs(20),
                "nothing arrives within 20 s"
            );
        }
        Ok(())
    }

    fn run_for(&mut self, duration: Duration) -> anyhow::Result<()> {
        match self.load {
            // A thread that wakes for every message at 10,000 Hz would measure itself.
            Load::Paced(rate, _) => self.paced(rate, duration, Duration::from_micros(500)),
            Load::Single(rate, _) => self.paced(rate, duration, Duration::ZERO),
            Load::Full(bytes) => self.full(bytes, duration),
        }
    }

    fn paced(&mut self, rate: f64, duration: Duration, rest: Duration) -> anyhow::Result<()> {
        let begin = Instant::now();
        let mut count = 0_u64;
        while begin.elapsed() < duration {
            let due = (begin.elapsed().as_secs_f64() * rate) as u64 + 1;
            while count < due {
                self.one()?;
                count += 1;
            }
            self.source.flush()?;
            let next = begin + Duration::from_secs_f64(count as f64 / rate);
            std::thread::sleep(next.saturating_duration_since(Instant::now()).max(rest));
        }
        Ok(())
    }

    fn full(&mut self, bytes: usize, duration: Duration) -> anyhow::Result<()> {
        let window = (WINDOW_BYTES / bytes as u64).clamp(2, WINDOW_MESSAGES);
        let begin = Instant::now();
        // What was lost before must not close the window for ever.
        let missing = self.sent - self.seen.received.load(Ordering::Relaxed);
        let mut progress = (Instant::now(), 0);
        while begin.elapsed() < duration {
            let received = self.seen.received.load(Ordering::Relaxed);
            if received != progress.1 {
                progress = (Instant::now(), received);
            }
            if self.sent - missing.min(self.sent) < received + window {
                for _ in 0..32.min(window) {
                    self.one()?;
                }
                self.source.flush()?;
            } else {
                std::thread::sleep(Duration::from_micros(50));
                anyhow::ensure!(
                    progress.0.elapsed() < Duration::from_secs(5),
                    "nothing arrives any more"
                );
            }
        }
        Ok(())
    }

    /// Waits until nothing more arrives.
    fn drained(&self) {
        let begin = Instant::now();
        let mut last = (Instant::now(), self.seen.received.load(Ordering::Relaxed));
        while begin.elapsed() < DRAIN
            && last.0.elapsed() < Duration::from_millis(500)
            && last.1 < self.sent
        {
            std::thread::sleep(Duration::from_millis(5));
            let received = self.seen.received.load(Ordering::Relaxed);
            if received != last.1 {
                last = (Instant::now(), received);
            }
        }
    }
}

fn head(payload: &[u8]) -> Option<(u64, u64)> {
    let number = payload.get(1..9)?.try_into().ok()?;
    let sent = payload.get(9..17)?.try_into().ok()?;
    Some((u64::from_le_bytes(number), u64::from_le_bytes(sent)))
}
