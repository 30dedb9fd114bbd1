//! Writes: each becomes a request for the committer. A write that has begun goes on when its caller
//! goes away.

use std::collections::BTreeMap;
use std::sync::Arc;

use blaze_domain::config::{Applied, Code, FieldFault, Key, Kind, Problem};
use blaze_domain::{DocumentName, LayerName};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tokio::sync::oneshot;

use super::super::affected::MAX_CANDIDATES;
use super::super::committer::{
    Finished, Once, QUEUE_BYTES, Queued, Running, now, outcome_unknown, unavailable,
};
use super::super::evaluate::{Content, Form, Item, Prune, Request};
use super::super::report::{AnswerKind, Done, report_from, written_from};
use super::super::types::{
    Answer, ApplyReport, ApplyRequest, Caller, DocumentInput, Idempotency, Precondition,
    ReadOptions, Written,
};
use super::super::view::{authorize_whole, view};
use super::super::watch::trimmed;
use super::{ConfigService, selector};
use crate::auth::Right;
use crate::store::migrate::hex;
use crate::store::{Change, Op};

/// Documents of one `apply`, at most.
const MAX_ITEMS: usize = 1000;
/// Bytes that a queued request counts for besides its documents.
const REQUEST_BYTES: usize = 1024;

fn request(caller: &Caller, action: &'static str, form: Form, items: Vec<Item>) -> Request {
    Request {
        caller: caller.clone(),
        action,
        form,
        items,
        cascade: false,
        prune: None,
        unchanged_since: BTreeMap::new(),
    }
}

fn item(key: Key, content: Content, precondition: Precondition) -> Item {
    Item { key, content, precondition }
}

fn internal(what: &str) -> Problem {
    tracing::error!(what, "an answer could not be made");
    Problem::new(Code::Internal, "the answer could not be made; see the log of the service")
        .applied(Applied::Unknown)
}

impl ConfigService {
    /// A bound token gets 403 for what is outside its view, before anything else is looked at.
    async fn check_view(&self, caller: &Caller, key: &Key) -> Result<(), Problem> {
        self.check_view_of(caller, key, false).await
    }

    /// The same, for what must exist: what does not exist is outside of every layer.
    async fn check_view_of_existing(&self, caller: &Caller, key: &Key) -> Result<(), Problem> {
        self.check_view_of(caller, key, true).await
    }

    async fn check_view_of(
        &self,
        caller: &Caller,
        key: &Key,
        must_exist: bool,
    ) -> Result<(), Problem> {
        let view = view(&caller.claims);
        if view.layer().is_none() {
            return Ok(());
        }
        // Another process may just have made it.
        let state = self.read_state(&ReadOptions::default()).await?;
        if must_exist || state.get(key).is_some() {
            view.check_key(&state, key)?;
        }
        Ok(())
    }

    async fn submit(
        &self,
        request: Request,
        answer: AnswerKind,
        idempotency: Option<Idempotency>,
        bytes: usize,
    ) -> Result<Finished, Problem> {
        let once = idempotency.map(|idempotency| once(&request.caller, &idempotency));
        let in_progress = || {
            let detail = "the first request with this Idempotency-Key is still running";
            let problem = Problem::new(Code::IdempotencyInProgress, detail).retry_after(1);
            problem.at(self.revision())
        };
        let running = match &once {
            Some(once) => {
                Some(Running::begin(&self.inner.running, &once.id).ok_or_else(in_progress)?)
            }
            None => None,
        };
        let overloaded = || {
            Problem::new(Code::Overloaded, "too many writes wait for the store; try again")
                .retry_after(1)
        };
        let bytes = (bytes + REQUEST_BYTES).min(QUEUE_BYTES);
        let room = Arc::clone(&self.inner.room);
        let room = room.try_acquire_many_owned(u32::try_from(bytes).unwrap_or(u32::MAX));
        let room = room.map_err(|_| overloaded())?;
        let (reply, result) = oneshot::channel();
        let queued =
            Queued { request: Arc::new(request), answer, once, bytes, reply, running, _room: room };
        self.inner.queue.try_send(queued).map_err(|_| overloaded())?;
        let ended = || {
            let detail = "the service ended before the store answered: read the documents to see \
                whether it took effect";
            Problem::new(Code::ShuttingDown, detail).applied(Applied::Unknown)
        };
        result.await.map_err(|_| ended())?
    }

    async fn write_one(
        &self,
        request: Request,
        idempotency: Option<Idempotency>,
        bytes: usize,
    ) -> Result<Answer<Written>, Problem> {
        match self.submit(request, AnswerKind::Document, idempotency, bytes).await? {
            Finished::Done(done) => Ok(Answer {
                revision: own_revision(&done),
                replayed: false,
                value: done.written().ok_or_else(|| internal("no document after a write"))?,
            }),
            Finished::Before(revision, text) => Ok(Answer {
                revision,
                replayed: true,
                value: written_from(&text)
                    .ok_or_else(|| internal("a kept answer cannot be read"))?,
            }),
        }
    }

    async fn write_many(
        &self,
        request: Request,
        idempotency: Option<Idempotency>,
        bytes: usize,
    ) -> Result<Answer<ApplyReport>, Problem> {
        match self.submit(request, AnswerKind::Report, idempotency, bytes).await? {
            Finished::Done(done) => {
                let revision = done.revision;
                // Whom it affects may take long to find out.
                let report = tokio::task::spawn_blocking(move || done.report(false)).await;
                Ok(Answer {
                    revision,
                    replayed: false,
                    value: report.map_err(|_| internal("the report of a write"))?,
                })
            }
            Finished::Before(revision, text) => Ok(Answer {
                revision,
                replayed: true,
                value: report_from(&text)
                    .ok_or_else(|| internal("a kept answer cannot be read"))?,
            }),
        }
    }

    /// Makes a document that must not exist yet.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn create(
        &self,
        caller: &Caller,
        input: DocumentInput,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<Written>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        self.check_view(caller, &input.key).await?;
        let bytes = input.spec.to_string().len();
        let item = item(input.key.clone(), Content::Write(input), Precondition::None);
        let action = if item.key.kind() == Kind::Rollout { "rollout_start" } else { "create" };
        self.write_one(request(caller, action, Form::Create, vec![item]), idempotency, bytes).await
    }

    /// Replaces a document, or makes it.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn replace(
        &self,
        caller: &Caller,
        input: DocumentInput,
        precondition: Precondition,
    ) -> Result<Answer<Written>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        match precondition {
            Precondition::Revisions(_) | Precondition::Any => {
                self.check_view_of_existing(caller, &input.key).await?;
            }
            Precondition::None | Precondition::Absent => {
                self.check_view(caller, &input.key).await?;
            }
        }
        let bytes = input.spec.to_string().len();
        let item = item(input.key.clone(), Content::Write(input), precondition);
        self.write_one(request(caller, "update", Form::Single, vec![item]), None, bytes).await
    }

    /// Changes a document by a merge patch of its labels, annotations and spec.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn patch(
        &self,
        caller: &Caller,
        key: &Key,
        merge_patch: Value,
        precondition: Precondition,
    ) -> Result<Answer<Written>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        self.check_view_of_existing(caller, key).await?;
        let bytes = merge_patch.to_string().len();
        let item = item(key.clone(), Content::Patch(merge_patch), precondition);
        self.write_one(request(caller, "patch", Form::Single, vec![item]), None, bytes).await
    }

    /// Deletes a document; with `cascade` also those that refer to it.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn delete(
        &self,
        caller: &Caller,
        key: &Key,
        precondition: Precondition,
        cascade: bool,
    ) -> Result<Answer<()>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        self.check_view_of_existing(caller, key).await?;
        let item = item(key.clone(), Content::Delete, precondition);
        let mut request = request(caller, "delete", Form::Single, vec![item]);
        request.cascade = cascade;
        let finished = self.submit(request, AnswerKind::Report, None, 0).await?;
        let revision = match finished {
            Finished::Done(done) => done.revision,
            Finished::Before(revision, _) => revision,
        };
        Ok(Answer { revision, replayed: false, value: () })
    }

    /// Many documents in one commit, or none of them.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn apply(
        &self,
        caller: &Caller,
        asked: ApplyRequest,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<ApplyReport>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        if asked.items.len() > MAX_ITEMS {
            let detail =
                format!("{} documents, at most {MAX_ITEMS} are allowed at once", asked.items.len());
            return Err(Problem::new(Code::PayloadTooLarge, detail));
        }
        let prune = match &asked.prune {
            Some(text) => Some(Prune { selector: selector(text)?, confirm: asked.prune_confirm }),
            None => None,
        };
        let bytes = asked.items.iter().map(|item| item.input.spec.to_string().len()).sum();
        let items = asked.items.into_iter().map(|one| {
            let precondition = match one.revision {
                Some(revision) => Precondition::Revisions(vec![revision]),
                None => Precondition::None,
            };
            let content =
                if one.delete { Content::Delete } else { Content::Write(one.input.clone()) };
            item(one.input.key, content, precondition)
        });
        let mut request = request(caller, "apply", Form::Many, items.collect());
        request.prune = prune;
        if asked.dry_run {
            return self.dry_run(request, bytes).await;
        }
        self.write_many(request, idempotency, bytes).await
    }

    /// The same checks, and nothing is written.
    async fn dry_run(
        &self,
        request: Request,
        bytes: usize,
    ) -> Result<Answer<ApplyReport>, Problem> {
        let overloaded = || {
            Problem::new(Code::Overloaded, "too many dry runs wait for each other; try again")
                .retry_after(1)
        };
        let _waiting = self.inner.dry_waiting.try_acquire().map_err(|_| overloaded())?;
        let bytes = u32::try_from((bytes + REQUEST_BYTES).min(QUEUE_BYTES)).unwrap_or(u32::MAX);
        let room = Arc::clone(&self.inner.room).try_acquire_many_owned(bytes);
        let room = room.map_err(|_| overloaded())?;
        let running = Arc::clone(&self.inner.dry_running).acquire_owned().await;
        let running = running.map_err(|_| overloaded())?;
        let before = self.read_state(&ReadOptions::default()).await?;
        let revision = before.revision();
        let evaluator = Arc::clone(&self.inner.evaluator);
        let work = move || {
            // They are held as long as it runs, also when whoever asked has gone.
            let _held = (room, running);
            let evaluated = evaluator.evaluate(&before, &request, revision + 1, now())?;
            let done = Done {
                revision,
                before,
                evaluated,
                view: view(&request.caller.claims),
                places: MAX_CANDIDATES,
            };
            Ok(done.report(true))
        };
        let report = tokio::task::spawn_blocking(work).await;
        Ok(Answer {
            revision,
            replayed: false,
            value: report
                .map_err(|_| internal("the report of a dry run").applied(Applied::No))??,
        })
    }

    /// Sets a document back to what it was at a revision; makes it again if it is gone.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn rollback(
        &self,
        caller: &Caller,
        key: &Key,
        revision: u64,
        precondition: Precondition,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<Written>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        let state = self.read_state(&ReadOptions::default()).await?;
        self.check_view_of_existing(caller, key).await?;
        let version = match self.seen_version(caller, &state, key, revision).await {
            Err(problem) if problem.code == Code::RevisionUnknown => {
                let detail = format!(
                    "there is no revision {revision} yet; the newest is {}",
                    state.revision()
                );
                return Err(Problem::new(Code::NotFound, detail));
            }
            other => other?,
        };
        let item = item(key.clone(), Content::Restore(Some(version.change.document)), precondition);
        self.write_one(request(caller, "rollback", Form::Single, vec![item]), idempotency, 0).await
    }

    /// Gives every document that a commit changed the content that it had before, in one commit.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn revert(
        &self,
        caller: &Caller,
        revision: u64,
        force: bool,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<ApplyReport>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        let state = self.read_state(&ReadOptions::default()).await?;
        let missing = || Problem::new(Code::NotFound, format!("there is no commit {revision}"));
        if revision == 0 || revision > state.revision() {
            return Err(missing());
        }
        let batch = self.inner.store.commits_after(revision - 1, 1).await;
        let batch = batch.map_err(|error| unavailable(&error))?;
        if batch.floor >= revision {
            let detail = format!(
                "what commit {revision} did is no longer kept: the history begins after {}",
                batch.floor
            );
            return Err(Problem { detail, ..trimmed(batch.floor, state.revision()) });
        }
        let commit = batch.commits.into_iter().next().filter(|commit| commit.revision == revision);
        let commit = commit.ok_or_else(missing)?;
        let mut items = Vec::with_capacity(commit.changes.len());
        let mut unchanged_since = BTreeMap::new();
        let view = view(&caller.claims);
        let is_roll_out = |change: &Change| change.document.key.kind() == Kind::Rollout;
        let others = commit.changes.iter().any(|change| !is_roll_out(change));
        for change in &commit.changes {
            // Before anything is told of it: what a deleted document was counts too.
            if !view.sees_document(&state, &change.document) {
                return Err(view.outside(&format!("commit {revision}")));
            }
            let key = change.document.key.clone();
            // A roll-out goes on or has ended, whatever became of the documents beside it.
            if others && is_roll_out(change) && change.previous.is_some() {
                items.push(item(key, Content::Leave, Precondition::None));
                continue;
            }
            let before = match change.previous {
                None => None,
                Some(previous) => {
                    Some(self.seen_version(caller, &state, &key, previous).await?.change.document)
                }
            };
            if !force {
                let now = if change.op == Op::Delete { 0 } else { revision };
                unchanged_since.insert(key.clone(), now);
            }
            items.push(item(key, Content::Restore(before), Precondition::None));
        }
        let mut request = request(caller, "rollback", Form::Many, items);
        request.unchanged_since = unchanged_since;
        self.write_many(request, idempotency, 0).await
    }

    /// Makes a roll-out's change the content of its target.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn promote_rollout(
        &self,
        caller: &Caller,
        name: &DocumentName,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<Written>, Problem> {
        self.end_rollout(caller, name, "rollout_promote", Content::Promote, idempotency).await
    }

    /// Ends a roll-out without effect.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn abort_rollout(
        &self,
        caller: &Caller,
        name: &DocumentName,
        reason: &str,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<Written>, Problem> {
        let content = Content::Abort(reason.chars().take(1000).collect());
        self.end_rollout(caller, name, "rollout_abort", content, idempotency).await
    }

    async fn end_rollout(
        &self,
        caller: &Caller,
        name: &DocumentName,
        action: &'static str,
        content: Content,
        idempotency: Option<Idempotency>,
    ) -> Result<Answer<Written>, Problem> {
        self.authorize(&caller.claims, Right::Write)?;
        let key = Key::rollout(name.clone());
        self.check_view_of_existing(caller, &key).await?;
        let item = item(key, content, Precondition::None);
        self.write_one(request(caller, action, Form::Single, vec![item]), idempotency, 0).await
    }

    /// Removes commits before a revision. Gives the smallest revision that a watch may start after
    /// from now on.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn trim(
        &self,
        caller: &Caller,
        before: u64,
        _idempotency: Option<Idempotency>,
    ) -> Result<Answer<u64>, Problem> {
        authorize_whole(&caller.claims)?;
        let state = self.read_state(&ReadOptions::default()).await?;
        if before == 0 || before > state.revision() + 1 {
            let fault = FieldFault {
                pointer: "/before".to_owned(),
                code: Code::ValidationFailed,
                detail: format!("1 to {}, one more than the newest revision", state.revision() + 1),
                document: None,
            };
            return Err(Problem::faults(vec![fault]).at(state.revision()));
        }
        let entry = Self::entry(caller, "trim", None);
        let noted = self.inner.store.append_audit(&[entry]).await;
        noted.map_err(|error| unavailable(&error))?;
        // The floor rises first: what fails afterwards may have taken effect.
        let floor = self.inner.store.trim(before - 1, self.inner.keep_versions).await;
        let floor = floor.map_err(|error| outcome_unknown(&error))?;
        self.inner.log.raise_floor(floor);
        Ok(Answer { revision: state.revision(), replayed: false, value: floor })
    }
}

/// A write that changed nothing reflects the revision of what is there.
fn own_revision(done: &Done) -> u64 {
    match done.evaluated.changes.is_empty() {
        true => done.written().map_or(done.revision, |written| written.document.revision),
        false => done.revision,
    }
}

fn once(caller: &Caller, idempotency: &Idempotency) -> Once {
    // What a token sees is part of who asks: the answer that one got is not for another of the same
    // subject. Its roles are not: every token that comes here may write, and a renewed one may name
    // them otherwise.
    let claims = &caller.claims;
    let layer = claims.layer.as_ref().map(LayerName::as_str);
    let text = json!([claims.subject, layer, idempotency.path, idempotency.key]).to_string();
    Once { id: hex(&Sha256::digest(text.as_bytes())), body: hex(&idempotency.body) }
}
