//! What lies in the tables, alike in every store; also the lines of a backup.
//!
//! Keys are `Kind/name` or `Instance/service/name`, times milliseconds since 1970.

use serde::{Deserialize, Serialize};

/// A current document.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct DocumentRow {
    /// `Kind/name` or `Instance/service/name`.
    pub(crate) key: String,
    pub(crate) revision: i64,
    /// JSON.
    pub(crate) document: String,
}

/// One change of a commit; what a document was from then on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct VersionRow {
    pub(crate) key: String,
    pub(crate) revision: i64,
    /// Place in its commit, from 0.
    pub(crate) position: i64,
    pub(crate) op: String,
    pub(crate) previous: Option<i64>,
    pub(crate) time: i64,
    pub(crate) subject: String,
    pub(crate) request_id: String,
    /// JSON array.
    pub(crate) paths: String,
    /// JSON.
    pub(crate) document: String,
}

/// A commit without its changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EventRow {
    pub(crate) revision: i64,
    pub(crate) batch: String,
    pub(crate) time: i64,
    pub(crate) subject: String,
    pub(crate) request_id: String,
    /// How many changes it has.
    pub(crate) changes: i64,
    /// How large their documents are together.
    pub(crate) bytes: i64,
}

/// A line of the audit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct AuditRow {
    pub(crate) id: String,
    pub(crate) time: i64,
    pub(crate) revision: Option<i64>,
    pub(crate) subject: String,
    /// JSON array.
    pub(crate) roles: String,
    pub(crate) action: String,
    pub(crate) kind: Option<String>,
    pub(crate) service: Option<String>,
    pub(crate) name: Option<String>,
    pub(crate) allowed: bool,
    pub(crate) code: Option<String>,
    /// JSON array.
    pub(crate) paths: String,
    pub(crate) request_id: String,
    pub(crate) address: String,
    pub(crate) detail: Option<String>,
}

/// An answer to repeat.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct IdempotencyRow {
    pub(crate) id: String,
    pub(crate) body: String,
    pub(crate) expires: i64,
    pub(crate) revision: i64,
    pub(crate) answer: String,
}

/// A token that was given out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct TokenRow {
    pub(crate) id: String,
    pub(crate) subject: String,
    /// JSON array.
    pub(crate) roles: String,
    pub(crate) layer: Option<String>,
    pub(crate) create_time: i64,
    pub(crate) expire_time: i64,
    pub(crate) revoke_time: Option<i64>,
}
