//! What the admin port of the monitor answers.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Json, Router};
use blaze_runtime::http::{GetLimits, get as http_get};
use blaze_runtime::{AdminServer, Supervisor};
use futures::StreamExt as _;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::limits::{ALL_PAGES, ANSWER, MAX_ALL_PAGES_BYTES, MAX_PAGE_BYTES, MAX_PAGES};
use crate::page::Merged;
use crate::ping::OrderError;
use crate::shared::Shared;

/// Pages that are asked for at a time.
const AT_ONCE: usize = 8;

type App = State<Arc<Shared>>;

/// Serves the admin port.
///
/// # Errors
/// When it cannot be bound.
pub async fn serve(
    shared: &Arc<Shared>,
    address: SocketAddr,
    supervisor: &Supervisor,
) -> std::io::Result<SocketAddr> {
    let router = Router::new()
        .route("/v1/node", get(|State(shared): App| async move { Json(shared.node()) }))
        .route("/v1/ping", get(|State(shared): App| async move { Json(shared.ping()) }).post(ping))
        .route("/v1/latency", get(|State(shared): App| async move { Json(shared.latency()) }))
        .route("/v1/health", get(|State(shared): App| async move { Json(shared.health()) }))
        .route("/v1/series", get(series))
        .with_state(Arc::clone(shared));
    let page = Arc::clone(shared);
    let metrics = Arc::new(move || page.page());
    let server = AdminServer::bind(address, router, shared.readiness.clone(), metrics).await?;
    let all = Arc::clone(shared);
    let server = server.all_metrics(Arc::new(move |own| {
        let shared = Arc::clone(&all);
        Box::pin(async move { all_pages(&shared, &own).await })
    }));
    let address = server.address();
    server.serve(supervisor);
    Ok(address)
}

async fn series(State(shared): App, Query(query): Query<BTreeMap<String, String>>) -> Json<Value> {
    Json(shared.series(query.get("names").map_or("", String::as_str)))
}

/// Body of `POST /v1/ping`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    to: String,
    #[serde(default = "four")]
    count: u32,
    #[serde(default = "fifth_of_a_second")]
    interval_ms: u64,
}

fn four() -> u32 {
    4
}

fn fifth_of_a_second() -> u64 {
    200
}

async fn ping(State(shared): App, body: Bytes) -> Response {
    let order: Order = match serde_json::from_slice(&body) {
        Ok(order) => order,
        Err(error) => {
            return refusal(StatusCode::BAD_REQUEST, "invalid_request", &error.to_string());
        }
    };
    let Ok(to) = order.to.parse() else {
        let detail = format!("to: {:?} is no LAYER/NODE, such as fog/fog-1", order.to);
        return refusal(StatusCode::BAD_REQUEST, "invalid_request", &detail);
    };
    let interval = Duration::from_millis(order.interval_ms);
    if !shared.pings.are_sent() {
        let detail = "this monitor is on no broker, so it sends no pings: give brokers.node or \
                      brokers.layer in the node file";
        return refusal(StatusCode::SERVICE_UNAVAILABLE, "no_broker", detail);
    }
    match shared.pings.order(to, order.count, interval).await {
        Ok(samples) => Json(shared.answer(json!({"samples": samples}))).into_response(),
        Err(error) => {
            let (status, code) = match &error {
                OrderError::Busy => (StatusCode::CONFLICT, "busy"),
                OrderError::Unknown(_) => (StatusCode::NOT_FOUND, "not_found"),
                OrderError::Invalid => (StatusCode::BAD_REQUEST, "invalid_request"),
            };
            refusal(status, code, &error.to_string())
        }
    }
}

fn refusal(status: StatusCode, code: &str, detail: &str) -> Response {
    (status, Json(json!({"error": {"code": code, "detail": detail}}))).into_response()
}

/// The pages of all programs of this node, and of services that name one, as one page.
async fn all_pages(shared: &Shared, own: &str) -> String {
    let asked = asked(shared);
    let pages: Vec<_> = futures::stream::iter(asked)
        .map(page_of)
        .buffer_unordered(AT_ONCE)
        .filter_map(|page| async { page })
        .take_until(tokio::time::sleep(ALL_PAGES))
        .scan(0, |bytes, page| {
            *bytes += page.0.len();
            std::future::ready((*bytes <= MAX_ALL_PAGES_BYTES).then_some(page))
        })
        .collect()
        .await;
    let mut merged = Merged::default();
    merged.add(own, &[("program", "blaze-monitor")]);
    for (body, labels) in &pages {
        let labels: Vec<(&str, &str)> =
            labels.iter().map(|(name, value)| (name.as_str(), value.as_str())).collect();
        merged.add(&String::from_utf8_lossy(body), &labels);
    }
    if merged.refused() > 0 {
        tracing::debug!(samples = merged.refused(), "left out of the page of all metrics");
    }
    merged.text()
}

async fn page_of((address, labels): (String, Labels)) -> Option<(Bytes, Labels)> {
    let limits = GetLimits { bytes: MAX_PAGE_BYTES, ..ANSWER };
    let refused = match http_get(&address, "/metrics", limits).await {
        Ok((200, body)) => return Some((body, labels)),
        Ok((status, _)) => format!("status {status}"),
        Err(error) => error.to_string(),
    };
    tracing::debug!(address, refused, "no page of metrics");
    None
}

type Labels = Vec<(String, String)>;

/// Addresses of the pages, with the labels of their series.
fn asked(shared: &Shared) -> Vec<(String, Labels)> {
    let programs = shared.programs();
    let label = |name: &str, value: &str| (name.to_owned(), value.to_owned());
    let are_several = programs.flows.len() > 1;
    let flows = programs.flows.iter().filter(|flow| flow.summary.is_some()).map(|flow| {
        let name = flow.name.as_ref().filter(|_| are_several);
        let labels = name.map(|name| label("flow", &name.to_string())).into_iter();
        (flow.address.clone(), [label("program", "blaze-flow")].into_iter().chain(labels).collect())
    });
    let worker = programs
        .worker
        .is_reachable
        .then(|| (shared.live().worker.clone(), vec![label("program", "blaze-worker")]));
    let signs = shared.signs.now(Instant::now()).unwrap_or_default();
    let services = signs.into_iter().filter_map(|sign| {
        // Elsewhere it would be somebody else's port: who may write a sign of life decides where
        // this program connects to.
        let address: SocketAddr = sign.metrics.parse().ok()?;
        let labels = vec![label("service", &sign.service), label("instance", &sign.instance)];
        address.ip().is_loopback().then(|| (address.to_string(), labels))
    });
    flows.chain(worker).chain(services).take(MAX_PAGES).collect()
}
