//! A metric with its label sets, of which there is a bounded number.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::RwLock;
use prometheus::IntCounter;
use prometheus::core::{Collector, Desc};
use prometheus::proto::{self, LabelPair, MetricFamily};

use super::limits::{MAX_LABEL_SETS, OTHER};
use super::shape::{Shape, cut};
use super::values::{Counter, Gauge, Histogram, Value};
use crate::SdkError;

/// Between the values of a key; never a byte of UTF-8, so that each key is of one set.
const BETWEEN: u8 = 0xff;

/// A metric of a service; clones are the same one. [`Metric::labels`] gives the value of a label
/// set; a metric without labels has one value, which the metric itself changes.
pub struct Metric<V> {
    family: Arc<Family<V>>,
}

struct Family<V> {
    shape: Shape,
    desc: Desc,
    sets: RwLock<HashMap<Vec<u8>, Set<V>>>,
    /// Value of a metric without labels, else of the set with all values `_other`.
    rest: V,
    has_rest: AtomicBool,
    /// Label sets above the limit.
    refused: IntCounter,
}

#[derive(Clone)]
struct Set<V> {
    labels: Arc<[LabelPair]>,
    value: V,
}

impl<V: Value> Metric<V> {
    pub(super) fn new(shape: Shape, refused: IntCounter) -> Result<Self, SdkError> {
        let fault = |error: prometheus::Error| shape.fault(&error.to_string());
        let (name, help, labels) = (shape.name.clone(), shape.help.clone(), shape.labels.clone());
        let desc = Desc::new(name, help, labels, HashMap::new()).map_err(fault)?;
        let rest = V::new(&shape).map_err(fault)?;
        let has_rest = AtomicBool::new(shape.labels.is_empty());
        let sets = RwLock::default();
        let family = Arc::new(Family { shape, desc, sets, rest, has_rest, refused });
        Ok(Self { family })
    }

    pub(super) fn shape(&self) -> &Shape {
        &self.family.shape
    }

    /// The value of a label set, in the order of the metric's labels. Keep it where it is changed
    /// often: this looks it up under a lock that is held for the look-up alone. Values are cut at
    /// 128 bytes. The first 1,000 sets have values of their own. Further ones share the set with
    /// all values `_other`, and so does a set with another number of values than the metric has
    /// labels; `blaze_sdk_label_sets_refused_total` counts them.
    #[must_use]
    pub fn labels(&self, values: &[&str]) -> V {
        let family = &self.family;
        if values.len() != family.shape.labels.len() {
            return family.refuse().clone();
        }
        if values.iter().all(|value| *value == OTHER) {
            return family.rest().clone();
        }
        let key = key(values);
        let sets = family.sets.read();
        if let Some(set) = sets.get(&key) {
            return set.value.clone();
        }
        let is_full = sets.len() >= MAX_LABEL_SETS;
        drop(sets);
        let made = if is_full { None } else { family.make(key, values) };
        made.unwrap_or_else(|| family.refuse().clone())
    }

    /// The only value of a metric without labels.
    fn only(&self) -> &V {
        match self.family.shape.labels.is_empty() {
            true => &self.family.rest,
            false => self.family.refuse(),
        }
    }
}

impl<V: Value> Family<V> {
    /// `None` when there are as many sets as there may be.
    fn make(&self, key: Vec<u8>, values: &[&str]) -> Option<V> {
        let labels = self.pairs(values.iter().map(|value| cut(value)));
        let value = V::new(&self.shape).ok()?;
        let mut sets = self.sets.write();
        // Another thread may have made it meanwhile.
        if let Some(set) = sets.get(&key) {
            return Some(set.value.clone());
        }
        if sets.len() >= MAX_LABEL_SETS {
            return None;
        }
        sets.insert(key, Set { labels, value: value.clone() });
        Some(value)
    }

    fn refuse(&self) -> &V {
        self.refused.inc();
        self.rest()
    }

    fn rest(&self) -> &V {
        self.has_rest.store(true, Ordering::Relaxed);
        &self.rest
    }

    fn pairs<'v>(&self, values: impl Iterator<Item = &'v str>) -> Arc<[LabelPair]> {
        self.shape.labels.iter().zip(values).map(|(name, value)| pair(name, value)).collect()
    }

    fn samples(&self) -> Vec<proto::Metric> {
        // Copied, so that the lock is not held while the text is made.
        let mut sets: Vec<Set<V>> = self.sets.read().values().cloned().collect();
        if self.has_rest.load(Ordering::Relaxed) {
            let labels = self.pairs(std::iter::repeat(OTHER));
            sets.push(Set { labels, value: self.rest.clone() });
        }
        let sample = |set: &Set<V>| {
            let mut sample = set.value.sample();
            sample.set_label(set.labels.to_vec());
            sample
        };
        sets.iter().map(sample).collect()
    }
}

impl<V: Value> Collector for Metric<V> {
    fn desc(&self) -> Vec<&Desc> {
        vec![&self.family.desc]
    }

    fn collect(&self) -> Vec<MetricFamily> {
        let Shape { name, help, kind, .. } = self.shape();
        vec![gathered(name, help, *kind, self.family.samples())]
    }
}

impl Metric<Counter> {
    /// Adds 1 to a counter without labels.
    pub fn inc(&self) {
        self.only().inc();
    }

    /// Adds a number to a counter without labels, as [`Counter::inc_by`] does.
    pub fn inc_by(&self, number: f64) {
        self.only().inc_by(number);
    }
}

impl Metric<Gauge> {
    /// Sets a gauge without labels.
    pub fn set(&self, value: f64) {
        self.only().set(value);
    }

    /// Adds a number, which may be negative, to a gauge without labels.
    pub fn add(&self, number: f64) {
        self.only().add(number);
    }
}

impl Metric<Histogram> {
    /// Adds an observation to a histogram without labels, as [`Histogram::observe`] does.
    pub fn observe(&self, value: f64) {
        self.only().observe(value);
    }
}

impl<V> Clone for Metric<V> {
    fn clone(&self) -> Self {
        Self { family: Arc::clone(&self.family) }
    }
}

impl<V> fmt::Debug for Metric<V> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Metric").field(&self.family.shape).finish()
    }
}

fn key(values: &[&str]) -> Vec<u8> {
    let mut key = Vec::with_capacity(64);
    for value in values {
        key.extend_from_slice(cut(value).as_bytes());
        key.push(BETWEEN);
    }
    key
}

/// A label with its value.
pub(super) fn pair(name: &str, value: &str) -> LabelPair {
    let mut pair = LabelPair::default();
    pair.set_name(name.to_owned());
    pair.set_value(value.to_owned());
    pair
}

/// A metric as the text encoder takes it.
pub(super) fn gathered(
    name: &str,
    help: &str,
    kind: proto::MetricType,
    samples: Vec<proto::Metric>,
) -> MetricFamily {
    let mut family = MetricFamily::default();
    family.set_name(name.to_owned());
    family.set_help(help.to_owned());
    family.set_field_type(kind);
    family.set_metric(samples);
    family
}
