//! How documents, commits, audit entries, answers and tokens are stored, alike in every store.
//!
//! ```text
//! CommitRecord ──encode──▶ EventRow        one per commit
//!                          VersionRow      one per change: the document as one JSON text
//!                          AuditRow, IdempotencyRow
//! rows ──decode──▶ Commit, Version, Document, AuditEntry, …
//! ```
//!
//! What users write is inside of JSON texts: no key of theirs becomes a column, nor a member that
//! the database looks at.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::sync::Arc;

use blaze_domain::config::{Document, Key, Labels, Timestamp};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::rows::{AuditRow, DocumentRow, EventRow, IdempotencyRow, TokenRow, VersionRow};
use super::{
    AuditEntry, Change, Commit, CommitRecord, IdempotencyRecord, Op, StoreError, TokenRecord,
    Version,
};

/// A commit record as rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EncodedCommit {
    pub(crate) event: EventRow,
    pub(crate) versions: Vec<VersionRow>,
    pub(crate) audit: Vec<AuditRow>,
    pub(crate) idempotency: Option<IdempotencyRow>,
}

/// Commits as rows; they must have changes and contiguous revisions.
pub(crate) fn encode_group(records: &[CommitRecord]) -> Result<Vec<EncodedCommit>, StoreError> {
    let mut expected = records.first().map(|record| record.commit.revision);
    let mut group = Vec::with_capacity(records.len());
    for record in records {
        let revision = record.commit.revision;
        if expected != Some(revision) || revision == 0 || record.commit.changes.is_empty() {
            return Err(corrupt(format_args!(
                "commit {revision} is empty or does not follow the one before it"
            )));
        }
        expected = Some(revision + 1);
        group.push(encode_commit(record)?);
    }
    Ok(group)
}

fn encode_commit(record: &CommitRecord) -> Result<EncodedCommit, StoreError> {
    let commit = &record.commit;
    let mut versions = Vec::with_capacity(commit.changes.len());
    for (position, change) in commit.changes.iter().enumerate() {
        versions.push(VersionRow {
            key: change.document.key.to_string(),
            revision: signed(commit.revision),
            position: i64::try_from(position).unwrap_or(i64::MAX),
            op: change.op.as_str().to_owned(),
            previous: change.previous.map(signed),
            time: commit.time.as_millis(),
            subject: commit.subject.clone(),
            request_id: commit.request_id.clone(),
            paths: json(&change.paths)?,
            document: document_text(&change.document)?,
        });
    }
    let bytes: usize = versions.iter().map(|version| version.document.len()).sum();
    let event = EventRow {
        revision: signed(commit.revision),
        batch: commit.batch.clone(),
        time: commit.time.as_millis(),
        subject: commit.subject.clone(),
        request_id: commit.request_id.clone(),
        changes: i64::try_from(versions.len()).unwrap_or(i64::MAX),
        bytes: i64::try_from(bytes).unwrap_or(i64::MAX),
    };
    let audit = record.audit.iter().map(AuditRow::encode).collect::<Result<_, _>>()?;
    let idempotency = record.idempotency.as_ref().map(IdempotencyRow::encode);
    Ok(EncodedCommit { event, versions, audit, idempotency })
}

/// What each document is after all of these changes, which ascend: its last version, which may be
/// its deletion.
pub(crate) fn last_versions<'a>(
    versions: impl IntoIterator<Item = &'a VersionRow>,
) -> BTreeMap<&'a str, &'a VersionRow> {
    let versions = versions.into_iter();
    versions.map(|version| (version.key.as_str(), version)).collect()
}

/// Commits from their events and the changes of all of them, both ascending. They must follow
/// `after` without a hole, and each must have all its changes.
pub(crate) fn decode_commits(
    after: u64,
    events: Vec<EventRow>,
    versions: Vec<VersionRow>,
) -> Result<Vec<Commit>, StoreError> {
    let mut versions = versions.into_iter().peekable();
    let mut commits = Vec::with_capacity(events.len());
    for (expected, event) in (signed(after) + 1..).zip(events) {
        if event.revision != expected {
            return Err(corrupt(format_args!(
                "commit {expected} is missing before {}",
                event.revision
            )));
        }
        let mut changes = Vec::new();
        while let Some(version) = versions.next_if(|version| version.revision <= event.revision) {
            changes.push(version.into_version()?.change);
        }
        if i64::try_from(changes.len()) != Ok(event.changes) {
            return Err(corrupt(format_args!(
                "commit {} has {} changes, but {} are there",
                event.revision,
                event.changes,
                changes.len()
            )));
        }
        commits.push(Commit {
            revision: unsigned(event.revision)?,
            batch: event.batch,
            time: Timestamp::from_millis(event.time),
            subject: event.subject,
            request_id: event.request_id,
            changes,
        });
    }
    Ok(commits)
}

impl VersionRow {
    /// Whether the document is there after this change.
    pub(crate) fn is_deletion(&self) -> bool {
        self.op == Op::Delete.as_str()
    }

    /// The document as it is from this change on.
    #[cfg(feature = "mongodb")]
    pub(crate) fn into_current(self) -> DocumentRow {
        DocumentRow { key: self.key, revision: self.revision, document: self.document }
    }

    pub(crate) fn into_version(self) -> Result<Version, StoreError> {
        let key: Key =
            self.key.parse().map_err(|error| corrupt(format_args!("a version: {error}")))?;
        Ok(Version {
            revision: unsigned(self.revision)?,
            time: Timestamp::from_millis(self.time),
            subject: self.subject,
            request_id: self.request_id,
            change: Change {
                op: op(&self.op)?,
                document: Arc::new(document(key, &self.document)?),
                previous: self.previous.map(unsigned).transpose()?,
                paths: parsed("paths", &self.paths)?,
            },
        })
    }
}

impl DocumentRow {
    pub(crate) fn into_document(self) -> Result<Document, StoreError> {
        let key: Key =
            self.key.parse().map_err(|error| corrupt(format_args!("a document: {error}")))?;
        document(key, &self.document)
    }
}

impl AuditRow {
    pub(crate) fn encode(entry: &AuditEntry) -> Result<Self, StoreError> {
        let key = entry.key.as_ref();
        Ok(Self {
            id: entry.id.clone(),
            time: entry.time.as_millis(),
            revision: entry.revision.map(signed),
            subject: entry.subject.clone(),
            roles: json(&entry.roles)?,
            action: entry.action.clone(),
            kind: key.map(|key| key.kind().to_string()),
            service: key.and_then(Key::service_name).map(ToString::to_string),
            name: key.map(|key| key.name().to_string()),
            allowed: entry.allowed,
            code: entry.code.clone(),
            paths: json(&entry.paths)?,
            request_id: entry.request_id.clone(),
            address: entry.address.clone(),
            detail: entry.detail.clone(),
        })
    }

    pub(crate) fn decode(self) -> Result<AuditEntry, StoreError> {
        let key = match (&self.kind, &self.name) {
            (Some(kind), Some(name)) => Some(audit_key(kind, self.service.as_deref(), name)?),
            _ => None,
        };
        Ok(AuditEntry {
            time: Timestamp::from_millis(self.time),
            revision: self.revision.map(unsigned).transpose()?,
            roles: parsed("roles", &self.roles)?,
            key,
            paths: parsed("paths", &self.paths)?,
            id: self.id,
            subject: self.subject,
            action: self.action,
            allowed: self.allowed,
            code: self.code,
            request_id: self.request_id,
            address: self.address,
            detail: self.detail,
        })
    }
}

fn audit_key(kind: &str, service: Option<&str>, name: &str) -> Result<Key, StoreError> {
    let text = match service {
        Some(service) => format!("{kind}/{service}/{name}"),
        None => format!("{kind}/{name}"),
    };
    text.parse().map_err(|error| corrupt(format_args!("an audit entry: {error}")))
}

impl IdempotencyRow {
    pub(crate) fn encode(record: &IdempotencyRecord) -> Self {
        Self {
            id: record.id.clone(),
            body: record.body.clone(),
            expires: record.expires.as_millis(),
            revision: signed(record.revision),
            answer: record.answer.clone(),
        }
    }

    pub(crate) fn decode(self) -> Result<IdempotencyRecord, StoreError> {
        Ok(IdempotencyRecord {
            expires: Timestamp::from_millis(self.expires),
            revision: unsigned(self.revision)?,
            id: self.id,
            body: self.body,
            answer: self.answer,
        })
    }
}

impl TokenRow {
    pub(crate) fn encode(token: &TokenRecord) -> Result<Self, StoreError> {
        Ok(Self {
            id: token.id.clone(),
            subject: token.subject.clone(),
            roles: json(&token.roles)?,
            layer: token.layer.clone(),
            create_time: token.create_time.as_millis(),
            expire_time: token.expire_time.as_millis(),
            revoke_time: token.revoke_time.map(Timestamp::as_millis),
        })
    }

    pub(crate) fn decode(self) -> Result<TokenRecord, StoreError> {
        Ok(TokenRecord {
            roles: parsed("roles", &self.roles)?,
            create_time: Timestamp::from_millis(self.create_time),
            expire_time: Timestamp::from_millis(self.expire_time),
            revoke_time: self.revoke_time.map(Timestamp::from_millis),
            id: self.id,
            subject: self.subject,
            layer: self.layer,
        })
    }
}

/// A document but for its key.
#[derive(Serialize, Deserialize)]
struct Stored<'a> {
    uid: Cow<'a, str>,
    revision: u64,
    create_time: i64,
    update_time: i64,
    updated_by: Cow<'a, str>,
    labels: Cow<'a, Labels>,
    annotations: Cow<'a, Labels>,
    spec: Cow<'a, Value>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    status: Option<Cow<'a, Value>>,
}

/// A document as JSON, without its key.
pub(crate) fn document_text(document: &Document) -> Result<String, StoreError> {
    json(&Stored {
        uid: Cow::Borrowed(&document.uid),
        revision: document.revision,
        create_time: document.create_time.as_millis(),
        update_time: document.update_time.as_millis(),
        updated_by: Cow::Borrowed(&document.updated_by),
        labels: Cow::Borrowed(&document.labels),
        annotations: Cow::Borrowed(&document.annotations),
        spec: Cow::Borrowed(&document.spec),
        status: document.status.as_ref().map(Cow::Borrowed),
    })
}

/// The document that [`document_text`] wrote.
pub(crate) fn document(key: Key, text: &str) -> Result<Document, StoreError> {
    let read: Stored<'_> =
        serde_json::from_str(text).map_err(|error| corrupt(format_args!("{key}: {error}")))?;
    Ok(Document {
        key,
        uid: read.uid.into_owned(),
        revision: read.revision,
        create_time: Timestamp::from_millis(read.create_time),
        update_time: Timestamp::from_millis(read.update_time),
        updated_by: read.updated_by.into_owned(),
        labels: read.labels.into_owned(),
        annotations: read.annotations.into_owned(),
        spec: Arc::new(read.spec.into_owned()),
        status: read.status.map(Cow::into_owned),
    })
}

fn op(word: &str) -> Result<Op, StoreError> {
    let all = [Op::Create, Op::Update, Op::Delete, Op::Rollback];
    let found = all.into_iter().find(|op| op.as_str() == word);
    found.ok_or_else(|| corrupt(format_args!("no change is called {word:?}")))
}

fn json<T: Serialize + ?Sized>(value: &T) -> Result<String, StoreError> {
    serde_json::to_string(value)
        .map_err(|error| corrupt(format_args!("it cannot be written as JSON: {error}")))
}

fn parsed(what: &str, text: &str) -> Result<Vec<String>, StoreError> {
    serde_json::from_str(text).map_err(|error| corrupt(format_args!("{what}: {error}")))
}

/// For what a store holds and this program did not write.
pub(crate) fn corrupt(what: impl Display) -> StoreError {
    StoreError::Corrupt(what.to_string())
}

/// Revisions are far below the limit of both types.
pub(crate) fn signed(revision: u64) -> i64 {
    i64::try_from(revision).unwrap_or(i64::MAX)
}

/// The other way round.
pub(crate) fn unsigned(revision: i64) -> Result<u64, StoreError> {
    u64::try_from(revision).map_err(|_| corrupt(format_args!("revision {revision}")))
}

#[cfg(test)]
#[path = "encode_tests.rs"]
mod tests;
