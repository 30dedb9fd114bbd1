//! Name, labels and buckets of a metric, and the rules for them.

use prometheus::proto::MetricType;

use super::limits::{
    MAX_BUCKETS, MAX_HELP_BYTES, MAX_LABEL_VALUE_BYTES, MAX_LABELS, MAX_NAME_BYTES,
};
use crate::SdkError;

/// What a metric is, without its values.
#[derive(Debug, Clone)]
pub struct Shape {
    pub(super) name: String,
    pub(super) help: String,
    pub(super) kind: MetricType,
    pub(super) labels: Vec<String>,
    /// Upper bounds; empty for all but histograms.
    pub(super) buckets: Vec<f64>,
}

impl Shape {
    pub(super) fn new(
        kind: MetricType,
        name: &str,
        help: &str,
        labels: &[&str],
        buckets: &[f64],
    ) -> Result<Self, SdkError> {
        let shape = Self {
            name: name.to_owned(),
            help: help.to_owned(),
            kind,
            labels: labels.iter().map(|label| (*label).to_owned()).collect(),
            buckets: buckets.to_vec(),
        };
        shape.check()?;
        Ok(shape)
    }

    fn check(&self) -> Result<(), SdkError> {
        check_name(&self.name)?;
        if self.name.starts_with("blaze_") {
            return Err(self.fault("names that begin with blaze_ are those of BlazeAIoT"));
        }
        if self.kind == MetricType::COUNTER && !self.name.ends_with("_total") {
            return Err(self.fault("the name of a counter must end in _total"));
        }
        if self.help.is_empty() || self.help.len() > MAX_HELP_BYTES {
            return Err(self.fault(&format!("its help must have 1 to {MAX_HELP_BYTES} bytes")));
        }
        self.check_labels()?;
        self.check_buckets()
    }

    fn check_labels(&self) -> Result<(), SdkError> {
        if self.labels.len() > MAX_LABELS {
            let count = self.labels.len();
            let reason = format!("has {count} labels, at most {MAX_LABELS} are allowed");
            return Err(self.fault(&reason));
        }
        for (index, label) in self.labels.iter().enumerate() {
            check_name(label)?;
            if self.labels[..index].contains(label) {
                return Err(self.fault(&format!("has the label {label} twice")));
            }
            if label.starts_with("__") || (self.kind == MetricType::HISTOGRAM && label == "le") {
                return Err(self.fault(&format!("the label {label} is that of Prometheus")));
            }
        }
        Ok(())
    }

    fn check_buckets(&self) -> Result<(), SdkError> {
        if self.kind != MetricType::HISTOGRAM {
            return Ok(());
        }
        let ascend = self.buckets.windows(2).all(|pair| pair[0] < pair[1]);
        let are_finite = self.buckets.iter().all(|bound| bound.is_finite());
        if !(1..=MAX_BUCKETS).contains(&self.buckets.len()) || !ascend || !are_finite {
            let reason = format!("needs 1 to {MAX_BUCKETS} finite buckets that ascend");
            return Err(self.fault(&reason));
        }
        Ok(())
    }

    /// Whether one metric can be both. The help of the first one stays.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        self.kind == other.kind && self.labels == other.labels && self.buckets == other.buckets
    }

    /// All names that it has in a scrape.
    pub(super) fn names(&self) -> Vec<String> {
        let ends: &[&str] = match self.kind {
            MetricType::HISTOGRAM => &["", "_bucket", "_sum", "_count"],
            _ => &[""],
        };
        ends.iter().map(|end| format!("{}{end}", self.name)).collect()
    }

    pub(super) fn fault(&self, reason: &str) -> SdkError {
        fault(&self.name, reason)
    }
}

fn fault(name: &str, reason: &str) -> SdkError {
    SdkError::Option { option: "metric", reason: format!("{}: {reason}", cut(name)) }
}

fn check_name(name: &str) -> Result<(), SdkError> {
    let starts = name.starts_with(|first: char| first.is_ascii_lowercase() || first == '_');
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    if starts && name.chars().all(is_allowed) && name.len() <= MAX_NAME_BYTES {
        return Ok(());
    }
    let rule = format!("names are [a-z_][a-z0-9_]* of at most {MAX_NAME_BYTES} bytes");
    Err(fault(name, &rule))
}

/// The beginning of a label value, at most as long as one may be.
pub(super) fn cut(value: &str) -> &str {
    &value[..value.floor_char_boundary(MAX_LABEL_VALUE_BYTES)]
}
