//! Limits of the metrics of a service.

/// Metrics of a service; further ones are refused. Bounds what a scrape returns.
pub(super) const MAX_METRICS: usize = 1_000;
/// Labels of a metric; each multiplies the number of series.
pub(super) const MAX_LABELS: usize = 8;
/// Label sets of a metric; further ones share the set with all values [`OTHER`].
pub(super) const MAX_LABEL_SETS: usize = 1_000;
/// Topics with counts of their own; further ones share the topic [`OTHER`].
pub(super) const MAX_TOPICS: usize = 1_000;
/// Label value, in bytes; longer ones are cut, because values may come from messages.
pub(super) const MAX_LABEL_VALUE_BYTES: usize = 128;
/// Name of a metric or label, in bytes; it stands in each line of a scrape.
pub(super) const MAX_NAME_BYTES: usize = 200;
/// Help of a metric, in bytes.
pub(super) const MAX_HELP_BYTES: usize = 1_024;
/// Buckets of a histogram; each is a series per label set.
pub(super) const MAX_BUCKETS: usize = 64;
/// Label value of everything above a limit.
pub(super) const OTHER: &str = "_other";
