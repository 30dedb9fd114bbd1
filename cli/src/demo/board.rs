//! What the demo knows of each topic and consumer; written by the player and the consumers, read by
//! the report.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::DropReason;
use blaze_proto::Frame;
use blaze_sdk::SubscriptionStats;
use parking_lot::Mutex;
use serde::Serialize;

use super::flows::{FlowView, Spot};
use super::options::DemoNode;
use super::roles::{Consumer, MOVES_FROM, MOVES_TO, MOVING_SERVICE, PUBLISHING_NODE, PlayedTopic};
use super::stats::{Arrival, ConsumerStats, Period};

/// Messages that a consumer did not get as they were published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Faults {
    lost: u64,
    duplicated: u64,
    reordered: u64,
}

impl Faults {
    /// What its subscription left out is missing, too.
    fn of(counts: &SubscriptionStats) -> Self {
        Self {
            lost: counts.lost + counts.queue_dropped + counts.expired,
            duplicated: counts.duplicated,
            reordered: counts.reordered,
        }
    }

    /// A late message that fills a gap of before lowers no earlier count.
    fn since(self, before: Self) -> Self {
        Self {
            lost: self.lost.saturating_sub(before.lost),
            duplicated: self.duplicated.saturating_sub(before.duplicated),
            reordered: self.reordered.saturating_sub(before.reordered),
        }
    }
}

/// Index of a consumer on the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ConsumerId(usize);

/// One topic on its way to one consumer; a line of the report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicRow {
    /// The topic.
    pub topic: String,
    /// `layer/node` of the publisher.
    pub from: String,
    /// `layer/node` of the consumer; absent where nobody listens in this process.
    pub to: Option<String>,
    /// The consumer.
    pub service: Option<&'static str>,
    /// Scopes on the way, `scope:broker`.
    pub route: Vec<String>,
    /// Messages published a second; absent where the publisher is in another process.
    pub rate_in_hz: Option<f64>,
    /// Messages received a second.
    pub rate_out_hz: f64,
    /// Payload bytes received a second.
    pub bytes_per_s: f64,
    /// Messages published; absent where the publisher is in another process.
    pub sent: Option<u64>,
    /// Messages received.
    pub received: u64,
    /// Missing between the first and the last received.
    pub lost: u64,
    /// Received again.
    pub duplicated: u64,
    /// Received after a later one.
    pub reordered: u64,
    /// Dropped on the way, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// From publication to the consumer.
    pub latency_ms: LatencyMs,
    /// Whether the topic counts as large.
    #[serde(skip)]
    pub large: bool,
    /// Whether the consumer still listens.
    #[serde(skip)]
    pub active: bool,
    /// Whether a message was published that the consumer should have, as far as is known here.
    #[serde(skip)]
    pub due: bool,
    /// From the last message received to the last one published; absent without any.
    #[serde(skip)]
    pub silent: Option<Duration>,
}

/// Latency percentiles in milliseconds; absent without any message.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencyMs {
    /// Median.
    pub p50: Option<f64>,
    /// 99 %.
    pub p99: Option<f64>,
}

/// A consumer that went from one node to another.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Move {
    /// The service.
    pub service: &'static str,
    /// `layer/node` that it left.
    pub from: String,
    /// `layer/node` where it is now.
    pub to: String,
    /// From the last message there to the first here, by their publication; 0 when both ran side by
    /// side.
    pub gap_ms: f64,
}

/// See the module.
#[derive(Debug)]
pub struct Board {
    start: Instant,
    same_clock: bool,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    publishers: Vec<PublisherEntry>,
    consumers: Vec<ConsumerEntry>,
    looked: Instant,
}

#[derive(Debug)]
struct PublisherEntry {
    topic: PlayedTopic,
    /// Whether it publishes in this process.
    here: bool,
    sent: u64,
    sent_before: u64,
    first: Option<Instant>,
    last: Option<Instant>,
}

#[derive(Debug)]
struct ConsumerEntry {
    consumer: Consumer,
    began: Instant,
    publisher: usize,
    stats: ConsumerStats,
    active: bool,
    route: Vec<String>,
    on_the_way: DropCounter,
    /// What its subscription counted.
    at_consumer: SubscriptionStats,
    dropped_before: BTreeMap<String, u64>,
    faults_before: Faults,
}

/// Adds up counters of bridges that may be made anew, and then count from 0.
#[derive(Debug, Default)]
struct DropCounter {
    earlier: BTreeMap<String, u64>,
    current: BTreeMap<String, u64>,
}

impl DropCounter {
    fn set(&mut self, now: BTreeMap<String, u64>) {
        let fell = self
            .current
            .iter()
            .any(|(reason, count)| now.get(reason).copied().unwrap_or(0) < *count);
        let last = std::mem::replace(&mut self.current, now);
        if fell {
            for (reason, count) in last {
                *self.earlier.entry(reason).or_default() += count;
            }
        }
    }

    fn total(&self) -> BTreeMap<String, u64> {
        let mut total = self.earlier.clone();
        for (reason, count) in &self.current {
            *total.entry(reason.clone()).or_default() += count;
        }
        total.retain(|_, count| *count > 0);
        total
    }
}

impl PublisherEntry {
    /// Whether whoever listens since then should have had a message. What is not published here may
    /// be.
    fn is_due(&self, since: Instant) -> bool {
        let keeps = self.topic.depth > 0;
        !self.here || self.last.is_some_and(|last| keeps || last >= since)
    }
}

impl ConsumerEntry {
    fn dropped(&self) -> BTreeMap<String, u64> {
        let mut total = self.on_the_way.total();
        let counts = &self.at_consumer;
        for (reason, count) in
            [(DropReason::QueueFull, counts.queue_dropped), (DropReason::Lifespan, counts.expired)]
        {
            if count > 0 {
                *total.entry(reason.as_str().to_owned()).or_default() += count;
            }
        }
        total
    }
}

impl Board {
    /// A board without consumers. `nodes` run in this process; `start` is when the demo began.
    #[must_use]
    pub fn new(topics: Vec<PlayedTopic>, nodes: &[DemoNode], start: Instant) -> Self {
        let here = nodes.contains(&PUBLISHING_NODE);
        let publishers = topics.into_iter().map(|topic| PublisherEntry {
            topic,
            here,
            sent: 0,
            sent_before: 0,
            first: None,
            last: None,
        });
        Self {
            start,
            same_clock: here,
            state: Mutex::new(State {
                publishers: publishers.collect(),
                consumers: Vec::new(),
                looked: start,
            }),
        }
    }

    /// Notes that a topic (its index) was published.
    pub fn published(&self, topic: usize, now: Instant) {
        if let Some(publisher) = self.state.lock().publishers.get_mut(topic) {
            publisher.sent += 1;
            publisher.first.get_or_insert(now);
            publisher.last = Some(now);
        }
    }

    /// A consumer begins to listen. `None`: nobody plays its topic.
    pub fn add_consumer(&self, consumer: Consumer, now: Instant) -> Option<ConsumerId> {
        let mut state = self.state.lock();
        let publisher =
            state.publishers.iter().position(|entry| entry.topic.name == consumer.topic)?;
        state.consumers.push(ConsumerEntry {
            consumer,
            began: now,
            publisher,
            stats: ConsumerStats::new(now),
            active: true,
            route: Vec::new(),
            on_the_way: DropCounter::default(),
            at_consumer: SubscriptionStats::default(),
            dropped_before: BTreeMap::new(),
            faults_before: Faults::default(),
        });
        Some(ConsumerId(state.consumers.len() - 1))
    }

    /// A frame came. `unix_ns` is the clock of this host; it is compared with the publisher's only
    /// if that runs here too, else the age that the flows wrote into the frame counts.
    pub fn frame_arrived(&self, id: ConsumerId, frame: &Frame, unix_ns: u64, now: Instant) {
        let latency = if self.same_clock {
            Duration::from_nanos(unix_ns.saturating_sub(frame.publish_time_ns()))
        } else {
            Duration::from_micros(frame.age_us())
        };
        let arrival = Arrival {
            publish_time_ns: frame.publish_time_ns(),
            latency,
            bytes: frame.payload().len(),
        };
        self.arrived(id, &arrival, now);
    }

    /// A message came.
    pub fn arrived(&self, id: ConsumerId, arrival: &Arrival, now: Instant) {
        if let Some(entry) = self.state.lock().consumers.get_mut(id.0) {
            entry.stats.add(arrival, now);
        }
    }

    /// Takes over what a consumer's subscription counted.
    pub fn set_consumer_counts(&self, id: ConsumerId, counts: SubscriptionStats) {
        if let Some(entry) = self.state.lock().consumers.get_mut(id.0) {
            entry.at_consumer = counts;
        }
    }

    /// The consumer listens no more.
    pub fn end_consumer(&self, id: ConsumerId) {
        if let Some(entry) = self.state.lock().consumers.get_mut(id.0) {
            entry.active = false;
        }
    }

    /// Messages that a consumer has received.
    #[must_use]
    pub fn received(&self, id: ConsumerId) -> u64 {
        let state = self.state.lock();
        state.consumers.get(id.0).map_or(0, |entry| entry.stats.received())
    }

    /// Whether a message was published that a consumer should have, as far as is known here.
    #[must_use]
    pub fn is_due(&self, id: ConsumerId) -> bool {
        let state = self.state.lock();
        let entry = state.consumers.get(id.0);
        let publisher =
            entry.and_then(|entry| Some((entry, state.publishers.get(entry.publisher)?)));
        publisher.is_some_and(|(entry, publisher)| publisher.is_due(entry.began))
    }

    /// Messages that all consumers have received.
    #[must_use]
    pub fn received_by_all(&self) -> u64 {
        let state = self.state.lock();
        state.consumers.iter().map(|entry| entry.stats.received()).sum()
    }

    /// Pictures that came to each consumer outside the publisher's layer, on average.
    #[must_use]
    pub fn pictures_elsewhere(&self) -> f64 {
        let state = self.state.lock();
        let is_elsewhere = |entry: &&ConsumerEntry| {
            let publisher = state.publishers.get(entry.publisher);
            publisher.is_some_and(|publisher| publisher.topic.large)
                && entry.consumer.node.layer() != PUBLISHING_NODE.layer()
        };
        let received = state.consumers.iter().filter(is_elsewhere);
        let received: Vec<u64> = received.map(|entry| entry.stats.received()).collect();
        received.iter().sum::<u64>() as f64 / received.len().max(1) as f64
    }

    /// Takes over routes and drops from the flows. What is not to be seen any more keeps its last
    /// value.
    pub fn set_view(&self, view: &FlowView) {
        let from = Spot::Node(PUBLISHING_NODE);
        for entry in &mut self.state.lock().consumers {
            if let Some(path) =
                view.path(entry.consumer.topic.as_str(), &from, &entry.consumer.spot())
            {
                entry.route = path.route;
                entry.on_the_way.set(path.dropped);
            }
        }
    }

    /// What happened since the last call: a row for each consumer that listens, and for each topic
    /// without any.
    #[must_use]
    pub fn recent(&self, now: Instant) -> Vec<TopicRow> {
        let mut state = self.state.lock();
        let seconds = now.saturating_duration_since(state.looked).as_secs_f64();
        state.looked = now;
        let State { publishers, consumers, .. } = &mut *state;
        let mut rows = Vec::new();
        for entry in consumers.iter_mut() {
            let period = entry.stats.take_recent(now);
            let faults = Faults::of(&entry.at_consumer);
            let faults = faults.since(std::mem::replace(&mut entry.faults_before, faults));
            let total = entry.dropped();
            let before = std::mem::replace(&mut entry.dropped_before, total.clone());
            if let Some(publisher) = publishers.get(entry.publisher).filter(|_| entry.active) {
                let sent = publisher.sent - publisher.sent_before;
                let mut row = row(publisher, sent, seconds, Some(entry), &period, faults);
                row.dropped = difference(&total, &before);
                rows.push(row);
            }
        }
        rows.extend(unheard(publishers, consumers, |publisher| {
            (publisher.sent - publisher.sent_before, seconds)
        }));
        for publisher in publishers {
            publisher.sent_before = publisher.sent;
        }
        rows
    }

    /// Everything until `end`: a row for each consumer there ever was, and for each topic without
    /// any.
    #[must_use]
    pub fn total(&self, end: Instant) -> Vec<TopicRow> {
        let state = self.state.lock();
        let State { publishers, consumers, .. } = &*state;
        let sent = |publisher: &PublisherEntry| {
            let since = |first| end.saturating_duration_since(first).as_secs_f64();
            (publisher.sent, publisher.first.map_or(0.0, since))
        };
        let heard = consumers.iter().filter_map(|entry| {
            let publisher = publishers.get(entry.publisher)?;
            // One that has left is measured up to its last message, and so is one to which messages
            // still came after the end.
            let last = entry.stats.last.map_or(end, |(at, _)| at);
            let until = if entry.active { last.max(end) } else { last };
            let (count, seconds) = sent(publisher);
            let (period, faults) = (entry.stats.total(until), Faults::of(&entry.at_consumer));
            Some(row(publisher, count, seconds, Some(entry), &period, faults))
        });
        heard.chain(unheard(publishers, consumers, sent)).collect()
    }

    /// Seconds from the start to the first message in each layer that has one.
    #[must_use]
    pub fn first_message_s(&self) -> BTreeMap<&'static str, f64> {
        let state = self.state.lock();
        let mut first = BTreeMap::new();
        for entry in &state.consumers {
            if let Some((at, _)) = entry.stats.first {
                let seconds = round(at.saturating_duration_since(self.start).as_secs_f64(), 3);
                let known = first.entry(entry.consumer.node.layer()).or_insert(seconds);
                *known = known.min(seconds);
            }
        }
        first
    }

    /// The move of the consumer, once messages have come to it at both ends and it has left the
    /// first.
    #[must_use]
    pub fn moved(&self) -> Option<Move> {
        let state = self.state.lock();
        let find = |node: DemoNode| {
            let mut entries = state.consumers.iter();
            entries.find(|entry| {
                entry.consumer.service == MOVING_SERVICE && entry.consumer.node == node
            })
        };
        let (left, joined) = (find(MOVES_FROM)?, find(MOVES_TO)?);
        let (_, last_ns) = left.stats.last.filter(|_| !left.active)?;
        let (_, first_ns) = joined.stats.first?;
        Some(Move {
            service: MOVING_SERVICE,
            from: MOVES_FROM.flow(),
            to: MOVES_TO.flow(),
            gap_ms: round(first_ns.saturating_sub(last_ns) as f64 / 1e6, 3),
        })
    }
}

/// Rows for what is published here and heard by nobody here; `sent` gives the messages and the
/// seconds they took.
fn unheard<'a>(
    publishers: &'a [PublisherEntry],
    consumers: &'a [ConsumerEntry],
    sent: impl Fn(&PublisherEntry) -> (u64, f64) + 'a,
) -> impl Iterator<Item = TopicRow> + 'a {
    let nobody = move |publisher: &&PublisherEntry| {
        publisher.here
            && !consumers.iter().any(|entry| entry.consumer.topic == publisher.topic.name)
    };
    publishers.iter().filter(nobody).map(move |publisher| {
        let (count, seconds) = sent(publisher);
        row(publisher, count, seconds, None, &Period::default(), Faults::default())
    })
}

fn row(
    publisher: &PublisherEntry,
    sent: u64,
    seconds: f64,
    entry: Option<&ConsumerEntry>,
    period: &Period,
    faults: Faults,
) -> TopicRow {
    let rate = |count: u64, seconds: f64| if seconds > 0.0 { count as f64 / seconds } else { 0.0 };
    TopicRow {
        topic: publisher.topic.name.to_string(),
        from: PUBLISHING_NODE.flow(),
        to: entry.map(|entry| entry.consumer.node.flow()),
        service: entry.map(|entry| entry.consumer.service),
        route: entry.map(|entry| entry.route.clone()).unwrap_or_default(),
        rate_in_hz: publisher.here.then(|| round(rate(sent, seconds), 2)),
        rate_out_hz: round(rate(period.received, period.seconds), 2),
        bytes_per_s: round(rate(period.bytes, period.seconds), 0),
        sent: publisher.here.then_some(sent),
        received: period.received,
        lost: faults.lost,
        duplicated: faults.duplicated,
        reordered: faults.reordered,
        dropped: entry.map(ConsumerEntry::dropped).unwrap_or_default(),
        latency_ms: LatencyMs {
            p50: period.p50_ms.map(|value| round(value, 3)),
            p99: period.p99_ms.map(|value| round(value, 3)),
        },
        large: publisher.topic.large,
        active: entry.is_some_and(|entry| entry.active),
        due: entry.is_some_and(|entry| publisher.is_due(entry.began)),
        silent: entry
            .and_then(|entry| Some(publisher.last?.saturating_duration_since(entry.stats.last?.0))),
    }
}

fn difference(
    now: &BTreeMap<String, u64>,
    before: &BTreeMap<String, u64>,
) -> BTreeMap<String, u64> {
    let grown = now.iter().map(|(reason, count)| {
        let earlier = before.get(reason).copied().unwrap_or(0);
        (reason.clone(), count.saturating_sub(earlier))
    });
    grown.filter(|(_, count)| *count > 0).collect()
}

fn round(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale
}

#[cfg(test)]
#[path = "board_tests.rs"]
mod tests;
