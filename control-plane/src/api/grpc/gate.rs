//! Before and after every call of `ConfigService`: who asks, whether it may, for how long, and what
//! became of it.
//!
//! ```text
//! head ─▶ --dev ─▶ address ─▶ token ─▶ rate ─▶ method ─▶ right ─▶ time ─▶ message ─▶ in flight ─▶ call
//!           7         8         16       8       12        7       3         3, 8        14         │
//! response ◀─ x-request-id, traceparent, blaze-revision, details for the library's own refusals ◀───┘
//! ```
//!
//! The numbers are the codes of gRPC of the refusals.
//!
//! Everything before the message is decided by the head alone, so nobody without a token makes the
//! service read one. The caller goes to the call as a [`Call`] in the request; a call without one
//! is refused, so that none can be served around this gate.

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use blaze_domain::config::{Applied, Code, Key, Problem};
use tokio::time::Instant;
use tonic::Status;
use tracing::Instrument as _;

use super::methods::{self, Method};
use super::{MAX_MESSAGE_BYTES, MAX_OPEN_BYTES, status};
use crate::api::limits::{ApiLimits, refusal};
use crate::api::request;
use crate::auth::Claims;
use crate::core::{Caller, ConfigService};
use crate::metrics::ApiMetrics;

/// Longest time for a call; the beginning of a watch is a call, its stream is not.
const MAX_TIME: Duration = Duration::from_secs(30);
const REQUEST_ID: &str = "x-request-id";
pub(super) const REVISION: &str = "blaze-revision";
/// Name of an operation that does not exist, for metrics.
const NO_METHOD: &str = "unknown";

/// What it needs to decide.
pub(super) struct Gate {
    pub(super) core: ConfigService,
    pub(super) limits: Arc<ApiLimits>,
    pub(super) metrics: Arc<ApiMetrics>,
    /// `--dev`: no token needed, and only from this machine.
    pub(super) dev: bool,
}

/// Who calls which method, as the gate let it through.
#[derive(Clone)]
pub(super) struct Call {
    pub(super) caller: Caller,
    pub(super) method: &'static Method,
    /// For the audit of a refusal: as the method says, unless the message says more.
    pub(super) action: &'static str,
    /// What it is about, once the message is read.
    pub(super) key: Option<Key>,
    /// Set once the message is read: until then nothing can have taken effect.
    pub(super) begun: Arc<AtomicBool>,
}

/// The head of a request.
struct Head {
    id: String,
    address: IpAddr,
    method: Option<&'static Method>,
}

/// The middleware.
pub(super) async fn gate(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    let started = Instant::now();
    let head = Head {
        id: request::request_id(request.headers()),
        address: request::client_address(request.extensions()),
        method: methods::of_path(request.uri().path()),
    };
    let operation = head.method.map_or(NO_METHOD, |method| method.name);
    let trace = request::traceparent(request.headers()).cloned();
    let traceparent = trace.as_ref().map(tracing::field::debug);
    let span = tracing::info_span!("grpc", operation, request_id = %head.id, traceparent);

    let mut response = gate.answer(&head, request, next).instrument(span.clone()).await;
    let code = explain(&mut response, &head.id, MAX_MESSAGE_BYTES);
    if let Ok(id) = HeaderValue::from_str(&head.id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    if let Some(trace) = trace {
        response.headers_mut().insert("traceparent", trace);
    }
    let time = started.elapsed();
    gate.metrics.observe("grpc", operation, code, time);
    span.in_scope(|| tracing::debug!(code, time_us = time.as_micros() as u64, "answered"));
    response
}

impl Gate {
    async fn answer(&self, head: &Head, request: Request, next: Next) -> Response {
        let claims = match self.identify(head, &request) {
            Ok(claims) => claims,
            Err(problem) => return self.refuse(head, None, &problem, "authenticate"),
        };
        let mut response = match self.admit(head, &claims, request.headers()) {
            Ok((method, time)) => {
                let caller = Caller { claims, request_id: head.id.clone(), address: head.address };
                let limits = &self.limits;
                // The messages of a worker or monitor come as long as its stream is open: they are
                // no upload on its way.
                let request = match [methods::SYNC, methods::REPORT].contains(&method) {
                    true => request,
                    false => request.map(|body| limits.metered(body)),
                };
                serve(Call::new(caller, method), time, request, next).await
            }
            Err(problem) => {
                let action = head.method.map_or(NO_METHOD, |method| method.action);
                self.refuse(head, Some(&claims), &problem, action)
            }
        };
        let headers = response.headers_mut();
        headers.entry(REVISION).or_insert_with(|| self.core.revision().into());
        response
    }

    fn identify(&self, head: &Head, request: &Request) -> Result<Arc<Claims>, Problem> {
        let headers = request.headers();
        if self.dev {
            request::check_dev(request.uri(), headers)?;
        }
        self.limits.check_address(head.address)?;
        let token = request::bearer(headers);
        let claims = self.core.authenticate(token, head.address);
        if token.is_some()
            && claims.as_ref().is_err_and(|problem| problem.code == Code::Unauthenticated)
        {
            self.limits.count_refused_token(head.address);
        }
        claims
    }

    /// Which method, and how long it may take.
    fn admit(
        &self,
        head: &Head,
        claims: &Claims,
        headers: &HeaderMap,
    ) -> Result<(&'static Method, Duration), Problem> {
        self.limits.count_request(&claims.subject)?;
        let none =
            || Problem::new(Code::MethodNotAllowed, "there is no such service or method here");
        let method = head.method.ok_or_else(none)?;
        self.core.authorize(claims, method.right)?;
        Ok((method, call_time(headers)?))
    }

    fn refuse(
        &self,
        head: &Head,
        claims: Option<&Claims>,
        problem: &Problem,
        action: &str,
    ) -> Response {
        if is_denial(problem) {
            let (code, internal) =
                (problem.code.as_str(), problem.internal.as_deref().unwrap_or_default());
            tracing::info!(
                target: "blaze_config::access",
                action,
                code,
                peer = %head.address,
                internal,
                "refused",
            );
            self.core.denied(claims, problem, action, None, &head.id, head.address);
        }
        status::from_problem(problem, &head.id).into_http()
    }
}

impl Call {
    fn new(caller: Caller, method: &'static Method) -> Self {
        Self { caller, method, action: method.action, key: None, begun: Arc::default() }
    }
}

/// Whether a refusal belongs into the audit.
pub(super) fn is_denial(problem: &Problem) -> bool {
    matches!(problem.code, Code::Unauthenticated | Code::PermissionDenied)
}

async fn serve(call: Call, time: Duration, mut request: Request, next: Next) -> Response {
    let (id, writes) = (call.caller.request_id.clone(), call.method.writes);
    let begun = Arc::clone(&call.begun);
    request.extensions_mut().insert(call);
    let served = tokio::time::timeout(time, next.run(request)).await;
    served.unwrap_or_else(|_| {
        let problem = Problem::new(
            Code::DeadlineExceeded,
            format!("it took longer than {} ms", time.as_millis()),
        );
        // The core goes on with a write whose caller has left.
        let is_open = writes && begun.load(Ordering::Relaxed);
        let applied = if is_open { Applied::Unknown } else { Applied::No };
        status::from_problem(&problem.applied(applied), &id).into_http()
    })
}

/// The time that the client gives (`grpc-timeout`), at most [`MAX_TIME`].
fn call_time(headers: &HeaderMap) -> Result<Duration, Problem> {
    let Some(value) = headers.get("grpc-timeout") else {
        return Ok(MAX_TIME);
    };
    let time = value.to_str().ok().and_then(parse_timeout);
    let time = time.ok_or_else(|| {
        let detail = "grpc-timeout must be 1 to 8 digits and one of H, M, S, m, u, n";
        Problem::new(Code::InvalidHeader, detail)
    })?;
    Ok(time.min(MAX_TIME))
}

fn parse_timeout(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if !(1..=8).contains(&digits.len()) || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let number: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(number * 3600)),
        "M" => Some(Duration::from_secs(number * 60)),
        "S" => Some(Duration::from_secs(number)),
        "m" => Some(Duration::from_millis(number)),
        "u" => Some(Duration::from_micros(number)),
        "n" => Some(Duration::from_nanos(number)),
        _ => None,
    }
}

/// Gives the code of a response for metrics, and a refusal by the library the details that ours
/// have.
fn explain(response: &mut Response, request_id: &str, most_bytes: usize) -> &'static str {
    let held = response.extensions().get::<Status>().cloned();
    let Some(found) = held.or_else(|| Status::from_header_map(response.headers())) else {
        return "ok";
    };
    if found.code() == tonic::Code::Ok {
        return "ok";
    }
    if let Some(code) = status::code_of(&found) {
        return code.as_str();
    }
    let problem = as_problem(&found, most_bytes);
    let old =
        std::mem::replace(response, status::from_problem(&problem, request_id).into_http::<Body>());
    for (name, value) in old.headers() {
        response.headers_mut().entry(name).or_insert_with(|| value.clone());
    }
    problem.code.as_str()
}

/// What the library refused, in our words.
fn as_problem(found: &Status, most_bytes: usize) -> Problem {
    if let Some(problem) = refusal(found) {
        return problem.clone();
    }
    match (found.code(), found.message()) {
        (tonic::Code::Unimplemented, "") => {
            Problem::new(Code::MethodNotAllowed, "there is no such service or method here")
        }
        // The message is not in the compression that the client said, or in one that is not
        // offered.
        (tonic::Code::Unimplemented, message) => Problem::new(Code::MethodNotAllowed, message),
        (tonic::Code::NotFound, message) => Problem::new(Code::NotFound, message),
        (tonic::Code::OutOfRange | tonic::Code::ResourceExhausted, _) => {
            Problem::new(Code::PayloadTooLarge, format!("a message may have {most_bytes} bytes"))
        }
        (_, message) => {
            Problem::new(Code::InvalidRequest, format!("the message cannot be read: {message}"))
        }
    }
}

/// The middleware of what needs no token, and of what is not there.
pub(super) async fn open(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    let head = Head {
        id: request::request_id(request.headers()),
        address: request::client_address(request.extensions()),
        method: None,
    };
    // A page that a browser of this machine shows is not told what there is either.
    let checked = match gate.dev {
        true => request::check_dev(request.uri(), request.headers()),
        false => Ok(()),
    };
    let mut response = match checked {
        Ok(()) => next.run(request).await,
        Err(problem) => gate.refuse(&head, None, &problem, "authenticate"),
    };
    explain(&mut response, &head.id, MAX_OPEN_BYTES);
    if let Ok(id) = HeaderValue::from_str(&head.id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    response
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_timeout_is_read_as_the_protocol_says() {
        for (text, millis) in [
            ("1H", 3_600_000),
            ("2M", 120_000),
            ("3S", 3000),
            ("4m", 4),
            ("5000u", 5),
            ("6000000n", 6),
        ] {
            assert_eq!(parse_timeout(text), Some(Duration::from_millis(millis)), "{text}");
        }
        assert_eq!(parse_timeout("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        for text in ["", "S", "1", "123456789S", "1s", "-1S", "+1S", "1 S", "1ä", "ä"] {
            assert_eq!(parse_timeout(text), None, "{text}");
        }
    }

    #[test]
    fn no_call_has_longer_than_the_limit() {
        let mut headers = HeaderMap::new();
        assert_eq!(call_time(&headers).unwrap(), MAX_TIME);
        headers.insert("grpc-timeout", HeaderValue::from_static("1H"));
        assert_eq!(call_time(&headers).unwrap(), MAX_TIME);
        headers.insert("grpc-timeout", HeaderValue::from_static("100m"));
        assert_eq!(call_time(&headers).unwrap(), Duration::from_millis(100));
        headers.insert("grpc-timeout", HeaderValue::from_static("soon"));
        assert_eq!(call_time(&headers).unwrap_err().code, Code::InvalidHeader);
    }

    #[test]
    fn refusals_of_the_library_get_a_code_and_details() {
        for (status, code) in [
            (Status::out_of_range("decoded message length too large"), "payload_too_large"),
            (Status::internal("failed to decode Protobuf message"), "invalid_request"),
            (Status::unimplemented(""), "method_not_allowed"),
            (Status::from_error(Problem::new(Code::RateLimited, "").into()), "rate_limited"),
        ] {
            let mut response = status.into_http::<Body>();
            response.headers_mut().insert(REVISION, 7.into());
            assert_eq!(explain(&mut response, "r1", 1), code);
            let status = response.extensions().get::<Status>().unwrap();
            assert_eq!(status::code_of(status).unwrap().as_str(), code);
            assert_eq!(response.headers()[REVISION], "7");
        }
        assert_eq!(explain(&mut Response::new(Body::empty()), "r1", 1), "ok");
    }

    proptest! {
        #[test]
        fn no_timeout_panics(text in "\\PC{0,12}") {
            let _ = parse_timeout(&text);
        }
    }
}
