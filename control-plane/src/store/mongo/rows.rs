//! Rows as documents of MongoDB.
//!
//! Numbers are read in any width, as tools that copy databases do not keep it.

use mongodb::bson::{Bson, DateTime, Document, doc};

use crate::store::StoreError;
use crate::store::encode::corrupt;
use crate::store::rows::{AuditRow, DocumentRow, EventRow, IdempotencyRow, TokenRow, VersionRow};

/// `_id` of the record in `documents` that holds the floor. Keys of documents begin with a capital letter.
pub(super) const FLOOR: &str = "floor";

/// Bytes that a document takes beside its long texts.
pub(super) const OVERHEAD_BYTES: usize = 256;

pub(super) fn event(row: &EventRow, writer: &str) -> Document {
    doc! {
        "_id": row.revision, "batch": &row.batch, "writer": writer, "time": row.time, "subject": &row.subject,
        "request_id": &row.request_id, "changes": row.changes, "bytes": row.bytes,
    }
}

pub(super) fn read_event(found: &Document) -> Result<EventRow, StoreError> {
    Ok(EventRow {
        revision: integer(found, "_id")?,
        batch: text(found, "batch")?,
        time: integer(found, "time")?,
        subject: text(found, "subject")?,
        request_id: text(found, "request_id")?,
        changes: integer(found, "changes")?,
        bytes: integer(found, "bytes")?,
    })
}

/// Key and revision in one: versions of one key are together, and in order.
pub(super) fn version_id(key: &str, revision: i64) -> String {
    format!("{key}@{revision:016x}")
}

/// Key and revision of an `_id`.
pub(super) fn split_version_id(id: &str) -> Result<(&str, i64), StoreError> {
    let parts = id.rsplit_once('@');
    let parts = parts.and_then(|(key, revision)| Some((key, i64::from_str_radix(revision, 16).ok()?)));
    parts.ok_or_else(|| corrupt(format_args!("{id:?} names no version")))
}

/// Filter for the versions of a key with a revision below.
pub(super) fn versions_below(key: &str, below: i64) -> Document {
    doc! { "_id": { "$gte": version_id(key, 0), "$lt": version_id(key, below) } }
}

pub(super) fn version(row: &VersionRow) -> Document {
    doc! {
        "_id": version_id(&row.key, row.revision), "revision": row.revision, "position": row.position, "op": &row.op,
        "previous": row.previous.map_or(Bson::Null, Bson::Int64), "time": row.time, "subject": &row.subject,
        "request_id": &row.request_id, "paths": &row.paths, "document": &row.document,
    }
}

pub(super) fn read_version(found: &Document) -> Result<VersionRow, StoreError> {
    let id = text(found, "_id")?;
    let (key, _) = split_version_id(&id)?;
    Ok(VersionRow {
        key: key.to_owned(),
        revision: integer(found, "revision")?,
        position: integer(found, "position")?,
        op: text(found, "op")?,
        previous: optional_integer(found, "previous")?,
        time: integer(found, "time")?,
        subject: text(found, "subject")?,
        request_id: text(found, "request_id")?,
        paths: text(found, "paths")?,
        document: text(found, "document")?,
    })
}

pub(super) fn document(row: &DocumentRow) -> Document {
    doc! { "_id": &row.key, "revision": row.revision, "document": &row.document }
}

pub(super) fn read_document(found: &Document) -> Result<DocumentRow, StoreError> {
    Ok(DocumentRow {
        key: text(found, "_id")?,
        revision: integer(found, "revision")?,
        document: text(found, "document")?,
    })
}

pub(super) fn audit(row: &AuditRow) -> Document {
    doc! {
        "_id": &row.id, "time": DateTime::from_millis(row.time),
        "revision": row.revision.map_or(Bson::Null, Bson::Int64), "subject": &row.subject, "roles": &row.roles,
        "action": &row.action, "kind": optional(&row.kind), "service": optional(&row.service),
        "name": optional(&row.name), "allowed": row.allowed, "code": optional(&row.code), "paths": &row.paths,
        "request_id": &row.request_id, "address": &row.address, "detail": optional(&row.detail),
    }
}

pub(super) fn read_audit(found: &Document) -> Result<AuditRow, StoreError> {
    Ok(AuditRow {
        id: text(found, "_id")?,
        time: date(found, "time")?,
        revision: optional_integer(found, "revision")?,
        subject: text(found, "subject")?,
        roles: text(found, "roles")?,
        action: text(found, "action")?,
        kind: optional_text(found, "kind")?,
        service: optional_text(found, "service")?,
        name: optional_text(found, "name")?,
        allowed: found.get_bool("allowed").map_err(corrupt)?,
        code: optional_text(found, "code")?,
        paths: text(found, "paths")?,
        request_id: text(found, "request_id")?,
        address: text(found, "address")?,
        detail: optional_text(found, "detail")?,
    })
}

pub(super) fn idempotency(row: &IdempotencyRow) -> Document {
    doc! {
        "_id": &row.id, "body": &row.body, "expires": DateTime::from_millis(row.expires), "revision": row.revision,
        "answer": &row.answer,
    }
}

pub(super) fn read_idempotency(found: &Document) -> Result<IdempotencyRow, StoreError> {
    Ok(IdempotencyRow {
        id: text(found, "_id")?,
        body: text(found, "body")?,
        expires: date(found, "expires")?,
        revision: integer(found, "revision")?,
        answer: text(found, "answer")?,
    })
}

pub(super) fn token(row: &TokenRow) -> Document {
    doc! {
        "_id": &row.id, "subject": &row.subject, "roles": &row.roles, "layer": optional(&row.layer),
        "create_time": row.create_time, "expire_time": DateTime::from_millis(row.expire_time),
        "revoke_time": row.revoke_time.map_or(Bson::Null, Bson::Int64),
    }
}

pub(super) fn read_token(found: &Document) -> Result<TokenRow, StoreError> {
    Ok(TokenRow {
        id: text(found, "_id")?,
        subject: text(found, "subject")?,
        roles: text(found, "roles")?,
        layer: optional_text(found, "layer")?,
        create_time: integer(found, "create_time")?,
        expire_time: date(found, "expire_time")?,
        revoke_time: optional_integer(found, "revoke_time")?,
    })
}

fn optional(value: &Option<String>) -> Bson {
    value.clone().map_or(Bson::Null, Bson::String)
}

pub(super) fn text(found: &Document, name: &str) -> Result<String, StoreError> {
    found.get_str(name).map(str::to_owned).map_err(corrupt)
}

fn optional_text(found: &Document, name: &str) -> Result<Option<String>, StoreError> {
    match found.get(name) {
        None | Some(Bson::Null) => Ok(None),
        Some(_) => text(found, name).map(Some),
    }
}

pub(super) fn integer(found: &Document, name: &str) -> Result<i64, StoreError> {
    match found.get(name) {
        Some(Bson::Int64(value)) => Ok(*value),
        Some(Bson::Int32(value)) => Ok(i64::from(*value)),
        other => Err(corrupt(format_args!("{name} is {other:?} and no whole number"))),
    }
}

fn optional_integer(found: &Document, name: &str) -> Result<Option<i64>, StoreError> {
    match found.get(name) {
        None | Some(Bson::Null) => Ok(None),
        Some(_) => integer(found, name).map(Some),
    }
}

fn date(found: &Document, name: &str) -> Result<i64, StoreError> {
    found
        .get_datetime(name)
        .map(|date| date.timestamp_millis())
        .map_err(corrupt)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::conformance::samples;
    use crate::store::encode::encode_group;

    #[test]
    fn rows_are_read_as_they_were_written() {
        let mut record = samples::record(samples::commit(7, &["a", "b"]));
        record.idempotency = Some(samples::answer("x", 7));
        let group = encode_group(&[record]).unwrap();
        let commit = &group[0];
        assert_eq!(read_event(&event(&commit.event, "me")).unwrap(), commit.event);
        for row in &commit.versions {
            assert_eq!(read_version(&version(row)).unwrap(), *row);
        }
        for row in &commit.audit {
            assert_eq!(read_audit(&audit(row)).unwrap(), *row);
        }
        let row = commit.idempotency.clone().unwrap();
        assert_eq!(read_idempotency(&idempotency(&row)).unwrap(), row);
        let row = TokenRow::encode(&samples::token("t")).unwrap();
        assert_eq!(read_token(&token(&row)).unwrap(), row);
    }

    #[test]
    fn versions_of_one_key_are_together_and_in_order() {
        let mut ids: Vec<String> = ["Node/a", "Node/a-b", "Node/ab", "Node/a0"]
            .iter()
            .flat_map(|key| [300, 9, 4_096, 1_000_000_007].map(|revision| version_id(key, revision)))
            .collect();
        ids.sort();
        let split: Vec<(&str, i64)> = ids.iter().map(|id| split_version_id(id).unwrap()).collect();
        for pair in split.windows(2) {
            assert!(pair[0].0 != pair[1].0 || pair[0].1 < pair[1].1);
        }
        let mut keys: Vec<&str> = split.iter().map(|(key, _)| *key).collect();
        keys.dedup();
        assert_eq!(keys.len(), 4);
        assert!(split_version_id("Node/a").is_err());
        assert!(split_version_id("Node/a@x").is_err());
    }

    #[test]
    fn numbers_of_any_width_are_read_and_others_refused() {
        assert_eq!(integer(&doc! { "a": 5_i32 }, "a"), Ok(5));
        assert_eq!(integer(&doc! { "a": 5_i64 }, "a"), Ok(5));
        for wrong in [doc! {}, doc! { "a": "5" }, doc! { "a": 5.0 }] {
            assert!(integer(&wrong, "a").is_err());
        }
    }
}
