//! Series, the readings that consist of them, and the sample of all collectors.

use std::sync::Arc;
use std::time::Instant;

use super::file::Fault;
use super::metrics::COLLECTOR_UP;
use crate::metric::Metric;

/// Value of a label. Cheap to clone; compared and hashed as text.
#[derive(Clone, Debug)]
pub enum Label {
    /// A word of the code.
    Fixed(&'static str),
    /// A name that the machine gives.
    Shared(Arc<str>),
}

impl Label {
    /// A name that the machine gives.
    pub(super) fn new(name: &str) -> Self {
        Self::Shared(Arc::from(name))
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        match self {
            Self::Fixed(text) => text,
            Self::Shared(text) => text,
        }
    }
}

impl PartialEq for Label {
    fn eq(&self, other: &Self) -> bool {
        self.as_str() == other.as_str()
    }
}

impl Eq for Label {}

impl std::hash::Hash for Label {
    fn hash<H: std::hash::Hasher>(&self, state: &mut H) {
        self.as_str().hash(state);
    }
}

impl std::fmt::Display for Label {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl From<&'static str> for Label {
    fn from(text: &'static str) -> Self {
        Self::Fixed(text)
    }
}

/// One value of one metric.
#[derive(Clone, Debug)]
pub(super) struct Series {
    pub(super) metric: &'static Metric,
    labels: [Label; 2],
    pub(super) value: f64,
}

impl Series {
    /// Values of the labels, as many as the metric has.
    pub(super) fn labels(&self) -> &[Label] {
        &self.labels[..self.metric.labels.len().min(2)]
    }

    /// Whether the series is of this metric.
    pub(super) fn is(&self, metric: &'static Metric) -> bool {
        std::ptr::eq(self.metric, metric)
    }
}

/// What one run of a collector gave.
#[derive(Debug, Default)]
pub(super) struct Batch {
    pub(super) series: Vec<Series>,
    /// Names of GPUs: label, name.
    pub(super) names: Vec<(Label, Label)>,
    /// The source is there, even if it has no value at present.
    pub(super) found: bool,
    faults: Vec<Fault>,
}

impl Batch {
    /// Adds a value without label.
    pub(super) fn plain(&mut self, metric: &'static Metric, value: f64) {
        self.two(metric, "", "", value);
    }

    /// Adds a value with one label.
    pub(super) fn one(&mut self, metric: &'static Metric, label: impl Into<Label>, value: f64) {
        self.two(metric, label, "", value);
    }

    /// Adds a value with two labels.
    pub(super) fn two(
        &mut self,
        metric: &'static Metric,
        first: impl Into<Label>,
        second: impl Into<Label>,
        value: f64,
    ) {
        if value.is_finite() {
            self.series.push(Series { metric, labels: [first.into(), second.into()], value });
        }
    }

    /// Keeps a fault; the value of a result without one.
    pub(super) fn take<T>(&mut self, result: Result<Option<T>, Fault>) -> Option<T> {
        match result {
            Ok(value) => value,
            Err(fault) => {
                self.faults.push(fault);
                None
            }
        }
    }

    fn state(&self) -> State {
        match self.faults.as_slice() {
            [] if self.found || !self.series.is_empty() => State::Up,
            [] => State::Absent,
            [one] => State::Down(one.to_string()),
            [one, more @ ..] => State::Down(format!("{one} (and {} more)", more.len())),
        }
    }
}

/// Whether a source is there, and read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum State {
    Absent,
    Up,
    /// With the reason and the remedy.
    Down(String),
}

/// A run of a collector, and when it was.
#[derive(Debug)]
pub(super) struct Reading {
    pub(super) at: Instant,
    pub(super) series: Vec<Series>,
    pub(super) names: Vec<(Label, Label)>,
    pub(super) state: State,
}

impl Reading {
    pub(super) fn new(batch: Batch, at: Instant) -> Self {
        let state = batch.state();
        Self { at, series: batch.series, names: batch.names, state }
    }
}

/// State and values of one collector.
#[derive(Clone, Debug)]
pub(super) struct Slot {
    pub(super) collector: &'static str,
    pub(super) state: State,
    pub(super) reading: Option<Arc<Reading>>,
    up: Option<Series>,
}

impl Slot {
    pub(super) fn new(
        collector: &'static str,
        state: State,
        reading: Option<Arc<Reading>>,
    ) -> Self {
        let up = match state {
            State::Absent => None,
            State::Up => Some(1.0),
            State::Down(_) => Some(0.0),
        };
        let up = up.map(|value| Series {
            metric: &COLLECTOR_UP,
            labels: [collector.into(), "".into()],
            value,
        });
        Self { collector, state, reading, up }
    }
}

/// The newest values of all collectors. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Sample {
    pub(super) slots: Vec<Slot>,
}

impl Sample {
    /// All series: metric, values of its labels in the order of [`Metric::labels`], value.
    pub fn series(&self) -> impl Iterator<Item = (&'static Metric, &[Label], f64)> {
        let up = self.slots.iter().filter_map(|slot| slot.up.as_ref());
        self.values().chain(up).map(|series| (series.metric, series.labels(), series.value))
    }

    /// The series of the collectors, without their states.
    pub(super) fn values(&self) -> impl Iterator<Item = &Series> {
        self.slots.iter().filter_map(|slot| slot.reading.as_ref()).flat_map(|r| &r.series)
    }
}
