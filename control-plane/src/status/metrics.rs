//! Counters of the status stream.

use prometheus::core::Collector;
use prometheus::{IntCounter, IntCounterVec, IntGauge, Opts};

use super::Refusal;

/// What happened on the status streams.
#[derive(Debug, Clone)]
pub struct StatusMetrics {
    streams: IntGauge,
    summaries: IntCounter,
    queries: IntCounterVec,
    refused: IntCounterVec,
}

/// What becomes of a query.
pub(super) const QUERY_RESULTS: &[&str] =
    &["ok", "failed", "shared", "timeout", "unreachable", "overloaded"];

impl StatusMetrics {
    /// All at zero.
    ///
    /// # Errors
    /// If a metric has a bad name: a fault of this program.
    pub fn new() -> prometheus::Result<Self> {
        let queries = Opts::new(
            "blaze_config_status_queries_total",
            "Queries to monitors by result; shared: answered by another one's answer.",
        );
        let refused = Opts::new(
            "blaze_config_status_refused_total",
            "What monitors sent and the service did not take, by reason.",
        );
        let metrics = Self {
            streams: IntGauge::new("blaze_config_status_streams", "Open streams of monitors.")?,
            summaries: IntCounter::new(
                "blaze_config_status_summaries_total",
                "Summaries that were taken.",
            )?,
            queries: IntCounterVec::new(queries, &["result"])?,
            refused: IntCounterVec::new(refused, &["reason"])?,
        };
        for result in QUERY_RESULTS {
            metrics.queries.with_label_values(&[result]);
        }
        for reason in Refusal::ALL {
            metrics.refused.with_label_values(&[reason.as_str()]);
        }
        Ok(metrics)
    }

    /// What a registry takes.
    #[must_use]
    pub fn collectors(&self) -> [Box<dyn Collector>; 4] {
        [
            Box::new(self.streams.clone()),
            Box::new(self.summaries.clone()),
            Box::new(self.queries.clone()),
            Box::new(self.refused.clone()),
        ]
    }

    pub(super) fn streams(&self, open: usize) {
        self.streams.set(i64::try_from(open).unwrap_or(i64::MAX));
    }

    pub(super) fn summary(&self) {
        self.summaries.inc();
    }

    pub(super) fn query(&self, result: &str) {
        self.queries.with_label_values(&[result]).inc();
    }

    /// How often something was refused for a reason.
    #[cfg(test)]
    pub(crate) fn count(&self, reason: &str) -> u64 {
        self.refused.with_label_values(&[reason]).get()
    }

    /// Counts what was refused.
    pub fn refused(&self, reason: Refusal) {
        self.refused.with_label_values(&[reason.as_str()]).inc();
    }
}
