//! Metrics of the monitor: their tables, and the text of Prometheus made of their values.

use std::collections::BTreeMap;

use prometheus::proto::{
    Bucket, Counter, Gauge, Histogram as ProtoHistogram, LabelPair, Metric as Row, MetricFamily,
    MetricType,
};
use prometheus::{Encoder as _, Opts, TextEncoder};

/// Kind of a metric in the sense of Prometheus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Grows, or starts again at the restart of its source.
    Counter,
    /// Goes up and down.
    Gauge,
    /// Counts of values up to bounds, their sum and number.
    Histogram,
}

impl Kind {
    /// The word of the exposition format.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Counter => "counter",
            Self::Gauge => "gauge",
            Self::Histogram => "histogram",
        }
    }
}

/// One metric. `/metrics` and the documentation are made of such tables.
#[derive(Debug, PartialEq, Eq)]
pub struct Metric {
    /// Name, without labels.
    pub name: &'static str,
    /// Kind.
    pub kind: Kind,
    /// Unit of the value; `1` for ratios, states and counts.
    pub unit: &'static str,
    /// Meaning, one sentence.
    pub help: &'static str,
    /// Names of the labels, in the order of a series' values.
    pub labels: &'static [&'static str],
}

impl Metric {
    /// Name and help in the form of the crate `prometheus`.
    #[must_use]
    pub fn opts(&self) -> Opts {
        Opts::new(self.name, self.help)
    }
}

/// Declares the metrics of a module and the table `METRICS` of them.
macro_rules! metrics {
    ($($id:ident $kind:ident $name:literal [$($label:literal),*] $unit:literal $help:literal)*) => {
        $(pub(crate) static $id: $crate::metric::Metric = $crate::metric::Metric {
            name: $name, kind: $crate::metric::Kind::$kind, unit: $unit, help: $help,
            labels: &[$($label),*],
        };)*
        /// All metrics of this module, in the order of the documentation.
        #[allow(unreachable_pub, reason = "some of these modules are private")]
        pub static METRICS: &[&$crate::metric::Metric] = &[$(&$id),*];
    };
}
pub(crate) use metrics;

/// Counts of values by upper bounds.
#[derive(Debug, Clone, PartialEq)]
pub struct Histogram {
    bounds: &'static [f64],
    /// Values up to each bound and above the one before; the last: above all of them.
    counts: Vec<u64>,
    sum: f64,
}

impl Histogram {
    /// Without values. `bounds` ascend.
    #[must_use]
    pub fn new(bounds: &'static [f64]) -> Self {
        Self { bounds, counts: vec![0; bounds.len() + 1], sum: 0.0 }
    }

    /// Adds a value.
    pub fn observe(&mut self, value: f64) {
        let at = self.bounds.partition_point(|bound| *bound < value);
        self.counts[at] += 1;
        self.sum += value;
    }

    /// How many values there are.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Sum of the values.
    #[must_use]
    pub fn sum(&self) -> f64 {
        self.sum
    }

    /// Upper bounds, each with the number of values up to it.
    pub fn buckets(&self) -> impl Iterator<Item = (f64, u64)> {
        let sums = self.counts.iter().scan(0, |sum, count| {
            *sum += count;
            Some(*sum)
        });
        self.bounds.iter().copied().zip(sums)
    }

    fn proto(&self) -> ProtoHistogram {
        let bucket = |(bound, count)| {
            let mut bucket = Bucket::default();
            bucket.set_upper_bound(bound);
            bucket.set_cumulative_count(count);
            bucket
        };
        let mut out = ProtoHistogram::default();
        out.set_bucket(self.buckets().map(bucket).collect());
        out.set_sample_sum(self.sum);
        out.set_sample_count(self.count());
        out
    }
}

/// Value of a series.
#[derive(Debug, Clone, Copy)]
pub enum Value<'a> {
    /// Of a counter or gauge.
    Number(f64),
    /// Of a histogram.
    Histogram(&'a Histogram),
}

/// A page of metrics that is being filled.
#[derive(Debug, Default)]
pub struct Page {
    families: BTreeMap<&'static str, MetricFamily>,
    more: Vec<MetricFamily>,
}

impl Page {
    /// Adds a series, with the values of the metric's labels in their order.
    pub fn add<'a>(
        &mut self,
        metric: &'static Metric,
        labels: impl IntoIterator<Item = &'a str>,
        value: Value<'_>,
    ) {
        let family = self.families.entry(metric.name).or_insert_with(|| family(metric));
        let pairs = metric.labels.iter().zip(labels).map(|(name, value)| {
            let mut pair = LabelPair::default();
            pair.set_name((*name).to_owned());
            pair.set_value(value.to_owned());
            pair
        });
        let mut row = Row::from_label(pairs.collect());
        match (value, metric.kind) {
            (Value::Number(number), Kind::Counter) => {
                let mut counter = Counter::default();
                counter.set_value(number);
                row.set_counter(counter);
            }
            (Value::Number(number), _) => {
                let mut gauge = Gauge::default();
                gauge.set_value(number);
                row.set_gauge(gauge);
            }
            (Value::Histogram(histogram), _) => row.set_histogram(histogram.proto()),
        }
        family.mut_metric().push(row);
    }

    /// Adds whole families.
    pub fn extend(&mut self, families: impl IntoIterator<Item = MetricFamily>) {
        // An empty one is an error to the encoder.
        self.more.extend(families.into_iter().filter(|family| !family.get_metric().is_empty()));
    }

    /// The text.
    #[must_use]
    pub fn text(self) -> String {
        let families: Vec<MetricFamily> = self.families.into_values().chain(self.more).collect();
        let mut text = Vec::new();
        if let Err(error) = TextEncoder::new().encode(&families, &mut text) {
            tracing::error!(%error, "metrics");
        }
        String::from_utf8(text).unwrap_or_default()
    }
}

fn family(metric: &Metric) -> MetricFamily {
    let mut family = MetricFamily::default();
    family.set_name(metric.name.to_owned());
    family.set_help(metric.help.to_owned());
    family.set_field_type(match metric.kind {
        Kind::Counter => MetricType::COUNTER,
        Kind::Gauge => MetricType::GAUGE,
        Kind::Histogram => MetricType::HISTOGRAM,
    });
    family
}

/// Name of a series in answers: as in Prometheus' text.
#[must_use]
pub fn series_name<'a>(metric: &Metric, labels: impl IntoIterator<Item = &'a str>) -> String {
    let pairs: Vec<String> =
        metric.labels.iter().zip(labels).map(|(name, value)| format!("{name}={value:?}")).collect();
    match pairs.is_empty() {
        true => metric.name.to_owned(),
        false => format!("{}{{{}}}", metric.name, pairs.join(",")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    metrics! {
        RATIO Gauge "test_ratio" ["kind"] "1" "A ratio."
        SECONDS Histogram "test_seconds" [] "seconds" "Seconds."
    }

    #[test]
    fn a_page_has_each_family_once() {
        let mut histogram = Histogram::new(&[0.1, 1.0]);
        [0.1, 0.5, 7.0].into_iter().for_each(|value| histogram.observe(value));
        let mut page = Page::default();
        page.add(&RATIO, ["a\"b"], Value::Number(0.5));
        page.add(&SECONDS, [], Value::Histogram(&histogram));
        page.add(&RATIO, ["c"], Value::Number(1.0));
        assert_eq!(
            page.text(),
            "# HELP test_ratio A ratio.\n# TYPE test_ratio gauge\ntest_ratio{kind=\"a\\\"b\"} 0.5\n\
             test_ratio{kind=\"c\"} 1\n# HELP test_seconds Seconds.\n# TYPE test_seconds histogram\n\
             test_seconds_bucket{le=\"0.1\"} 1\ntest_seconds_bucket{le=\"1\"} 2\n\
             test_seconds_bucket{le=\"+Inf\"} 3\ntest_seconds_sum 7.6\ntest_seconds_count 3\n"
        );
        assert_eq!(METRICS.len(), 2);
    }
}
