//! What was measured of each pair of topic and publishing node; bounded.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

use blaze_domain::node_file::Stamp;
use blaze_domain::{FlowId, TopicName, WriterId};
use prometheus::{Histogram, HistogramVec};

use super::flows::Quantiles;
use super::limits::{IDLE, MAX_LABELS, MAX_PAIRS, MAX_WRITERS, SWEEP_EVERY, WINDOW};
use super::measure::{Measured, Method};

/// Label of what is beyond the bounds.
const OTHER: &str = "_other";

/// A pair: topic, layer and node of the publisher.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Key {
    pub(super) topic: String,
    pub(super) layer: String,
    pub(super) node: String,
}

impl Key {
    pub(super) fn new(topic: &str, from: &FlowId) -> Self {
        let (layer, node) = (from.layer.to_string(), from.node.to_string());
        Self { topic: topic.to_owned(), layer, node }
    }

    pub(super) fn from(&self) -> String {
        if self.node == OTHER { OTHER.to_owned() } else { format!("{}/{}", self.layer, self.node) }
    }
}

/// One value of the window.
#[derive(Debug, Clone, Copy)]
struct Value {
    latency_ms: f32,
    error_ms: f32,
    method: Method,
}

/// What was measured of one pair.
#[derive(Debug)]
pub(super) struct Row {
    pub(super) stamp: Stamp,
    pub(super) messages: u64,
    pub(super) unknown: u64,
    pub(super) lost: u64,
    seen: Instant,
    window: VecDeque<Value>,
    by_clock: Option<Histogram>,
    by_age: Option<Histogram>,
}

impl Row {
    fn new(stamp: Stamp, now: Instant) -> Self {
        Self {
            stamp,
            messages: 0,
            unknown: 0,
            lost: 0,
            seen: now,
            window: VecDeque::new(),
            by_clock: None,
            by_age: None,
        }
    }

    /// Takes one message.
    pub(super) fn add(&mut self, key: &Key, measured: Option<Measured>, metric: &HistogramVec) {
        self.messages += 1;
        let Some(Measured { latency_s, error_s, method }) = measured else {
            self.unknown += 1;
            return;
        };
        if self.window.len() >= WINDOW {
            self.window.pop_front();
        }
        let (latency_ms, error_ms) = ((latency_s * 1e3) as f32, (error_s * 1e3) as f32);
        self.window.push_back(Value { latency_ms, error_ms, method });
        let histogram = match method {
            Method::Clock => &mut self.by_clock,
            Method::Age => &mut self.by_age,
        };
        let make = || {
            let labels = [&*key.topic, &*key.layer, &*key.node, method.as_str()];
            metric.with_label_values(&labels)
        };
        histogram.get_or_insert_with(make).observe(latency_s);
    }

    /// The method of most values of the window, its quantiles and greatest error in ms.
    pub(super) fn summary(&self) -> Option<(Method, Quantiles, f64)> {
        let clocks = self.window.iter().filter(|value| value.method == Method::Clock).count();
        let method = if clocks * 2 >= self.window.len() { Method::Clock } else { Method::Age };
        let values = self.window.iter().filter(|value| value.method == method);
        let error_ms = values.clone().map(|value| f64::from(value.error_ms)).fold(0.0, f64::max);
        let mut sorted: Vec<f32> = values.map(|value| value.latency_ms).collect();
        sorted.sort_by(f32::total_cmp);
        let at = |part: f64| {
            let rank = (sorted.len() as f64 * part).ceil() as usize;
            sorted.get(rank.saturating_sub(1)).map(|ms| f64::from(*ms))
        };
        let quantiles = Quantiles { p50: at(0.5), p99: at(0.99) };
        quantiles.p50.map(|_| (method, quantiles, error_ms))
    }
}

/// All pairs.
#[derive(Debug, Default)]
pub(super) struct Rows {
    rows: BTreeMap<Key, Row>,
    /// Topics and nodes of the rows.
    topics: BTreeSet<String>,
    nodes: BTreeSet<String>,
    /// When idle rows were last looked for.
    swept: Option<Instant>,
}

impl Rows {
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Key, &Row)> {
        self.rows.iter()
    }

    /// The row of a pair, or that of the others.
    pub(super) fn of(
        &mut self,
        topic: &TopicName,
        from: &FlowId,
        stamp: Stamp,
        now: Instant,
        metric: &HistogramVec,
    ) -> (Key, &mut Row) {
        let mut key = Key::new(topic.as_str(), from);
        if !self.rows.contains_key(&key) {
            self.bound(&mut key, now, metric);
            self.topics.insert(key.topic.clone());
            self.nodes.insert(key.node.clone());
        }
        let row = self.rows.entry(key.clone()).or_insert_with(|| Row::new(stamp, now));
        row.seen = now;
        (key, row)
    }

    /// Keeps those that fit, without their series.
    pub(super) fn retain(&mut self, metric: &HistogramVec, keep: impl Fn(&Key, &Row) -> bool) {
        self.rows.retain(|key, row| {
            let is_kept = keep(key, row);
            if !is_kept {
                for method in [Method::Clock, Method::Age] {
                    let labels = [&*key.topic, &*key.layer, &*key.node, method.as_str()];
                    // Not there unless the method was used.
                    let _ = metric.remove_label_values(&labels);
                }
            }
            is_kept
        });
        self.topics = self.rows.keys().map(|key| key.topic.clone()).collect();
        self.nodes = self.rows.keys().map(|key| key.node.clone()).collect();
    }

    /// Replaces what has no room by `_other`, once pairs that are silent have left.
    fn bound(&mut self, key: &mut Key, now: Instant, metric: &HistogramVec) {
        let is_due = |swept| now.saturating_duration_since(swept) >= SWEEP_EVERY;
        if self.exceeds(key) != (false, false) && self.swept.is_none_or(is_due) {
            self.swept = Some(now);
            self.retain(metric, |_, row| now.saturating_duration_since(row.seen) < IDLE);
        }
        let (topic, node) = self.exceeds(key);
        if topic {
            OTHER.clone_into(&mut key.topic);
        }
        if node {
            OTHER.clone_into(&mut key.layer);
            OTHER.clone_into(&mut key.node);
        }
    }

    /// Whether there is no room for a topic, for a node. One place is that of `_other`.
    fn exceeds(&self, key: &Key) -> (bool, bool) {
        if self.rows.len() >= MAX_PAIRS - 1 {
            return (true, true);
        }
        let is_full =
            |set: &BTreeSet<String>, name| set.len() >= MAX_LABELS - 1 && !set.contains(name);
        (is_full(&self.topics, &key.topic), is_full(&self.nodes, &key.node))
    }
}

/// Losses by gaps in the numbers of writers; bounded.
#[derive(Debug, Default)]
pub(super) struct Writers {
    last: BTreeMap<WriterId, (u64, Instant)>,
    /// Writers that were forgotten because there are too many.
    pub(super) forgotten: u64,
}

impl Writers {
    /// Takes a number; what to add to the losses: the gap before it, −1 if it fills one.
    pub(super) fn note(&mut self, writer: WriterId, sequence: u64, now: Instant) -> i64 {
        if let Some((last, seen)) = self.last.get_mut(&writer) {
            *seen = now;
            if sequence < *last {
                return -1;
            }
            let gap = sequence.saturating_sub(last.saturating_add(1));
            *last = sequence;
            return i64::try_from(gap).unwrap_or(i64::MAX);
        }
        if self.last.len() >= MAX_WRITERS {
            let oldest = self.last.iter().min_by_key(|(_, (_, seen))| *seen);
            if let Some(oldest) = oldest.map(|(writer, _)| *writer) {
                self.last.remove(&oldest);
                self.forgotten += 1;
            }
        }
        self.last.insert(writer, (sequence, now));
        0
    }
}
