//! The system as a whole: topology, workers, digests, audit, trimming.

use axum::http::StatusCode;
use axum::response::Response;
use blaze_domain::config::{Code, Kind, Problem};
use blaze_domain::{DocumentName, LayerName};
use serde_json::{Value, json};

use super::operation::Call;
use super::query::Param;
use super::reply;
use super::requests::TrimRequest;
use crate::api::json as answers;
use crate::core::Answer;
use crate::store::AuditQuery;

/// What `outcome` of the audit may be.
pub(super) const OUTCOMES: &[&str] = &["allowed", "denied"];
/// Longest subject that is looked for, in characters.
pub(super) const MAX_SUBJECT: usize = 256;
/// Longest action that is looked for, in characters.
pub(super) const MAX_ACTION: usize = 64;

fn value(answer: &Answer<Value>) -> Response {
    reply::json(StatusCode::OK, answer.revision, &answer.value)
}

/// `GET /topology`
pub(super) async fn topology(call: &Call) -> Result<Response, Problem> {
    Ok(value(&call.service().topology(&call.caller, &call.read_options()?).await?))
}

/// `GET /workers`
pub(super) async fn workers(call: &Call) -> Result<Response, Problem> {
    Ok(value(&call.service().workers(&call.caller, &call.read_options()?).await?))
}

/// `GET /digest`
pub(super) async fn digest(call: &Call) -> Result<Response, Problem> {
    let Some(layer) = call.query.name::<LayerName>(Param::DigestLayer)? else {
        return Err(Problem::new(
            Code::InvalidRequest,
            "query parameter layer is missing: the layer to digest",
        ));
    };
    Ok(value(&call.service().digest(&call.caller, &layer, &call.read_options()?).await?))
}

/// `GET /audit`
pub(super) async fn audit(call: &Call) -> Result<Response, Problem> {
    let query = &call.query;
    let kinds: Vec<&'static str> = Kind::ALL.iter().map(|kind| kind.as_str()).collect();
    let wanted = AuditQuery {
        subject: subject(query.text(Param::Subject))?,
        kind: query.word(Param::Kind, &kinds)?.map(str::to_owned),
        name: query.name::<DocumentName>(Param::AuditName)?.map(|name| name.to_string()),
        action: action(query.text(Param::Action))?,
        allowed: query.word(Param::Outcome, OUTCOMES)?.map(|outcome| outcome == "allowed"),
        since: query.time(Param::SinceTime)?,
        until: query.time(Param::UntilTime)?,
        below: None,
        limit: query.limit()?.map_or(100, |limit| limit as usize),
    };
    let answer = call
        .service()
        .audit(&call.caller, wanted, query.page_token(), &call.read_options()?)
        .await?;
    let body = answers::page(&answer.value, answer.revision, answers::audit_entry);
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}

fn subject(text: Option<&str>) -> Result<Option<String>, Problem> {
    match text {
        Some(text) if text.is_empty() || text.chars().count() > MAX_SUBJECT => {
            let detail = format!(
                "query parameter subject is empty, or has more than {MAX_SUBJECT} characters"
            );
            Err(Problem::new(Code::InvalidRequest, detail))
        }
        text => Ok(text.map(str::to_owned)),
    }
}

/// Words of actions are an open set: what this process does not know, another one may have written.
fn action(text: Option<&str>) -> Result<Option<String>, Problem> {
    let fits = |text: &str| {
        (1..=MAX_ACTION).contains(&text.len())
            && text.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_')
    };
    match text {
        Some(text) if !fits(text) => {
            let detail = format!("query parameter action is 1 to {MAX_ACTION} of a-z and _");
            Err(Problem::new(Code::InvalidRequest, detail))
        }
        text => Ok(text.map(str::to_owned)),
    }
}

/// `POST /trim`
pub(super) async fn trim(call: &Call) -> Result<Response, Problem> {
    let idempotency = call.idempotency()?;
    let TrimRequest { before } = call.read()?;
    let answer = call.service().trim(&call.caller, before, idempotency).await?;
    let body = json!({ "oldest_revision": answer.value });
    Ok(reply::replayed(reply::json(StatusCode::OK, answer.revision, &body), answer.replayed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_of_the_audit_have_a_form() {
        assert_eq!(action(Some("token_create")), Ok(Some("token_create".to_owned())));
        assert_eq!(action(None), Ok(None));
        for bad in ["", "Create", "a b", &"a".repeat(65)] {
            assert_eq!(action(Some(bad)).unwrap_err().code, Code::InvalidRequest, "{bad}");
        }
        assert_eq!(subject(Some("ops@example.org")), Ok(Some("ops@example.org".to_owned())));
        for bad in ["", &"x".repeat(257)] {
            assert!(subject(Some(bad)).is_err(), "{bad}");
        }
    }
}
