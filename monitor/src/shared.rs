//! What the parts of a monitor share: the newest values, and the answers made of them.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::control::rfc3339_millis;
use blaze_domain::{FlowId, TopicName};
use blaze_runtime::Readiness;
use parking_lot::Mutex;
use serde::Serialize;
use serde_json::{Map, Value, json};
use tokio::sync::watch;

use crate::expiry::{self, Ends};
use crate::health::{self, Change, Health, Inputs, Moment};
use crate::history::History;
use crate::latency::{self, Latency};
use crate::limits::MAX_PROBLEMS;
use crate::metric::{Page, Value as Number, metrics, series_name};
use crate::node::{self, Sample};
use crate::ping;
use crate::pings::Pings;
use crate::programs::Programs;
use crate::report::{ReportState, Site, Targets};
use crate::services::Signs;
use crate::settings::LiveSettings;

metrics! {
    BUILD_INFO Gauge "blaze_build_info" ["version", "program"] "1"
        "1, with the version as label."
    SAMPLE_SECONDS Gauge "blaze_monitor_sample_seconds" [] "seconds"
        "Time that the newest sample of the node's values took."
    REPORT_CONNECTED Gauge "blaze_monitor_report_connected" [] "1"
        "1 while the main service has accepted the status stream, else 0."
    REPORT_TOO_LARGE Counter "blaze_monitor_summaries_too_large_total" [] "1"
        "Summaries that were not sent, because they were above 256 KiB."
    HISTORY_REFUSED Counter "blaze_monitor_history_refused_total" [] "1"
        "Values left out of the last hour, because there were too many series."
}

/// The two newest samples of the node.
#[derive(Default)]
struct Values {
    now: Sample,
    before: Sample,
    took: Duration,
}

/// What the parts of a monitor share.
pub struct Shared {
    /// This node.
    pub me: FlowId,
    /// Larger after each start.
    pub epoch: u64,
    /// The checks of `/readyz`.
    pub readiness: Readiness,
    /// Health of the node.
    pub health: Mutex<Health>,
    /// Latency of messages.
    pub latency: Arc<Mutex<Latency>>,
    /// Round trips to other nodes.
    pub pings: Arc<Pings>,
    /// Signs of life of services.
    pub signs: Arc<Signs>,
    /// What became of the status stream.
    pub report: Arc<ReportState>,
    live: watch::Sender<Arc<LiveSettings>>,
    programs: watch::Sender<Arc<Programs>>,
    /// Counts changes of health.
    changed: watch::Sender<u64>,
    values: Mutex<Values>,
    history: Mutex<History>,
    admin: OnceLock<SocketAddr>,
}

impl Shared {
    /// Before anything was measured.
    #[must_use]
    pub fn new(
        me: FlowId,
        live: LiveSettings,
        health: Health,
        latency: Latency,
        pings: Pings,
    ) -> Self {
        Self {
            me,
            epoch: unix_ms(SystemTime::now()),
            readiness: Readiness::new(),
            health: Mutex::new(health),
            latency: Arc::new(Mutex::new(latency)),
            pings: Arc::new(pings),
            signs: Arc::default(),
            report: Arc::default(),
            live: watch::Sender::new(Arc::new(live)),
            programs: watch::Sender::new(Arc::default()),
            changed: watch::Sender::new(0),
            values: Mutex::default(),
            history: Mutex::default(),
            admin: OnceLock::new(),
        }
    }

    /// Where the monitor is asked, once the port is bound.
    pub fn set_admin(&self, address: SocketAddr) {
        // It is set once, at the start.
        let _ = self.admin.set(address);
    }

    /// What changes while it runs.
    #[must_use]
    pub fn live(&self) -> Arc<LiveSettings> {
        Arc::clone(&self.live.borrow())
    }

    /// Marked at each change of it.
    #[must_use]
    pub fn live_changes(&self) -> watch::Receiver<Arc<LiveSettings>> {
        self.live.subscribe()
    }

    /// Replaces it.
    pub fn set_live(&self, live: LiveSettings) {
        self.live.send_replace(Arc::new(live));
    }

    /// What the flows and the worker said last.
    #[must_use]
    pub fn programs(&self) -> Arc<Programs> {
        Arc::clone(&self.programs.borrow())
    }

    /// Marked at each look at them.
    #[must_use]
    pub fn looks(&self) -> watch::Receiver<Arc<Programs>> {
        self.programs.subscribe()
    }

    /// Replaces it. Another state of a flow or a link is reported at once, as that of health is.
    pub fn set_programs(&self, programs: Programs) {
        let states = programs.states();
        let before = self.programs.send_replace(Arc::new(programs));
        if before.states() != states {
            self.changed.send_modify(|count| *count += 1);
        }
    }

    /// Marked at each change of health.
    #[must_use]
    pub fn health_changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Takes a sample of the node, and the time that it took.
    pub fn set_sample(&self, sample: Sample, took: Duration) {
        let mut values = self.values.lock();
        values.before = std::mem::replace(&mut values.now, sample);
        values.took = took;
    }

    /// The few values of the node that health judges.
    #[must_use]
    pub fn vitals(&self) -> node::Vitals {
        let values = self.values.lock();
        values.now.vitals(Some(&values.before))
    }

    /// Judges health anew, and logs what changed.
    pub fn judge(&self, inputs: &Inputs) {
        let changes = self.health.lock().update(moment(), inputs);
        if changes.is_empty() {
            return;
        }
        changes.iter().for_each(log);
        self.changed.send_modify(|count| *count += 1);
    }

    /// Topics that flows here know, where a rule subscribes to topics by a pattern.
    #[must_use]
    pub fn known_topics(&self) -> BTreeSet<TopicName> {
        if !self.live().subscribes() {
            return BTreeSet::new();
        }
        let programs = self.programs();
        let rows =
            programs.flows.iter().flat_map(|flow| flow.topics.iter().chain(&flow.unrequested));
        let topics = rows.filter_map(|row| row["topic"].as_str()?.parse::<TopicName>().ok());
        topics.filter(|topic| !topic.is_for_monitors_alone()).collect()
    }

    /// An answer with what each answer has.
    #[must_use]
    pub fn answer(&self, body: impl Serialize) -> Value {
        let mut whole = Map::new();
        whole.insert("layer".into(), json!(self.me.layer));
        whole.insert("node".into(), json!(self.me.node));
        whole.insert("epoch".into(), json!(self.epoch));
        whole.insert("time".into(), json!(rfc3339_millis(unix_ms(SystemTime::now()))));
        if let Ok(Value::Object(members)) = serde_json::to_value(body) {
            whole.extend(members);
        }
        Value::Object(whole)
    }

    /// `/v1/node`.
    #[must_use]
    pub fn node(&self) -> Value {
        let status = {
            let values = self.values.lock();
            values.now.status(Some(&values.before))
        };
        self.answer(status)
    }

    /// `/v1/ping`.
    #[must_use]
    pub fn ping(&self) -> Value {
        self.answer(self.pings.read(ping::Engine::view))
    }

    /// `/v1/latency`.
    #[must_use]
    pub fn latency(&self) -> Value {
        let body = self.latency.lock().body();
        self.answer(body)
    }

    /// `/v1/health`.
    #[must_use]
    pub fn health(&self) -> Value {
        let body = self.health.lock().body();
        self.answer(body)
    }

    /// `/v1/series`.
    #[must_use]
    pub fn series(&self, names: &str) -> Value {
        let body = self.history.lock().body(names);
        self.answer(body)
    }

    /// Adds the values of now to the last hour.
    pub fn keep_history(&self, at: SystemTime) {
        let sample = self.values.lock().now.clone();
        let of_node = sample.series().map(|(metric, labels, value)| {
            (series_name(metric, labels.iter().map(node::Label::as_str)), value)
        });
        let of_pings = self.pings.read(|engine, now| {
            engine
                .metrics(now)
                .filter_map(|reading| match reading.value {
                    ping::Value::Number(value) => {
                        let labels = reading.labels.iter().map(|(_, value)| value.as_str());
                        Some((series_name(reading.metric, labels), value))
                    }
                    ping::Value::Histogram(_) => None,
                })
                .collect::<Vec<_>>()
        });
        self.history.lock().take(at, of_node.chain(of_pings));
    }

    /// When token and certificates end. The files are small, and read at each scrape: they may have
    /// been replaced.
    fn ends(&self) -> Ends {
        self.live().main.as_ref().map(expiry::ends).unwrap_or_default()
    }

    /// The monitor's own page of metrics.
    #[must_use]
    pub fn page(&self) -> String {
        let mut page = Page::default();
        let (sample, took) = {
            let values = self.values.lock();
            (values.now.clone(), values.took)
        };
        for (metric, labels, value) in sample.series() {
            page.add(metric, labels.iter().map(node::Label::as_str), Number::Number(value));
        }
        self.pings.read(|engine, now| {
            for reading in engine.metrics(now) {
                let labels = reading.labels.iter().map(|(_, value)| value.as_str());
                let value = match &reading.value {
                    ping::Value::Number(value) => Number::Number(*value),
                    ping::Value::Histogram(histogram) => Number::Histogram(histogram),
                };
                page.add(reading.metric, labels, value);
            }
        });
        page.extend(self.health.lock().metrics());
        page.extend(self.latency.lock().metrics());
        let connected = f64::from(u8::from(self.report.is_connected()));
        for (metric, value) in [
            (&SAMPLE_SECONDS, took.as_secs_f64()),
            (&REPORT_CONNECTED, connected),
            (&REPORT_TOO_LARGE, self.report.too_large() as f64),
            (&HISTORY_REFUSED, self.history.lock().refused() as f64),
        ] {
            page.add(metric, [], Number::Number(value));
        }
        let ends = self.ends();
        if let Some(end) = ends.token {
            page.add(&expiry::TOKEN_ENDS, [], Number::Number(end as f64));
        }
        for (file, end) in &ends.certificates {
            let file = file.to_string_lossy();
            page.add(&expiry::CERTIFICATE_ENDS, [&*file], Number::Number(*end as f64));
        }
        let build = [env!("CARGO_PKG_VERSION"), "blaze-monitor"];
        page.add(&BUILD_INFO, build, Number::Number(1.0));
        page.text()
    }
}

impl Site for Shared {
    fn summary(&self) -> String {
        let vitals = self.vitals();
        let programs = self.programs();
        let flows: Vec<&Value> =
            programs.flows.iter().filter_map(|flow| flow.summary.as_ref()).collect();
        json!({
            "health": self.answer(self.health.lock().body().bounded(MAX_PROBLEMS)),
            "node": {
                "cpu_ratio": vitals.cpu_ratio,
                "memory_ratio": vitals.memory_ratio.map(|available| 1.0 - available),
                "celsius": vitals.celsius_max.map(|(_, celsius)| celsius),
            },
            "flows": flows,
        })
        .to_string()
    }

    fn targets(&self) -> Targets {
        let programs = self.programs();
        let flows = programs
            .flows
            .iter()
            .filter_map(|flow| Some((flow.name.clone()?, flow.address.clone())))
            .collect();
        let admin = self.admin.get().map(ToString::to_string);
        Targets { monitor: admin.unwrap_or_default(), worker: self.live().worker.clone(), flows }
    }
}

/// Tables of all metrics that a monitor exports, for the documentation.
#[must_use]
pub fn all_metrics() -> Vec<&'static crate::metric::Metric> {
    let tables =
        [node::METRICS, ping::METRICS, latency::METRICS, health::METRICS, expiry::METRICS, METRICS];
    tables.into_iter().flatten().copied().collect()
}

fn log(change: &Change) {
    match change {
        Change::Raised(problem) => tracing::warn!(
            code = problem.code,
            name = problem.name,
            detail = problem.detail,
            remedy = problem.remedy,
            "problem",
        ),
        Change::Cleared(problem) => {
            tracing::info!(code = problem.code, name = problem.name, "problem is over");
        }
        Change::State { scope, name, from, to } => tracing::info!(
            scope = scope.as_str(),
            name,
            from = from.as_str(),
            to = to.as_str(),
            "health",
        ),
    }
}

/// Now by both clocks.
#[must_use]
pub fn moment() -> Moment {
    Moment { at: Instant::now(), unix_ms: unix_ms(SystemTime::now()) }
}

fn unix_ms(at: SystemTime) -> u64 {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}
