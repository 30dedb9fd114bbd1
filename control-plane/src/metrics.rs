//! The numbers of the main service, in the text format of Prometheus.
//!
//! ```text
//! REST, gRPC ──observe(api, operation, code, duration)──┐
//! committer ──commit(duration), revision(r)─────────────┼──▶ Registry ──text()──▶ admin port, /metrics
//! watches ──watcher() … dropped─────────────────────────┘
//! ```
//!
//! Labels come from closed sets (operations, error codes) or from documents (layers and nodes), never from a request.

use std::time::Duration;

use prometheus::core::Collector;
use prometheus::{
    Encoder, GaugeVec, Histogram, HistogramOpts, HistogramVec, IntCounterVec, IntGauge, Opts, Registry, TextEncoder,
};

/// Upper bounds of durations, in seconds.
const SECONDS: &[f64] = &[
    0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0,
];

/// What happened, counted. Shared by both interfaces.
pub struct ApiMetrics {
    registry: Registry,
    requests: IntCounterVec,
    durations: HistogramVec,
    commits: Histogram,
    revision: IntGauge,
    watchers: IntGauge,
    lag: GaugeVec,
}

impl std::fmt::Debug for ApiMetrics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ApiMetrics").finish_non_exhaustive()
    }
}

/// One open watch; closed when dropped.
#[derive(Debug)]
pub struct OpenWatch(IntGauge);

impl Drop for OpenWatch {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl ApiMetrics {
    /// All numbers at zero.
    ///
    /// # Errors
    /// If a metric has a bad name or comes twice: a fault of this program.
    pub fn new() -> prometheus::Result<Self> {
        let registry = Registry::new();
        let requests = Opts::new(
            "blaze_config_requests_total",
            "Requests by interface, operation and result: ok, or the error code.",
        );
        let durations = HistogramOpts::new(
            "blaze_config_request_duration_seconds",
            "Time to the answer; of a watch, to its beginning.",
        );
        let commits = HistogramOpts::new(
            "blaze_config_commit_duration_seconds",
            "Time for one transaction with all that was committed together.",
        );
        let lag = Opts::new(
            "blaze_config_worker_lag_revisions",
            "Revisions that a connected worker is behind.",
        );
        Ok(Self {
            requests: register(&registry, IntCounterVec::new(requests, &["api", "operation", "code"])?)?,
            durations: register(
                &registry,
                HistogramVec::new(durations.buckets(SECONDS.to_vec()), &["api", "operation"])?,
            )?,
            commits: register(&registry, Histogram::with_opts(commits.buckets(SECONDS.to_vec()))?)?,
            revision: register(
                &registry,
                IntGauge::new("blaze_config_revision", "Revision that this process has applied.")?,
            )?,
            watchers: register(&registry, IntGauge::new("blaze_config_watchers", "Open watches.")?)?,
            lag: register(&registry, GaugeVec::new(lag, &["layer", "node"])?)?,
            registry,
        })
    }

    /// Counts a request. `code` is `ok` or the error code as it is written.
    pub fn observe(&self, api: &str, operation: &str, code: &str, duration: Duration) {
        self.requests.with_label_values(&[api, operation, code]).inc();
        self.durations
            .with_label_values(&[api, operation])
            .observe(duration.as_secs_f64());
    }

    /// Counts a commit group.
    pub fn commit(&self, duration: Duration) {
        self.commits.observe(duration.as_secs_f64());
    }

    /// The revision that is applied.
    pub fn revision(&self, revision: u64) {
        self.revision.set(i64::try_from(revision).unwrap_or(i64::MAX));
    }

    /// Counts a watch as open until what it gives is dropped.
    #[must_use]
    pub fn watcher(&self) -> OpenWatch {
        self.watchers.inc();
        OpenWatch(self.watchers.clone())
    }

    /// How far a worker is behind; `None` once it has gone.
    pub fn worker_lag(&self, layer: &str, node: &str, revisions: Option<u64>) {
        match revisions {
            Some(revisions) => self.lag.with_label_values(&[layer, node]).set(revisions as f64),
            // Gone already is as good.
            None => drop(self.lag.remove_label_values(&[layer, node])),
        }
    }

    /// All numbers as text.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = Vec::new();
        match TextEncoder::new().encode(&self.registry.gather(), &mut text) {
            Ok(()) => String::from_utf8_lossy(&text).into_owned(),
            Err(error) => {
                tracing::error!(%error, "metrics cannot be written");
                String::new()
            }
        }
    }
}

fn register<M: Collector + Clone + 'static>(registry: &Registry, metric: M) -> prometheus::Result<M> {
    registry.register(Box::new(metric.clone()))?;
    Ok(metric)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_names_of_the_contract() {
        let metrics = ApiMetrics::new().unwrap();
        metrics.observe("rest", "get_node", "ok", Duration::from_millis(2));
        metrics.commit(Duration::from_millis(7));
        metrics.revision(412);
        metrics.worker_lag("edge", "robot-1", Some(3));
        let open = metrics.watcher();
        let text = metrics.text();
        for line in [
            "blaze_config_requests_total{api=\"rest\",code=\"ok\",operation=\"get_node\"} 1",
            "blaze_config_request_duration_seconds_count{api=\"rest\",operation=\"get_node\"} 1",
            "blaze_config_commit_duration_seconds_count 1",
            "blaze_config_revision 412",
            "blaze_config_watchers 1",
            "blaze_config_worker_lag_revisions{layer=\"edge\",node=\"robot-1\"} 3",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
        }
        drop(open);
        metrics.worker_lag("edge", "robot-1", None);
        let text = metrics.text();
        assert!(text.contains("blaze_config_watchers 0"), "{text}");
        assert!(!text.contains("robot-1"), "{text}");
    }
}
