//! What goes in and out of the core. REST and gRPC translate to and from these and decide nothing
//! themselves.

use std::net::IpAddr;
use std::sync::{Arc, OnceLock};

use blaze_domain::config::diff::Delta;
use blaze_domain::config::{Document, Key, Kind, Labels, Problem, Timestamp};
use blaze_domain::{LayerName, NodeName, ServiceName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::auth::Claims;
use crate::store::Op;

/// Who asks, and from where.
#[derive(Debug, Clone)]
pub struct Caller {
    /// What the token says.
    pub claims: Arc<Claims>,
    /// Of the request, for log and audit.
    pub request_id: String,
    /// Of the client.
    pub address: IpAddr,
}

/// How a read is to be answered.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Older data is allowed, and the store is not asked.
    pub cached: bool,
    /// Wait up to 5 s until the answer reflects this revision.
    pub min_revision: Option<u64>,
    /// As it was at this revision.
    pub at_revision: Option<u64>,
    /// Secrets as text.
    pub reveal: bool,
}

/// What a change insists on.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Precondition {
    /// Nothing said: allowed only where nothing can be lost.
    #[default]
    None,
    /// One of these revisions.
    Revisions(Vec<u64>),
    /// Any that exists.
    Any,
    /// None exists.
    Absent,
}

/// The part of a document that a user writes.
#[derive(Debug, Clone, PartialEq)]
pub struct DocumentInput {
    /// Kind and name.
    pub key: Key,
    /// Labels.
    pub labels: Labels,
    /// Annotations.
    pub annotations: Labels,
    /// Spec, secrets as text or redacted.
    pub spec: Value,
}

/// A request that may come twice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Idempotency {
    /// The client's key, 1 to 128 visible ASCII characters, without quotes.
    pub key: String,
    /// Path of the request (REST), or `grpc/<method>`.
    pub path: String,
    /// Hash of the body.
    pub body: [u8; 32],
}

/// What the answer says, and at which revision.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer<T> {
    /// `Blaze-Revision`: of a read, the revision that it reflects; of a write, the write's own.
    pub revision: u64,
    /// The first answer again.
    pub replayed: bool,
    /// The answer.
    pub value: T,
}

/// A document after a write.
#[derive(Debug, Clone, PartialEq)]
pub struct Written {
    /// Secrets redacted.
    pub document: Arc<Document>,
    /// Whether it is new.
    pub created: bool,
}

/// Which documents.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ListQuery {
    /// Of which kind.
    pub kind: Option<Kind>,
    /// Instances of this service; `None` with kind Instance: of all.
    pub service: Option<ServiceName>,
    /// In this layer: placed there, or on a node of it.
    pub layer: Option<LayerName>,
    /// On this node.
    pub node: Option<NodeName>,
    /// Kubernetes label selector.
    pub label_selector: Option<String>,
    /// 1 to 1000; `None`: 100.
    pub limit: Option<u32>,
    /// Of the page before; empty: the first page.
    pub page_token: String,
}

/// One page.
#[derive(Debug, Clone, PartialEq)]
pub struct Page<T> {
    /// The entries.
    pub items: Vec<T>,
    /// For the next page; empty on the last.
    pub next_page_token: String,
}

/// One document of `apply`.
#[derive(Debug, Clone, PartialEq)]
pub struct ApplyItem {
    /// What it is to be; of a deletion only the key counts.
    pub input: DocumentInput,
    /// `revision` in the document: its precondition.
    pub revision: Option<u64>,
    /// `delete: true`.
    pub delete: bool,
}

/// `apply` as a whole.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ApplyRequest {
    /// The documents.
    pub items: Vec<ApplyItem>,
    /// Only say what would happen.
    pub dry_run: bool,
    /// Delete what this selector matches and is not among the items.
    pub prune: Option<String>,
    /// How many documents `prune` may delete beyond 20: exactly as many as it would.
    pub prune_confirm: Option<u64>,
}

/// What `apply` did to one document.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ApplyAction {
    /// It is new.
    Created,
    /// It was changed.
    Updated,
    /// It is gone.
    Deleted,
    /// It was so already.
    Unchanged,
}

impl ApplyAction {
    /// The word in the answer.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Created => "created",
            Self::Updated => "updated",
            Self::Deleted => "deleted",
            Self::Unchanged => "unchanged",
        }
    }
}

/// What happened to one document.
#[derive(Debug, Clone, PartialEq)]
pub struct ApplyResult {
    /// Which.
    pub key: Key,
    /// What.
    pub action: ApplyAction,
    /// Its revision.
    pub revision: u64,
    /// Differences, secrets redacted.
    pub changes: Vec<Delta>,
}

/// Where a configuration takes effect. Absent parts are `null` in the answer.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct Place {
    /// Which service.
    pub service: Option<ServiceName>,
    /// Which instance of it.
    pub instance: Option<blaze_domain::InstanceName>,
    /// In which layer.
    pub layer: Option<LayerName>,
    /// On which node.
    pub node: Option<NodeName>,
}

/// Answer of `apply` and `revert`.
#[derive(Debug, Clone, PartialEq)]
pub struct ApplyReport {
    /// Nothing was written.
    pub dry_run: bool,
    /// Of the commit; the present one if there was none.
    pub revision: u64,
    /// In the order of the request, then what was pruned.
    pub results: Vec<ApplyResult>,
    /// Whose effective configuration changes; the first 1,000.
    pub affected: Vec<Place>,
    /// All of them.
    pub affected_total: u64,
}

/// An effective configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Effective {
    /// For whom.
    pub place: Place,
    /// `sha256:…`.
    pub hash: String,
    /// Name of the roll-out that is part of it.
    pub rollout: Option<String>,
    /// Secrets redacted (or as text, if that was asked for and allowed).
    pub config: Value,
    /// Where each key comes from, as in the contract.
    pub explain: Option<Value>,
}

/// One line of a document's history.
#[derive(Debug, Clone, PartialEq)]
pub struct HistoryEntry {
    /// Revision of the commit.
    pub revision: u64,
    /// What happened.
    pub op: Op,
    /// When.
    pub time: Timestamp,
    /// Whose token.
    pub subject: String,
    /// Which request.
    pub request_id: String,
    /// What changed.
    pub paths: Vec<String>,
    /// The whole document, if asked for; `None` for a deletion.
    pub document: Option<Arc<Document>>,
}

/// What a watch looks at.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WatchQuery {
    /// Start after this revision; `None`: now.
    pub since: Option<u64>,
    /// Only this kind.
    pub kind: Option<Kind>,
    /// Only this name.
    pub name: Option<String>,
    /// Only instances of this service (and, without `kind`, the service itself).
    pub service: Option<ServiceName>,
    /// Only what is in this layer.
    pub layer: Option<LayerName>,
    /// Kubernetes label selector.
    pub label_selector: Option<String>,
    /// Ends cleanly after so many seconds, 1 to 3600.
    pub timeout_s: Option<u32>,
}

/// What happened to a watched document.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WatchOp {
    /// It is new.
    Create,
    /// It was changed, or came into the filter.
    Update,
    /// It is gone.
    Delete,
    /// It exists and no longer matches.
    Leave,
}

impl WatchOp {
    /// The word in the stream.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Create => "create",
            Self::Update => "update",
            Self::Delete => "delete",
            Self::Leave => "leave",
        }
    }
}

/// One commit as one watcher sees it. Watchers with the same view share it.
#[derive(Debug)]
pub struct WatchCommit {
    /// Its revision.
    pub revision: u64,
    /// The commit before it in this stream's view.
    pub previous: u64,
    /// When.
    pub time: Timestamp,
    /// Whose token.
    pub subject: String,
    /// At least one.
    pub changes: Vec<(WatchOp, Arc<Document>)>,
    /// The JSON of the event, made once.
    pub json: OnceLock<Bytes>,
    /// The message of gRPC, made once.
    pub wire: OnceLock<blaze_proto::v1::Commit>,
}

/// What a watch gives. After `End` comes nothing.
#[derive(Debug, Clone)]
pub enum WatchItem {
    /// A commit.
    Commit(Arc<WatchCommit>),
    /// Everything up to this revision was told.
    Bookmark(u64),
    /// Why it ends; `None`: as was asked, the last bookmark was given.
    End(Option<Box<Problem>>),
}

/// Request for a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenRequest {
    /// `sub`.
    pub subject: String,
    /// `roles`.
    pub roles: Vec<String>,
    /// `layer`.
    pub layer: Option<String>,
    /// Seconds from now, 1 to 31,536,000.
    pub expires_in_s: u32,
}
