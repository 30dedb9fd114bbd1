//! Answers: JSON with the revision that they reflect, problems, and what the log is to say of them.

use std::convert::Infallible;
use std::sync::Arc;

use axum::body::Body;
use axum::http::header::{CONTENT_TYPE, ETAG, HeaderName, LOCATION, RETRY_AFTER};
use axum::http::{HeaderValue, StatusCode};
use axum::response::Response;
use blaze_domain::config::{Code, Document, Key, Problem};
use bytes::Bytes;
use futures::stream;
use serde_json::Value;

use super::headers::{BLAZE_REVISION, IDEMPOTENT_REPLAYED, etag};
use crate::core::{Answer, Written};

/// Content type of answers.
pub(super) const JSON: &str = "application/json";
/// Content type of refusals.
pub(super) const PROBLEM: &str = "application/problem+json";

/// A refusal, kept beside its response: what log and metrics say of it.
#[derive(Debug, Clone)]
pub(super) struct Refused {
    pub(super) code: Code,
    pub(super) internal: Option<String>,
}

/// Sets a header, if the value can be one.
pub(super) fn set(response: &mut Response, name: HeaderName, value: &str) {
    if let Ok(value) = HeaderValue::from_str(value) {
        response.headers_mut().insert(name, value);
    }
}

/// A body of JSON.
pub(super) fn json(status: StatusCode, revision: u64, value: &Value) -> Response {
    let mut response = Response::new(Body::from(value.to_string()));
    *response.status_mut() = status;
    set(&mut response, CONTENT_TYPE, JSON);
    set(&mut response, BLAZE_REVISION, &revision.to_string());
    response
}

/// No body, and no length either: that of a 304 would be the document's.
pub(super) fn empty(status: StatusCode, revision: u64) -> Response {
    let nothing = stream::empty::<Result<Bytes, Infallible>>();
    let mut response = Response::new(Body::from_stream(nothing));
    *response.status_mut() = status;
    set(&mut response, BLAZE_REVISION, &revision.to_string());
    response
}

/// A document with its tag.
pub(super) fn document(status: StatusCode, revision: u64, document: &Document) -> Response {
    let mut response = json(status, revision, &document.to_json());
    set(&mut response, ETAG, &etag(document.revision));
    response
}

/// A document after a write: 201 with its place if it is new.
pub(super) fn written(answer: &Answer<Written>) -> Response {
    let Written { document: shown, created } = &answer.value;
    let shown: &Arc<Document> = shown;
    let status = if *created { StatusCode::CREATED } else { StatusCode::OK };
    let mut response = document(status, answer.revision, shown);
    if *created {
        set(&mut response, LOCATION, &location(&shown.key));
    }
    replayed(response, answer.replayed)
}

/// Marks an answer as the first one again, if it is.
pub(super) fn replayed(mut response: Response, replayed: bool) -> Response {
    if replayed {
        set(&mut response, IDEMPOTENT_REPLAYED, "true");
    }
    response
}

/// Path of a document.
pub(super) fn location(key: &Key) -> String {
    let (collection, name) = (key.kind().collection(), key.name());
    match key.service_name() {
        Some(service) => format!("/api/v1/services/{service}/{collection}/{name}"),
        None => format!("/api/v1/{collection}/{name}"),
    }
}

/// A refusal.
pub(super) fn problem(problem: &Problem, path: &str, request_id: &str) -> Response {
    let body = problem.to_json(path, request_id).to_string();
    let mut response = Response::new(Body::from(body));
    let status = problem.code.http_status().and_then(|status| StatusCode::from_u16(status).ok());
    *response.status_mut() = status.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    set(&mut response, CONTENT_TYPE, PROBLEM);
    if let Some(seconds) = problem.retry_after_s {
        set(&mut response, RETRY_AFTER, &seconds.to_string());
    }
    response
        .extensions_mut()
        .insert(Refused { code: problem.code, internal: problem.internal.clone() });
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_becomes_a_response() {
        let refusal =
            Problem::new(Code::RateLimited, "too many").retry_after(3).because("bucket of ops");
        let response = problem(&refusal, "/api/v1/nodes", "r-1");
        assert_eq!(response.status(), 429);
        assert_eq!(response.headers()[RETRY_AFTER], "3");
        assert_eq!(response.headers()[CONTENT_TYPE], PROBLEM);
        let refused = response.extensions().get::<Refused>().unwrap();
        assert_eq!(
            (refused.code, refused.internal.as_deref()),
            (Code::RateLimited, Some("bucket of ops"))
        );
        // Told within streams alone; as an answer it would be a fault of the service.
        assert_eq!(problem(&Problem::new(Code::WatchTooSlow, ""), "/", "r").status(), 500);
    }

    #[test]
    fn documents_have_paths() {
        let of = |key: &str| location(&key.parse().unwrap());
        assert_eq!(of("Node/robot-1"), "/api/v1/nodes/robot-1");
        assert_eq!(of("Instance/slam/0"), "/api/v1/services/slam/instances/0");
    }
}
