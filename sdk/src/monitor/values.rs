//! Counter, gauge and histogram with one set of labels.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use prometheus::core::{Atomic as _, AtomicF64, Metric as _};
use prometheus::{HistogramOpts, proto};

use super::shape::Shape;

/// Largest whole number below which `f64` has all whole numbers (2^53).
const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;

/// Value of a metric with one set of labels. A closed set: counter, gauge, histogram.
pub trait Value: Clone + Send + Sync + 'static {
    /// A new one at zero.
    #[doc(hidden)]
    fn new(shape: &Shape) -> prometheus::Result<Self>;

    /// As it is now, without labels.
    #[doc(hidden)]
    fn sample(&self) -> proto::Metric;
}

/// Counts up. Cheap to clone; clones count together.
#[derive(Debug, Clone)]
pub struct Counter(Arc<Count>);

/// Whole numbers have an atomic of their own, so that counting is one addition without a loop.
#[derive(Debug)]
struct Count {
    whole: AtomicU64,
    part: AtomicF64,
}

impl Counter {
    /// Adds 1.
    pub fn inc(&self) {
        self.0.whole.fetch_add(1, Ordering::Relaxed);
    }

    /// Adds a number. One that is not finite, or not above 0, adds nothing: a counter never falls.
    pub fn inc_by(&self, number: f64) {
        if number > 0.0 && number < MAX_WHOLE && number.fract() == 0.0 {
            self.0.whole.fetch_add(number as u64, Ordering::Relaxed);
        } else if number > 0.0 && number.is_finite() {
            self.0.part.inc_by(number);
        }
    }

    /// As it is now.
    #[must_use]
    pub fn get(&self) -> f64 {
        self.0.whole.load(Ordering::Relaxed) as f64 + self.0.part.get()
    }
}

impl Value for Counter {
    fn new(_: &Shape) -> prometheus::Result<Self> {
        Ok(Self(Arc::new(Count { whole: AtomicU64::new(0), part: AtomicF64::new(0.0) })))
    }

    fn sample(&self) -> proto::Metric {
        let mut counter = proto::Counter::default();
        counter.set_value(self.get());
        let mut metric = proto::Metric::default();
        metric.set_counter(counter);
        metric
    }
}

/// Goes up and down. Cheap to clone; clones share the value.
#[derive(Debug, Clone)]
pub struct Gauge(Arc<AtomicF64>);

impl Gauge {
    /// Sets the value.
    pub fn set(&self, value: f64) {
        self.0.set(value);
    }

    /// Adds a number, which may be negative.
    pub fn add(&self, number: f64) {
        self.0.inc_by(number);
    }

    /// As it is now.
    #[must_use]
    pub fn get(&self) -> f64 {
        self.0.get()
    }
}

impl Value for Gauge {
    fn new(_: &Shape) -> prometheus::Result<Self> {
        Ok(Self(Arc::new(AtomicF64::new(0.0))))
    }

    fn sample(&self) -> proto::Metric {
        let mut gauge = proto::Gauge::default();
        gauge.set_value(self.get());
        proto::Metric::from_gauge(gauge)
    }
}

/// Counts observations in buckets. Cheap to clone; clones count together.
#[derive(Debug, Clone)]
pub struct Histogram(prometheus::Histogram);

impl Histogram {
    /// Adds an observation. One that is not finite is left out: it would spoil the sum for ever.
    pub fn observe(&self, value: f64) {
        if value.is_finite() {
            self.0.observe(value);
        }
    }
}

impl Value for Histogram {
    fn new(shape: &Shape) -> prometheus::Result<Self> {
        let options = HistogramOpts::new(&shape.name, &shape.help).buckets(shape.buckets.clone());
        Ok(Self(prometheus::Histogram::with_opts(options)?))
    }

    fn sample(&self) -> proto::Metric {
        self.0.metric()
    }
}
