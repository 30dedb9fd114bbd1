//! Answers of the core as messages.

use std::sync::Arc;

use blaze_domain::config::diff::Delta;
use blaze_domain::config::{Document, Timestamp};
use blaze_proto::config::timestamp_to_wire;
use blaze_proto::{google, v1};
use serde_json::Value;

use crate::core::{
    ApplyAction, ApplyReport, ApplyResult, Effective, HistoryEntry, Page, Place, WatchCommit,
    WatchOp, Written,
};
use crate::store::{Op, TokenRecord};

fn time(time: Timestamp) -> Option<google::Timestamp> {
    Some(timestamp_to_wire(time))
}

/// A name, empty if there is none.
fn name<T: AsRef<str>>(name: Option<&T>) -> String {
    name.map_or_else(String::new, |name| name.as_ref().to_owned())
}

fn text(value: Option<&Value>) -> String {
    value.map_or_else(String::new, Value::to_string)
}

pub(super) fn document(document: &Document) -> v1::Document {
    document.into()
}

pub(super) fn written(written: &Written) -> v1::Document {
    document(&written.document)
}

pub(super) fn json(value: &Value) -> v1::JsonResponse {
    v1::JsonResponse { json: value.to_string() }
}

pub(super) fn list(page: Page<Arc<Document>>, revision: u64) -> v1::ListResponse {
    v1::ListResponse {
        items: page.items.iter().map(|item| document(item)).collect(),
        revision,
        next_page_token: page.next_page_token,
    }
}

pub(super) fn delta(delta: &Delta) -> v1::Delta {
    v1::Delta {
        op: delta.op.to_owned(),
        path: delta.path.clone(),
        old_json: text(delta.old.as_ref()),
        value_json: text(delta.value.as_ref()),
    }
}

fn place(place: &Place) -> v1::Place {
    v1::Place {
        service: name(place.service.as_ref()),
        instance: name(place.instance.as_ref()),
        layer: name(place.layer.as_ref()),
        node: name(place.node.as_ref()),
    }
}

pub(super) fn applied(report: &ApplyReport) -> v1::ApplyResponse {
    v1::ApplyResponse {
        dry_run: report.dry_run,
        revision: report.revision,
        results: report.results.iter().map(result).collect(),
        affected: report.affected.iter().map(place).collect(),
        affected_total: report.affected_total,
    }
}

fn result(result: &ApplyResult) -> v1::ApplyResult {
    let op = match result.action {
        ApplyAction::Created => v1::Op::Create,
        ApplyAction::Updated => v1::Op::Update,
        ApplyAction::Deleted => v1::Op::Delete,
        ApplyAction::Unchanged => v1::Op::Unchanged,
    };
    v1::ApplyResult {
        op: op.into(),
        r#ref: Some((&result.key).into()),
        revision: result.revision,
        changes: result.changes.iter().map(delta).collect(),
    }
}

pub(super) fn effective(effective: Effective, revision: u64) -> v1::Effective {
    v1::Effective {
        place: Some(place(&effective.place)),
        revision,
        hash: effective.hash,
        config_json: effective.config.to_string(),
        explain_json: text(effective.explain.as_ref()),
        rollout: effective.rollout.unwrap_or_default(),
    }
}

pub(super) fn history(page: Page<HistoryEntry>) -> v1::ListHistoryResponse {
    v1::ListHistoryResponse {
        items: page.items.into_iter().map(history_entry).collect(),
        next_page_token: page.next_page_token,
    }
}

fn history_entry(entry: HistoryEntry) -> v1::HistoryEntry {
    let op = match entry.op {
        Op::Create => v1::Op::Create,
        Op::Update => v1::Op::Update,
        Op::Delete => v1::Op::Delete,
        Op::Rollback => v1::Op::Rollback,
    };
    v1::HistoryEntry {
        revision: entry.revision,
        op: op.into(),
        time: time(entry.time),
        subject: entry.subject,
        request_id: entry.request_id,
        paths: entry.paths,
        document: entry.document.as_deref().map(document),
    }
}

pub(super) fn token(record: TokenRecord, token: String) -> v1::CreateTokenResponse {
    v1::CreateTokenResponse { id: record.id, token, expire_time: time(record.expire_time) }
}

/// Made once for all watchers that share the commit.
pub(super) fn commit(commit: &WatchCommit) -> v1::Commit {
    let make = || v1::Commit {
        revision: commit.revision,
        previous: commit.previous,
        time: time(commit.time),
        subject: commit.subject.clone(),
        changes: commit.changes.iter().map(change).collect(),
    };
    commit.wire.get_or_init(make).clone()
}

fn change((op, of): &(WatchOp, Arc<Document>)) -> v1::Change {
    let op = match op {
        WatchOp::Create => v1::Op::Create,
        WatchOp::Update => v1::Op::Update,
        WatchOp::Delete => v1::Op::Delete,
        WatchOp::Leave => v1::Op::Leave,
    };
    v1::Change { op: op.into(), document: Some(document(of)) }
}

#[cfg(test)]
mod tests {
    use blaze_domain::config::Labels;
    use serde_json::json;

    use super::*;

    fn robot() -> Arc<Document> {
        Arc::new(Document {
            key: "Node/robot-1".parse().unwrap(),
            uid: "u".into(),
            revision: 7,
            create_time: Timestamp::default(),
            update_time: Timestamp::default(),
            updated_by: "ops".into(),
            labels: Labels::new(),
            annotations: Labels::new(),
            spec: Arc::new(json!({"layer": "edge"})),
            status: None,
        })
    }

    #[test]
    fn a_difference_tells_null_from_nothing() {
        let wire = delta(&Delta {
            op: "replace",
            path: "/spec/a".into(),
            old: Some(Value::Null),
            value: None,
        });
        assert_eq!((wire.old_json.as_str(), wire.value_json.as_str()), ("null", ""));
    }

    #[test]
    fn a_deletion_in_a_history_has_no_document() {
        let mut entry = HistoryEntry {
            revision: 9,
            op: Op::Rollback,
            time: Timestamp::default(),
            subject: "ops".into(),
            request_id: "r1".into(),
            paths: vec!["/spec".into()],
            document: Some(robot()),
        };
        let wire = history_entry(entry.clone());
        assert_eq!(
            (wire.op(), wire.document.unwrap().spec_json.as_str()),
            (v1::Op::Rollback, r#"{"layer":"edge"}"#)
        );
        entry.op = Op::Delete;
        entry.document = None;
        assert_eq!(history_entry(entry).document, None);
    }
}
