//! What the admin port answers.

use std::sync::Arc;

use axum::extract::{DefaultBodyLimit, Request};
use axum::http::{HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde_json::json;

use super::readiness::{Readiness, ReadinessStatus};
use super::{AllMetrics, Counters, MetricsText};

/// All routes: the three of every program, its own, and what answers the rest.
pub(super) fn router(
    extra: Router,
    readiness: Readiness,
    metrics: MetricsText,
    counters: Arc<Counters>,
    body_bytes: usize,
) -> Router {
    let metrics = move || {
        let text = metrics() + &counters.text();
        async move {
            ([(header::CONTENT_TYPE, HeaderValue::from_static("text/plain; version=0.0.4"))], text)
        }
    };
    extra
        .route("/livez", get(|| async { Json(json!({ "status": "alive" })) }))
        .route("/readyz", get(move || std::future::ready(readyz(&readiness))))
        .route("/metrics", get(metrics))
        .fallback(|uri: Uri| async move {
            error(StatusCode::NOT_FOUND, "not_found", &format!("no {}", uri.path()))
        })
        .method_not_allowed_fallback(|method: Method, uri: Uri| async move {
            let detail = format!("{method} is not for {}", uri.path());
            error(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", &detail)
        })
        .layer(DefaultBodyLimit::max(body_bytes))
}

/// The routes, with another page of metrics for `/metrics?all=1`.
pub(super) fn with_all_metrics(router: Router, all: AllMetrics) -> Router {
    router.layer(middleware::from_fn(move |request: Request, next: Next| {
        let asks_for_all = request.uri().path() == "/metrics"
            && request.uri().query().is_some_and(|query| query.split('&').any(|one| one == "all=1"));
        let all = Arc::clone(&all);
        async move {
            let response = next.run(request).await;
            if !asks_for_all {
                return response;
            }
            let (mut head, body) = response.into_parts();
            head.headers.remove(header::CONTENT_LENGTH);
            let own = axum::body::to_bytes(body, usize::MAX).await.unwrap_or_default();
            let page = all(String::from_utf8_lossy(&own).into_owned()).await;
            Response::from_parts(head, page.into())
        }
    }))
}

fn readyz(readiness: &Readiness) -> Response {
    let report = readiness.report();
    let status = match report.status {
        ReadinessStatus::Ready => StatusCode::OK,
        ReadinessStatus::NotReady => StatusCode::SERVICE_UNAVAILABLE,
    };
    (status, Json(report)).into_response()
}

/// An answer with `{"error":{"code","detail"}}`.
fn error(status: StatusCode, code: &str, detail: &str) -> Response {
    (status, Json(json!({ "error": { "code": code, "detail": detail } }))).into_response()
}
