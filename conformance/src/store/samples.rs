//! Documents and commits to write.
#![allow(clippy::expect_used, reason = "names written here are valid")]

use std::sync::Arc;

use blaze_domain::config::{Document, Key, Timestamp};
use serde_json::json;

use blaze_config::store::{
    AuditEntry, Change, Commit, CommitRecord, IdempotencyRecord, Op, TokenRecord,
};

/// A day in the life of the samples; each revision is a second later.
pub(crate) const START_MS: i64 = 1_795_244_400_000;

/// When the samples write a revision.
pub(crate) fn time(revision: u64) -> Timestamp {
    Timestamp::from_millis(START_MS + i64::try_from(revision).unwrap_or(0) * 1_000)
}

/// `Node/name`.
pub(crate) fn key(name: &str) -> Key {
    format!("Node/{name}").parse().expect("a node's name")
}

/// A node with all that must survive.
pub(crate) fn node(name: &str, revision: u64) -> Document {
    Document {
        key: key(name),
        uid: format!("uid-{name}-{revision}"),
        revision,
        create_time: time(1),
        update_time: time(revision),
        updated_by: "ops".to_owned(),
        labels: [("site.example/lab".to_owned(), "é".to_owned())].into(),
        annotations: [("$note".to_owned(), "a.b\u{0}c".to_owned())].into(),
        spec: Arc::new(json!({
            "layer": "edge", "type": "static",
            "config": {
                "z": revision, "a": 0.1, "$set": {"_id": [1, null, {"a.b": {}}]}, "": "",
                "big": 9_007_199_254_740_991_i64,
                "password": {"$secret": {"key": "e1", "nonce": "AAAA", "text": "BBBB",
                    "version": revision}},
            },
        })),
        status: None,
    }
}

/// A change of a node, to what [`node`] makes of it.
pub(crate) fn change(op: Op, name: &str, revision: u64, previous: Option<u64>) -> Change {
    Change {
        op,
        document: Arc::new(node(name, revision)),
        previous,
        paths: vec!["/spec/config/z".to_owned()],
    }
}

/// A commit that creates nodes.
pub(crate) fn commit(revision: u64, names: &[&str]) -> Commit {
    let changes = names.iter().map(|name| change(Op::Create, name, revision, None)).collect();
    commit_of(revision, changes)
}

/// A commit of some changes, in a batch of its own.
pub(crate) fn commit_of(revision: u64, changes: Vec<Change>) -> Commit {
    Commit {
        revision,
        batch: format!("batch-{}", uuid::Uuid::now_v7()),
        time: time(revision),
        subject: "ops".to_owned(),
        request_id: format!("request-{revision}"),
        changes,
    }
}

/// A commit with one audit entry.
pub(crate) fn record(commit: Commit) -> CommitRecord {
    let entry = audit("update", Some(commit.revision));
    CommitRecord { commit: Arc::new(commit), audit: vec![entry], idempotency: None }
}

/// An audit entry.
pub(crate) fn audit(action: &str, revision: Option<u64>) -> AuditEntry {
    AuditEntry {
        id: uuid::Uuid::now_v7().to_string(),
        time: blaze_config::store::upkeep::now(),
        revision,
        subject: "ops".to_owned(),
        roles: vec!["operator".to_owned(), "viewer".to_owned()],
        action: action.to_owned(),
        key: Some("Instance/slam/0".parse().expect("an instance's name")),
        allowed: revision.is_some(),
        code: revision.is_none().then(|| "permission_denied".to_owned()),
        paths: vec!["/spec".to_owned()],
        request_id: "request".to_owned(),
        address: "127.0.0.1".to_owned(),
        detail: revision.is_none().then(|| "no right".to_owned()),
    }
}

/// An answer that is kept for a day.
pub(crate) fn answer(id: &str, revision: u64) -> IdempotencyRecord {
    let day = 24 * 3_600 * 1_000;
    IdempotencyRecord {
        id: id.to_owned(),
        body: "sha256:00".to_owned(),
        expires: Timestamp::from_millis(blaze_config::store::upkeep::now().as_millis() + day),
        revision,
        answer: r#"{"revision":1,"$set":{"a.b":null}}"#.to_owned(),
    }
}

/// A token of an hour.
pub(crate) fn token(id: &str) -> TokenRecord {
    let now = blaze_config::store::upkeep::now().as_millis();
    TokenRecord {
        id: id.to_owned(),
        subject: "ops".to_owned(),
        roles: vec!["viewer".to_owned()],
        layer: Some("edge".to_owned()),
        create_time: Timestamp::from_millis(now),
        expire_time: Timestamp::from_millis(now + 3_600_000),
        revoke_time: None,
    }
}
