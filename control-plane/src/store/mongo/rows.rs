//! Rows as documents of MongoDB.
//!
//! Numbers are read in any width, as tools that copy databases do not keep it.

use mongodb::bson::{Bson, DateTime, Document, deserialize_from_document, doc};
use serde::de::DeserializeOwned;

use crate::store::StoreError;
use crate::store::encode::{EncodedCommit, corrupt};
use crate::store::rows::{AuditRow, DocumentRow, EventRow, IdempotencyRow, TokenRow, VersionRow};

/// `_id` of the record in `documents` that holds the floor, and how far the documents have come.
/// Keys of documents begin with a capital letter.
pub(super) const FLOOR: &str = "floor";

/// What the record [`FLOOR`] holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Guard {
    /// Commits up to this revision are gone.
    pub(super) floor: i64,
    /// The documents are those of this revision, or newer where they are being brought up to date.
    pub(super) folded: i64,
    /// How many steps that has taken.
    pub(super) turn: i64,
    /// How often the log was rewritten: what was read of it before is out of date.
    pub(super) rewrites: i64,
}

impl Guard {
    pub(super) fn read(found: &Document) -> Result<Self, StoreError> {
        Ok(Self {
            floor: integer(found, FLOOR)?,
            folded: integer(found, "folded")?,
            turn: integer(found, "turn")?,
            rewrites: integer(found, "rewrites")?,
        })
    }

    /// The record as long as nobody else has brought documents up to date.
    pub(super) fn not_folded(self) -> Document {
        doc! { "_id": FLOOR, "folded": self.folded, "turn": self.turn, "rewrites": self.rewrites }
    }

    /// The record as long as the floor is this one, and may be raised to another.
    pub(super) fn not_raised(self, floor: i64) -> Document {
        doc! {
            "_id": FLOOR,
            FLOOR: self.floor,
            "folded": { "$gte": floor },
            "rewrites": self.rewrites,
        }
    }
}

/// Bytes that a document takes beside its long texts.
pub(super) const OVERHEAD_BYTES: usize = 256;

/// One record of the log: commits that were written together.
#[derive(Debug, Default)]
pub(super) struct Record {
    pub(super) first: i64,
    pub(super) last: i64,
    /// Its commits.
    pub(super) events: Vec<EventRow>,
    /// Their changes, but for those that it had no room for.
    pub(super) versions: Vec<VersionRow>,
    pub(super) audit: Vec<AuditRow>,
    pub(super) answers: Vec<IdempotencyRow>,
}

impl Record {
    /// About.
    pub(super) fn bytes(&self) -> i64 {
        let documents: i64 = self.events.iter().map(|event| event.bytes).sum();
        let answers: usize = self.answers.iter().map(|answer| answer.answer.len()).sum();
        let audit = self.audit.iter().map(|entry| entry.paths.len() + 2 * OVERHEAD_BYTES);
        documents.saturating_add(i64::try_from(answers + audit.sum::<usize>()).unwrap_or(i64::MAX))
    }

    /// Revisions some of whose changes are in `versions` alone.
    pub(super) fn incomplete(&self) -> impl Iterator<Item = i64> {
        let inline = |revision: i64| {
            self.versions.iter().filter(move |row| row.revision == revision).count()
        };
        let lacks =
            move |event: &&EventRow| i64::try_from(inline(event.revision)) != Ok(event.changes);
        // Changes are counted only where a record is large enough to lack some.
        let count: i64 = self.events.iter().map(|event| event.changes).sum();
        let whole = i64::try_from(self.versions.len()) == Ok(count);
        self.events.iter().filter(move |_| !whole).filter(lacks).map(|event| event.revision)
    }
}

/// The record of some commits, with at most `inline` of their changes in it.
pub(super) fn record(commits: &[EncodedCommit], writer: &str, inline: usize) -> Document {
    let first = commits.first().map(|commit| &commit.event);
    let batch = first.map_or("", |event| event.batch.as_str());
    let events: Vec<Document> = commits.iter().map(|commit| event(&commit.event, batch)).collect();
    let versions = commits.iter().flat_map(|commit| &commit.versions).take(inline);
    let docs: Vec<Document> = versions.map(change).collect();
    let mut record = doc! {
        "_id": first.map_or(0, |event| event.revision),
        "last": commits.last().map_or(0, |commit| commit.event.revision),
        "batch": batch, "writer": writer, "commits": events, "docs": docs,
    };
    let entries = || commits.iter().flat_map(|commit| &commit.audit);
    if let (Some(oldest), Some(newest)) =
        (entries().map(|entry| &entry.id).min(), entries().map(|entry| &entry.id).max())
    {
        record.insert("audit_first", oldest);
        record.insert("audit_last", newest);
        record.insert("audit", entries().map(audit).collect::<Vec<_>>());
    }
    let answers = commits.iter().filter_map(|commit| commit.idempotency.as_ref());
    let answers: Vec<Document> = answers.map(idempotency).collect();
    if !answers.is_empty() {
        record.insert("answers", answers);
    }
    record
}

fn event(row: &EventRow, batch: &str) -> Document {
    let mut event = doc! {
        "time": row.time, "subject": &row.subject, "request_id": &row.request_id,
        "changes": row.changes,
        "bytes": row.bytes,
    };
    if row.batch != batch {
        event.insert("batch", &row.batch);
    }
    event
}

fn change(row: &VersionRow) -> Document {
    doc! {
        "key": &row.key, "revision": row.revision, "position": row.position, "op": &row.op,
        "previous": row.previous.map_or(Bson::Null, Bson::Int64), "paths": &row.paths,
        "document": &row.document,
    }
}

/// Reads a record; what was left out of it by the query is left out here.
pub(super) fn read_record(found: &Document) -> Result<Record, StoreError> {
    let first = integer(found, "_id")?;
    let batch = text(found, "batch")?;
    let mut events = Vec::new();
    for (revision, commit) in (first..).zip(members(found, "commits")) {
        let commit = commit?;
        events.push(EventRow {
            revision,
            batch: optional_text(commit, "batch")?.unwrap_or_else(|| batch.clone()),
            time: integer(commit, "time")?,
            subject: text(commit, "subject")?,
            request_id: text(commit, "request_id")?,
            changes: integer(commit, "changes")?,
            bytes: integer(commit, "bytes")?,
        });
    }
    let versions = members(found, "docs").map(|change| read_change(first, &events, change?));
    Ok(Record {
        first,
        last: integer(found, "last")?,
        versions: versions.collect::<Result<_, _>>()?,
        audit: members(found, "audit").map(|entry| read_audit(entry?)).collect::<Result<_, _>>()?,
        answers: members(found, "answers")
            .map(|answer| read_idempotency(answer?))
            .collect::<Result<_, _>>()?,
        events,
    })
}

fn read_change(
    first: i64,
    events: &[EventRow],
    found: &Document,
) -> Result<VersionRow, StoreError> {
    let revision = integer(found, "revision")?;
    let event = usize::try_from(revision - first).ok().and_then(|place| events.get(place));
    let event = event
        .ok_or_else(|| corrupt(format_args!("commit {revision} is not in its record {first}")))?;
    Ok(VersionRow {
        key: text(found, "key")?,
        revision,
        position: integer(found, "position")?,
        op: text(found, "op")?,
        previous: optional_integer(found, "previous")?,
        time: event.time,
        subject: event.subject.clone(),
        request_id: event.request_id.clone(),
        paths: text(found, "paths")?,
        document: text(found, "document")?,
    })
}

/// The documents of an array; none if it is not there.
pub(super) fn members<'a>(
    found: &'a Document,
    name: &str,
) -> impl Iterator<Item = Result<&'a Document, StoreError>> + use<'a> {
    let all = found.get_array(name).map(Vec::as_slice).unwrap_or_default();
    all.iter().map(|member| {
        member.as_document().ok_or_else(|| corrupt("a record holds what is no document"))
    })
}

/// Key and revision in one: versions of one key are together, and in order.
pub(super) fn version_id(key: &str, revision: i64) -> String {
    format!("{key}@{revision:016x}")
}

/// Key and revision of an `_id`.
pub(super) fn split_version_id(id: &str) -> Result<(&str, i64), StoreError> {
    let parts = id.rsplit_once('@');
    let parts =
        parts.and_then(|(key, revision)| Some((key, i64::from_str_radix(revision, 16).ok()?)));
    parts.ok_or_else(|| corrupt(format_args!("{id:?} names no version")))
}

/// Filter for the versions of a key with a revision below.
pub(super) fn versions_below(key: &str, below: i64) -> Document {
    doc! { "_id": { "$gte": version_id(key, 0), "$lt": version_id(key, below) } }
}

pub(super) fn version(row: &VersionRow) -> Document {
    doc! {
        "_id": version_id(&row.key, row.revision), "revision": row.revision,
        "position": row.position, "op": &row.op,
        "previous": row.previous.map_or(Bson::Null, Bson::Int64), "time": row.time,
        "subject": &row.subject,
        "request_id": &row.request_id, "paths": &row.paths, "document": &row.document,
    }
}

pub(super) fn read_version(found: &Document) -> Result<VersionRow, StoreError> {
    let id = text(found, "_id")?;
    let (key, _) = split_version_id(&id)?;
    let row: VersionRow = read(found, "key")?;
    Ok(VersionRow { key: key.to_owned(), ..row })
}

/// A row whose members are those of the document; its `_id` is called otherwise in the row.
fn read<T: DeserializeOwned>(found: &Document, id: &str) -> Result<T, StoreError> {
    let members = found.iter().map(|(name, value)| {
        let name = if name == "_id" { id } else { name };
        let value = match value {
            Bson::DateTime(time) => Bson::Int64(time.timestamp_millis()),
            other => other.clone(),
        };
        (name.to_owned(), value)
    });
    deserialize_from_document(members.collect()).map_err(corrupt)
}

pub(super) fn document(row: &DocumentRow) -> Document {
    doc! { "_id": &row.key, "revision": row.revision, "document": &row.document }
}

pub(super) fn read_document(found: &Document) -> Result<DocumentRow, StoreError> {
    read(found, "key")
}

pub(super) fn audit(row: &AuditRow) -> Document {
    doc! {
        "_id": &row.id, "time": DateTime::from_millis(row.time),
        "revision": row.revision.map_or(Bson::Null, Bson::Int64), "subject": &row.subject,
        "roles": &row.roles,
        "action": &row.action, "kind": optional(&row.kind), "service": optional(&row.service),
        "name": optional(&row.name), "allowed": row.allowed, "code": optional(&row.code),
        "paths": &row.paths,
        "request_id": &row.request_id, "address": &row.address, "detail": optional(&row.detail),
    }
}

pub(super) fn read_audit(found: &Document) -> Result<AuditRow, StoreError> {
    read(found, "id")
}

pub(super) fn idempotency(row: &IdempotencyRow) -> Document {
    doc! {
        "_id": &row.id, "body": &row.body, "expires": DateTime::from_millis(row.expires),
        "revision": row.revision,
        "answer": &row.answer,
    }
}

pub(super) fn read_idempotency(found: &Document) -> Result<IdempotencyRow, StoreError> {
    read(found, "id")
}

pub(super) fn token(row: &TokenRow) -> Document {
    doc! {
        "_id": &row.id, "subject": &row.subject, "roles": &row.roles, "layer": optional(&row.layer),
        "create_time": row.create_time, "expire_time": DateTime::from_millis(row.expire_time),
        "revoke_time": row.revoke_time.map_or(Bson::Null, Bson::Int64),
    }
}

pub(super) fn read_token(found: &Document) -> Result<TokenRow, StoreError> {
    read(found, "id")
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::encode::encode_group;
    use crate::store::samples;

    #[test]
    fn rows_are_read_as_they_were_written() {
        let mut record = samples::record(samples::commit(7, &["a", "b"]));
        record.idempotency = Some(samples::answer("x", 7));
        let mut next = samples::record(samples::commit(8, &["c"]));
        next.commit = std::sync::Arc::new(crate::store::Commit {
            batch: record.commit.batch.clone(),
            ..(*next.commit).clone()
        });
        let group = encode_group(&[record, next]).unwrap();
        let found = read_record(&super::record(&group, "me", usize::MAX)).unwrap();
        assert_eq!((found.first, found.last), (7, 8));
        assert_eq!(found.events, [group[0].event.clone(), group[1].event.clone()]);
        assert_eq!(found.versions, [group[0].versions.clone(), group[1].versions.clone()].concat());
        assert_eq!(found.audit, [group[0].audit.clone(), group[1].audit.clone()].concat());
        assert_eq!(found.answers, [group[0].idempotency.clone().unwrap()]);
        assert_eq!(found.incomplete().count(), 0);
        let part = read_record(&super::record(&group, "me", 1)).unwrap();
        assert_eq!(part.incomplete().collect::<Vec<_>>(), [7, 8]);
        let commit = &group[0];
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
            .flat_map(|key| {
                [300, 9, 4_096, 1_000_000_007].map(|revision| version_id(key, revision))
            })
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
