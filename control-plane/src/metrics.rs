//! The numbers of the main service, in the text format of Prometheus.
//!
//! ```text
//! REST, gRPC ──observe(api, operation, code, duration)──┐
//! committer ──commit(report); core ──state(…)───────────┼──▶ Registry ──text()──▶ admin port, /metrics
//! watches ──watcher() … dropped─────────────────────────┘
//! ```
//!
//! Labels come from closed sets (operations, error codes) or from documents (layers and nodes),
//! never from a request.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus::core::Collector;
use prometheus::{
    Encoder, Gauge, GaugeVec, Histogram, HistogramOpts, HistogramVec, IntCounter, IntCounterVec,
    IntGauge, IntGaugeVec, Opts, Registry, TextEncoder,
};

use crate::core::CommitReport;

/// Upper bounds of durations, in seconds.
const SECONDS: &[f64] =
    &[0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0];

/// Upper bounds of the number of requests in one transaction.
const REQUESTS: &[f64] = &[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];

/// What happened, counted. Shared by both interfaces.
pub struct ApiMetrics {
    registry: Registry,
    requests: IntCounterVec,
    durations: HistogramVec,
    commits: Histogram,
    batches: Histogram,
    unfinished: IntCounterVec,
    revision: IntGauge,
    oldest: IntGauge,
    documents: IntGauge,
    skipped: IntCounter,
    watchers: IntGauge,
    lag: GaugeVec,
    connections: IntCounterVec,
    open_connections: IntGaugeVec,
}

impl std::fmt::Debug for ApiMetrics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ApiMetrics").finish_non_exhaustive()
    }
}

/// What becomes of a connection: taken, or over the limit of connections; the TLS handshake failed
/// or took too long; no first request came in time; the client took no byte for long.
const CONNECTION_RESULTS: [&str; 6] =
    ["accepted", "refused", "handshake_failed", "handshake_timeout", "timeout", "stalled"];

/// One of what a gauge counts; counted no more when dropped.
#[derive(Debug)]
pub struct OpenGauge(IntGauge);

impl OpenGauge {
    fn new(gauge: &IntGauge) -> Self {
        gauge.inc();
        Self(gauge.clone())
    }
}

impl Drop for OpenGauge {
    fn drop(&mut self) {
        self.0.dec();
    }
}

/// Connections of one port.
#[derive(Debug, Clone)]
pub struct ConnectionMetrics {
    listener: &'static str,
    total: IntCounterVec,
    open: IntGauge,
}

impl ConnectionMetrics {
    /// Counts a connection by what became of it.
    pub(crate) fn count(&self, result: &'static str) {
        self.total.with_label_values(&[self.listener, result]).inc();
    }

    /// Counts a connection as open until what it gives is dropped.
    pub(crate) fn open(&self) -> OpenGauge {
        OpenGauge::new(&self.open)
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
        let batches = HistogramOpts::new(
            "blaze_config_commit_requests",
            "Requests that were written in one transaction.",
        );
        let unfinished = Opts::new(
            "blaze_config_commits_failed_total",
            "Transactions that were not written: another process was first (conflict), or the \
             store failed (store).",
        );
        let build = Opts::new("blaze_build_info", "1, with the version as label.");
        let build = register(&registry, IntGaugeVec::new(build, &["version", "program"])?)?;
        build.with_label_values(&[env!("CARGO_PKG_VERSION"), "blaze-config"]).set(1);
        let started =
            Gauge::new("process_start_time_seconds", "When the process started, since 1970.")?;
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        register(&registry, started)?.set(since.as_secs_f64());
        let lag = Opts::new(
            "blaze_config_worker_lag_revisions",
            "Revisions that a connected worker is behind.",
        );
        let connections =
            Opts::new("blaze_config_connections_total", "Connections by what became of them.");
        let open_connections = Opts::new("blaze_config_connections", "Connections that are open.");
        Ok(Self {
            connections: register(
                &registry,
                IntCounterVec::new(connections, &["listener", "result"])?,
            )?,
            open_connections: register(
                &registry,
                IntGaugeVec::new(open_connections, &["listener"])?,
            )?,
            requests: register(
                &registry,
                IntCounterVec::new(requests, &["api", "operation", "code"])?,
            )?,
            durations: register(
                &registry,
                HistogramVec::new(durations.buckets(SECONDS.to_vec()), &["api", "operation"])?,
            )?,
            commits: register(&registry, Histogram::with_opts(commits.buckets(SECONDS.to_vec()))?)?,
            batches: register(
                &registry,
                Histogram::with_opts(batches.buckets(REQUESTS.to_vec()))?,
            )?,
            unfinished: register(&registry, IntCounterVec::new(unfinished, &["reason"])?)?,
            oldest: register(
                &registry,
                IntGauge::new(
                    "blaze_config_oldest_revision",
                    "Smallest revision that a watch may start after.",
                )?,
            )?,
            documents: register(
                &registry,
                IntGauge::new("blaze_config_documents", "Documents that there are.")?,
            )?,
            skipped: register(
                &registry,
                IntCounter::new(
                    "blaze_config_audit_skipped_total",
                    "Refusals that are not in the audit, since there were too many at once.",
                )?,
            )?,
            revision: register(
                &registry,
                IntGauge::new("blaze_config_revision", "Revision that this process has applied.")?,
            )?,
            watchers: register(
                &registry,
                IntGauge::new("blaze_config_watchers", "Open watches.")?,
            )?,
            lag: register(&registry, GaugeVec::new(lag, &["layer", "node"])?)?,
            registry,
        })
    }

    /// Counts a request. `code` is `ok` or the error code as it is written.
    pub fn observe(&self, api: &str, operation: &str, code: &str, duration: Duration) {
        self.requests.with_label_values(&[api, operation, code]).inc();
        self.durations.with_label_values(&[api, operation]).observe(duration.as_secs_f64());
    }

    /// Counts a transaction.
    pub fn commit(&self, report: &CommitReport) {
        self.commits.observe(report.duration.as_secs_f64());
        if report.committed {
            self.batches.observe(report.requests as f64);
        } else {
            let reason = if report.conflict { "conflict" } else { "store" };
            self.unfinished.with_label_values(&[reason]).inc();
        }
    }

    /// What the core holds now: the revision that is applied, the oldest one that is kept,
    /// documents, and refusals that are missing in the audit so far.
    pub fn state(&self, revision: u64, oldest: u64, documents: usize, skipped: u64) {
        self.revision.set(i64::try_from(revision).unwrap_or(i64::MAX));
        self.oldest.set(i64::try_from(oldest).unwrap_or(i64::MAX));
        self.documents.set(i64::try_from(documents).unwrap_or(i64::MAX));
        self.skipped.inc_by(skipped.saturating_sub(self.skipped.get()));
    }

    /// Counts a watch as open until what it gives is dropped.
    #[must_use]
    pub fn watcher(&self) -> OpenGauge {
        OpenGauge::new(&self.watchers)
    }

    /// The connections of a port, all at zero.
    #[must_use]
    pub fn connections(&self, listener: &'static str) -> ConnectionMetrics {
        for result in CONNECTION_RESULTS {
            self.connections.with_label_values(&[listener, result]);
        }
        ConnectionMetrics {
            listener,
            total: self.connections.clone(),
            open: self.open_connections.with_label_values(&[listener]),
        }
    }

    /// How far the connected workers are behind, by layer and node; those that are not named have
    /// gone.
    pub fn worker_lags<'a>(&self, lags: impl IntoIterator<Item = (&'a str, &'a str, u64)>) {
        self.lag.reset();
        for (layer, node, revisions) in lags {
            self.lag.with_label_values(&[layer, node]).set(revisions as f64);
        }
    }

    /// Takes further numbers among its own.
    ///
    /// # Errors
    /// If one of them is there already: a fault of this program.
    pub fn add(
        &self,
        collectors: impl IntoIterator<Item = Box<dyn Collector>>,
    ) -> prometheus::Result<()> {
        collectors.into_iter().try_for_each(|collector| self.registry.register(collector))
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

fn register<M: Collector + Clone + 'static>(
    registry: &Registry,
    metric: M,
) -> prometheus::Result<M> {
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
        let report = CommitReport {
            duration: Duration::from_millis(7),
            requests: 3,
            committed: true,
            conflict: false,
        };
        metrics.commit(&report);
        let conflict = CommitReport { committed: false, conflict: true, ..report };
        metrics.commit(&conflict);
        for _ in 0..2 {
            metrics.state(412, 7, 10, 5);
        }
        metrics.worker_lags([("edge", "robot-1", 3)]);
        let port = metrics.connections("grpc");
        port.count("stalled");
        let open = (metrics.watcher(), port.open());
        let text = metrics.text();
        for line in [
            "blaze_config_requests_total{api=\"rest\",code=\"ok\",operation=\"get_node\"} 1",
            "blaze_config_request_duration_seconds_count{api=\"rest\",operation=\"get_node\"} 1",
            "blaze_config_commit_duration_seconds_count 2",
            "blaze_config_commit_requests_bucket{le=\"4\"} 1",
            "blaze_config_commit_requests_sum 3",
            "blaze_config_commits_failed_total{reason=\"conflict\"} 1",
            "blaze_config_oldest_revision 7",
            "blaze_config_documents 10",
            "blaze_config_audit_skipped_total 5",
            "blaze_config_revision 412",
            "blaze_config_watchers 1",
            "blaze_config_connections_total{listener=\"grpc\",result=\"stalled\"} 1",
            "blaze_config_connections_total{listener=\"grpc\",result=\"refused\"} 0",
            "blaze_config_connections{listener=\"grpc\"} 1",
            "blaze_config_worker_lag_revisions{layer=\"edge\",node=\"robot-1\"} 3",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
        }
        assert!(
            text.contains("blaze_build_info{") && text.contains("process_start_time_seconds "),
            "{text}"
        );
        drop(open);
        metrics.worker_lags([]);
        let text = metrics.text();
        assert!(text.contains("blaze_config_watchers 0"), "{text}");
        assert!(!text.contains("robot-1"), "{text}");
    }
}
