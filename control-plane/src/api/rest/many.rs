//! Many documents in one commit: `apply` and `revert`.

use axum::http::StatusCode;
use axum::response::Response;
use blaze_domain::config::{Code, FieldFault, MAX_DEPTH, MAX_DOCUMENTS, Problem, json};
use blaze_runtime::config::{LocatedFault, yaml_documents};
use serde_json::Value;

use super::body::Media;
use super::documents::apply_item;
use super::operation::Call;
use super::query::Param;
use super::reply;
use super::requests::RevertRequest;
use crate::api::json as answers;
use crate::core::{Answer, ApplyItem, ApplyReport, ApplyRequest};

/// Documents of one request, at most.
const MAX_ITEMS: usize = 1000;
/// Bodies from this size on, in bytes, are read beside the threads that serve others.
const LARGE_BYTES: usize = 32 * 1024;
/// Faults that are told, at most.
const MAX_FAULTS: usize = 100;

/// `POST /apply`
pub(super) async fn apply(call: &Call) -> Result<Response, Problem> {
    let request = ApplyRequest {
        dry_run: call.query.flag(Param::DryRun)?,
        prune: call.query.text(Param::Prune).map(str::to_owned),
        prune_confirm: call.query.number(Param::PruneConfirm, 0, MAX_DOCUMENTS as u64)?,
        items: Vec::new(),
    };
    let idempotency = call.idempotency()?;
    let (media, bytes) = call.body();
    let items = if bytes.len() < LARGE_BYTES {
        read(media, bytes)?
    } else {
        // Text that is made for it takes seconds to read.
        let bytes = bytes.clone();
        let reading = tokio::task::spawn_blocking(move || read(media, &bytes));
        reading.await.map_err(|_| Problem::new(Code::Internal, "the body could not be read"))??
    };
    let answer =
        call.service().apply(&call.caller, ApplyRequest { items, ..request }, idempotency).await?;
    Ok(report(&answer))
}

fn read(media: Media, bytes: &[u8]) -> Result<Vec<ApplyItem>, Problem> {
    let values = match media {
        Media::Yaml => yaml(bytes)?,
        Media::Json | Media::MergePatch => array(bytes)?,
    };
    items(values)
}

/// `POST /revert`
pub(super) async fn revert(call: &Call) -> Result<Response, Problem> {
    let idempotency = call.idempotency()?;
    let RevertRequest { revision, force } = call.read()?;
    let answer = call.service().revert(&call.caller, revision, force, idempotency).await?;
    Ok(report(&answer))
}

fn report(answer: &Answer<ApplyReport>) -> Response {
    let body = answers::apply_report(&answer.value);
    reply::replayed(reply::json(StatusCode::OK, answer.revision, &body), answer.replayed)
}

fn too_many(count: usize) -> Problem {
    let detail = format!("the request has {count} documents, at most {MAX_ITEMS} are allowed");
    Problem::new(Code::PayloadTooLarge, detail)
}

/// A JSON array; it may be one deeper than a document.
fn array(bytes: &[u8]) -> Result<Vec<Value>, Problem> {
    let value = json::parse_within(bytes, MAX_DEPTH + 1).map_err(|fault| {
        Problem::new(
            Code::InvalidRequest,
            format!("the body is no JSON as it is taken here: {fault}"),
        )
    })?;
    match value {
        Value::Array(values) if values.len() > MAX_ITEMS => Err(too_many(values.len())),
        Value::Array(values) => Ok(values),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Object(_) => {
            Err(Problem::new(
                Code::InvalidRequest,
                "the body is no array of documents; YAML takes documents split by ---",
            ))
        }
    }
}

/// YAML with as many documents; what JSON could not hold is refused here too.
fn yaml(bytes: &[u8]) -> Result<Vec<Value>, Problem> {
    let refuse = |detail: String| {
        Problem::new(
            Code::InvalidRequest,
            format!("the body is no YAML as it is taken here: {detail}"),
        )
    };
    let text = std::str::from_utf8(bytes).map_err(|_| refuse("it is not UTF-8".to_owned()))?;
    let values = yaml_documents(text, MAX_ITEMS).map_err(|faults| match faults.as_slice() {
        faults if faults.iter().any(LocatedFault::is_too_many_documents) => {
            let detail = format!("the request has more than {MAX_ITEMS} documents");
            Problem::new(Code::PayloadTooLarge, detail)
        }
        [] => refuse("it cannot be read".to_owned()),
        [one] => refuse(one.to_string()),
        [first, rest @ ..] => refuse(format!("{first} (and {} more)", rest.len())),
    })?;
    for (index, value) in values.iter().enumerate() {
        json::check(value).map_err(|fault| refuse(format!("document {index}: {fault}")))?;
    }
    Ok(values)
}

/// All documents, or the faults of all.
fn items(values: Vec<Value>) -> Result<Vec<ApplyItem>, Problem> {
    let mut items = Vec::with_capacity(values.len());
    let mut faults: Vec<FieldFault> = Vec::new();
    for (index, value) in values.into_iter().enumerate() {
        match apply_item(value) {
            Ok(item) => items.push(item),
            Err(found) => faults.extend(
                found.into_iter().map(|fault| FieldFault { document: Some(index), ..fault }),
            ),
        }
    }
    if faults.is_empty() {
        return Ok(items);
    }
    faults.truncate(MAX_FAULTS);
    Err(Problem::faults(faults))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn yaml_and_json_give_the_same_documents() {
        let from_yaml = yaml(
            b"kind: Layer\nname: edge\nspec: { kind: edge }\n---\n{ kind: Layer, name: fog, spec: { kind: fog } }\n",
        )
        .unwrap();
        let from_json =
            array(br#"[{"kind":"Layer","name":"edge","spec":{"kind":"edge"}},{"kind":"Layer","name":"fog","spec":{"kind":"fog"}}]"#);
        assert_eq!(from_yaml, from_json.unwrap());
        assert_eq!(items(from_yaml).unwrap().len(), 2);
    }

    #[test]
    fn what_cannot_be_read_is_a_bad_request() {
        for bad in ["a: &x 1", "a: 1\na: 2", "a: [", "a: 9007199254740993", "\u{0}"] {
            assert_eq!(yaml(bad.as_bytes()).unwrap_err().code, Code::InvalidRequest, "{bad}");
        }
        assert_eq!(yaml(b"\xff").unwrap_err().code, Code::InvalidRequest);
        for bad in ["{}", "null", "[1,", "[9007199254740993]"] {
            assert_eq!(array(bad.as_bytes()).unwrap_err().code, Code::InvalidRequest, "{bad}");
        }
    }

    #[test]
    fn a_thousand_documents_are_enough() {
        let json = |count: usize| {
            array(format!("[{}]", vec!["0"; count].join(",")).as_bytes())
                .map_err(|problem| problem.code)
        };
        assert_eq!(json(MAX_ITEMS).unwrap().len(), MAX_ITEMS);
        assert_eq!(json(MAX_ITEMS + 1), Err(Code::PayloadTooLarge));
        let yaml = |count: usize| {
            yaml("a: 1\n---\n".repeat(count).as_bytes()).map_err(|problem| problem.code)
        };
        assert_eq!(yaml(MAX_ITEMS).unwrap().len(), MAX_ITEMS);
        assert_eq!(yaml(MAX_ITEMS + 1), Err(Code::PayloadTooLarge));
    }

    #[test]
    fn faults_say_in_which_document_they_are() {
        let values =
            array(br#"[{"kind":"Layer","name":"edge","spec":{}},{"kind":"Laier"},{"name":"x","spec":[]}]"#).unwrap();
        let problem = items(values).unwrap_err();
        let documents: Vec<Option<usize>> =
            problem.errors.iter().map(|fault| fault.document).collect();
        assert_eq!(problem.code, Code::ValidationFailed);
        assert!(
            documents.contains(&Some(1))
                && documents.contains(&Some(2))
                && !documents.contains(&Some(0))
        );
    }
}
