//! Engines in one simulated network, with clocks that drift and step, and delays from a seed.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::time::Duration;

use blaze_domain::{FlowId, TopicName};
use bytes::Bytes;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::{Engine, Now, Settings};

pub(super) const MS: i64 = 1_000_000;
pub(super) const S: i64 = 1_000 * MS;

pub(super) fn node(name: &str) -> FlowId {
    name.parse().unwrap()
}

/// Clocks at a time of a node whose clocks are right, in milliseconds.
pub(super) fn at(ms: i64) -> Now {
    TestClock::default().now(ms * MS)
}

/// Monotonic and wall clock of a node, as functions of the true time in nanoseconds.
#[derive(Debug, Clone)]
pub(super) struct TestClock {
    since: i64,
    monotonic: i64,
    ppm: f64,
    /// Wall clock minus monotonic clock.
    pub(super) course: i64,
    pub(super) synchronized: bool,
}

impl Default for TestClock {
    fn default() -> Self {
        Self {
            since: 0,
            monotonic: 1_000 * S,
            ppm: 0.0,
            course: 1_767_225_600 * S,
            synchronized: true,
        }
    }
}

impl TestClock {
    pub(super) fn now(&self, at: i64) -> Now {
        let passed = at - self.since;
        let drift = (passed as f64 * self.ppm * 1e-6).round() as i64;
        let monotonic = self.monotonic + passed + drift;
        Now {
            monotonic: Duration::from_nanos(monotonic.unsigned_abs()),
            wall_ns: monotonic + self.course,
            synchronized: self.synchronized,
        }
    }

    pub(super) fn drift(&mut self, at: i64, ppm: f64) {
        self.monotonic = i64::try_from(self.now(at).monotonic.as_nanos()).unwrap();
        (self.since, self.ppm) = (at, ppm);
    }

    pub(super) fn true_offset_s(&self, to: &Self, at: i64) -> f64 {
        (to.now(at).wall_ns - self.now(at).wall_ns) as f64 * 1e-9
    }
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    Poll(usize),
    Message(usize, TopicName, Bytes),
}

/// Delay of a message by its sender in nanoseconds; `None`: lost.
pub(super) type Delay = Box<dyn FnMut(usize, &mut StdRng) -> Option<i64>>;

/// Messages received by one node.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Received {
    pub(super) pings: u64,
    pub(super) pongs: u64,
    pub(super) longest: usize,
}

/// All nodes and the messages on their way.
pub(super) struct Net {
    pub(super) at: i64,
    pub(super) ids: Vec<FlowId>,
    pub(super) engines: Vec<Engine>,
    pub(super) clocks: Vec<TestClock>,
    pub(super) received: Vec<Received>,
    pub(super) delay: Delay,
    readers: BTreeMap<TopicName, Vec<usize>>,
    events: BinaryHeap<Reverse<(i64, u64, Event)>>,
    polls: Vec<i64>,
    events_made: u64,
    rng: StdRng,
}

impl Net {
    /// Each node knows all others by their requests.
    pub(super) fn new(ids: Vec<FlowId>, clocks: Vec<TestClock>, seed: u64, delay: Delay) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        let settings = Settings { period: Duration::from_secs(60) };
        let start = |(id, clock): (&FlowId, &TestClock)| {
            let mut engine = Engine::new(id.clone(), settings, rng.random(), clock.now(0));
            engine.set_requesters(clock.now(0), ids.iter().cloned());
            engine
        };
        let engines: Vec<Engine> = ids.iter().zip(&clocks).map(start).collect();
        let mut net = Self {
            at: 0,
            received: vec![Received::default(); ids.len()],
            polls: vec![i64::MAX; ids.len()],
            engines,
            ids,
            clocks,
            delay,
            readers: BTreeMap::new(),
            events: BinaryHeap::new(),
            events_made: 0,
            rng,
        };
        (0..net.ids.len()).for_each(|n| net.wake(n, 0));
        net
    }

    pub(super) fn now(&self, n: usize) -> Now {
        self.clocks[n].now(self.at)
    }

    /// Runs up to a true time, in nanoseconds.
    pub(super) fn run_until(&mut self, end: i64) {
        while let Some(Reverse((at, _, event))) = self.events.pop() {
            if at > end {
                self.push(at, event);
                break;
            }
            self.at = at;
            match event {
                Event::Poll(n) if self.polls[n] == at => self.poll(n),
                Event::Poll(_) => {}
                Event::Message(from, topic, payload) => self.deliver(from, &topic, &payload),
            }
        }
        self.at = end;
    }

    /// Lets a node act at once, after an input from outside.
    pub(super) fn poll(&mut self, n: usize) {
        let now = self.now(n);
        for output in self.engines[n].poll(now) {
            if let Some(delay) = (self.delay)(n, &mut self.rng) {
                let message = Event::Message(n, output.topic(), output.payload());
                self.push(self.at + delay, message);
            }
        }
        let topics = self.engines[n].take_topics();
        for topic in topics.request {
            self.readers.entry(topic).or_default().push(n);
        }
        for topic in topics.release {
            self.readers.entry(topic).or_default().retain(|reader| *reader != n);
        }
        self.polls[n] = i64::MAX;
        self.schedule(n);
    }

    fn deliver(&mut self, from: usize, topic: &TopicName, payload: &[u8]) {
        let is_ping = topic.as_str().starts_with("blaze/ping/");
        let readers = self.readers.get(topic).cloned().unwrap_or_default();
        for n in readers.into_iter().filter(|n| *n != from) {
            let now = self.now(n);
            let received = &mut self.received[n];
            received.longest = received.longest.max(payload.len());
            if is_ping {
                received.pings += 1;
                self.engines[n].ping_received(now, &self.ids[from], payload);
            } else {
                received.pongs += 1;
                self.engines[n].pong_received(now, &self.ids[from], payload);
            }
            self.schedule(n);
        }
    }

    fn schedule(&mut self, n: usize) {
        let now = self.now(n);
        let wait = self.engines[n].next_deadline(now) - now.monotonic;
        // A little later, because the clock of the node may be slower than the true time.
        let wait = i64::try_from(wait.as_nanos()).unwrap();
        self.wake(n, self.at + wait + wait / 5_000 + 2);
    }

    fn wake(&mut self, n: usize, at: i64) {
        if at < self.polls[n] {
            self.polls[n] = at;
            self.push(at, Event::Poll(n));
        }
    }

    fn push(&mut self, at: i64, event: Event) {
        self.events_made += 1;
        self.events.push(Reverse((at, self.events_made, event)));
    }
}
