//! Latency of messages to this node: pure, with `now` as a parameter.
//!
//! ```text
//! observe: flow       ages and round trips of the flows ──► row, method `age`
//! observe: subscribe  message ──clocks good enough?──► row, method `clock`
//!                                └─else, with an age──► method `age`, else unknown
//! ```

mod flows;
mod limits;
mod measure;
mod rows;
mod stamp;

#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, VecDeque};
use std::time::Instant;

use blaze_domain::node_file::{LatencyRule, Observe, Stamp};
use blaze_domain::{FlowId, TopicName};
use prometheus::core::Collector as _;
use prometheus::proto::MetricFamily;
use prometheus::{GaugeVec, HistogramOpts, HistogramVec, IntCounterVec};
use serde::Serialize;

pub use flows::{Bridge, Count, End, FlowFigures, Hop, Quantiles};
pub use measure::{Measured, Message, Method, Offset, Outcome};
pub use stamp::{header_stamp_cdr, header_stamp_json};

use crate::metric::metrics;
use flows::{Path, rounded};
use limits::{BUCKETS, MAX_PAIRS, MAX_SAMPLES};
use rows::{Key, Row, Rows, Writers};

metrics! {
    SECONDS Histogram "blaze_message_latency_seconds" ["topic", "from_layer", "from_node", "method"] "seconds"
        "Latency of messages that the monitor subscribes to, by the clocks or by their age."
    ERROR Gauge "blaze_message_latency_error_seconds" ["topic", "from_layer", "from_node"] "seconds"
        "Bound of the error of the latency of the last messages."
    UNKNOWN Counter "blaze_message_latency_unknown_total" ["topic", "from_layer", "from_node"] "1"
        "Messages without an age whose latency the clocks are not good enough for."
}

/// `/v1/latency`, without the members of every answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Body {
    /// One row per topic and publishing node.
    pub topics: Vec<TopicBody>,
    /// Pairs that are observed passively and for which there is no room.
    pub left_out: u64,
}

/// One row.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicBody {
    /// The topic.
    pub topic: String,
    /// Node that publishes it, `layer/node`; `None` where a flow counts several together.
    pub from: Option<String>,
    /// How it is observed.
    pub observe: Observe,
    /// From when on the latency counts.
    pub stamp: Stamp,
    /// How it was measured; `None` before the first value.
    pub method: Option<Method>,
    /// Messages that were measured or unknown.
    pub messages: u64,
    /// Quantiles of the last values in ms.
    pub latency_ms: Quantiles,
    /// Bound of their error in ms.
    pub error_ms: Option<f64>,
    /// Messages whose latency is unknown.
    pub unknown: u64,
    /// Messages that did not come, by the gaps in their numbers; `None` where nobody counts: for a
    /// passive topic, and below `max_rate_hz`, which makes gaps on purpose.
    pub lost: Option<u64>,
    /// The parts of the latency.
    pub hops: Vec<Hop>,
}

/// A raw sample.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sample {
    /// When the message was received, in ns since 1970.
    pub received_ns: i64,
    /// Its topic.
    pub topic: TopicName,
    /// Node that published it.
    pub from: FlowId,
    /// Its number.
    pub sequence: u64,
    /// Its latency in seconds; `None`: unknown.
    pub latency_s: Option<f64>,
    /// Bound of the error in seconds.
    pub error_s: Option<f64>,
    /// How it was measured.
    pub method: Option<Method>,
}

/// Raw samples that wait to be taken.
#[derive(Debug, Default)]
struct Samples {
    is_on: bool,
    ring: VecDeque<Sample>,
    dropped: u64,
}

impl Samples {
    fn add(&mut self, message: &Message<'_>, measured: Option<Measured>) {
        if !self.is_on {
            return;
        }
        if self.ring.len() >= MAX_SAMPLES {
            self.ring.pop_front();
            self.dropped += 1;
        }
        self.ring.push_back(Sample {
            received_ns: message.received_ns,
            topic: message.topic.clone(),
            from: message.from.clone(),
            sequence: message.sequence,
            latency_s: measured.map(|measured| measured.latency_s),
            error_s: measured.map(|measured| measured.error_s),
            method: measured.map(|measured| measured.method),
        });
    }
}

/// Latency of the topics that the rules name.
#[derive(Debug)]
pub struct Latency {
    rules: Vec<LatencyRule>,
    rows: Rows,
    writers: Writers,
    /// Figures of the topics that rules name.
    flows: Vec<FlowFigures>,
    samples: Samples,
    histogram: HistogramVec,
}

impl Latency {
    /// Nothing is measured yet.
    ///
    /// # Errors
    /// None in practice: the crate `prometheus` checks names that are constants.
    pub fn new(rules: Vec<LatencyRule>) -> Result<Self, prometheus::Error> {
        let options = HistogramOpts::from(SECONDS.opts()).buckets(BUCKETS.to_vec());
        Ok(Self {
            rules,
            rows: Rows::default(),
            writers: Writers::default(),
            flows: Vec::new(),
            samples: Samples::default(),
            histogram: HistogramVec::new(options, SECONDS.labels)?,
        })
    }

    /// Rules of a changed configuration. Rows of topics that are no longer subscribed to, or whose
    /// stamp is another one, begin anew.
    pub fn set_rules(&mut self, rules: Vec<LatencyRule>) {
        self.rules = rules;
        let rules = &self.rules;
        self.rows.retain(&self.histogram, |key, row| {
            let Ok(topic) = key.topic.parse() else { return true };
            rule_of(rules, &topic)
                .is_some_and(|rule| rule.observe == Observe::Subscribe && rule.stamp == row.stamp)
        });
    }

    /// The first rule that names a topic.
    #[must_use]
    pub fn rule_of(&self, topic: &TopicName) -> Option<&LatencyRule> {
        rule_of(&self.rules, topic)
    }

    /// Takes the newest figures of all flows that were asked; they replace those before.
    pub fn observe(&mut self, mut flows: Vec<FlowFigures>) {
        let rules = &self.rules;
        for figures in &mut flows {
            figures.bridges.retain(|bridge| {
                bridge.topic.parse().is_ok_and(|topic| rule_of(rules, &topic).is_some())
            });
            let topics: BTreeSet<&str> =
                figures.bridges.iter().map(|bridge| bridge.topic.as_str()).collect();
            figures.publishers.retain(|topic, _| topics.contains(topic.as_str()));
        }
        self.flows = flows;
    }

    /// Takes a message of a topic with `observe: subscribe`. Of other topics nothing is kept.
    pub fn message(&mut self, now: Instant, message: &Message<'_>) -> Outcome {
        let rule = rule_of(&self.rules, message.topic);
        let Some(rule) = rule.filter(|rule| rule.observe == Observe::Subscribe) else {
            return Outcome::default();
        };
        let outcome = measure::measure(message, rule.stamp, self.age_error_s(message.from));
        let gap = self.writers.note(message.writer, message.sequence, now);
        let (stamp, is_thinned) = (rule.stamp, rule.max_rate_hz.is_some());
        let metric = &self.histogram;
        let (key, row) = self.rows.of(message.topic, message.from, stamp, now, metric);
        row.add(&key, outcome.measured, metric);
        if !is_thinned {
            row.lost = row.lost.saturating_add_signed(gap);
        }
        self.samples.add(message, outcome.measured);
        outcome
    }

    /// Half the round trip of the link to a node; of an unknown one the greatest.
    fn age_error_s(&self, from: &FlowId) -> f64 {
        let here = || self.flows.iter().filter(|figures| figures.is_here);
        if here().any(|figures| figures.flow.layer == from.layer) {
            return 0.0;
        }
        let links = || here().flat_map(|figures| &figures.links);
        let to = links().find(|link| link.flow == *from).and_then(|link| link.rtt_ms);
        let greatest = || links().filter_map(|link| link.rtt_ms).fold(0.0, f64::max);
        to.unwrap_or_else(greatest) / 2e3
    }

    /// The answer of `/v1/latency`.
    #[must_use]
    pub fn body(&self) -> Body {
        let mut topics: Vec<TopicBody> =
            self.rows.iter().map(|(key, row)| self.subscribed(key, row)).collect();
        let mut left_out = 0;
        for (topic, from) in self.passive_pairs() {
            match self.passive(&topic, from.as_ref()) {
                Some(_) if topics.len() >= MAX_PAIRS => left_out += 1,
                row => topics.extend(row),
            }
        }
        Body { topics, left_out }
    }

    fn subscribed(&self, key: &Key, row: &Row) -> TopicBody {
        let summary = row.summary();
        let quantiles = summary.map_or_else(Quantiles::default, |(_, quantiles, _)| quantiles);
        let rule = key.topic.parse().ok().and_then(|topic| rule_of(&self.rules, &topic));
        let is_thinned = rule.is_none_or(|rule| rule.max_rate_hz.is_some());
        let from = key.from();
        let publisher = from.parse().ok();
        let path = publisher
            .as_ref()
            .and_then(|publisher| Path::of(&self.flows, &key.topic, Some(publisher)));
        TopicBody {
            topic: key.topic.clone(),
            from: Some(from),
            observe: Observe::Subscribe,
            stamp: row.stamp,
            method: summary.map(|(method, ..)| method),
            messages: row.messages,
            latency_ms: shown(quantiles),
            error_ms: summary.map(|(.., error_ms)| rounded(error_ms)),
            unknown: row.unknown,
            lost: (!is_thinned).then_some(row.lost),
            hops: path.map_or_else(Vec::new, |path| path.hops(quantiles)),
        }
    }

    /// Topics that are observed passively, with their publisher if there is only one.
    fn passive_pairs(&self) -> BTreeSet<(String, Option<FlowId>)> {
        let here = self.flows.iter().filter(|figures| figures.is_here);
        let pairs = here.flat_map(|figures| {
            let delivering = figures.bridges.iter().filter(|bridge| bridge.age_ms.is_some());
            delivering.map(|bridge| {
                let publishers = figures.publishers.get(&bridge.topic).map(Vec::as_slice);
                let from = match publishers {
                    Some([first, others @ ..]) if others.iter().all(|other| other == first) => {
                        Some(first.clone())
                    }
                    _ => None,
                };
                (bridge.topic.clone(), from)
            })
        });
        let is_passive = |topic: &str| {
            let rule = topic.parse().ok().and_then(|topic| rule_of(&self.rules, &topic));
            rule.is_some_and(|rule| rule.observe == Observe::Flow)
        };
        pairs.filter(|(topic, _)| is_passive(topic)).collect()
    }

    fn passive(&self, topic: &str, from: Option<&FlowId>) -> Option<TopicBody> {
        let path = Path::of(&self.flows, topic, from)?;
        Some(TopicBody {
            topic: topic.to_owned(),
            from: from.map(FlowId::to_string),
            observe: Observe::Flow,
            stamp: Stamp::Publish,
            method: Some(Method::Age),
            messages: path.messages,
            latency_ms: shown(path.age_ms),
            error_ms: Some(rounded(path.error_ms)),
            unknown: 0,
            lost: None,
            hops: path.hops(path.age_ms),
        })
    }

    /// Metrics of all rows.
    #[must_use]
    pub fn metrics(&self) -> Vec<MetricFamily> {
        let (Ok(errors), Ok(unknown)) = (
            GaugeVec::new(ERROR.opts(), ERROR.labels),
            IntCounterVec::new(UNKNOWN.opts(), UNKNOWN.labels),
        ) else {
            return Vec::new();
        };
        for (key, row) in self.rows.iter() {
            let labels = [&*key.topic, &*key.layer, &*key.node];
            unknown.with_label_values(&labels).inc_by(row.unknown);
            if let Some((.., error_ms)) = row.summary() {
                errors.with_label_values(&labels).set(error_ms / 1e3);
            }
        }
        [self.histogram.collect(), errors.collect(), unknown.collect()].concat()
    }

    /// Whether raw samples are kept; those that wait are dropped when they no longer are.
    pub fn keep_samples(&mut self, is_on: bool) {
        self.samples = Samples { is_on, ..Samples::default() };
    }

    /// The raw samples since the last call, and how many were dropped before them.
    pub fn take_samples(&mut self) -> (Vec<Sample>, u64) {
        let dropped = std::mem::take(&mut self.samples.dropped);
        (self.samples.ring.drain(..).collect(), dropped)
    }

    /// Writers whose losses are no longer counted, because there are too many.
    #[must_use]
    pub fn forgotten_writers(&self) -> u64 {
        self.writers.forgotten
    }
}

fn rule_of<'a>(rules: &'a [LatencyRule], topic: &TopicName) -> Option<&'a LatencyRule> {
    rules.iter().find(|rule| rule.pattern.matches(topic))
}

fn shown(quantiles: Quantiles) -> Quantiles {
    Quantiles { p50: quantiles.p50.map(rounded), p99: quantiles.p99.map(rounded) }
}
