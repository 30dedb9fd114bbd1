//! What publishers and subscriptions have counted anyway, summed per topic when it is asked for.
//!
//! ```text
//! Publisher ────┐ counts()                ┌─ live: asked at each scrape
//!               ├─────────► Topics ─ topic┤
//! Subscription ─┘                         └─ ended: what those counted that have been dropped
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::{DropReason, TopicName};
use parking_lot::Mutex;
use prometheus::IntCounter;
use prometheus::proto::{self, Metric, MetricFamily, MetricType};

use super::family::{gathered, pair};
use super::limits::{MAX_TOPICS, OTHER};
use super::shape::cut;

/// The metric that counts messages; topics above the limit are counted under its name.
pub(super) const MESSAGES: &str = "blaze_sdk_messages_total";

/// Upper bounds of the time of a callback, in seconds.
const BOUNDS: [f64; 10] = [0.0001, 0.0005, 0.001, 0.005, 0.01, 0.05, 0.1, 0.5, 1.0, 5.0];

/// A publisher or subscription, which has counters of its own.
pub(crate) trait Counted: Send + Sync {
    /// What it counted so far.
    fn counts(&self) -> Counts;
}

/// Sums over publishers and subscriptions.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Counts {
    /// Messages by direction: `publish`, `receive`.
    pub(crate) messages: BTreeMap<&'static str, u64>,
    pub(crate) dropped: BTreeMap<DropReason, u64>,
    /// Of callbacks; only subscriptions have them.
    pub(crate) callbacks: Option<Times>,
}

impl Counts {
    fn add(&mut self, other: &Self) {
        for (direction, count) in &other.messages {
            *self.messages.entry(direction).or_default() += count;
        }
        for (reason, count) in &other.dropped {
            *self.dropped.entry(*reason).or_default() += count;
        }
        if let Some(times) = &other.callbacks {
            self.callbacks.get_or_insert_default().merge(times);
        }
    }
}

/// How long callbacks took. Without atomics: it stands under a lock that is taken anyway.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Times {
    /// Per bound, and above the last one.
    buckets: [u64; BOUNDS.len() + 1],
    sum: Duration,
}

impl Times {
    pub(crate) fn add(&mut self, time: Duration) {
        let seconds = time.as_secs_f64();
        self.buckets[BOUNDS.partition_point(|bound| *bound < seconds)] += 1;
        self.sum = self.sum.saturating_add(time);
    }

    fn merge(&mut self, other: &Self) {
        self.buckets.iter_mut().zip(other.buckets).for_each(|(own, other)| *own += other);
        self.sum = self.sum.saturating_add(other.sum);
    }

    fn histogram(&self) -> proto::Histogram {
        let mut count = 0;
        let bucket = |(bound, own): (&f64, &u64)| {
            count += own;
            let mut bucket = proto::Bucket::default();
            bucket.set_upper_bound(*bound);
            bucket.set_cumulative_count(count);
            bucket
        };
        let mut histogram = proto::Histogram::default();
        histogram.set_bucket(BOUNDS.iter().zip(&self.buckets).map(bucket).collect());
        histogram.set_sample_count(self.buckets.iter().sum());
        histogram.set_sample_sum(self.sum.as_secs_f64());
        histogram
    }
}

/// All topics of a service, of which a bounded number has counts of their own.
pub(crate) struct Topics {
    state: Mutex<State>,
    /// Publishers and subscriptions of topics above the limit.
    refused: IntCounter,
}

#[derive(Default)]
struct State {
    next: u64,
    topics: BTreeMap<String, Topic>,
}

#[derive(Default)]
struct Topic {
    ended: Counts,
    live: BTreeMap<u64, Arc<dyn Counted>>,
}

impl Topic {
    fn counts(&self) -> Counts {
        let mut sum = self.ended.clone();
        self.live.values().for_each(|source| sum.add(&source.counts()));
        sum
    }
}

impl Topics {
    pub(super) fn new(refused: IntCounter) -> Self {
        Self { state: Mutex::default(), refused }
    }

    /// Counts `source` in until the result is dropped; what it has counted by then stays.
    pub(crate) fn count(self: &Arc<Self>, topic: &TopicName, source: Arc<dyn Counted>) -> Counting {
        let mut state = self.state.lock();
        let mut name = cut(topic.as_str());
        if !state.topics.contains_key(name) && state.topics.len() >= MAX_TOPICS {
            self.refused.inc();
            name = OTHER;
        }
        state.next += 1;
        let id = state.next;
        state.topics.entry(name.to_owned()).or_default().live.insert(id, source);
        Counting { topics: Arc::clone(self), topic: name.to_owned(), id }
    }

    pub(super) fn gather(&self) -> Vec<MetricFamily> {
        let counts: Vec<(String, Counts)> = {
            let state = self.state.lock();
            state.topics.iter().map(|(name, topic)| (name.clone(), topic.counts())).collect()
        };
        let (mut messages, mut dropped, mut times) = (Vec::new(), Vec::new(), Vec::new());
        for (topic, counts) in &counts {
            let of = |label, value, count| counter(topic, label, value, count);
            let by_direction = counts.messages.iter();
            messages.extend(by_direction.map(|(way, count)| of("direction", way, *count)));
            let by_reason = counts.dropped.iter();
            dropped.extend(by_reason.map(|(why, count)| of("reason", why.as_str(), *count)));
            times.extend(counts.callbacks.iter().map(|callbacks| {
                let mut metric = Metric::from_label(vec![pair("topic", topic)]);
                metric.set_histogram(callbacks.histogram());
                metric
            }));
        }
        let mut families = vec![
            gathered(
                MESSAGES,
                "Messages given to the broker and received from it.",
                MetricType::COUNTER,
                messages,
            ),
            gathered(
                "blaze_sdk_dropped_total",
                "Messages dropped on their way to the broker or to a callback.",
                MetricType::COUNTER,
                dropped,
            ),
            gathered(
                "blaze_sdk_callback_seconds",
                "Time of callbacks of subscriptions.",
                MetricType::HISTOGRAM,
                times,
            ),
        ];
        families.retain(|family| !family.get_metric().is_empty());
        families
    }
}

fn counter(topic: &str, label: &str, value: &str, count: u64) -> Metric {
    let mut counter = proto::Counter::default();
    counter.set_value(count as f64);
    let mut metric = Metric::from_label(vec![pair("topic", topic), pair(label, value)]);
    metric.set_counter(counter);
    metric
}

/// A publisher or subscription that is counted in.
#[must_use = "dropping it ends the counting"]
pub(crate) struct Counting {
    topics: Arc<Topics>,
    topic: String,
    id: u64,
}

impl Drop for Counting {
    fn drop(&mut self) {
        // Dropped after the lock: what a callback has captured may be anything.
        let _source = {
            let mut state = self.topics.state.lock();
            state.topics.get_mut(&self.topic).and_then(|topic| {
                let source = topic.live.remove(&self.id)?;
                topic.ended.add(&source.counts());
                Some(source)
            })
        };
    }
}
