//! Answers as JSON: bodies of REST, and what gRPC gives as text.
//!
//! Every function here is the one place that knows the members of its answer; the schemas of the
//! OpenAPI document ([`super::rest`]) describe the same, and a test compares them.

use std::sync::Arc;

use blaze_domain::ServiceName;
use blaze_domain::config::diff::Delta;
use blaze_domain::config::{Document, Key};
use bytes::Bytes;
use serde_json::{Map, Value, json};

use crate::core::service::DiffReport;
use crate::core::{ApplyReport, ApplyResult, Effective, HistoryEntry, Page, Place, WatchCommit};
use crate::store::{AuditEntry, TokenRecord};

/// One page of anything, with the revision that it shows.
#[must_use]
pub fn page<T>(page: &Page<T>, revision: u64, item: impl Fn(&T) -> Value) -> Value {
    let items: Vec<Value> = page.items.iter().map(item).collect();
    json!({ "items": items, "revision": revision, "next_page_token": page.next_page_token })
}

/// One page of documents.
#[must_use]
pub fn document_page(documents: &Page<Arc<Document>>, revision: u64) -> Value {
    page(documents, revision, |document| document.to_json())
}

/// Kind, name and, of an instance, service: as they begin a document.
fn reference(key: &Key) -> Map<String, Value> {
    let mut members = Map::new();
    members.insert("kind".to_owned(), key.kind().as_str().into());
    members.insert("name".to_owned(), key.name().as_str().into());
    if let Some(service) = key.service_name() {
        members.insert("service".to_owned(), service.as_str().into());
    }
    members
}

fn place_members(place: &Place) -> Map<String, Value> {
    let mut members = Map::new();
    let mut put = |name: &str, value: Option<&str>| {
        members.insert(name.to_owned(), value.map_or(Value::Null, Value::from));
    };
    put("service", place.service.as_ref().map(AsRef::as_ref));
    put("instance", place.instance.as_ref().map(AsRef::as_ref));
    put("layer", place.layer.as_ref().map(AsRef::as_ref));
    put("node", place.node.as_ref().map(AsRef::as_ref));
    members
}

/// Answer of `apply` and `revert`.
#[must_use]
pub fn apply_report(report: &ApplyReport) -> Value {
    let results: Vec<Value> = report.results.iter().map(apply_result).collect();
    let affected: Vec<Value> =
        report.affected.iter().map(|place| Value::Object(place_members(place))).collect();
    json!({
        "dry_run": report.dry_run,
        "revision": report.revision,
        "results": results,
        "affected": affected,
        "affected_total": report.affected_total,
    })
}

fn apply_result(result: &ApplyResult) -> Value {
    let mut members = reference(&result.key);
    members.insert("action".to_owned(), result.action.as_str().into());
    members.insert("revision".to_owned(), result.revision.into());
    members.insert("changes".to_owned(), result.changes.iter().map(Delta::to_json).collect());
    Value::Object(members)
}

/// An effective configuration.
#[must_use]
pub fn effective(effective: &Effective, revision: u64) -> Value {
    let mut members = place_members(&effective.place);
    members.insert("revision".to_owned(), revision.into());
    members.insert("hash".to_owned(), effective.hash.as_str().into());
    members.insert(
        "rollout".to_owned(),
        effective.rollout.as_deref().map_or(Value::Null, Value::from),
    );
    members.insert("config".to_owned(), effective.config.clone());
    if let Some(explain) = &effective.explain {
        members.insert("explain".to_owned(), explain.clone());
    }
    Value::Object(members)
}

/// One line of a document's history; with `full`, the whole document (`null` for a deletion).
#[must_use]
pub fn history_entry(entry: &HistoryEntry, full: bool) -> Value {
    let mut members = Map::new();
    members.insert("revision".to_owned(), entry.revision.into());
    members.insert("op".to_owned(), entry.op.as_str().into());
    members.insert("time".to_owned(), entry.time.to_string().into());
    members.insert("subject".to_owned(), entry.subject.as_str().into());
    members.insert("request_id".to_owned(), entry.request_id.as_str().into());
    members.insert("paths".to_owned(), entry.paths.iter().map(String::as_str).collect());
    if full {
        let document = entry.document.as_ref().map_or(Value::Null, |document| document.to_json());
        members.insert("document".to_owned(), document);
    }
    Value::Object(members)
}

/// What changed in a document between two revisions.
#[must_use]
pub fn diff(report: &DiffReport) -> Value {
    let changes: Vec<Value> = report.changes.iter().map(Delta::to_json).collect();
    json!({ "from": report.from, "to": report.to, "changes": changes })
}

/// One line of the audit.
#[must_use]
pub fn audit_entry(entry: &AuditEntry) -> Value {
    let key = entry.key.as_ref();
    json!({
        "id": entry.id,
        "time": entry.time.to_string(),
        "revision": entry.revision,
        "subject": entry.subject,
        "roles": entry.roles,
        "action": entry.action,
        "kind": key.map(|key| key.kind().as_str()),
        "service": key.and_then(Key::service_name).map(ServiceName::as_str),
        "name": key.map(|key| key.name().as_str()),
        "outcome": if entry.allowed { "allowed" } else { "denied" },
        "code": entry.code,
        "paths": entry.paths,
        "request_id": entry.request_id,
        "address": entry.address,
        "detail": entry.detail,
    })
}

/// What is known of a token that was given out; never its text.
#[must_use]
pub fn token(record: &TokenRecord) -> Value {
    json!({
        "id": record.id,
        "subject": record.subject,
        "roles": record.roles,
        "layer": record.layer,
        "create_time": record.create_time.to_string(),
        "expire_time": record.expire_time.to_string(),
        "revoke_time": record.revoke_time.map(|time| time.to_string()),
    })
}

/// A new token with its text: the only answer that shows it.
#[must_use]
pub fn new_token(record: &TokenRecord, text: &str) -> Value {
    json!({
        "id": record.id,
        "token": text,
        "subject": record.subject,
        "roles": record.roles,
        "layer": record.layer,
        "expire_time": record.expire_time.to_string(),
    })
}

/// The event of a commit, written once for all who see it the same.
pub fn watch_commit(commit: &WatchCommit) -> &Bytes {
    commit.json.get_or_init(|| {
        let changes: Vec<Value> = commit
            .changes
            .iter()
            .map(|(op, document)| {
                let mut members = Map::new();
                members.insert("op".to_owned(), op.as_str().into());
                members.extend(reference(&document.key));
                members.insert("document".to_owned(), document.to_json());
                Value::Object(members)
            })
            .collect();
        let event = json!({
            "revision": commit.revision,
            "time": commit.time.to_string(),
            "subject": commit.subject,
            "changes": changes,
        });
        Bytes::from(event.to_string())
    })
}

#[cfg(test)]
mod tests {
    use blaze_domain::config::Timestamp;

    use super::*;
    use crate::core::ApplyAction;
    use crate::store::Op;

    fn node() -> Arc<Document> {
        Arc::new(Document {
            key: "Node/robot-1".parse().unwrap(),
            uid: "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11".to_owned(),
            revision: 413,
            create_time: Timestamp::from_millis(0),
            update_time: Timestamp::from_millis(1),
            updated_by: "ops".to_owned(),
            labels: Default::default(),
            annotations: Default::default(),
            spec: Arc::new(json!({ "layer": "edge" })),
            status: None,
        })
    }

    #[test]
    fn a_report_reads_as_in_the_contract() {
        let report = ApplyReport {
            dry_run: false,
            revision: 420,
            results: vec![ApplyResult {
                key: "Instance/slam/0".parse().unwrap(),
                action: ApplyAction::Created,
                revision: 420,
                changes: Vec::new(),
            }],
            affected: vec![Place {
                service: Some("slam".parse().unwrap()),
                layer: Some("edge".parse().unwrap()),
                ..Place::default()
            }],
            affected_total: 1,
        };
        assert_eq!(
            apply_report(&report),
            json!({
                "dry_run": false, "revision": 420,
                "results": [{
                    "kind": "Instance",
                    "name": "0",
                    "service": "slam",
                    "action": "created",
                    "revision": 420,
                    "changes": [],
                }],
                "affected": [{
                    "service": "slam",
                    "instance": null,
                    "layer": "edge",
                    "node": null,
                }], "affected_total": 1,
            })
        );
    }

    #[test]
    fn history_shows_documents_only_when_asked() {
        let mut entry = HistoryEntry {
            revision: 9,
            op: Op::Delete,
            time: Timestamp::from_millis(0),
            subject: "ops".to_owned(),
            request_id: "r".to_owned(),
            paths: vec!["/spec/config/a".to_owned()],
            document: None,
        };
        assert_eq!(history_entry(&entry, true)["document"], Value::Null);
        assert!(history_entry(&entry, false).get("document").is_none());
        entry.document = Some(node());
        assert_eq!(history_entry(&entry, true)["document"]["name"], "robot-1");
    }
}
