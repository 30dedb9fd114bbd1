//! What the admin port shows of a worker.

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Json, Router};
use blaze_domain::Scope;
use blaze_runtime::{AdminServer, CheckStatus, Gate, Readiness, Supervisor, TaskPolicy};
use parking_lot::Mutex;
use serde_json::json;
use tokio::sync::watch;

use crate::engine::Status;
use crate::running::RunningWorker;

/// Between two looks at the worker, for readiness and metrics.
const LOOK: Duration = Duration::from_millis(250);
const NOTHING: &str = "nothing is loaded yet";
/// The same until services reach it.
const FIRST_LOOK: Duration = Duration::from_millis(50);
/// Where configurations can come from.
const SOURCES: [&str; 3] = ["main", "copy", "file"];

/// The worker once it runs, and how it was at the last look.
#[derive(Clone, Default)]
pub struct Shown {
    inner: Arc<Mutex<Inner>>,
    begun: Arc<watch::Sender<bool>>,
}

#[derive(Default)]
struct Inner {
    worker: Option<Arc<RunningWorker>>,
    status: Option<Status>,
}

impl Shown {
    /// Serves the admin port of a worker that is [started](Self::set) afterwards, so that it can be asked from the beginning. `scope`
    /// is that of its broker.
    ///
    /// # Errors
    /// When the port cannot be bound.
    pub async fn serve(
        &self,
        address: SocketAddr,
        scope: Scope,
        readiness: Readiness,
        supervisor: &Supervisor,
    ) -> std::io::Result<SocketAddr> {
        let broker = match scope {
            Scope::Node => "node_broker",
            Scope::Layer | Scope::Inter => "layer_broker",
        };
        // Before anybody can ask: without them it would be ready.
        let (decides, shows) = (Gate::Decides, Gate::Shows);
        readiness.add(broker, decides, CheckStatus::Failed, "not connected yet");
        readiness.add("configuration", decides, CheckStatus::Failed, NOTHING);
        readiness.add("main service", shows, CheckStatus::Failed, "not connected yet");
        readiness.add("mounted file", shows, CheckStatus::Ok, "");
        readiness.add("config", shows, CheckStatus::Ok, "");
        let numbers = self.clone();
        let metrics = Arc::new(move || numbers.metrics());
        let admin = AdminServer::bind(address, self.router(), readiness.clone(), metrics).await?;
        let address = admin.address();
        admin.serve(supervisor);
        let (look, stop) = (self.clone().look(broker, readiness), supervisor.stopping_token());
        supervisor.spawn("look", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = look => {}
                () = stop.cancelled() => {}
            }
        });
        Ok(address)
    }

    /// The worker runs.
    pub fn set(&self, worker: Arc<RunningWorker>) {
        self.inner.lock().worker = Some(worker);
    }

    fn worker(&self) -> Option<Arc<RunningWorker>> {
        self.inner.lock().worker.clone()
    }

    /// The routes below `/v1`.
    fn router(&self) -> Router {
        Router::new().route("/v1/status", get(status)).with_state(self.clone())
    }

    /// Looks at the worker again and again, for readiness and metrics.
    async fn look(self, broker: &'static str, readiness: Readiness) {
        let mut looked = None;
        loop {
            let Some(worker) = self.worker() else {
                tokio::time::sleep(FIRST_LOOK).await;
                continue;
            };
            let (is_reached, words) = worker.reach();
            let state = if is_reached {
                CheckStatus::Ok
            } else {
                CheckStatus::Failed
            };
            readiness.set(broker, state, words);
            // The answer has all services in it: not 20 times a second for nothing.
            let is_due = is_reached || looked.is_none_or(|at: Instant| at.elapsed() >= LOOK);
            if is_due && let Some(status) = worker.status().await {
                looked = Some(Instant::now());
                tell(&readiness, &status);
                // Others are not waited for: what is not there now is got later.
                let knows = status.is_ready || status.reason.is_some() || !worker.has_main();
                if is_reached && knows {
                    self.begun.send_replace(true);
                }
                self.inner.lock().status = Some(status);
            }
            let pause = if *self.begun.borrow() { LOOK } else { FIRST_LOOK };
            tokio::time::sleep(pause).await;
        }
    }

    /// Waits until services reach it for the first time, and it serves what there is: the configuration, unless there is none here and the
    /// main service cannot be reached either.
    pub async fn begun(&self) {
        // The sender lives as long as this.
        let _ = self.begun.subscribe().wait_for(|begun| *begun).await;
    }

    /// The numbers, as text.
    #[must_use]
    pub fn metrics(&self) -> String {
        let (worker, status) = {
            let inner = self.inner.lock();
            (inner.worker.clone(), inner.status.clone())
        };
        let mut out = String::new();
        if let (Some(worker), Some(status)) = (worker, status) {
            write(&mut out, &worker, &status);
        }
        out
    }
}

fn tell(readiness: &Readiness, status: &Status) {
    let revision = format!("revision {}", status.revision);
    match status.is_ready {
        true => readiness.set("configuration", CheckStatus::Ok, revision.clone()),
        false => readiness.set("configuration", CheckStatus::Failed, NOTHING),
    }
    match (status.in_sync, &status.reason) {
        (true, _) => readiness.set("main service", CheckStatus::Ok, revision),
        (false, Some(reason)) => readiness.set("main service", CheckStatus::Failed, reason.clone()),
        (false, None) => readiness.set("main service", CheckStatus::Failed, "not in sync yet"),
    }
    match &status.defaults_problem {
        Some(problem) => readiness.set("mounted file", CheckStatus::Failed, problem.clone()),
        None => readiness.set("mounted file", CheckStatus::Ok, ""),
    }
}

/// In the text format of Prometheus.
fn write(out: &mut String, worker: &RunningWorker, status: &Status) {
    let mut one = |name: &str, kind: &str, help: &str, lines: &[(String, f64)]| {
        // Writing to a text cannot fail.
        let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} {kind}");
        for (labels, value) in lines {
            let _ = writeln!(out, "{name}{labels} {value}");
        }
    };
    let plain = |value: f64| vec![(String::new(), value)];
    let (json, speaker) = (&status.json, worker.speaker());
    let connected = json["connected"].as_bool().unwrap_or_default();
    one(
        "blaze_worker_connected",
        "gauge",
        "1 while there is a stream from the main service.",
        &plain(f64::from(u8::from(connected))),
    );
    let leader = json["leader"].as_bool().unwrap_or_default();
    one(
        "blaze_worker_leader",
        "gauge",
        "1 while this worker answers and notifies for its layer or node.",
        &plain(f64::from(u8::from(leader))),
    );
    one(
        "blaze_worker_revision",
        "gauge",
        "Revision of what services get.",
        &plain(status.revision as f64),
    );
    let age = json["age_s"].as_f64().unwrap_or(f64::NAN);
    one(
        "blaze_worker_age_seconds",
        "gauge",
        "Since the worker last knew itself in sync with the main service.",
        &plain(age),
    );
    let source = json["source"].as_str();
    let sources = SOURCES.map(|word| {
        let is_it = f64::from(u8::from(source == Some(word)));
        (format!("{{source=\"{word}\"}}"), is_it)
    });
    one(
        "blaze_worker_source",
        "gauge",
        "1 for where configurations come from.",
        &sources,
    );
    one(
        "blaze_worker_notices_total",
        "counter",
        "Notices that the broker has taken.",
        &plain(speaker.notices as f64),
    );
    one(
        "blaze_worker_notices_replaced_total",
        "counter",
        "Notices that gave way to newer ones of the same place before the broker took them.",
        &plain(speaker.replaced as f64),
    );
    one(
        "blaze_worker_notices_waiting",
        "gauge",
        "Places with a notice that the broker has not taken yet.",
        &plain(speaker.waiting as f64),
    );
    let counts = status.counts;
    let requests = [
        ("answered", counts.answered),
        ("refused", counts.refused),
        ("left_to_others", counts.left_to_others),
    ]
    .map(|(result, count)| (format!("{{result=\"{result}\"}}"), count as f64));
    one(
        "blaze_worker_requests_total",
        "counter",
        "Requests for configurations by result.",
        &requests,
    );
    let signs = [
        ("understood", counts.signs),
        ("misunderstood", counts.misunderstood),
        ("left_out", counts.left_out),
    ]
    .map(|(result, count)| (format!("{{result=\"{result}\"}}"), count as f64));
    one(
        "blaze_worker_signs_total",
        "counter",
        "Acknowledgements and signs of life of services by result.",
        &signs,
    );
    one(
        "blaze_worker_rollouts_failed_total",
        "counter",
        "Roll-outs that failed here and were undone.",
        &plain(counts.failed_rollouts as f64),
    );
    one(
        "blaze_worker_canaries_unwatched",
        "gauge",
        "Canaries that are not judged, because there are too many.",
        &plain(status.unwatched as f64),
    );
    one(
        "blaze_worker_sync_faults_total",
        "counter",
        "Streams that were begun anew because something was missing or different.",
        &plain(counts.faults as f64),
    );
    let copies = worker.copies();
    let of = |count: fn(&crate::copy::Counts) -> u64| -> Vec<(String, f64)> {
        let label = |place: &str| format!("{{copy=\"{}\"}}", place.replace(['"', '\\', '\n'], "_"));
        copies
            .iter()
            .map(|copy| (label(&copy.place), count(copy) as f64))
            .collect()
    };
    one(
        "blaze_worker_copy_writes_total",
        "counter",
        "Writes of a copy that were done.",
        &of(|copy| copy.written),
    );
    one(
        "blaze_worker_copy_failures_total",
        "counter",
        "Writes of a copy that failed.",
        &of(|copy| copy.failed),
    );
    one(
        "blaze_worker_copy_current",
        "gauge",
        "1 while a copy holds all that it should.",
        &of(|copy| u64::from(copy.is_current)),
    );
}

async fn status(State(shown): State<Shown>) -> Response {
    let status = match shown.worker() {
        Some(worker) => worker.status().await,
        None => None,
    };
    match status {
        Some(status) => Json(status.json).into_response(),
        None => {
            let body = json!({ "error": { "code": "not_ready", "detail": "the worker is starting or ending" } });
            (StatusCode::SERVICE_UNAVAILABLE, Json(body)).into_response()
        }
    }
}
