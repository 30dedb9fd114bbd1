//! A sender that is paced by an estimate, a bottleneck with a queue, and a receiver that reports.
//! In steps of 1 ms.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::super::{Capacity, Seen};
use crate::testing::Random;

/// Bytes of a datagram.
pub(super) const DATAGRAM: usize = 1400;
/// Places for what is on the way after the bottleneck, one for each millisecond.
const PLACES: u64 = 1024;
/// Milliseconds of one entry of the log.
const ENTRY: u64 = 100;

/// The path from the sender to the receiver.
#[derive(Debug, Clone, Copy)]
pub(super) struct Link {
    /// Bytes per second.
    pub rate: f64,
    /// Bytes that fit before the bottleneck.
    pub queue: f64,
    /// One way, in milliseconds, plus or minus the jitter.
    pub delay: u64,
    pub jitter: u64,
    /// Share that is lost at random, in both directions.
    pub loss: f64,
}

impl Default for Link {
    /// The reference link with so much more than 20 MB/s that nothing waits.
    fn default() -> Self {
        Self { rate: 40e6, queue: 8e6, delay: 25, jitter: 5, loss: 0.0001 }
    }
}

/// What there is to send.
#[derive(Debug, Clone, Copy)]
pub(super) enum Demand {
    /// More than can be sent.
    Endless,
    /// Bytes per second, evenly.
    Even(f64),
    /// So many bytes at once every so many milliseconds.
    Bursts(f64, u64),
}

/// What came in one millisecond.
#[derive(Debug, Clone, Copy, Default)]
struct Arrived {
    bytes: u64,
    lost: u64,
    datagrams: u32,
    first_sent: u64,
    last_sent: u64,
}

impl Arrived {
    fn add(&mut self, other: Self) {
        if self.datagrams == 0 {
            self.first_sent = other.first_sent;
        }
        if other.datagrams > 0 {
            self.last_sent = other.last_sent;
        }
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.datagrams += other.datagrams;
    }
}

#[derive(Debug, Clone, Copy)]
struct Report {
    arrives: u64,
    bytes: u64,
    lost: u64,
    echo_sent: u64,
    echo_held: u64,
}

/// What happened in a tenth of a second.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub sent: f64,
    /// Longest wait before the bottleneck, in milliseconds.
    pub queue: f64,
    pub least_rate: f64,
    pub most_rate: f64,
}

pub(super) struct Simulator {
    pub capacity: Capacity,
    pub link: Link,
    pub demand: Demand,
    /// A Feedback after so many datagrams, too.
    pub samples: u32,
    /// Milliseconds that receiver and sender stand still every few seconds.
    pub stall: u64,
    pub log: Vec<Entry>,
    start: Instant,
    random: Random,
    /// Milliseconds since the start.
    now: u64,
    backlog: f64,
    credit: f64,
    queue: VecDeque<u64>,
    served: f64,
    places: Vec<Arrived>,
    unread: Arrived,
    stalls: [(u64, u64); 2],
    received: u64,
    lost: u64,
    echo: (u64, u64),
    unreported: u32,
    reported_at: u64,
    reports: VecDeque<Report>,
    known: (u64, u64),
}

impl Simulator {
    pub(super) fn new(limit: f64, link: Link, seed: u64) -> Self {
        let start = Instant::now();
        Self {
            capacity: Capacity::new(limit, start),
            link,
            demand: Demand::Endless,
            samples: u32::MAX,
            stall: 0,
            log: Vec::new(),
            start,
            random: Random(seed),
            now: 0,
            backlog: 0.0,
            credit: 0.0,
            queue: VecDeque::new(),
            served: 0.0,
            places: vec![Arrived::default(); usize::try_from(PLACES).unwrap()],
            unread: Arrived::default(),
            stalls: [(1500, 1500), (3100, 3100)],
            received: 0,
            lost: 0,
            echo: (0, 0),
            unreported: 0,
            reported_at: 0,
            reports: VecDeque::new(),
            known: (0, 0),
        }
    }

    pub(super) fn instant(&self) -> Instant {
        self.start + Duration::from_millis(self.now)
    }

    /// Lets seconds pass.
    pub(super) fn run(&mut self, seconds: f64) -> &mut Self {
        for _ in 0..(seconds * 1000.0) as u64 {
            self.now += 1;
            let stalled = self.stalled();
            if !stalled[1] {
                self.learn();
                self.send();
            }
            self.serve();
            let at = (self.now % PLACES) as usize;
            let arrived = std::mem::take(&mut self.places[at]);
            self.unread.add(arrived);
            if !stalled[0] {
                self.read();
                self.report();
            }
            self.note();
        }
        self
    }

    /// Receiver, sender.
    fn stalled(&mut self) -> [bool; 2] {
        let now = self.now;
        for stall in &mut self.stalls {
            if now > stall.1 {
                let begin = now + 1000 + self.random.below(3000);
                *stall = (begin, begin + self.stall);
            }
        }
        self.stalls.map(|stall| stall.0 <= now && now < stall.1)
    }

    fn send(&mut self) {
        self.backlog += match self.demand {
            Demand::Endless => 1e6,
            Demand::Even(bytes_per_s) => bytes_per_s / 1000.0,
            Demand::Bursts(bytes, every) if self.now.is_multiple_of(every) => bytes,
            Demand::Bursts(..) => 0.0,
        };
        self.backlog = self.backlog.min(4e6);
        let rate = self.capacity.bytes_per_s();
        assert!(rate.is_finite() && rate > 0.0);
        self.credit = (self.credit + rate / 1000.0).min(2.0 * DATAGRAM as f64 + rate / 1000.0);
        while self.credit >= 0.0 && self.backlog >= DATAGRAM as f64 {
            self.credit -= DATAGRAM as f64;
            self.backlog -= DATAGRAM as f64;
            self.capacity.sent(self.instant(), DATAGRAM);
            if let Some(entry) = self.log.last_mut() {
                entry.sent += DATAGRAM as f64;
            }
            if (self.queue.len() + 1) as f64 * DATAGRAM as f64 <= self.link.queue {
                self.queue.push_back(self.now);
            } else {
                let wait = (self.waiting() as u64).min(PLACES / 2);
                self.arrive(wait, true, self.now);
            }
        }
    }

    /// Milliseconds that a datagram waits now.
    fn waiting(&self) -> f64 {
        self.queue.len() as f64 * DATAGRAM as f64 / self.link.rate * 1000.0
    }

    fn serve(&mut self) {
        self.served += self.link.rate / 1000.0;
        while self.served >= DATAGRAM as f64 {
            let Some(sent) = self.queue.pop_front() else {
                self.served = self.served.min(DATAGRAM as f64);
                break;
            };
            self.served -= DATAGRAM as f64;
            let lost = self.random.chance(self.link.loss);
            self.arrive(0, lost, sent);
        }
    }

    fn travel(&mut self) -> u64 {
        self.link.delay.saturating_sub(self.link.jitter)
            + self.random.below(2 * self.link.jitter + 1)
    }

    fn arrive(&mut self, wait: u64, lost: bool, sent: u64) {
        let at = (self.now + wait + self.travel().max(1)) % PLACES;
        let bytes = DATAGRAM as u64;
        self.places[at as usize].add(Arrived {
            bytes: if lost { 0 } else { bytes },
            lost: if lost { bytes } else { 0 },
            datagrams: u32::from(!lost),
            first_sent: sent,
            last_sent: sent,
        });
    }

    fn read(&mut self) {
        let arrived = std::mem::take(&mut self.unread);
        self.received += arrived.bytes;
        self.lost += arrived.lost;
        if arrived.datagrams > 0 {
            // The first of what a stall has kept waiting is what a Feedback in the middle of it
            // would echo.
            let kept = self.stalls[0].1 == self.now;
            let sent = if kept { arrived.first_sent } else { arrived.last_sent };
            self.echo = (sent, self.now);
            self.unreported += arrived.datagrams;
        }
    }

    fn report(&mut self) {
        let since = self.now - self.reported_at;
        let due = self.unreported > 0 && (since >= 50 || self.unreported >= self.samples);
        if !due && since < 500 {
            return;
        }
        self.unreported = 0;
        self.reported_at = self.now;
        if self.random.chance(self.link.loss) {
            return;
        }
        let arrives = self.now + self.travel();
        self.reports.push_back(Report {
            arrives,
            bytes: self.received,
            lost: self.lost,
            echo_sent: self.echo.0,
            echo_held: self.now - self.echo.1,
        });
        self.reports.make_contiguous().sort_by_key(|report| report.arrives);
    }

    fn learn(&mut self) {
        while let Some(report) = self.reports.pop_front_if(|report| report.arrives <= self.now) {
            let seen = Seen {
                delivered_bytes: report.bytes.saturating_sub(self.known.0),
                lost_bytes: report.lost.saturating_sub(self.known.1),
                round_trip: (report.echo_sent > 0)
                    .then(|| Duration::from_millis(self.now - report.echo_sent - report.echo_held)),
            };
            self.known = (self.known.0.max(report.bytes), self.known.1.max(report.lost));
            self.capacity.feedback(self.instant(), &seen);
        }
    }

    fn note(&mut self) {
        let (rate, queue) = (self.capacity.bytes_per_s(), self.waiting());
        if (self.now - 1).is_multiple_of(ENTRY) {
            self.log.push(Entry { sent: 0.0, queue, least_rate: rate, most_rate: rate });
        }
        if let Some(entry) = self.log.last_mut() {
            entry.queue = entry.queue.max(queue);
            entry.least_rate = entry.least_rate.min(rate);
            entry.most_rate = entry.most_rate.max(rate);
        }
    }

    /// The log from and up to these seconds.
    pub(super) fn between(&self, from: f64, to: f64) -> &[Entry] {
        let [from, to] = [from, to].map(|seconds| (seconds * 1000.0) as usize / ENTRY as usize);
        &self.log[from..to.min(self.log.len())]
    }

    /// Bytes per second sent.
    pub(super) fn mean_sent(&self, from: f64, to: f64) -> f64 {
        let entries = self.between(from, to);
        entries.iter().map(|entry| entry.sent).sum::<f64>() / entries.len() as f64 * 1000.0
            / ENTRY as f64
    }

    /// Longest wait before the bottleneck, in milliseconds.
    pub(super) fn longest_queue(&self, from: f64, to: f64) -> f64 {
        self.between(from, to).iter().map(|entry| entry.queue).fold(0.0, f64::max)
    }

    pub(super) fn least_rate(&self, from: f64, to: f64) -> f64 {
        let entries = self.between(from, to);
        entries.iter().map(|entry| entry.least_rate).fold(f64::MAX, f64::min)
    }
}
