//! Watches: each has a place in the log and reads on from there; nothing is copied or kept per
//! watcher but that place.
//!
//! ```text
//! since ─▶ store (commits that the memory no longer has, on the state rebuilt at `since`) ─▶ log ─▶ live
//! ```

use std::collections::VecDeque;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{Code, Document, Key, Kind, Problem};
use blaze_domain::{LayerName, ServiceName};
use futures::StreamExt as _;
use futures::stream::BoxStream;
use rand::RngExt as _;
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::committer::{now, unavailable};
use super::log::{Applied, Log};
use super::types::{Caller, WatchCommit, WatchItem, WatchOp, WatchQuery};
use super::view::{View, view};
use crate::auth::{Claims, Revocations};
use crate::store::{Change, Commit, Store};
use blaze_domain::config::placement::Placement;
use blaze_domain::config::state::{Effect, Held, State};

/// Between two bookmarks of a watch with nothing to tell.
const BOOKMARK: Duration = Duration::from_secs(15);
/// Commits that a watcher may be behind once it has caught up.
const MAX_BEHIND: usize = 1000;
/// Bytes that it may be behind.
const MAX_BEHIND_BYTES: usize = 8 * 1024 * 1024;
/// Commits read from the store at once.
const READ: usize = 256;
/// Every stream ends by itself after a time in this range, so that load spreads over processes
/// again.
const LIFE: std::ops::Range<u64> = 30 * 60..40 * 60;

/// What a watcher looks at.
pub(crate) struct Filter {
    kind: Option<Kind>,
    name: Option<String>,
    service: Option<ServiceName>,
    layer: Option<LayerName>,
    selector: Option<LabelSelector>,
    view: View,
    /// Documents as they are stored, with their secrets encrypted; else as users see them.
    as_stored: bool,
}

impl Filter {
    pub(crate) fn new(query: &WatchQuery, caller: &Caller) -> Result<Self, Problem> {
        let selector = match &query.label_selector {
            Some(text) => Some(super::service::selector(text)?),
            None => None,
        };
        Ok(Self {
            kind: query.kind,
            name: query.name.clone(),
            service: query.service.clone(),
            layer: query.layer.clone(),
            selector,
            view: view(&caller.claims),
            as_stored: false,
        })
    }

    /// What a layer sees, as it is stored.
    fn stored(layer: &LayerName) -> Self {
        Self {
            kind: None,
            name: None,
            service: None,
            layer: None,
            selector: None,
            view: View::of_layer(layer),
            as_stored: true,
        }
    }

    fn is_everything(&self) -> bool {
        let Self { kind, name, service, layer, selector, view, as_stored } = self;
        kind.is_none()
            && name.is_none()
            && service.is_none()
            && layer.is_none()
            && selector.is_none()
            && view.layer().is_none()
            && !as_stored
    }

    fn matches(&self, document: &Document, placement: &Placement) -> bool {
        let key = &document.key;
        self.kind.is_none_or(|kind| kind == key.kind())
            && self.name.as_ref().is_none_or(|name| name == key.name().as_str())
            && self.service.as_ref().is_none_or(|service| is_of_service(key, service))
            && self.layer.as_ref().is_none_or(|layer| is_in_layer(key, placement, layer))
            && self.selector.as_ref().is_none_or(|selector| selector.matches(&document.labels))
            && self.view.sees(placement)
    }

    /// What an effect is to this watcher.
    fn seen(&self, effect: &Effect) -> Option<(WatchOp, Arc<Document>)> {
        let matching = |side: &Option<(Arc<Held>, Placement)>| {
            let (held, placement) = side.as_ref()?;
            let document = if self.as_stored { &held.document } else { &held.shown };
            self.matches(document, placement).then(|| Arc::clone(document))
        };
        match (matching(&effect.before), matching(&effect.after)) {
            (None, Some(document)) if effect.before.is_none() => Some((WatchOp::Create, document)),
            (None, Some(document)) => Some((WatchOp::Update, document)),
            (Some(_), Some(document)) => {
                (!effect.moved_only).then_some((WatchOp::Update, document))
            }
            (Some(last), None) if effect.after.is_none() => Some((WatchOp::Delete, last)),
            (Some(last), None) => Some((WatchOp::Leave, last)),
            (None, None) => None,
        }
    }

    fn commit(&self, commit: &Commit, effects: &[Effect], previous: u64) -> Option<WatchCommit> {
        let changes: Vec<_> = effects.iter().filter_map(|effect| self.seen(effect)).collect();
        (!changes.is_empty()).then(|| WatchCommit {
            revision: commit.revision,
            previous,
            time: commit.time,
            subject: commit.subject.clone(),
            changes,
            json: OnceLock::new(),
            wire: OnceLock::new(),
        })
    }
}

/// Instances of a service, and the service itself.
fn is_of_service(key: &Key, service: &ServiceName) -> bool {
    match key.kind() {
        Kind::Instance => key.service_name() == Some(service),
        Kind::Service => key.name().as_str() == service.as_str(),
        Kind::Layer | Kind::Node | Kind::Rollout => false,
    }
}

/// Layers, nodes and instances by where they are; services and roll-outs by who may see them.
pub(crate) fn is_in_layer(key: &Key, placement: &Placement, layer: &LayerName) -> bool {
    match key.kind() {
        Kind::Layer | Kind::Node | Kind::Instance => placement.layer.as_ref() == Some(layer),
        Kind::Service | Kind::Rollout => placement.visible.contains(layer),
    }
}

/// What all watches of a process share.
pub(crate) struct Watches {
    pub(crate) store: Arc<dyn Store>,
    pub(crate) log: Arc<Log>,
    pub(crate) revocations: Revocations,
    /// Cancelled when streams shall end.
    pub(crate) ending: CancellationToken,
}

/// What a watcher gets, until [`WatchItem::End`].
pub type WatchStream = BoxStream<'static, WatchItem>;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    Running,
    /// The last bookmark was given.
    Closing,
    Ended,
}

struct Watcher {
    shared: Arc<Watches>,
    filter: Filter,
    everything: bool,
    caller: Caller,
    /// Everything up to here was told or is no business of this watcher.
    cursor: u64,
    /// Everything up to here was given out.
    told: u64,
    /// The last commit that is to be told, or where it began.
    previous: u64,
    /// Commits to tell, with their bytes, about.
    pending: VecDeque<(Arc<WatchCommit>, usize)>,
    pending_bytes: usize,
    /// State at `cursor` while commits come from the store.
    rebuilt: Option<State>,
    /// It has caught up once: from then on it may not fall far behind, unless it is patient.
    live: bool,
    /// It may fall behind as far as the history reaches: what it is behind is not kept for it.
    patient: bool,
    /// A bookmark is due as soon as all is told.
    bookmark_due: bool,
    next_bookmark: Instant,
    end: Instant,
    head: watch::Receiver<u64>,
    revoked: watch::Receiver<u64>,
    stage: Stage,
}

impl Watches {
    /// A stream from a revision on; the caller has checked that it is within the history.
    pub(crate) fn open(
        self: &Arc<Self>,
        caller: &Caller,
        filter: Filter,
        since: u64,
        timeout_s: Option<u32>,
    ) -> WatchStream {
        let life = rand::rng().random_range(LIFE);
        let life = timeout_s.map_or(life, |timeout| life.min(u64::from(timeout)));
        self.stream(caller, filter, since, life, false)
    }

    /// A stream of what a layer sees, documents as they are stored. It never ends because its
    /// reader is slow.
    pub(crate) fn open_stored(
        self: &Arc<Self>,
        caller: &Caller,
        layer: &LayerName,
        since: u64,
    ) -> WatchStream {
        let life = rand::rng().random_range(LIFE);
        self.stream(caller, Filter::stored(layer), since, life, true)
    }

    fn stream(
        self: &Arc<Self>,
        caller: &Caller,
        filter: Filter,
        since: u64,
        life: u64,
        patient: bool,
    ) -> WatchStream {
        let watcher = Watcher {
            shared: Arc::clone(self),
            everything: filter.is_everything(),
            filter,
            caller: caller.clone(),
            cursor: since,
            told: since,
            previous: since,
            pending: VecDeque::new(),
            pending_bytes: 0,
            rebuilt: None,
            live: false,
            patient,
            bookmark_due: true,
            next_bookmark: Instant::now() + BOOKMARK,
            end: Instant::now() + Duration::from_secs(life),
            head: self.log.subscribe(),
            revoked: self.revocations.changed(),
            stage: Stage::Running,
        };
        let start = futures::stream::iter([WatchItem::Bookmark(since)]);
        let rest = futures::stream::unfold(watcher, |mut watcher| async move {
            let item = watcher.next().await?;
            Some((item, watcher))
        });
        start.chain(rest).boxed()
    }
}

impl Watches {
    /// Why every stream of this caller must end now.
    pub(crate) fn trouble(&self, claims: &Claims) -> Option<Problem> {
        if self.ending.is_cancelled() {
            let detail =
                "the service is ending; go on with the last id, at another process or soon";
            return Some(Problem::new(Code::ShuttingDown, detail).retry_after(1));
        }
        let expired = claims.expires_s.is_some_and(|expires| now().as_millis() / 1000 >= expires);
        let revoked = claims.token_id.as_ref().is_some_and(|id| self.revocations.is_revoked(id));
        (expired || revoked).then(|| {
            let detail = "the token ran out or was revoked; go on with the last id and a new token";
            Problem::new(Code::Unauthenticated, detail)
        })
    }

    /// Waits until a time, or until a stream of this caller must end before.
    pub(crate) async fn ended(&self, claims: &Claims, until: Instant) -> Option<Problem> {
        let mut revoked = self.revocations.changed();
        let deadline = expiry(claims).map_or(until, |end| until.min(end));
        loop {
            if let Some(problem) = self.trouble(claims) {
                return Some(problem);
            }
            if Instant::now() >= until {
                return None;
            }
            tokio::select! {
                // The sender lives in `self`.
                _ = revoked.changed() => {}
                () = self.ending.cancelled() => {}
                () = tokio::time::sleep_until(deadline) => {}
            }
        }
    }

    /// When a stream that begins now ends by itself.
    pub(crate) fn life_end() -> Instant {
        Instant::now() + Duration::from_secs(rand::rng().random_range(LIFE))
    }
}

/// When a token runs out.
fn expiry(claims: &Claims) -> Option<Instant> {
    let left = claims.expires_s?.saturating_mul(1000).saturating_sub(now().as_millis()).max(0) + 1;
    Some(Instant::now() + Duration::from_millis(left.unsigned_abs()))
}

impl Watcher {
    async fn next(&mut self) -> Option<WatchItem> {
        match self.stage {
            Stage::Ended => return None,
            Stage::Closing => return Some(self.finish(None)),
            Stage::Running => {}
        }
        loop {
            if let Some(problem) = self.trouble() {
                return Some(self.finish(Some(problem)));
            }
            // Also while there is always more to tell: then it ends where it has come to.
            if Instant::now() >= self.end && !self.pending.is_empty() {
                self.pending.clear();
                self.pending_bytes = 0;
                self.stage = Stage::Closing;
                return Some(WatchItem::Bookmark(self.told));
            }
            if let Err(problem) = self.read().await {
                return Some(self.finish(Some(problem)));
            }
            if let Some((commit, bytes)) = self.pending.pop_front() {
                self.pending_bytes -= bytes;
                self.told = commit.revision;
                return Some(WatchItem::Commit(commit));
            }
            self.told = self.cursor;
            let is_behind = self.rebuilt.is_some() || self.cursor < self.shared.log.revision();
            if is_behind && Instant::now() < self.end {
                continue;
            }
            self.live |= !is_behind;
            let timed_out = Instant::now() >= self.end;
            if timed_out {
                self.stage = Stage::Closing;
            }
            if self.bookmark_due || timed_out || Instant::now() >= self.next_bookmark {
                self.bookmark_due = false;
                self.next_bookmark = Instant::now() + BOOKMARK;
                return Some(WatchItem::Bookmark(self.cursor));
            }
            self.wait().await;
        }
    }

    fn finish(&mut self, problem: Option<Problem>) -> WatchItem {
        self.stage = Stage::Ended;
        self.pending.clear();
        self.pending_bytes = 0;
        WatchItem::End(problem.map(Box::new))
    }

    /// Why the stream must end now.
    fn trouble(&self) -> Option<Problem> {
        if let Some(problem) = self.shared.trouble(&self.caller.claims) {
            return Some(problem);
        }
        if self.live
            && !self.patient
            && (self.pending.len() > MAX_BEHIND || self.pending_bytes > MAX_BEHIND_BYTES)
        {
            return Some(too_slow());
        }
        None
    }

    /// Takes in what there is after the cursor, from the log or, further back, from the store.
    async fn read(&mut self) -> Result<(), Problem> {
        if self.rebuilt.is_none() {
            // A watcher that has caught up looks at all there is, to know how far it is behind.
            let counts = self.live && !self.patient;
            let limit = if counts { usize::MAX } else { READ };
            if !counts && !self.pending.is_empty() {
                return Ok(());
            }
            match self.shared.log.after(self.cursor, limit) {
                Some(commits) => {
                    for applied in commits {
                        self.take(&applied);
                    }
                    return match self.trouble() {
                        Some(problem) => Err(problem),
                        None => Ok(()),
                    };
                }
                None if counts => return Err(too_slow()),
                None => self.rebuild().await?,
            }
        }
        if self.pending.is_empty() {
            self.read_store().await?;
        }
        Ok(())
    }

    fn take(&mut self, applied: &Applied) {
        let revision = applied.commit.revision;
        let seen = if self.everything {
            Some(applied.shared_commit(&self.filter))
        } else {
            let commit = self.filter.commit(&applied.commit, &applied.effects, self.previous);
            commit.map(Arc::new)
        };
        self.push(revision, seen, applied.bytes);
    }

    fn push(&mut self, revision: u64, seen: Option<Arc<WatchCommit>>, bytes: usize) {
        self.cursor = revision;
        match seen {
            Some(commit) => {
                self.previous = revision;
                self.pending_bytes += bytes;
                self.pending.push_back((commit, bytes));
            }
            // What was skipped is told by the next bookmark, when there is nothing else to tell.
            None => self.bookmark_due |= !self.live,
        }
    }

    /// The state at the cursor, from the newest one and what the store knows of the past.
    async fn rebuild(&mut self) -> Result<(), Problem> {
        let mut state = self.shared.log.state();
        let until = state.revision();
        let past = self.shared.store.documents_at(self.cursor, until).await;
        state.overlay(self.cursor, past.map_err(|error| unavailable(&error))?);
        self.rebuilt = Some(state);
        Ok(())
    }

    async fn read_store(&mut self) -> Result<(), Problem> {
        let batch = self.shared.store.commits_after(self.cursor, READ).await;
        let batch = batch.map_err(|error| unavailable(&error))?;
        if batch.floor > self.cursor {
            return Err(trimmed(batch.floor, self.shared.log.revision()));
        }
        let Some(mut state) = self.rebuilt.take() else {
            return Ok(());
        };
        for commit in &batch.commits {
            let effects = state.apply(commit.revision, commit.changes.iter().map(Change::step));
            let previous = if self.everything { commit.revision - 1 } else { self.previous };
            let seen = self.filter.commit(commit, &effects, previous).map(Arc::new);
            self.push(commit.revision, seen, super::log::commit_bytes(commit));
        }
        // As soon as the log reaches back to the cursor it is quicker.
        if self.shared.log.after(self.cursor, 1).is_none() && !batch.commits.is_empty() {
            self.rebuilt = Some(state);
        }
        Ok(())
    }

    async fn wait(&mut self) {
        let deadline = self.next_bookmark.min(self.end);
        let deadline = expiry(&self.caller.claims).map_or(deadline, |end| deadline.min(end));
        tokio::select! {
            // The senders live in `shared`.
            _ = self.head.changed() => {}
            _ = self.revoked.changed() => {}
            () = self.shared.ending.cancelled() => {}
            () = tokio::time::sleep_until(deadline) => {}
        }
    }
}

impl Applied {
    /// The commit as it is for everybody who sees everything.
    fn shared_commit(&self, everything: &Filter) -> Arc<WatchCommit> {
        let make = || {
            let previous = self.commit.revision - 1;
            let commit = everything.commit(&self.commit, &self.effects, previous);
            Arc::new(commit.unwrap_or_else(|| WatchCommit {
                revision: self.commit.revision,
                previous,
                time: self.commit.time,
                subject: self.commit.subject.clone(),
                changes: Vec::new(),
                json: OnceLock::new(),
                wire: OnceLock::new(),
            }))
        };
        Arc::clone(self.unfiltered.get_or_init(make))
    }
}

fn too_slow() -> Problem {
    let detail = format!(
        "the watcher is more than {MAX_BEHIND} events or {} MiB behind: read faster, or go on with \
         the last id",
        MAX_BEHIND_BYTES / (1024 * 1024)
    );
    Problem::new(Code::WatchTooSlow, detail)
}

/// The refusal of a revision that the history does not have any more.
pub(crate) fn trimmed(floor: u64, revision: u64) -> Problem {
    let detail = format!(
        "the history reaches back to revision {floor}: list again, then watch from the list's \
         revision"
    );
    let mut problem = Problem::new(Code::RevisionTrimmed, detail).at(revision);
    problem.oldest_revision = Some(floor);
    problem
}
