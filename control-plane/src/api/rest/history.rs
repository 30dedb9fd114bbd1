//! What was: history of a document, differences between its revisions, and the way back.

use axum::http::StatusCode;
use axum::response::Response;
use blaze_domain::config::{Code, Kind, MAX_INTEGER, Problem};

use super::headers;
use super::operation::Call;
use super::query::Param;
use super::reply;
use super::requests::RollbackRequest;
use crate::api::json;

/// What `view` may be.
pub(super) const VIEWS: &[&str] = &["basic", "full"];

/// `GET /{c}/{n}/history`
pub(super) async fn list(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let full = call.query.word(Param::View, VIEWS)? == Some("full");
    let (limit, page_token) = (call.query.limit()?, call.query.page_token());
    let answer = call
        .service()
        .history(&call.caller, &call.key(kind)?, limit, page_token, full, &call.read_options()?)
        .await?;
    let body = json::page(&answer.value, answer.revision, |entry| json::history_entry(entry, full));
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}

/// `GET /{c}/{n}/diff`
pub(super) async fn diff(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let revision = |param| call.query.number(param, 1, MAX_INTEGER.unsigned_abs());
    let Some(from) = revision(Param::From)? else {
        return Err(Problem::new(
            Code::InvalidRequest,
            "query parameter from is missing: the revision to compare from",
        ));
    };
    let to = revision(Param::To)?;
    let answer = call
        .service()
        .diff(&call.caller, &call.key(kind)?, from, to, &call.read_options()?)
        .await?;
    Ok(reply::json(StatusCode::OK, answer.revision, &json::diff(&answer.value)))
}

/// `POST /{c}/{n}/rollback`
pub(super) async fn rollback(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let precondition = headers::precondition(&call.headers)?;
    let idempotency = call.idempotency()?;
    let RollbackRequest { revision } = call.read()?;
    let mut answer = call
        .service()
        .rollback(&call.caller, &call.key(kind)?, revision, precondition, idempotency)
        .await?;
    // 200 also where it makes a deleted document again.
    answer.value.created = false;
    Ok(reply::written(&answer))
}
