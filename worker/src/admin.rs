//! What the admin port shows of a worker.

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

use crate::copy::Counts as CopyCounts;
use crate::engine::{Counts, Status};
use crate::running::RunningWorker;
use crate::serve::SpeakerCounts;

/// Between two looks at the worker, for readiness and metrics. Each reckons with all services.
const LOOK: Duration = Duration::from_secs(1);
/// Between two looks whether services reach it.
const REACH: Duration = Duration::from_millis(250);
const NOTHING: &str = "nothing is loaded yet";
/// The same until services reach it.
const FIRST_LOOK: Duration = Duration::from_millis(50);

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
    /// Serves the admin port of a worker that is [started](Self::set) afterwards, so that it can be
    /// asked from the beginning. `scope` is that of its broker.
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
            Scope::Layer | Scope::Ros2 | Scope::Inter => "layer_broker",
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
            let state = if is_reached { CheckStatus::Ok } else { CheckStatus::Failed };
            readiness.set(broker, state, words);
            // The answer has all services in it: not 20 times a second for nothing.
            let rest = if is_reached && !*self.begun.borrow() { FIRST_LOOK } else { LOOK };
            let is_due = looked.is_none_or(|at: Instant| at.elapsed() >= rest);
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
            let rest = if *self.begun.borrow() { REACH } else { FIRST_LOOK };
            blaze_runtime::pause(rest).await;
        }
    }

    /// Waits until services reach it for the first time, and it serves what there is: the
    /// configuration, unless there is none here and the main service cannot be reached either.
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
        worker.zip(status).map_or_else(String::new, |(worker, status)| text_of(&worker, &status))
    }
}

fn tell(readiness: &Readiness, status: &Status) {
    let revision = format!("revision {}", status.revision);
    let with_others = match &status.beside[..] {
        [] => revision.clone(),
        others => format!("{revision}; other workers of this node run: {}", others.join(", ")),
    };
    match status.is_ready {
        true => readiness.set("configuration", CheckStatus::Ok, revision.clone()),
        false => readiness.set("configuration", CheckStatus::Failed, NOTHING),
    }
    match (status.in_sync, &status.reason) {
        (true, _) => readiness.set("main service", CheckStatus::Ok, with_others),
        (false, Some(reason)) => readiness.set("main service", CheckStatus::Failed, reason.clone()),
        (false, None) => readiness.set("main service", CheckStatus::Failed, "not in sync yet"),
    }
    match &status.defaults_problem {
        Some(problem) => readiness.set("mounted file", CheckStatus::Failed, problem.clone()),
        None => readiness.set("mounted file", CheckStatus::Ok, ""),
    }
}

/// In the text format of Prometheus.
fn text_of(worker: &RunningWorker, status: &Status) -> String {
    let json = &status.json;
    let is = |name: &str| u8::from(json[name].as_bool().unwrap_or_default());
    let (connected, leader) = (is("connected"), is("leader"));
    let [main, copy, file] = ["main", "copy", "file"].map(|word| u8::from(json["source"] == word));
    let (revision, unwatched) = (status.revision, status.unwatched);
    let version = env!("CARGO_PKG_VERSION");
    let age = json["age_s"].as_f64().unwrap_or(f64::NAN);
    let SpeakerCounts { notices, replaced, waiting, .. } = worker.speaker();
    let Counts {
        answered,
        refused,
        left_to_others,
        faults,
        signs,
        misunderstood,
        left_out,
        failed_rollouts,
        forgotten_asked,
        forgotten_ended,
    } = status.counts;
    let copies = worker.copies();
    let of = |name: &str, count: fn(&CopyCounts) -> u64| -> String {
        let place = |copy: &CopyCounts| copy.place.replace(['"', '\\', '\n'], "_");
        let line = |copy| format!("{name}{{copy=\"{}\"}} {}\n", place(copy), count(copy));
        copies.iter().map(line).collect()
    };
    let writes = of("blaze_worker_copy_writes_total", |copy| copy.written);
    let failures = of("blaze_worker_copy_failures_total", |copy| copy.failed);
    let current = of("blaze_worker_copy_current", |copy| u64::from(copy.is_current));
    format!(
        r#"# HELP blaze_build_info 1, with the version as label.
# TYPE blaze_build_info gauge
blaze_build_info{{version="{version}",program="blaze-worker"}} 1
# HELP blaze_worker_connected 1 while there is a stream from the main service.
# TYPE blaze_worker_connected gauge
blaze_worker_connected {connected}
# HELP blaze_worker_leader 1 while this worker answers and notifies for its layer or node.
# TYPE blaze_worker_leader gauge
blaze_worker_leader {leader}
# HELP blaze_worker_revision Revision of what services get.
# TYPE blaze_worker_revision gauge
blaze_worker_revision {revision}
# HELP blaze_worker_age_seconds Since the worker last knew itself in sync with the main service.
# TYPE blaze_worker_age_seconds gauge
blaze_worker_age_seconds {age}
# HELP blaze_worker_source 1 for where configurations come from.
# TYPE blaze_worker_source gauge
blaze_worker_source{{source="main"}} {main}
blaze_worker_source{{source="copy"}} {copy}
blaze_worker_source{{source="file"}} {file}
# HELP blaze_worker_notices_total Notices that the broker has taken.
# TYPE blaze_worker_notices_total counter
blaze_worker_notices_total {notices}
# HELP blaze_worker_notices_replaced_total Notices that gave way to newer ones of the same place before the broker took them.
# TYPE blaze_worker_notices_replaced_total counter
blaze_worker_notices_replaced_total {replaced}
# HELP blaze_worker_notices_waiting Places with a notice that the broker has not taken yet.
# TYPE blaze_worker_notices_waiting gauge
blaze_worker_notices_waiting {waiting}
# HELP blaze_worker_requests_total Requests for configurations by result.
# TYPE blaze_worker_requests_total counter
blaze_worker_requests_total{{result="answered"}} {answered}
blaze_worker_requests_total{{result="refused"}} {refused}
blaze_worker_requests_total{{result="left_to_others"}} {left_to_others}
# HELP blaze_worker_signs_total Acknowledgements and signs of life of services by result.
# TYPE blaze_worker_signs_total counter
blaze_worker_signs_total{{result="understood"}} {signs}
blaze_worker_signs_total{{result="misunderstood"}} {misunderstood}
blaze_worker_signs_total{{result="left_out"}} {left_out}
# HELP blaze_worker_places_forgotten_total Places that were forgotten, because there were too many.
# TYPE blaze_worker_places_forgotten_total counter
blaze_worker_places_forgotten_total{{reason="asked"}} {forgotten_asked}
blaze_worker_places_forgotten_total{{reason="ended"}} {forgotten_ended}
# HELP blaze_worker_rollouts_failed_total Roll-outs that failed here and were undone.
# TYPE blaze_worker_rollouts_failed_total counter
blaze_worker_rollouts_failed_total {failed_rollouts}
# HELP blaze_worker_canaries_unwatched Canaries that are not judged, because there are too many.
# TYPE blaze_worker_canaries_unwatched gauge
blaze_worker_canaries_unwatched {unwatched}
# HELP blaze_worker_sync_faults_total Streams that were begun anew because something was missing or different.
# TYPE blaze_worker_sync_faults_total counter
blaze_worker_sync_faults_total {faults}
# HELP blaze_worker_copy_writes_total Writes of a copy that were done.
# TYPE blaze_worker_copy_writes_total counter
{writes}# HELP blaze_worker_copy_failures_total Writes of a copy that failed.
# TYPE blaze_worker_copy_failures_total counter
{failures}# HELP blaze_worker_copy_current 1 while a copy holds all that it should.
# TYPE blaze_worker_copy_current gauge
{current}"#
    )
}

async fn status(State(shown): State<Shown>) -> Response {
    let status = match shown.worker() {
        Some(worker) => worker.status().await,
        None => None,
    };
    match status {
        Some(status) => Json(status.json).into_response(),
        None => {
            let body = json!({ "error": { "code": "not_ready", "detail": "the worker is starting \
                or ending" } });
            (StatusCode::SERVICE_UNAVAILABLE, Json(body)).into_response()
        }
    }
}
