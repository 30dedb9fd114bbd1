//! The one task of a process that writes: it takes what waits, works out all of it on one state and
//! commits it together.
//!
//! ```text
//! queue ─▶ batch ─▶ evaluate each on the state after the ones before ─▶ one transaction ─▶ log ─▶ answers
//!            ▲                                                              │ another process was first
//!            └───────────────── read its commits, evaluate again ◀──────────┘
//! ```
//!
//! Revision n + 1 can be written once only. Its success proves that nobody has committed since n,
//! and so that every check that was made on the state n was exact, also those that ended in a
//! refusal. A batch that writes nothing has no such proof; it asks the store for its newest
//! revision before it answers.

use std::collections::HashSet;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use blaze_domain::config::{Applied, Code, Problem, Timestamp};
use parking_lot::Mutex;
use rand::RngExt as _;
use tokio::sync::{OwnedSemaphorePermit, mpsc, oneshot};
use tokio::time::Instant;

use super::affected::{MAX_CANDIDATES, MAX_KEPT_CANDIDATES};
use super::evaluate::{Evaluator, Request};
use super::log::Log;
use super::report::{AnswerKind, Done};
use super::view::view;
use crate::store::{
    AuditEntry, Commit, CommitError, CommitRecord, IdempotencyRecord, Op, Store, StoreError,
};
use blaze_domain::config::state::State;

/// Requests that may wait, at most.
pub(crate) const QUEUE: usize = 4096;
/// Requests in one transaction, at most.
const MAX_BATCH: usize = 256;
/// Bytes of the bodies of requests that may wait, at most, about: those whose callers have left
/// wait on.
pub(crate) const QUEUE_BYTES: usize = 64 * 1024 * 1024;
/// Bytes of their bodies, at most, about.
const MAX_BATCH_BYTES: usize = 4 * 1024 * 1024;
/// Bytes of the bodies of a batch up to which it is worked out at once.
const QUICK_BYTES: usize = 64 * 1024;
/// How long one batch is tried.
const DEADLINE: Duration = Duration::from_secs(10);
/// How long a batch is worked out before it is written with what there is: while it is, other
/// processes may be first, and all of it is worked out again.
const SHARE: Duration = Duration::from_millis(100);
/// Pause before a batch is tried again after another process was first, at most.
const JITTER: Duration = Duration::from_millis(4);
/// How long an idempotency record is kept.
const IDEMPOTENCY: i64 = 24 * 60 * 60 * 1000;
/// Commits that are read at once.
const READ: usize = 1000;

/// A request whose answer is kept.
#[derive(Debug, Clone)]
pub(crate) struct Once {
    /// Hash of subject, path and key.
    pub(crate) id: String,
    /// Hash of the body.
    pub(crate) body: String,
}

/// Idempotency keys of requests that are running in this process.
pub(crate) type RunningKeys = Arc<Mutex<HashSet<String>>>;

/// An idempotency key is in use here until this goes, also when whoever asked goes before.
pub(crate) struct Running {
    keys: RunningKeys,
    id: String,
}

impl Running {
    /// `None` if it is in use already.
    pub(crate) fn begin(keys: &RunningKeys, id: &str) -> Option<Self> {
        keys.lock()
            .insert(id.to_owned())
            .then(|| Self { keys: Arc::clone(keys), id: id.to_owned() })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.keys.lock().remove(&self.id);
    }
}

/// What the committer answers.
#[derive(Debug)]
pub(crate) enum Finished {
    /// It was done now, or there was nothing to do.
    Done(Box<Done>),
    /// It had been done before: revision and text of the first answer.
    Before(u64, String),
}

/// One request in the queue.
pub(crate) struct Queued {
    pub(crate) request: Arc<Request>,
    pub(crate) answer: AnswerKind,
    pub(crate) once: Option<Once>,
    /// Of the body, about.
    pub(crate) bytes: usize,
    pub(crate) reply: oneshot::Sender<Result<Finished, Problem>>,
    pub(crate) running: Option<Running>,
    /// Its share of [`QUEUE_BYTES`].
    pub(crate) _room: OwnedSemaphorePermit,
}

impl Queued {
    fn finish(self, result: Result<Finished, Problem>) {
        let Self { reply, running, .. } = self;
        // First, for whoever gets the answer may ask again at once.
        drop(running);
        // Who has gone needs no answer; what was asked for is done all the same.
        let _ = reply.send(result);
    }
}

/// What is told of every transaction.
#[derive(Debug, Clone, Copy)]
pub struct CommitReport {
    /// How long the store took.
    pub duration: Duration,
    /// Requests that were written together.
    pub requests: usize,
    /// Whether it was written.
    pub committed: bool,
    /// Another process was first.
    pub conflict: bool,
}

/// Told of every transaction.
pub type OnCommit = Arc<dyn Fn(CommitReport) + Send + Sync>;

/// Now, for people.
pub(crate) fn now() -> Timestamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_millis(i64::try_from(since.as_millis()).unwrap_or(i64::MAX))
}

/// Reads commits of other processes until the log has `at_least`, or all there are.
pub(crate) async fn follow(
    store: &dyn Store,
    log: &Log,
    at_least: Option<u64>,
) -> Result<(), StoreError> {
    loop {
        let from = log.revision();
        if at_least.is_some_and(|wanted| from >= wanted) {
            return Ok(());
        }
        let batch = store.commits_after(from, READ).await?;
        if batch.floor > from {
            if log.revision() != from {
                continue;
            }
            // What is between was trimmed: this process has slept too long and begins anew.
            let snapshot = store.load().await?;
            tracing::warn!(
                from,
                to = snapshot.revision,
                "commits were trimmed before they were read; starting from the documents"
            );
            log.reset(State::new(snapshot.revision, snapshot.documents), snapshot.floor);
            continue;
        }
        log.raise_floor(batch.floor);
        let count = batch.commits.len();
        for commit in batch.commits {
            let revision = commit.revision;
            if !log.append(Arc::new(commit)) {
                return Err(StoreError::Corrupt(format!(
                    "commit {revision} does not follow {}",
                    log.revision()
                )));
            }
        }
        if count == 0 {
            return match at_least {
                Some(wanted) if log.revision() < wanted => Err(StoreError::Corrupt(format!(
                    "the newest revision is said to be {wanted}, but after {} there is none",
                    log.revision()
                ))),
                _ => Ok(()),
            };
        }
    }
}

/// The committer of a process.
pub(crate) struct Committer {
    pub(crate) store: Arc<dyn Store>,
    pub(crate) log: Arc<Log>,
    pub(crate) evaluator: Arc<Evaluator>,
    pub(crate) queue: mpsc::Receiver<Queued>,
    pub(crate) on_commit: OnCommit,
    /// The state in memory may lack a commit of our own.
    pub(crate) doubtful: bool,
}

/// What became of one request of a batch, before it is known whether the batch is written.
enum Tried {
    Refused(Problem),
    Before(u64, String),
    Done(Box<Done>),
}

impl Committer {
    /// Commits until nobody can ask any more.
    pub(crate) async fn run(mut self) {
        while let Some(first) = self.queue.recv().await {
            let mut bytes = first.bytes;
            let mut batch = vec![first];
            while batch.len() < MAX_BATCH && bytes < MAX_BATCH_BYTES {
                let Ok(next) = self.queue.try_recv() else { break };
                bytes += next.bytes;
                batch.push(next);
            }
            self.commit(batch).await;
        }
    }

    async fn commit(&mut self, mut batch: Vec<Queued>) {
        let mut deadline = Instant::now() + DEADLINE;
        loop {
            if self.doubtful {
                if let Err(error) = follow(&*self.store, &self.log, None).await {
                    return refuse(batch, &unavailable(&error));
                }
                self.doubtful = false;
            }
            match self.try_batch(&batch).await {
                Ok(tried) => {
                    let rest = batch.split_off(tried.len());
                    answer(batch, tried);
                    if rest.is_empty() {
                        return;
                    }
                    batch = rest;
                    deadline = Instant::now() + DEADLINE;
                    continue;
                }
                Err(Again::Refuse(problem)) => return refuse(batch, &problem),
                Err(Again::Follow) => {
                    if let Err(error) = follow(&*self.store, &self.log, None).await {
                        return refuse(batch, &unavailable(&error));
                    }
                }
            }
            if Instant::now() >= deadline {
                let problem = Problem::new(
                    Code::Overloaded,
                    "other processes were first again and again; try later",
                );
                return refuse(batch, &problem.retry_after(1));
            }
            let pause = rand::rng().random_range(Duration::ZERO..=JITTER);
            tokio::time::sleep(pause).await;
        }
    }

    /// What became of the first ones: of all, unless that takes long.
    async fn try_batch(&mut self, batch: &[Queued]) -> Result<Vec<Tried>, Again> {
        let time = now();
        let mut work = Vec::with_capacity(batch.len());
        for queued in batch {
            work.push(Work {
                request: Arc::clone(&queued.request),
                answer: queued.answer,
                once: queued.once.clone(),
                before: self.done_before(queued, time).await?,
            });
        }
        let start = self.log.state();
        // Who is told of an answer may read what it speaks of.
        let is_ahead = |one: &Work| {
            matches!(
                one.before,
                Some(Tried::Before(revision, _)) if revision > start.revision(),
            )
        };
        if work.iter().any(is_ahead) {
            return Err(Again::Follow);
        }
        let is_long = batch.iter().map(|queued| queued.bytes).sum::<usize>() > QUICK_BYTES
            || start.has_schemas()
            || start.has_big()
            || work.iter().any(Work::may_take_long);
        let (records, tried) = if is_long {
            // Beside the threads that serve, so that they go on meanwhile.
            let (evaluator, start) = (Arc::clone(&self.evaluator), start.clone());
            let worked =
                tokio::task::spawn_blocking(move || work_out(&evaluator, &start, work, time)).await;
            worked.map_err(|error| not_worked_out(&error))?
        } else {
            // A fault of ours in one change must not end the committer. What it works on is
            // dropped.
            let worked = AssertUnwindSafe(|| work_out(&self.evaluator, &start, work, time));
            std::panic::catch_unwind(worked).map_err(|_| not_worked_out(&"it panicked"))?
        };
        if records.is_empty() {
            self.check_newest(&start).await?;
            return Ok(tried);
        }
        let begun = Instant::now();
        let result = self.store.commit(&records).await;
        (self.on_commit)(CommitReport {
            duration: begun.elapsed(),
            requests: records.len(),
            committed: result.is_ok(),
            conflict: matches!(result, Err(CommitError::Conflict)),
        });
        match result {
            Ok(()) => {
                for record in records {
                    if !self.log.append(record.commit) {
                        self.doubtful = true;
                    }
                }
                Ok(tried)
            }
            Err(CommitError::Conflict) => Err(Again::Follow),
            Err(CommitError::NotWritten(error)) => Err(Again::Refuse(unavailable(&error))),
            Err(CommitError::Unknown(error)) => {
                self.doubtful = true;
                Err(Again::Refuse(outcome_unknown(&error)))
            }
        }
    }

    /// Nothing is written, so nothing proves that the state is the newest: ask.
    async fn check_newest(&self, state: &State) -> Result<(), Again> {
        if self.store.alone().is_some_and(|above| state.revision() >= above) {
            return Ok(());
        }
        match self.store.head().await {
            Ok(head) if head > state.revision() => Err(Again::Follow),
            Ok(_) => Ok(()),
            Err(error) => Err(Again::Refuse(unavailable(&error))),
        }
    }

    async fn done_before(&self, queued: &Queued, time: Timestamp) -> Result<Option<Tried>, Again> {
        let Some(once) = &queued.once else { return Ok(None) };
        let found = self.store.idempotency(&once.id, time).await;
        let found = found.map_err(|error| Again::Refuse(unavailable(&error)))?;
        Ok(found.map(|record| {
            if record.body == once.body {
                Tried::Before(record.revision, record.answer)
            } else {
                let detail =
                    "the Idempotency-Key was used for a request with another body: use a new key";
                Tried::Refused(Problem::new(Code::IdempotencyKeyReused, detail))
            }
        }))
    }
}

/// One request of a batch, without who waits for its answer.
struct Work {
    request: Arc<Request>,
    answer: AnswerKind,
    once: Option<Once>,
    /// It was done before, or cannot be done.
    before: Option<Tried>,
}

impl Work {
    /// Whether it may take longer than its size says.
    fn may_take_long(&self) -> bool {
        self.request.has_schema() || self.request.cascade || self.request.prune.is_some() || {
            self.once.is_some() && self.answer == AnswerKind::Report
        }
    }
}

/// Works out each request on the state after the ones before, until that has taken [`SHARE`].
fn work_out(
    evaluator: &Evaluator,
    start: &State,
    work: Vec<Work>,
    time: Timestamp,
) -> (Vec<CommitRecord>, Vec<Tried>) {
    let id = uuid::Uuid::now_v7().to_string();
    let mut state = start.clone();
    let mut records: Vec<CommitRecord> = Vec::new();
    let mut tried = Vec::with_capacity(work.len());
    let begun = Instant::now();
    for one in work {
        if !tried.is_empty() && begun.elapsed() >= SHARE {
            break;
        }
        if let Some(found) = one.before {
            tried.push(found);
            continue;
        }
        let revision = state.revision() + 1;
        match evaluator.evaluate(&state, &one.request, revision, time) {
            Err(problem) => tried.push(Tried::Refused(problem)),
            Ok(evaluated) => {
                let before = state.clone();
                state = evaluated.after.clone();
                let done = Done {
                    revision: state.revision(),
                    before,
                    evaluated,
                    view: view(&one.request.caller.claims),
                    // The first answer and the kept one are the same.
                    places: match one.once {
                        Some(_) => MAX_KEPT_CANDIDATES,
                        None => MAX_CANDIDATES,
                    },
                };
                if !done.evaluated.changes.is_empty() {
                    records.push(record(
                        &one.request,
                        one.answer,
                        one.once.as_ref(),
                        &done,
                        &id,
                        time,
                    ));
                }
                tried.push(Tried::Done(Box::new(done)));
            }
        }
    }
    (records, tried)
}

fn not_worked_out(error: &dyn std::fmt::Display) -> Again {
    tracing::error!(%error, "a change could not be worked out");
    let detail = "the change could not be worked out; see the log of the service";
    Again::Refuse(Problem::new(Code::Internal, detail))
}

enum Again {
    /// Read what others wrote, then again.
    Follow,
    /// Give up, for all of the batch.
    Refuse(Problem),
}

/// The refusal for a store that does not answer.
pub(crate) fn unavailable(error: &StoreError) -> Problem {
    tracing::warn!(%error, "the store refused");
    let detail = match error {
        StoreError::Unavailable(_) => "the store cannot be reached; try again",
        StoreError::Corrupt(_) | StoreError::Refused(_) => {
            "the store cannot be used; see the log of the service"
        }
    };
    Problem::new(Code::StoreUnavailable, detail).retry_after(2)
}

/// The refusal for a store that failed while it wrote.
pub(crate) fn outcome_unknown(error: &StoreError) -> Problem {
    tracing::warn!(%error, "the outcome of a write is not known");
    let detail =
        "the store went away while it wrote: read what is there to see whether it took effect";
    Problem::new(Code::OutcomeUnknown, detail).applied(Applied::Unknown).retry_after(2)
}

fn answer(batch: Vec<Queued>, tried: Vec<Tried>) {
    for (queued, tried) in batch.into_iter().zip(tried) {
        let result = match tried {
            Tried::Refused(problem) => Err(problem),
            Tried::Before(revision, answer) => Ok(Finished::Before(revision, answer)),
            Tried::Done(done) => Ok(Finished::Done(done)),
        };
        queued.finish(result);
    }
}

fn refuse(batch: Vec<Queued>, problem: &Problem) {
    for queued in batch {
        queued.finish(Err(problem.clone()));
    }
}

fn record(
    request: &Request,
    answer: AnswerKind,
    once: Option<&Once>,
    done: &Done,
    batch: &str,
    time: Timestamp,
) -> CommitRecord {
    let changes = &done.evaluated.changes;
    let audit = changes.iter().map(|change| AuditEntry {
        id: uuid::Uuid::now_v7().to_string(),
        time,
        revision: Some(done.revision),
        subject: request.caller.claims.subject.clone(),
        roles: request.caller.claims.roles.clone(),
        action: action(request.action, change.op).to_owned(),
        key: Some(change.document.key.clone()),
        allowed: true,
        code: None,
        paths: change.paths.clone(),
        request_id: request.caller.request_id.clone(),
        address: request.caller.address.to_string(),
        detail: None,
    });
    CommitRecord {
        audit: audit.collect(),
        idempotency: once.map(|once| IdempotencyRecord {
            id: once.id.clone(),
            body: once.body.clone(),
            expires: Timestamp::from_millis(time.as_millis() + IDEMPOTENCY),
            revision: done.revision,
            answer: done.to_text(answer),
        }),
        commit: Arc::new(Commit {
            revision: done.revision,
            batch: batch.to_owned(),
            time,
            subject: request.caller.claims.subject.clone(),
            request_id: request.caller.request_id.clone(),
            changes: changes.clone(),
        }),
    }
}

/// A replacement that makes a document is a creation.
fn action(asked: &'static str, op: Op) -> &'static str {
    match (asked, op) {
        ("update", Op::Create) => "create",
        (asked, _) => asked,
    }
}
