//! Metrics of a service: its own, and those of the SDK, in a registry per service.
//!
//! ```text
//! counter, gauge, histogram ─► Metric ─ labels() ─► value: an atomic
//!                                │ read when somebody asks
//! publishers, subscriptions ─► Topics ─► text(), and /metrics where a port is served
//! ```

mod endpoint;
mod family;
mod limits;
mod shape;
#[cfg(test)]
mod tests;
mod topics;
mod values;

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};

use blaze_domain::NodeName;
use parking_lot::Mutex;
use prometheus::proto::MetricType;
use prometheus::{IntCounterVec, IntGauge, Opts, Registry, TextEncoder};

pub(crate) use endpoint::Endpoint;
pub use endpoint::MetricsEndpoint;
pub use family::Metric;
use shape::Shape;
pub(crate) use topics::{Counted, Counting, Counts, Times, Topics};
use values::Value;
pub use values::{Counter, Gauge, Histogram};

use crate::SdkError;
use crate::service::Identity;

/// Metrics of a service: makes counters, gauges and histograms, and gives all of them as text.
///
/// At most 1,000 metrics with 8 labels each. A metric's name, and those of its labels, are
/// `[a-z_][a-z0-9_]*`, and no metric's begins with `blaze_`. Recording never waits: a counter is
/// an atomic addition.
#[derive(Clone)]
pub struct MonitorManager {
    shared: Arc<Shared>,
}

struct Shared {
    registry: Registry,
    known: Mutex<Known>,
    refused: IntCounterVec,
    topics: Arc<Topics>,
    address: OnceLock<String>,
}

#[derive(Default)]
struct Known {
    /// Each a `Metric` of some kind.
    metrics: BTreeMap<String, Box<dyn Any + Send>>,
    /// All names in a scrape; a histogram has several.
    names: BTreeSet<String>,
}

impl MonitorManager {
    pub(crate) fn new(identity: &Identity, version: &str) -> Result<Self, SdkError> {
        Self::registered(identity, version).map_err(|error| SdkError::Option {
            option: "metrics",
            reason: format!("cannot be registered: {error}"),
        })
    }

    fn registered(identity: &Identity, version: &str) -> prometheus::Result<Self> {
        let registry = Registry::new();
        let info = Opts::new("blaze_service_info", "1, with the service as labels.")
            .const_label("layer", identity.layer.as_str())
            .const_label("node", identity.node.as_ref().map_or("", NodeName::as_str))
            .const_label("service", identity.service.as_str())
            .const_label("instance", identity.instance.as_str())
            .const_label("version", version)
            .const_label("language", "rust");
        let info = IntGauge::with_opts(info)?;
        info.set(1);
        registry.register(Box::new(info))?;
        let refused = Opts::new(
            "blaze_sdk_label_sets_refused_total",
            "Uses of label sets above the limit, which were counted as _other.",
        );
        let refused = IntCounterVec::new(refused, &["metric"])?;
        registry.register(Box::new(refused.clone()))?;
        let topics = Topics::new(refused.with_label_values(&[topics::MESSAGES]));
        Ok(Self {
            shared: Arc::new(Shared {
                registry,
                known: Mutex::default(),
                refused,
                topics: Arc::new(topics),
                address: OnceLock::new(),
            }),
        })
    }

    /// A counter; its name ends in `_total`. The same name with the same labels is the same
    /// counter.
    ///
    /// # Errors
    /// [`SdkError::Option`] when the name, the help (1 to 1,024 bytes) or a label may not be, when
    /// there are 1,000 metrics already, or when the name is that of another metric.
    pub fn counter(
        &self,
        name: &str,
        help: &str,
        labels: &[&str],
    ) -> Result<Metric<Counter>, SdkError> {
        self.metric(Shape::new(MetricType::COUNTER, name, help, labels, &[])?)
    }

    /// A gauge: a value that goes up and down.
    ///
    /// # Errors
    /// As [`MonitorManager::counter`].
    pub fn gauge(
        &self,
        name: &str,
        help: &str,
        labels: &[&str],
    ) -> Result<Metric<Gauge>, SdkError> {
        self.metric(Shape::new(MetricType::GAUGE, name, help, labels, &[])?)
    }

    /// A histogram. `buckets` are the upper bounds of its buckets, at most 64, ascending, without
    /// infinity; by default those of Prometheus, 5 ms to 10 s, for times in seconds.
    ///
    /// # Errors
    /// As [`MonitorManager::counter`], or when the buckets may not be.
    pub fn histogram(
        &self,
        name: &str,
        help: &str,
        labels: &[&str],
        buckets: Option<&[f64]>,
    ) -> Result<Metric<Histogram>, SdkError> {
        let buckets = buckets.unwrap_or(prometheus::DEFAULT_BUCKETS);
        self.metric(Shape::new(MetricType::HISTOGRAM, name, help, labels, buckets)?)
    }

    fn metric<V: Value>(&self, shape: Shape) -> Result<Metric<V>, SdkError> {
        let mut known = self.shared.known.lock();
        if let Some(present) = known.metrics.get(&shape.name) {
            return present
                .downcast_ref::<Metric<V>>()
                .filter(|present| present.shape().is_like(&shape))
                .cloned()
                .ok_or_else(|| shape.fault("there is one with another kind, labels or buckets"));
        }
        let names = shape.names();
        if names.iter().any(|name| known.names.contains(name)) {
            return Err(shape.fault("the name clashes with that of a histogram's series"));
        }
        if known.metrics.len() >= limits::MAX_METRICS {
            let most = limits::MAX_METRICS;
            return Err(shape.fault(&format!("the service has {most} metrics already")));
        }
        let refused = self.shared.refused.with_label_values(&[shape.name.as_str()]);
        let metric = Metric::new(shape, refused)?;
        let registered = self.shared.registry.register(Box::new(metric.clone()));
        registered.map_err(|error| metric.shape().fault(&error.to_string()))?;
        known.metrics.insert(metric.shape().name.clone(), Box::new(metric.clone()));
        known.names.extend(names);
        Ok(metric)
    }

    /// Where the metrics are served, as `host:port`; `None` when they are not.
    #[must_use]
    pub fn address(&self) -> Option<&str> {
        self.shared.address.get().map(String::as_str)
    }

    /// All metrics in the text format of Prometheus.
    #[must_use]
    pub fn text(&self) -> String {
        let mut families = self.shared.registry.gather();
        families.extend(self.shared.topics.gather());
        TextEncoder::new().encode_to_string(&families).unwrap_or_else(|error| {
            tracing::error!(%error, "the metrics of the service cannot be written");
            String::new()
        })
    }

    /// Counts of publishers and subscriptions.
    pub(crate) fn topics(&self) -> &Arc<Topics> {
        &self.shared.topics
    }

    fn served_at(&self, address: SocketAddr) {
        // Set once: a service binds one port.
        let _ = self.shared.address.set(address.to_string());
    }
}
