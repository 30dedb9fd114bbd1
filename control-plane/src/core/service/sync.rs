//! What a worker is told: the whole view of its layer or what was committed since it was last here,
//! then every commit.
//!
//! ```text
//! Hello ─▶ Welcome ─▶ (Snapshot … Snapshot, last) ─▶ Commit, Commit, Bookmark, … ─▶ GoAway
//!            resumed? no ───┘                            └─ a watch of the layer's view, with secrets in clear
//! ```

use std::sync::Arc;
use std::sync::OnceLock;
use std::time::Duration;

use blaze_domain::config::placement::placement;
use blaze_domain::config::state::{Held, State};
use blaze_domain::config::{Code, Document, Problem, secret};
use blaze_domain::{LayerName, NodeName};
use futures::StreamExt as _;
use futures::stream::{self, BoxStream};
use rand::RngExt as _;
use serde_json::Value;
use tokio::sync::OwnedSemaphorePermit;

use super::super::committer::now;
use super::super::secrets;
use super::super::types::{Caller, ReadOptions, WatchCommit, WatchItem, WatchOp};
use super::super::view::view;
use super::super::workers::{Acknowledged, WorkerName, WorkerSession};
use super::ConfigService;
use crate::auth::Right;
use crate::secrets::Keyring;

/// The protocol of `Sync` that is spoken here. Version 2: Hello says whether texts of secrets are
/// wanted.
pub const SYNC_PROTOCOL: u32 = 2;
/// The oldest one that is spoken here.
pub const OLDEST_SYNC_PROTOCOL: u32 = SYNC_PROTOCOL - 1;
/// A part of a snapshot ends with the document that makes it this large, in bytes of JSON: with the
/// largest document it is still below the 1 MiB that a part may have.
const PART_BYTES: usize = 512 * 1024;
/// What a document takes besides its spec, labels and annotations, about.
const OVERHEAD_BYTES: usize = 512;
/// Snapshots that are on their way at once: after an outage everybody wants one, and users are to
/// be answered meanwhile.
pub(super) const SNAPSHOTS: usize = 8;
/// Whoever has waited for its turn so long gets its snapshot beside the others: some of those may
/// read slowly, or not at all.
const TURN: Duration = Duration::from_secs(2);
/// When a worker is told to come again: not all at once.
const AGAIN_MS: std::ops::Range<u32> = 100..2000;
/// Name of a worker, in bytes.
const MAX_ID_BYTES: usize = 256;

/// Who asks, and what it has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyncHello {
    /// Newest protocol that it speaks.
    pub protocol: u32,
    /// Whose view.
    pub layer: LayerName,
    /// Where it runs.
    pub node: Option<NodeName>,
    /// Its name.
    pub worker_id: String,
    /// Version of the program.
    pub version: String,
    /// Store that its copy is of; empty: it has none.
    pub store_id: String,
    /// Revision of its copy; 0: it has none.
    pub revision: u64,
    /// Digest of its copy; empty: it does not say.
    pub digest: String,
    /// It tells nobody the texts of secrets: they are not to be sent.
    pub without_texts: bool,
}

/// What a worker is told. After `End` comes nothing.
#[derive(Debug, Clone)]
pub enum SyncItem {
    /// The answer to Hello.
    Welcome {
        /// Protocol that is spoken from now on.
        protocol: u32,
        /// Which store this is.
        store_id: String,
        /// Where the store stands.
        revision: u64,
        /// Commits follow; else a snapshot does.
        resumed: bool,
    },
    /// A part of the view.
    Snapshot {
        /// Of which revision.
        revision: u64,
        /// Secrets in clear, where the connection is safe.
        documents: Vec<Arc<Document>>,
        /// No part comes after it.
        last: bool,
    },
    /// A commit.
    Commit(Arc<WatchCommit>),
    /// Everything up to this revision was told.
    Bookmark {
        /// The revision.
        revision: u64,
        /// Of what the layer sees then; empty where that cannot be told any more.
        digest: String,
        /// Other workers of the same layer and node that are connected, for people.
        beside: Vec<String>,
    },
    /// The stream ends well: come again.
    GoAway {
        /// After how long, in ms.
        retry_after_ms: u32,
        /// Why, for people.
        reason: String,
    },
    /// Why it ends.
    End(Option<Box<Problem>>),
}

/// A worker's open stream.
pub struct SyncStream {
    items: BoxStream<'static, SyncItem>,
    session: Arc<WorkerSession>,
}

impl SyncStream {
    /// What it gives, and who it is.
    #[must_use]
    pub fn into_parts(self) -> (BoxStream<'static, SyncItem>, Arc<WorkerSession>) {
        (self.items, self.session)
    }
}

/// What turns documents of the store into what a worker gets.
#[derive(Clone)]
struct Clear {
    keyring: Arc<Keyring>,
    /// Texts of secrets are wanted, and nobody else can read what is sent.
    with_texts: bool,
}

impl Clear {
    fn document(&self, held: &Arc<Document>) -> Arc<Document> {
        if !secret::contains(&held.spec) {
            return Arc::clone(held);
        }
        let mut clear = (**held).clone();
        clear.spec = Arc::new(match self.with_texts {
            true => secrets::revealed(&self.keyring, held, &held.spec),
            false => secret::redact(&held.spec).into_owned(),
        });
        Arc::new(clear)
    }

    /// Of what is gone the name is enough: with everything that a layer lost at once the message
    /// could be too large.
    fn changed(&self, op: WatchOp, held: &Arc<Document>) -> Arc<Document> {
        match op {
            WatchOp::Create | WatchOp::Update => self.document(held),
            WatchOp::Delete | WatchOp::Leave => Arc::new(Document {
                spec: Arc::new(Value::Object(serde_json::Map::new())),
                status: None,
                ..(**held).clone()
            }),
        }
    }

    fn commit(&self, commit: &WatchCommit) -> Arc<WatchCommit> {
        let changes = commit.changes.iter();
        Arc::new(WatchCommit {
            revision: commit.revision,
            previous: commit.previous,
            time: commit.time,
            subject: commit.subject.clone(),
            changes: changes.map(|(op, held)| (*op, self.changed(*op, held))).collect(),
            json: OnceLock::new(),
            wire: OnceLock::new(),
        })
    }
}

impl ConfigService {
    /// Opens a worker's stream. `is_safe`: nobody else can read what is sent (TLS, or this machine
    /// alone).
    ///
    /// # Errors
    /// [`Problem`]: the token is not that layer's worker's, the greeting makes no sense, or the store does not answer.
    pub async fn sync(
        &self,
        caller: &Caller,
        hello: SyncHello,
        is_safe: bool,
    ) -> Result<SyncStream, Problem> {
        self.authorize(&caller.claims, Right::Sync)?;
        view(&caller.claims).check_layer(&hello.layer)?;
        check_hello(&hello)?;
        // Another process may have committed what this worker has already.
        let state = self.read_state(&ReadOptions::default()).await?;
        let resumed = self.can_resume(&hello, &state).await;
        let since = if resumed { hello.revision } else { state.revision() };
        let session = self.enter(&hello)?.with_address(caller.address);
        let clear = Clear {
            keyring: Arc::clone(&self.inner.evaluator.keyring),
            with_texts: is_safe && !hello.without_texts,
        };
        tracing::info!(
            layer = %hello.layer, node = hello.node.as_ref().map(NodeName::as_str),
            worker = hello.worker_id,
            version = hello.version, revision = hello.revision, resumed, "a worker has come"
        );
        let welcome = SyncItem::Welcome {
            protocol: SYNC_PROTOCOL.min(hello.protocol),
            store_id: self.inner.store_id.clone(),
            revision: state.revision(),
            resumed,
        };
        let snapshot = match resumed {
            true => stream::empty().boxed(),
            false => self.snapshot(state, hello.layer.clone(), clear.clone()),
        };
        let watch = self.inner.watches.open_stored(caller, &hello.layer, since);
        let (service, name) = (self.clone(), session.name().clone());
        let told = watch.flat_map(move |item| stream::iter(service.told(&name, &clear, item)));
        let first = stream::iter([welcome]);
        Ok(SyncStream {
            items: first.chain(snapshot).chain(told).boxed(),
            session: Arc::new(session),
        })
    }

    /// Notes what a worker says it has. A roll-out that failed there ends everywhere.
    pub fn acknowledged(&self, session: &WorkerSession, has: Acknowledged) {
        self.end_failed(session, &has);
        session.said(has, now());
    }

    fn enter(&self, hello: &SyncHello) -> Result<WorkerSession, Problem> {
        let name = WorkerName {
            layer: hello.layer.clone(),
            node: hello.node.clone(),
            id: hello.worker_id.clone(),
        };
        let has = Acknowledged::new(hello.revision, hello.digest.clone(), [], []);
        let entered = self.inner.workers.enter(name, hello.version.clone(), has, now());
        entered.map_err(|error| Problem::new(Code::Overloaded, error.to_string()).retry_after(30))
    }

    /// Whether the commits after what a worker has are all there, and what it has is what it should
    /// have.
    async fn can_resume(&self, hello: &SyncHello, state: &State) -> bool {
        if hello.store_id != self.inner.store_id
            || hello.revision == 0
            || hello.revision > state.revision()
        {
            return false;
        }
        if self.check_floor(state, hello.revision).await.is_err() {
            return false;
        }
        // What is too far back is compared at the first bookmark.
        let then = match hello.revision == state.revision() {
            true => Some(state.clone()),
            false => self.inner.log.state_at(hello.revision),
        };
        let wanted = then.map(|then| self.inner.digests.of(&then, &hello.layer));
        hello.digest.is_empty() || wanted.is_none_or(|wanted| wanted == hello.digest)
    }

    /// The view of a layer, in parts.
    fn snapshot(
        &self,
        state: State,
        layer: LayerName,
        clear: Clear,
    ) -> BoxStream<'static, SyncItem> {
        let room = Arc::clone(&self.inner.snapshots);
        let begin = async move {
            // It is never closed.
            let place = tokio::time::timeout(TURN, room.acquire_owned()).await;
            let place = place.ok().and_then(Result::ok);
            let seen = state
                .all()
                .filter(|(_, held)| placement(&state, &held.document).visible.contains(&layer))
                .map(|(_, held)| Arc::clone(held));
            let parts = Parts {
                revision: state.revision(),
                held: seen.collect::<Vec<_>>().into_iter().peekable(),
                clear,
                has_ended: false,
                _place: place,
            };
            stream::iter(parts)
        };
        stream::once(begin).flatten().boxed()
    }

    /// What an item of the watch is to a worker.
    fn told(&self, name: &WorkerName, clear: &Clear, item: WatchItem) -> Vec<SyncItem> {
        let go_away = |reason: &str| SyncItem::GoAway {
            retry_after_ms: rand::rng().random_range(AGAIN_MS),
            reason: reason.to_owned(),
        };
        match item {
            WatchItem::Commit(commit) => vec![SyncItem::Commit(clear.commit(&commit))],
            WatchItem::Bookmark(revision) => {
                let state = self.inner.log.state_at(revision);
                let digest = state.map(|state| self.inner.digests.of(&state, &name.layer));
                vec![SyncItem::Bookmark {
                    revision,
                    digest: digest.unwrap_or_default(),
                    beside: self.inner.workers.beside(name),
                }]
            }
            WatchItem::End(None) => {
                vec![go_away("the stream has been open for long"), SyncItem::End(None)]
            }
            WatchItem::End(Some(problem)) => match problem.code {
                Code::ShuttingDown => vec![go_away("the service is ending"), SyncItem::End(None)],
                Code::RevisionTrimmed => {
                    vec![go_away("the history was trimmed"), SyncItem::End(None)]
                }
                _ => vec![SyncItem::End(Some(problem))],
            },
        }
    }
}

/// Parts of a snapshot, made one at a time.
struct Parts {
    revision: u64,
    held: std::iter::Peekable<std::vec::IntoIter<Arc<Held>>>,
    clear: Clear,
    has_ended: bool,
    _place: Option<OwnedSemaphorePermit>,
}

impl Iterator for Parts {
    type Item = SyncItem;

    fn next(&mut self) -> Option<SyncItem> {
        if self.has_ended {
            return None;
        }
        let (mut documents, mut bytes) = (Vec::new(), 0);
        while bytes < PART_BYTES
            && let Some(held) = self.held.next()
        {
            bytes += size(&held);
            documents.push(self.clear.document(&held.document));
        }
        self.has_ended = self.held.peek().is_none();
        Some(SyncItem::Snapshot { revision: self.revision, documents, last: self.has_ended })
    }
}

fn size(held: &Held) -> usize {
    let words = held.document.labels.iter().chain(&held.document.annotations);
    held.bytes
        + words.map(|(name, value)| name.len() + value.len() + 8).sum::<usize>()
        + OVERHEAD_BYTES
}

fn check_hello(hello: &SyncHello) -> Result<(), Problem> {
    let fault = match hello {
        SyncHello { protocol: 0, .. } => "protocol 0: there is none before 1",
        SyncHello { worker_id, .. } if worker_id.is_empty() => {
            "worker_id is empty: several workers could not be told apart"
        }
        SyncHello { worker_id, version, .. }
            if worker_id.len().max(version.len()) > MAX_ID_BYTES =>
        {
            "worker_id or version has more than 256 bytes"
        }
        SyncHello { store_id, digest, .. } if store_id.len().max(digest.len()) > MAX_ID_BYTES => {
            "store_id or digest has more than 256 bytes"
        }
        _ => return Ok(()),
    };
    Err(Problem::new(Code::InvalidRequest, format!("Hello: {fault}")))
}
