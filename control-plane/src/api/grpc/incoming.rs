//! Messages of requests as the core wants them. What cannot be read is refused here, what makes no
//! sense by the core.

use std::str::FromStr;

use blaze_domain::config::{Code, FieldFault, Key, Kind, Problem, Timestamp, json};
use blaze_domain::{DocumentName, NameError};
use blaze_proto::config::{WireError, kind_from_wire, object_from_wire};
use blaze_proto::{Message, v1};
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};

use super::MAX_APPLY_BYTES;
use crate::api::DEFAULT_TOKEN_LIFE_S;
use crate::core::{
    ApplyItem, ApplyRequest, DocumentInput, Idempotency, ListQuery, Place, Precondition,
    ReadOptions, WatchQuery,
};
use crate::store::AuditQuery;

pub(super) fn invalid(detail: impl Into<String>) -> Problem {
    Problem::new(Code::InvalidRequest, detail)
}

fn unreadable(error: &WireError) -> Problem {
    invalid(error.to_string())
}

/// A name, or none where the text is empty.
pub(super) fn optional<T: FromStr<Err = NameError>>(
    member: &str,
    text: &str,
) -> Result<Option<T>, Problem> {
    match text {
        "" => Ok(None),
        text => required(member, text).map(Some),
    }
}

/// A name that must be there.
pub(super) fn required<T: FromStr<Err = NameError>>(
    member: &str,
    text: &str,
) -> Result<T, Problem> {
    text.parse::<T>().map_err(|error| invalid(format!("{member} {text:?} {error}")))
}

fn text(text: String) -> Option<String> {
    (!text.is_empty()).then_some(text)
}

fn number(number: u64) -> Option<u64> {
    (number > 0).then_some(number)
}

/// A revision that must be said.
pub(super) fn revision(member: &str, number: u64) -> Result<u64, Problem> {
    match number {
        0 => Err(invalid(format!("{member} is missing: revisions begin with 1"))),
        number => Ok(number),
    }
}

/// Life of a token, in seconds.
pub(super) fn life(expires_in_s: u32) -> u32 {
    match expires_in_s {
        0 => DEFAULT_TOKEN_LIFE_S,
        seconds => seconds,
    }
}

/// What a request is about.
pub(super) fn key(wire: Option<&v1::Ref>) -> Result<Key, Problem> {
    let wire = wire.ok_or_else(|| invalid("ref is missing"))?;
    Key::try_from(wire).map_err(|error| unreadable(&error))
}

/// What a document is to be. A name that breaks the rules is a fault of the document, as in REST.
pub(super) fn input(wire: Option<v1::Document>) -> Result<DocumentInput, Problem> {
    let wire = wire.ok_or_else(|| invalid("document is missing"))?;
    let key = document_key(wire.r#ref.as_ref())?;
    Ok(DocumentInput {
        key,
        labels: wire.labels,
        annotations: wire.annotations,
        spec: object_from_wire("spec_json", &wire.spec_json).map_err(|error| unreadable(&error))?,
    })
}

fn document_key(wire: Option<&v1::Ref>) -> Result<Key, Problem> {
    let wire = wire.ok_or_else(|| invalid("document.ref is missing"))?;
    Key::try_from(wire).map_err(|error| match &error {
        WireError::Key(_) => {
            let is_service = !wire.service.is_empty() || wire.kind == i32::from(v1::Kind::Instance);
            let is_named = wire.name.parse::<DocumentName>().is_ok();
            Problem::faults(vec![FieldFault {
                pointer: if is_service && is_named { "/service" } else { "/name" }.to_owned(),
                code: Code::ValidationFailed,
                detail: error.to_string(),
                document: None,
            }])
        }
        WireError::Missing(_) | WireError::Kind(_) | WireError::Json { .. } => unreadable(&error),
    })
}

pub(super) fn precondition(wire: Option<v1::Precondition>) -> Result<Precondition, Problem> {
    use v1::precondition::Is;
    match wire.and_then(|wire| wire.is) {
        None => Ok(Precondition::None),
        Some(Is::Revision(revision)) => Ok(Precondition::Revisions(vec![revision])),
        Some(Is::Absent(true)) => Ok(Precondition::Absent),
        Some(Is::Any(true)) => Ok(Precondition::Any),
        Some(Is::Absent(false)) => Err(invalid("precondition.absent can only be true")),
        Some(Is::Any(false)) => Err(invalid("precondition.any can only be true")),
    }
}

pub(super) fn read(wire: Option<v1::ReadOptions>) -> ReadOptions {
    let wire = wire.unwrap_or_default();
    ReadOptions {
        cached: wire.cached,
        min_revision: number(wire.min_revision),
        at_revision: number(wire.at_revision),
        reveal: wire.reveal,
    }
}

/// Limit and token of a page.
pub(super) fn page(wire: Option<v1::Page>) -> (Option<u32>, String) {
    let wire = wire.unwrap_or_default();
    ((wire.limit > 0).then_some(wire.limit), wire.page_token)
}

pub(super) fn list(wire: v1::ListRequest) -> Result<(ListQuery, ReadOptions), Problem> {
    let kind = kind_from_wire(wire.kind).map_err(|error| unreadable(&error))?;
    let kind = kind.ok_or_else(|| invalid("kind is missing"))?;
    if kind != Kind::Instance && !wire.service.is_empty() {
        return Err(invalid(format!("service: a {kind} has no service")));
    }
    let (limit, page_token) = page(wire.page);
    let read = read(wire.read);
    let query = ListQuery {
        kind: Some(kind),
        service: optional("service", &wire.service)?,
        layer: optional("layer", &wire.layer)?,
        node: optional("node", &wire.node)?,
        label_selector: text(wire.label_selector),
        limit,
        page_token,
    };
    Ok((query, read))
}

pub(super) fn watch(wire: v1::WatchRequest) -> Result<WatchQuery, Problem> {
    Ok(WatchQuery {
        since: wire.since,
        kind: kind_from_wire(wire.kind).map_err(|error| unreadable(&error))?,
        name: optional("name", &wire.name)?.map(|name: DocumentName| name.to_string()),
        service: optional("service", &wire.service)?,
        layer: optional("layer", &wire.layer)?,
        label_selector: text(wire.label_selector),
        timeout_s: (wire.timeout_s > 0).then_some(wire.timeout_s),
    })
}

pub(super) fn place(wire: Option<v1::Place>) -> Result<Place, Problem> {
    let wire = wire.unwrap_or_default();
    Ok(Place {
        service: optional("place.service", &wire.service)?,
        instance: optional("place.instance", &wire.instance)?,
        layer: optional("place.layer", &wire.layer)?,
        node: optional("place.node", &wire.node)?,
    })
}

pub(super) fn apply(wire: v1::ApplyRequest) -> Result<ApplyRequest, Problem> {
    let bytes = wire.encoded_len();
    if bytes > MAX_APPLY_BYTES {
        let detail = format!("{bytes} bytes; at most {MAX_APPLY_BYTES} go in one request");
        return Err(Problem::new(Code::PayloadTooLarge, detail));
    }
    let item = |(index, item)| apply_item(item).map_err(|problem| at(index, problem));
    Ok(ApplyRequest {
        items: wire.items.into_iter().enumerate().map(item).collect::<Result<_, _>>()?,
        dry_run: wire.dry_run,
        prune: text(wire.prune),
        prune_confirm: None,
    })
}

fn apply_item(wire: v1::ApplyItem) -> Result<ApplyItem, Problem> {
    let mut document = wire.document;
    let revision = document.as_ref().and_then(|document| number(document.revision));
    if let Some(document) = document.as_mut().filter(|_| wire.delete) {
        // Only the name counts.
        document.spec_json.clear();
    }
    Ok(ApplyItem { input: input(document)?, revision, delete: wire.delete })
}

/// A problem of one item, as one of the whole request.
fn at(index: usize, mut problem: Problem) -> Problem {
    problem.detail = format!("items[{index}]: {}", problem.detail);
    for fault in &mut problem.errors {
        fault.document = Some(index);
    }
    problem
}

/// JSON that must be there.
pub(super) fn merge_patch(text: &str) -> Result<Value, Problem> {
    json::parse(text.as_bytes()).map_err(|fault| invalid(format!("merge_patch_json: {fault}")))
}

/// The key of a request that may come twice, if it has one.
pub(super) fn idempotency(
    method: &str,
    key: &str,
    message: &impl Message,
) -> Result<Option<Idempotency>, Problem> {
    if key.is_empty() {
        return Ok(None);
    }
    if key.len() > 128 || !key.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err(invalid("request_id must be 1 to 128 visible ASCII characters"));
    }
    Ok(Some(Idempotency {
        key: key.to_owned(),
        path: format!("grpc/{method}"),
        body: Sha256::digest(message.encode_to_vec()).into(),
    }))
}

/// The filter of the audit: a JSON object with the query parameters of REST.
pub(super) fn audit(filter: &str, wire: Option<v1::Page>) -> Result<(AuditQuery, String), Problem> {
    let fault = |error: WireError| unreadable(&error);
    let Value::Object(members) = object_from_wire("filter_json", filter).map_err(fault)? else {
        return Err(invalid("filter_json must be an object"));
    };
    let (limit, page_token) = page(wire);
    let query = AuditQuery {
        // The core's own size of a page is 0.
        limit: limit.unwrap_or_default() as usize,
        ..audit_filter(members)?
    };
    Ok((query, page_token))
}

fn audit_filter(members: Map<String, Value>) -> Result<AuditQuery, Problem> {
    let mut query = AuditQuery::default();
    for (name, value) in members {
        let Value::String(value) = value else {
            return Err(invalid(format!("filter_json: {name} must be text")));
        };
        let time = || -> Result<Timestamp, Problem> {
            value
                .parse::<Timestamp>()
                .map_err(|error| invalid(format!("filter_json: {name}: {error}")))
        };
        match name.as_str() {
            "subject" => query.subject = Some(value),
            "kind" => {
                let kind = value
                    .parse::<Kind>()
                    .map_err(|error| invalid(format!("filter_json: kind {error}")))?;
                query.kind = Some(kind.as_str().to_owned());
            }
            "name" => query.name = Some(value),
            "action" => query.action = Some(value),
            "outcome" => query.allowed = Some(outcome(&value)?),
            "since_time" => query.since = Some(time()?),
            "until_time" => query.until = Some(time()?),
            _ => {
                let detail = format!("filter_json: {name} is not known");
                return Err(Problem::new(Code::UnknownParameter, detail));
            }
        }
    }
    Ok(query)
}

fn outcome(word: &str) -> Result<bool, Problem> {
    match word {
        "allowed" => Ok(true),
        "denied" => Ok(false),
        _ => Err(invalid(format!("filter_json: outcome {word:?} is not one of allowed, denied"))),
    }
}

#[cfg(test)]
#[path = "incoming_tests.rs"]
mod tests;
