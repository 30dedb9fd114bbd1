//! The verbs that all five collections share, and the two of roll-outs alone.

use std::sync::Arc;

use axum::http::StatusCode;
use axum::http::header::ETAG;
use axum::response::Response;
use blaze_domain::config::spec::{self, Envelope};
use blaze_domain::config::{Code, FieldFault, Key, Kind, Problem};
use serde_json::Value;

use super::headers::{self, Tags, etag};
use super::operation::Call;
use super::query::Param;
use super::reply;
use super::requests::AbortRequest;
use crate::api::json;
use crate::auth::Claims;
use crate::core::{ApplyItem, Caller, DocumentInput, ListQuery, Precondition, ReadOptions};

/// `GET /{c}`
pub(super) async fn list(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let query = ListQuery {
        kind: Some(kind),
        service: call.names.service.clone(),
        layer: call.query.name(Param::Layer)?,
        node: call.query.name(Param::Node)?,
        label_selector: call.query.text(Param::LabelSelector).map(str::to_owned),
        limit: call.query.limit()?,
        page_token: call.query.page_token().to_owned(),
    };
    let answer = call.service().list(&call.caller, &query, &call.read_options()?).await?;
    let body = json::document_page(&answer.value, answer.revision);
    Ok(reply::json(StatusCode::OK, answer.revision, &body))
}

/// `POST /{c}`
pub(super) async fn create(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let idempotency = call.idempotency()?;
    let body = call.json()?;
    let new = spec::parse_new(body, kind, call.names.service.as_ref());
    let input = new.and_then(input).map_err(Problem::faults)?;
    let answer = call.service().create(&call.caller, input, idempotency).await?;
    Ok(reply::written(&answer))
}

/// `GET /{c}/{n}`
pub(super) async fn get(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let known = headers::if_none_match(&call.headers)?;
    let answer = call.service().get(&call.caller, &call.key(kind)?, &call.read_options()?).await?;
    let revision = answer.value.revision;
    let unchanged = match known {
        None => false,
        Some(Tags::Any) => true,
        Some(Tags::Revisions(revisions)) => revisions.contains(&revision),
    };
    if unchanged {
        let mut response = reply::empty(StatusCode::NOT_MODIFIED, answer.revision);
        reply::set(&mut response, ETAG, &etag(revision));
        return Ok(response);
    }
    Ok(reply::document(StatusCode::OK, answer.revision, &answer.value))
}

/// `PUT /{c}/{n}`
pub(super) async fn replace(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let key = call.key(kind)?;
    let precondition = headers::put_precondition(&call.headers)?;
    let input = match spec::parse_envelope(call.json()?, Some(&key)).and_then(input) {
        Ok(input) => input,
        Err(faults) => {
            return Err(
                precondition_first(call, &key, &precondition, Problem::faults(faults)).await
            );
        }
    };
    let answer = call.service().replace(&call.caller, input, precondition).await?;
    Ok(reply::written(&answer))
}

/// `PATCH /{c}/{n}`
pub(super) async fn patch(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let precondition = headers::precondition(&call.headers)?;
    let answer =
        call.service().patch(&call.caller, &call.key(kind)?, call.json()?, precondition).await?;
    Ok(reply::written(&answer))
}

/// `DELETE /{c}/{n}`
pub(super) async fn delete(call: &Call, kind: Kind) -> Result<Response, Problem> {
    let precondition = headers::precondition(&call.headers)?;
    let cascade = call.query.flag(Param::Cascade)?;
    let answer =
        call.service().delete(&call.caller, &call.key(kind)?, precondition, cascade).await?;
    Ok(reply::empty(StatusCode::NO_CONTENT, answer.revision))
}

/// `POST /rollouts/{n}/promote`
pub(super) async fn promote(call: &Call) -> Result<Response, Problem> {
    let key = call.key(Kind::Rollout)?;
    let answer =
        call.service().promote_rollout(&call.caller, key.name(), call.idempotency()?).await?;
    Ok(reply::written(&answer))
}

/// `POST /rollouts/{n}/abort`
pub(super) async fn abort(call: &Call) -> Result<Response, Problem> {
    let (key, idempotency) = (call.key(Kind::Rollout)?, call.idempotency()?);
    let AbortRequest { reason } = call.read()?;
    let answer =
        call.service().abort_rollout(&call.caller, key.name(), &reason, idempotency).await?;
    Ok(reply::written(&answer))
}

/// What is to be written.
fn input(envelope: Envelope) -> Result<DocumentInput, Vec<FieldFault>> {
    Ok(DocumentInput {
        key: envelope.key()?,
        labels: envelope.labels,
        annotations: envelope.annotations,
        spec: envelope.spec,
    })
}

/// One document of `apply`.
pub(super) fn apply_item(value: Value) -> Result<ApplyItem, Vec<FieldFault>> {
    let envelope = spec::parse_envelope(value, None)?;
    let (revision, delete) = (envelope.revision, envelope.delete);
    Ok(ApplyItem { input: input(envelope)?, revision, delete })
}

/// The order of checks has preconditions before faults of the document; the core sees only
/// documents without faults, so that what comes first is looked up here.
async fn precondition_first(
    call: &Call,
    key: &Key,
    precondition: &Precondition,
    faults: Problem,
) -> Problem {
    let read = |caller: Caller| async move {
        call.service().get(&caller, key, &ReadOptions::default()).await
    };
    let mut found = read(call.caller.clone()).await;
    if let Err(refused) = &found
        && refused.code == Code::PermissionDenied
        && may_create(key, precondition)
    {
        // A token bound to a layer may make what does not exist; whether it does, the token's own
        // view does not say.
        let whole = Claims { layer: None, ..(*call.caller.claims).clone() };
        let caller = Caller { claims: Arc::new(whole), ..call.caller.clone() };
        match read(caller).await {
            Err(problem) if problem.code == Code::NotFound => found = Err(problem),
            Ok(_) | Err(_) => {}
        }
    }
    let current = match found {
        Ok(answer) => Some(answer.value.revision),
        Err(problem) if problem.code == Code::NotFound => None,
        Err(problem) => return problem,
    };
    judge(key, precondition, current, call.service().revision()).unwrap_or(faults)
}

/// Whether a token bound to a layer may write what does not exist. Services belong to all layers.
fn may_create(key: &Key, precondition: &Precondition) -> bool {
    key.kind() != Kind::Service && matches!(precondition, Precondition::None | Precondition::Absent)
}

/// What a precondition says of the present revision, if it refuses; of what is missing, that of the
/// store is told.
fn judge(
    key: &Key,
    precondition: &Precondition,
    current: Option<u64>,
    store: u64,
) -> Option<Problem> {
    let (code, detail) = match (precondition, current) {
        (Precondition::None, Some(_)) => {
            let detail = format!(
                "{key} exists: say which revision you change with If-Match (its ETag), or * for any"
            );
            (Code::PreconditionRequired, detail)
        }
        (Precondition::Revisions(wanted), Some(revision)) if !wanted.contains(&revision) => {
            let detail = format!("{key} has revision {revision} now: read it again");
            (Code::PreconditionFailed, detail)
        }
        (Precondition::Revisions(_) | Precondition::Any, None) => {
            (Code::PreconditionFailed, format!("{key} does not exist"))
        }
        (Precondition::Absent, Some(_)) => (Code::PreconditionFailed, format!("{key} exists")),
        (Precondition::None | Precondition::Absent, None)
        | (Precondition::Revisions(_) | Precondition::Any, Some(_)) => {
            return None;
        }
    };
    Some(Problem::new(code, detail).at(current.unwrap_or(store)))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn preconditions_are_judged_as_the_core_does() {
        let key: Key = "Node/robot-1".parse().unwrap();
        let code = |precondition, current| {
            judge(&key, &precondition, current, 9).map(|problem| problem.code)
        };
        assert_eq!(code(Precondition::None, None), None);
        assert_eq!(code(Precondition::None, Some(7)), Some(Code::PreconditionRequired));
        assert_eq!(code(Precondition::Any, Some(7)), None);
        assert_eq!(code(Precondition::Any, None), Some(Code::PreconditionFailed));
        assert_eq!(code(Precondition::Revisions(vec![6, 7]), Some(7)), None);
        assert_eq!(code(Precondition::Revisions(vec![6]), Some(7)), Some(Code::PreconditionFailed));
        assert_eq!(code(Precondition::Revisions(vec![6]), None), Some(Code::PreconditionFailed));
        assert_eq!(code(Precondition::Absent, None), None);
        assert_eq!(code(Precondition::Absent, Some(7)), Some(Code::PreconditionFailed));
        let revision =
            |precondition, current| judge(&key, &precondition, current, 9).unwrap().revision;
        assert_eq!(revision(Precondition::None, Some(7)), Some(7));
        assert_eq!(revision(Precondition::Any, None), Some(9));
    }

    #[test]
    fn an_item_of_apply_says_what_it_is() {
        let item = apply_item(json!({ "kind": "Node", "name": "robot-1", "revision": 7,
            "spec": { "layer": "edge" } }))
        .unwrap();
        assert_eq!(
            (item.input.key.to_string().as_str(), item.revision, item.delete),
            ("Node/robot-1", Some(7), false)
        );
        let gone = apply_item(
            json!({ "kind": "Instance", "service": "slam", "name": "0", "delete": true }),
        )
        .unwrap();
        assert!(gone.delete);
        assert!(apply_item(json!({ "name": "robot-1", "spec": {} })).is_err());
    }
}
