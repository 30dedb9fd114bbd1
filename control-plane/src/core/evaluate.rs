//! From a request and a state to changes, or to a refusal. Pure but for new uids, nonces and the
//! deadline of the checks: the same code runs for a dry run, for the first try and again after
//! another process was first.

mod faults;
mod outcome;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Instant;

use blaze_domain::NodeName;
use blaze_domain::config::diff::{document_diff, paths};
use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{
    Code, Document, FieldFault, Key, Kind, MAX_DOCUMENTS, Problem, Timestamp, secret,
};
use serde_json::Value;

pub(super) use self::faults::invalid;
use self::faults::{COUNTED, Faults, in_use, twice};
use self::outcome::{Outcome, Target, cascade_into, outcome_of, prune_into, same_spec};

use super::check::{self, too_many};
use super::refs;
use super::rollouts::{begin, tried};
use super::schema::Schemas;
use super::secrets::Vault;
use super::types::{ApplyAction, Caller, DocumentInput, Precondition};
use super::view::view;
use crate::secrets::Keyring;
use crate::store::{Change, Op};
use blaze_domain::config::placement::rollout_target;
use blaze_domain::config::state::{State, tries_schema};

/// What one document is to become.
#[derive(Debug, Clone)]
pub(crate) enum Content {
    /// As a user wrote it.
    Write(DocumentInput),
    /// Changed by a merge patch of labels, annotations and spec.
    Patch(Value),
    /// As a version was; `None`: it did not exist.
    Restore(Option<Arc<Document>>),
    /// Gone.
    Delete,
    /// As it is.
    Leave,
    /// The roll-out's change becomes its target's content.
    Promote,
    /// The roll-out ends without effect, for a reason.
    Abort(String),
    /// The roll-out has failed on a canary. Nothing happens if it has ended meanwhile.
    Fail(Failed),
}

/// What a worker says of a roll-out that it has undone.
#[derive(Debug, Clone)]
pub(crate) struct Failed {
    /// Of the roll-out: another one may have its name by now.
    pub(crate) uid: String,
    /// Where.
    pub(crate) node: NodeName,
    /// Revision of what the worker has.
    pub(crate) revision: u64,
    /// Why.
    pub(crate) reason: String,
}

/// One document of a request.
#[derive(Debug, Clone)]
pub(crate) struct Item {
    pub(crate) key: Key,
    pub(crate) content: Content,
    pub(crate) precondition: Precondition,
}

impl Item {
    /// Whether it makes no sense for a document that is not there.
    fn must_exist(&self) -> bool {
        matches!(
            self.content,
            Content::Patch(_) | Content::Delete | Content::Promote | Content::Abort(_)
        ) || matches!(self.precondition, Precondition::Revisions(_) | Precondition::Any)
    }
}

/// How a request is answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    /// POST: the document must be new.
    Create,
    /// One document by its path.
    Single,
    /// Many documents, faults with their index.
    Many,
}

/// Deletion of what a selector matches.
#[derive(Debug, Clone)]
pub(crate) struct Prune {
    pub(crate) selector: LabelSelector,
    pub(crate) confirm: Option<u64>,
}

/// A change as it is asked for.
#[derive(Debug, Clone)]
pub(crate) struct Request {
    pub(crate) caller: Caller,
    /// For the audit.
    pub(crate) action: &'static str,
    pub(crate) form: Form,
    pub(crate) items: Vec<Item>,
    /// Deletes also what refers to what is deleted.
    pub(crate) cascade: bool,
    pub(crate) prune: Option<Prune>,
    /// Documents changed since are a conflict (`revert`): key and revision that each must still
    /// have.
    pub(crate) unchanged_since: BTreeMap<Key, u64>,
}

impl Request {
    /// Whether it brings a schema, which is checked against whatever there is.
    pub(crate) fn has_schema(&self) -> bool {
        self.items.iter().any(|item| match (&item.content, item.key.kind()) {
            (Content::Write(input), Kind::Service) => is_set(input.spec.get("schema")),
            (Content::Write(input), Kind::Rollout) => {
                is_set(input.spec.get("patch").and_then(|patch| patch.get("schema")))
            }
            (Content::Patch(patch), Kind::Service) => {
                is_set(patch.get("spec").and_then(|spec| spec.get("schema")))
            }
            (Content::Restore(_), Kind::Service) | (Content::Promote, _) => true,
            (
                Content::Write(_)
                | Content::Patch(_)
                | Content::Restore(_)
                | Content::Delete
                | Content::Abort(_)
                | Content::Fail(_)
                | Content::Leave,
                _,
            ) => false,
        })
    }
}

/// What a request comes to.
#[derive(Debug, Clone)]
pub(crate) struct Evaluated {
    /// None: nothing changes.
    pub(crate) changes: Vec<Change>,
    /// One per item in order, then what was pruned or deleted along with others.
    pub(crate) results: Vec<(Key, ApplyAction)>,
    /// The state with the changes.
    pub(crate) after: State,
}

/// What evaluating needs besides the state.
pub(crate) struct Evaluator {
    pub(crate) keyring: Arc<Keyring>,
    pub(crate) schemas: Schemas,
}

impl Evaluator {
    /// Works out what a request changes. `revision` and `time` are those of the commit that it
    /// would become.
    pub(crate) fn evaluate(
        &self,
        state: &State,
        request: &Request,
        revision: u64,
        time: Timestamp,
    ) -> Result<Evaluated, Problem> {
        let view = view(&request.caller.claims);
        for item in &request.items {
            view.check_named(state, &item.key, item.must_exist())?;
        }
        let mut faults = Faults::new(request.form);
        let mut outcomes: BTreeMap<Key, (Outcome, Op)> = BTreeMap::new();
        let mut order: Vec<Key> = Vec::new();
        for (index, item) in request.items.iter().enumerate() {
            match outcome_of(state, request, item) {
                Ok(pairs) => {
                    for (key, outcome, op) in pairs {
                        if outcomes.contains_key(&key) {
                            faults.add(index, twice(&key));
                        }
                        order.push(key.clone());
                        outcomes.insert(key, (outcome, op));
                    }
                }
                Err(problem) => faults.problem(index, *problem)?,
            }
        }
        faults.finish_invalid()?;
        if request.form == Form::Create
            && let Some(exists) = order.iter().find(|key| state.get(key).is_some())
        {
            let held = state.get(exists).map_or(0, |held| held.document.revision);
            faults.conflict(
                0,
                Problem::new(Code::AlreadyExists, format!("{exists} exists")).at(held),
            );
        }
        if let Some(prune) = &request.prune {
            prune_into(state, request, prune, &mut outcomes, &mut order)?;
        }
        if request.cascade {
            cascade_into(state, &mut outcomes, &mut order);
        }
        self.build(state, request, revision, time, outcomes, order, faults)
    }

    #[allow(clippy::too_many_arguments, reason = "one step of `evaluate`, cut for reading")]
    fn build(
        &self,
        state: &State,
        request: &Request,
        revision: u64,
        time: Timestamp,
        outcomes: BTreeMap<Key, (Outcome, Op)>,
        order: Vec<Key>,
        mut faults: Faults,
    ) -> Result<Evaluated, Problem> {
        let deadline = Instant::now() + check::TIME;
        let places: HashMap<&Key, usize> = order.iter().zip(0..).collect();
        let index_of = |key: &Key| places.get(key).copied().unwrap_or(0);
        let mut changes = Vec::with_capacity(outcomes.len());
        let mut actions: BTreeMap<Key, ApplyAction> = BTreeMap::new();
        for (key, (outcome, op)) in outcomes {
            let before = state.get(&key).map(|held| Arc::clone(&held.document));
            let change = match outcome {
                Outcome::Keep => None,
                Outcome::Remove => {
                    before.as_ref().map(|document| removal(document, revision, time, request))
                }
                Outcome::Put(target) => {
                    match self.document(
                        &key,
                        before.as_deref(),
                        *target,
                        revision,
                        time,
                        request,
                        deadline,
                    ) {
                        Ok(Some(document)) => {
                            // What is written anyway leaves old keys behind, so that they can be
                            // taken away one day.
                            let document =
                                self.keyring.reseal(&document).ok().flatten().unwrap_or(document);
                            Some(put(before.as_deref(), document, op))
                        }
                        Ok(None) => None,
                        Err(found) => {
                            found.into_iter().for_each(|fault| faults.add(index_of(&key), fault));
                            None
                        }
                    }
                }
            };
            let action = match change.as_ref().map(|change: &Change| (change.op, before.is_some()))
            {
                None => ApplyAction::Unchanged,
                Some((Op::Delete, _)) => ApplyAction::Deleted,
                Some((_, true)) => ApplyAction::Updated,
                Some((_, false)) => ApplyAction::Created,
            };
            actions.insert(key, action);
            changes.extend(change);
        }
        faults.finish_invalid()?;
        let mut after = state.clone();
        if !changes.is_empty() {
            after.advance(revision, changes.iter().map(Change::step));
        }
        check_rights(state, &after, request, &changes)?;
        self.begin_rollouts(&mut after, request, &mut changes, &index_of, &mut faults, deadline)?;
        self.check_result([state, &after], request, &changes, &index_of, &mut faults, deadline)?;
        let results = order.into_iter().map(|key| {
            let action = actions.get(&key).copied().unwrap_or(ApplyAction::Unchanged);
            (key, action)
        });
        Ok(Evaluated { results: results.collect(), changes, after })
    }

    /// The document that is stored; `None` if nothing changes.
    #[allow(clippy::too_many_arguments, reason = "one step of `build`, cut for reading")]
    fn document(
        &self,
        key: &Key,
        before: Option<&Document>,
        target: Target,
        revision: u64,
        time: Timestamp,
        request: &Request,
        deadline: Instant,
    ) -> Result<Option<Document>, Vec<FieldFault>> {
        let uid = before
            .map_or_else(|| uuid::Uuid::now_v7().to_string(), |document| document.uid.clone());
        let mut spec = target.spec;
        if key.kind() == Kind::Rollout && secret::contains(&spec) {
            return Err(vec![invalid(
                "/spec/patch",
                "a roll-out cannot carry secrets: change them in the target itself",
            )]);
        }
        Vault {
            keyring: &self.keyring,
            key,
            uid: &uid,
            current: before,
            from_uid: target.from_uid.as_deref().unwrap_or(&uid),
            revision,
        }
        .store(&mut spec)?;
        let stored = before.and_then(|before| before.spec_member("schema"));
        if key.kind() == Kind::Service
            && let Some(schema) = spec.get("schema").filter(|schema| !schema.is_null())
            // One that is stored was sound when it came, and does not stand in the way of other
            // changes.
            && stored != Some(schema)
        {
            self.check_schema(schema, "/spec/schema", deadline).map_err(|fault| vec![fault])?;
        }
        if let Some(before) = before
            && before.labels == target.labels
            && before.annotations == target.annotations
            && same_spec(&before.spec, &spec)
            && before.status == target.status
        {
            return Ok(None);
        }
        Ok(Some(Document {
            key: key.clone(),
            uid,
            revision,
            create_time: before.map_or(time, |document| document.create_time),
            update_time: time,
            updated_by: request.caller.claims.subject.clone(),
            labels: target.labels,
            annotations: target.annotations,
            spec: Arc::new(spec),
            status: target.status,
        }))
    }

    /// Whether a schema is sound.
    fn check_schema(
        &self,
        schema: &Value,
        pointer: &str,
        deadline: Instant,
    ) -> Result<(), FieldFault> {
        if Instant::now() >= deadline {
            return Err(too_many());
        }
        self.schemas.check(schema).map_err(|reason| invalid(pointer, &reason))
    }

    /// Judges roll-outs that begin by what there is after the change, of which their targets and
    /// nodes may be part.
    fn begin_rollouts(
        &self,
        after: &mut State,
        request: &Request,
        changes: &mut [Change],
        index_of: &dyn Fn(&Key) -> usize,
        faults: &mut Faults,
        deadline: Instant,
    ) -> Result<(), Problem> {
        let view = view(&request.caller.claims);
        let is_begun = |change: &&mut Change| begins(request, change);
        for change in changes.iter_mut().filter(is_begun) {
            let index = index_of(&change.document.key);
            let mut rollout = (*change.document).clone();
            match begin(after, &rollout) {
                Ok(status) => rollout.status = Some(status),
                Err(problem) => {
                    faults.problem(index, *problem)?;
                    continue;
                }
            }
            if let Some((target, patched)) = tried(after, &rollout) {
                let state: &State = after;
                let written = view.check_write((state, Some(&target)), (state, Some(&patched)));
                written.map_err(|_| {
                    view.outside(&format!("what {} makes of its target", rollout.key))
                })?;
                for fault in
                    self.faults_of_tried(state, &rollout, &patched, faults.room(), deadline)
                {
                    faults.add(index, fault);
                }
            }
            let before = change.previous;
            *change = put(None, rollout, change.op);
            change.previous = before;
            after.put(Arc::clone(&change.document));
        }
        Ok(())
    }

    /// What is wrong with what a roll-out makes of its target: references, and a schema that it
    /// brings.
    fn faults_of_tried(
        &self,
        after: &State,
        rollout: &Document,
        patched: &Document,
        most: usize,
        deadline: Instant,
    ) -> Vec<FieldFault> {
        let mut found = refs::missing_of(after, patched, most);
        for fault in &mut found {
            let within = fault.pointer.strip_prefix("/spec").unwrap_or_default();
            fault.pointer = format!("/spec/patch{within}");
        }
        if patched.key.kind() == Kind::Service
            && tries_schema(rollout)
            && let Some(schema) = patched.spec_member("schema")
            && let Err(fault) = self.check_schema(schema, "/spec/patch/schema", deadline)
        {
            found.push(fault);
        }
        found
    }

    /// What can only be judged on the resulting state: references, schemas, sizes, counts.
    fn check_result(
        &self,
        [before, after]: [&State; 2],
        request: &Request,
        changes: &[Change],
        index_of: &dyn Fn(&Key) -> usize,
        faults: &mut Faults,
        deadline: Instant,
    ) -> Result<(), Problem> {
        let view = view(&request.caller.claims);
        for change in changes.iter().filter(|change| change.op != Op::Delete) {
            if faults.room() == 0 {
                break;
            }
            let key = &change.document.key;
            for fault in refs::missing(after, key, faults.room()) {
                faults.add(index_of(key), fault);
            }
        }
        faults.finish_invalid()?;
        let keys: Vec<Key> = changes.iter().map(|change| change.document.key.clone()).collect();
        for fault in self.schemas.check_effective(before, after, &keys, &view, deadline) {
            faults.add(keys.first().map_or(0, index_of), fault);
        }
        faults.finish_invalid()?;
        for change in changes.iter().filter(|change| change.op == Op::Delete) {
            if !faults.has_room_for_conflicts() {
                break;
            }
            let key = &change.document.key;
            let referrers = refs::referrers(after, key, COUNTED);
            if !referrers.is_empty() {
                let mut problem = in_use(key, &referrers, [before, after], &view);
                problem.revision = change.previous;
                faults.conflict(index_of(key), problem);
            }
        }
        for change in changes.iter().filter(|change| begins(request, change)) {
            if let Some(problem) = active_elsewhere(after, &change.document) {
                faults.conflict(index_of(&change.document.key), problem);
            }
        }
        if after.len() > MAX_DOCUMENTS && after.len() > before.len() {
            let detail = format!(
                "the store would hold {} documents, at most {MAX_DOCUMENTS} are allowed",
                after.len()
            );
            return Err(Problem::new(Code::LimitExceeded, detail).at(before.revision()));
        }
        faults.finish_conflicts()
    }
}

/// Whether a change is a roll-out that begins. One that exists does not, but who makes it learns
/// first what is wrong with it.
fn begins(request: &Request, change: &Change) -> bool {
    change.document.key.kind() == Kind::Rollout
        && (change.op == Op::Create || request.form == Form::Create)
}

/// Refuses changes that a bound token may not make, before anything else is told of them.
fn check_rights(
    before: &State,
    after: &State,
    request: &Request,
    changes: &[Change],
) -> Result<(), Problem> {
    let view = view(&request.caller.claims);
    let document = |state: &State, key: &Key| state.get(key).map(|held| Arc::clone(&held.document));
    for change in changes {
        let key = &change.document.key;
        let (was, is) = (document(before, key), document(after, key));
        let written = view.check_write((before, was.as_deref()), (after, is.as_deref()));
        written.map_err(|problem| match request.items.iter().any(|item| item.key == *key) {
            true => problem,
            // It may be one that the token does not know of.
            false => view.outside("a document that would change along"),
        })?;
    }
    Ok(())
}

fn active_elsewhere(after: &State, rollout: &Document) -> Option<Problem> {
    let target = rollout_target(rollout)?;
    let other = after.active_on(&target).find(|held| held.document.key != rollout.key)?;
    let detail = format!(
        "{target} has the roll-out {} already: promote or abort it first",
        other.document.key.name()
    );
    Some(Problem::new(Code::RolloutActive, detail).at(other.document.revision))
}

fn removal(document: &Arc<Document>, revision: u64, time: Timestamp, request: &Request) -> Change {
    let mut last = (**document).clone();
    last.revision = revision;
    last.update_time = time;
    last.updated_by.clone_from(&request.caller.claims.subject);
    Change {
        op: Op::Delete,
        paths: paths(&document_diff(Some(document), None)),
        previous: Some(document.revision),
        document: Arc::new(last),
    }
}

fn put(before: Option<&Document>, document: Document, op: Op) -> Change {
    Change {
        op,
        previous: before.map(|document| document.revision),
        paths: paths(&document_diff(before, Some(&document))),
        document: Arc::new(document),
    }
}

fn is_set(value: Option<&Value>) -> bool {
    value.is_some_and(|value| !value.is_null())
}
