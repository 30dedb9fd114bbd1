//! What every request and every answer has: an id, a time limit, a line in the log, a count, and
//! some headers.

use std::net::IpAddr;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::Request;
use axum::http::header::{
    ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, HeaderName, REFERRER_POLICY, WWW_AUTHENTICATE,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, Method};
use axum::response::Response;
use blaze_domain::config::{Applied, Code, Problem};
use futures::FutureExt;

use super::headers::{TRACEPARENT, X_REQUEST_ID};
use super::reply::Refused;
use super::{DEADLINE, Rest, gate, reply};
use crate::api::request;

/// Label of what no operation was found for.
const NO_OPERATION: &str = "none";

/// One request as the layers below know it.
#[derive(Debug, Clone)]
pub(super) struct Visit {
    pub(super) request_id: Arc<str>,
    pub(super) address: IpAddr,
    /// The path as it came; nothing is decoded or made shorter.
    pub(super) path: Arc<str>,
    /// When the answer must begin.
    pub(super) deadline: tokio::time::Instant,
}

/// What the log says of a request besides; set on the response where it becomes known.
#[derive(Debug, Clone, Default)]
pub(super) struct Served {
    pub(super) operation: Option<&'static str>,
    pub(super) subject: Option<String>,
}

/// Sets what becomes known of a request.
pub(super) fn note(response: &mut Response, change: impl FnOnce(&mut Served)) {
    let mut served = response.extensions_mut().remove::<Served>().unwrap_or_default();
    change(&mut served);
    response.extensions_mut().insert(served);
}

/// Answers a request, whatever happens to it.
pub(super) async fn serve(
    rest: &Rest,
    api: Router,
    pages: Router,
    mut incoming: Request,
) -> Response {
    let started = Instant::now();
    let visit = Visit {
        request_id: request::request_id(incoming.headers()).into(),
        address: request::client_address(incoming.extensions()),
        path: incoming.uri().path().into(),
        deadline: tokio::time::Instant::now() + DEADLINE,
    };
    let method = incoming.method().clone();
    let trace = request::traceparent(incoming.headers()).cloned();
    incoming.extensions_mut().insert(visit.clone());
    let answer = AssertUnwindSafe(gate::pass(rest, api, pages, &visit, incoming)).catch_unwind();
    let mut response = match answer.await {
        Ok(response) => response,
        Err(_) => reply::problem(&panicked(&method), &visit.path, &visit.request_id),
    };
    finish(&mut response, &visit, trace);
    record(rest, &response, &visit, &method, started);
    response
}

/// The message of the panic is in the log already, by the hook; nothing of it leaves the process.
fn panicked(method: &Method) -> Problem {
    let problem =
        Problem::new(Code::Internal, "the service failed at this request; the log says more")
            .because("a handler panicked");
    if method.is_safe() { problem } else { problem.applied(Applied::Unknown) }
}

/// Headers of every answer; what a handler has set stays.
fn finish(response: &mut Response, visit: &Visit, trace: Option<HeaderValue>) {
    reply::set(response, X_REQUEST_ID, &visit.request_id);
    let headers = response.headers_mut();
    if let Some(trace) = trace {
        headers.insert(TRACEPARENT, trace);
    }
    let mut default = |name: HeaderName, value: &'static str| {
        headers.entry(name).or_insert(HeaderValue::from_static(value));
    };
    default(CACHE_CONTROL, "no-store");
    default(X_CONTENT_TYPE_OPTIONS, "nosniff");
    default(REFERRER_POLICY, "no-referrer");
    default(CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'");
}

/// One line and one count for each request. Nothing of query, headers or body: they may hold
/// secrets.
fn record(rest: &Rest, response: &Response, visit: &Visit, method: &Method, started: Instant) {
    let took = started.elapsed();
    let served = response.extensions().get::<Served>();
    let refused = response.extensions().get::<Refused>();
    let operation = served.and_then(|served| served.operation).unwrap_or(NO_OPERATION);
    let subject = served.and_then(|served| served.subject.as_deref()).unwrap_or_default();
    let code = refused.map_or("ok", |refused| refused.code.as_str());
    rest.options.metrics.observe("rest", operation, code, took);
    let status = response.status();
    let internal = refused.and_then(|refused| refused.internal.as_deref()).unwrap_or_default();
    let (request_id, duration_ms) = (&*visit.request_id, millis(took));
    let trace = response
        .headers()
        .get(TRACEPARENT)
        .and_then(|trace| trace.to_str().ok())
        .unwrap_or_default();
    let (peer, path) = (visit.address, &*visit.path);
    if status.is_server_error() {
        tracing::warn!(
            target: "blaze_config::access",
            request_id, subject, operation, %method, path, status = status.as_u16(), code,
            duration_ms, %peer, trace, internal,
            "request failed"
        );
    } else {
        tracing::info!(
            target: "blaze_config::access",
            request_id, subject, operation, %method, path, status = status.as_u16(), code,
            duration_ms, %peer, trace, internal,
            "request"
        );
    }
}

/// Milliseconds with three decimals.
fn millis(took: Duration) -> f64 {
    took.as_micros() as f64 / 1000.0
}

/// `WWW-Authenticate` of a 401: with an error only if a token was sent.
pub(super) fn challenge(response: &mut Response, sent: bool) {
    let value = if sent { "Bearer error=\"invalid_token\"" } else { "Bearer" };
    reply::set(response, WWW_AUTHENTICATE, value);
}

/// `Allow` of a 405.
pub(super) fn allow(response: &mut Response, methods: &str) {
    reply::set(response, ALLOW, methods);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_in_the_log_has_three_decimals() {
        assert_eq!(millis(Duration::from_nanos(92_132)).to_string(), "0.092");
        assert_eq!(millis(Duration::from_micros(12_345_678)).to_string(), "12345.678");
    }
}
