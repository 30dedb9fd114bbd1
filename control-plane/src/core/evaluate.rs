//! From a request and a state to changes, or to a refusal. Pure but for new uids and nonces: the same code runs for a
//! dry run, for the first try and again after another process was first.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use blaze_domain::config::diff::{document_diff, paths};
use blaze_domain::config::selector::LabelSelector;
use blaze_domain::config::{
    Code, Document, FieldFault, Key, Kind, Labels, MAX_DOCUMENT_BYTES, MAX_DOCUMENTS, Problem, Timestamp, merge,
    secret, spec,
};
use serde_json::{Map, Value, json};

use super::placement::{is_active, phase, rollout_target};
use super::refs;
use super::rollouts::{begin, too_large, tried};
use super::schema::Schemas;
use super::secrets::Vault;
use super::state::{State, tries_schema};
use super::types::{ApplyAction, Caller, DocumentInput, Precondition};
use super::view::{View, view};
use crate::secrets::Keyring;
use crate::store::{Change, Op};

/// Faults of one answer, at most.
const MAX_FAULTS: usize = 100;
/// Deletions by `prune` that need no confirmation.
const PRUNE_FREELY: usize = 20;
/// Referrers that are named in a refusal.
const NAMED: usize = 5;
/// The same that are counted.
const COUNTED: usize = 1000;

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
    /// Documents changed since are a conflict (`revert`): key and revision that each must still have.
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
            (Content::Patch(patch), Kind::Service) => is_set(patch.get("spec").and_then(|spec| spec.get("schema"))),
            (Content::Restore(_), Kind::Service) | (Content::Promote, _) => true,
            (
                Content::Write(_)
                | Content::Patch(_)
                | Content::Restore(_)
                | Content::Delete
                | Content::Abort(_)
                | Content::Leave,
                _,
            ) => false,
        })
    }
}

/// What a request comes to.
#[derive(Debug, Clone, Default)]
pub(crate) struct Evaluated {
    /// None: nothing changes.
    pub(crate) changes: Vec<Change>,
    /// One per item in order, then what was pruned or deleted along with others.
    pub(crate) results: Vec<(Key, ApplyAction)>,
}

/// What evaluating needs besides the state.
pub(crate) struct Evaluator {
    pub(crate) keyring: Arc<Keyring>,
    pub(crate) schemas: Schemas,
}

/// A document that is to be there after the change.
struct Target {
    labels: Labels,
    annotations: Labels,
    spec: Value,
    status: Option<Value>,
    /// Uid under which encrypted secrets in `spec` were encrypted, if it is not the document's present one.
    from_uid: Option<String>,
}

enum Outcome {
    Put(Box<Target>),
    Remove,
    Keep,
}

impl Evaluator {
    /// Works out what a request changes. `revision` and `time` are those of the commit that it would become.
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
        let places: HashMap<&Key, usize> = order.iter().zip(0..).collect();
        let index_of = |key: &Key| places.get(key).copied().unwrap_or(0);
        let mut changes = Vec::with_capacity(outcomes.len());
        let mut actions: BTreeMap<Key, ApplyAction> = BTreeMap::new();
        for (key, (outcome, op)) in outcomes {
            let before = state.get(&key).map(|held| Arc::clone(&held.document));
            let change = match outcome {
                Outcome::Keep => None,
                Outcome::Remove => before
                    .as_ref()
                    .map(|document| removal(document, revision, time, request)),
                Outcome::Put(target) => {
                    match self.document(&key, before.as_deref(), *target, revision, time, request) {
                        Ok(Some(document)) => {
                            // What is written anyway leaves old keys behind, so that they can be taken away one day.
                            let document = self.keyring.reseal(&document).ok().flatten().unwrap_or(document);
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
            let action = match change.as_ref().map(|change: &Change| (change.op, before.is_some())) {
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
        after.advance(revision, &changes);
        check_rights(state, &after, request, &changes)?;
        self.begin_rollouts(&mut after, request, &mut changes, &index_of, &mut faults)?;
        self.check_result(state, &after, request, &changes, &index_of, &mut faults)?;
        let results = order.into_iter().map(|key| {
            let action = actions.get(&key).copied().unwrap_or(ApplyAction::Unchanged);
            (key, action)
        });
        Ok(Evaluated {
            results: results.collect(),
            changes,
        })
    }

    /// The document that is stored; `None` if nothing changes.
    fn document(
        &self,
        key: &Key,
        before: Option<&Document>,
        target: Target,
        revision: u64,
        time: Timestamp,
        request: &Request,
    ) -> Result<Option<Document>, Vec<FieldFault>> {
        let uid = before.map_or_else(|| uuid::Uuid::now_v7().to_string(), |document| document.uid.clone());
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
        if let Some(schema) = spec
            .get("schema")
            .filter(|_| key.kind() == Kind::Service && is_set(spec.get("schema")))
        {
            self.schemas
                .check(schema)
                .map_err(|reason| vec![invalid("/spec/schema", &reason)])?;
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

    /// Judges roll-outs that begin by what there is after the change, of which their targets and nodes may be part.
    fn begin_rollouts(
        &self,
        after: &mut State,
        request: &Request,
        changes: &mut [Change],
        index_of: &dyn Fn(&Key) -> usize,
        faults: &mut Faults,
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
                written.map_err(|_| view.outside(&format!("what {} makes of its target", rollout.key)))?;
                for fault in self.faults_of_tried(state, &rollout, &patched, faults.room()) {
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

    /// What is wrong with what a roll-out makes of its target: references, and a schema that it brings.
    fn faults_of_tried(&self, after: &State, rollout: &Document, patched: &Document, most: usize) -> Vec<FieldFault> {
        let mut found = refs::missing_of(after, patched, most);
        for fault in &mut found {
            let within = fault.pointer.strip_prefix("/spec").unwrap_or_default();
            fault.pointer = format!("/spec/patch{within}");
        }
        if patched.key.kind() == Kind::Service
            && tries_schema(rollout)
            && let Some(schema) = patched.spec_member("schema")
            && let Err(reason) = self.schemas.check(schema)
        {
            found.push(invalid("/spec/patch/schema", &reason));
        }
        found
    }

    /// What can only be judged on the resulting state: references, schemas, sizes, counts.
    fn check_result(
        &self,
        before: &State,
        after: &State,
        request: &Request,
        changes: &[Change],
        index_of: &dyn Fn(&Key) -> usize,
        faults: &mut Faults,
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
        for fault in self.schemas.check_effective(after, &keys, &view) {
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

/// Whether a change is a roll-out that begins. One that exists does not, but who makes it learns first what is wrong with it.
fn begins(request: &Request, change: &Change) -> bool {
    change.document.key.kind() == Kind::Rollout && (change.op == Op::Create || request.form == Form::Create)
}

/// Refuses changes that a bound token may not make, before anything else is told of them.
fn check_rights(before: &State, after: &State, request: &Request, changes: &[Change]) -> Result<(), Problem> {
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

/// What becomes of the document of one item, and of others that it changes along.
fn outcome_of(state: &State, request: &Request, item: &Item) -> Result<Vec<(Key, Outcome, Op)>, Box<Problem>> {
    let current = state.get(&item.key).map(|held| &*held.document);
    precondition(state, request, item, current)?;
    let update = if current.is_some() { Op::Update } else { Op::Create };
    let one = |outcome, op| Ok(vec![(item.key.clone(), outcome, op)]);
    match &item.content {
        Content::Write(input) => {
            // What POST finds is no document to compare with: it is refused as one that exists.
            let compared = current.filter(|_| request.form != Form::Create);
            one(Outcome::Put(Box::new(written(input, compared)?)), update)
        }
        Content::Patch(patch) => {
            let current = current.ok_or_else(|| Box::new(not_found(&item.key)))?;
            let input = patch_input(state, &item.key, patch).map_err(|faults| Box::new(Problem::faults(faults)))?;
            one(Outcome::Put(Box::new(written(&input, Some(current))?)), Op::Update)
        }
        Content::Leave => one(Outcome::Keep, Op::Update),
        Content::Delete => match current {
            Some(_) => one(Outcome::Remove, Op::Delete),
            None if request.form == Form::Many => one(Outcome::Keep, Op::Delete),
            None => Err(Box::new(not_found(&item.key))),
        },
        Content::Restore(None) => one(
            if current.is_some() {
                Outcome::Remove
            } else {
                Outcome::Keep
            },
            Op::Delete,
        ),
        Content::Restore(Some(version)) => {
            if version.key.kind() == Kind::Rollout {
                let detail = "a roll-out is not set back; start another one";
                let revision = current.map_or(state.revision(), |document| document.revision);
                return Err(Box::new(Problem::new(Code::RolloutState, detail).at(revision)));
            }
            let faults = spec::check(
                &version.key,
                &version.labels,
                &version.annotations,
                &secret::redact(&version.spec),
            );
            if !faults.is_empty() {
                return Err(Box::new(Problem::faults(faults)));
            }
            let target = Target {
                labels: version.labels.clone(),
                annotations: version.annotations.clone(),
                spec: (*version.spec).clone(),
                status: None,
                from_uid: Some(version.uid.clone()),
            };
            one(Outcome::Put(Box::new(target)), Op::Rollback)
        }
        Content::Promote => promote(state, &item.key),
        Content::Abort(reason) => abort(state, &item.key, reason),
    }
}

fn precondition(state: &State, request: &Request, item: &Item, current: Option<&Document>) -> Result<(), Box<Problem>> {
    // Of what is missing, that of the store is told.
    let revision = current.map_or(state.revision(), |document| document.revision);
    let fail = |problem: Problem| Err(Box::new(problem.at(revision)));
    let many = request.form == Form::Many;
    let rolls_back = matches!(item.content, Content::Restore(_) | Content::Promote | Content::Abort(_));
    if let Some(revision) = request.unchanged_since.get(&item.key)
        && current.map_or(0, |document| document.revision) != *revision
    {
        let detail = format!("{} was changed since; `force` reverts it all the same", item.key);
        return fail(Problem::new(Code::RevisionConflict, detail));
    }
    match (&item.precondition, current) {
        // Not found comes before preconditions, for what needs a document.
        (_, None) if matches!(item.content, Content::Patch(_) | Content::Delete) && !many => {
            Err(Box::new(not_found(&item.key)))
        }
        (Precondition::None, Some(_)) if request.form == Form::Single && !rolls_back => {
            let detail = format!(
                "{} exists: say which revision you change with If-Match (its ETag), or `*` for any",
                item.key
            );
            fail(Problem::new(Code::PreconditionRequired, detail))
        }
        (Precondition::Revisions(wanted), Some(document)) if !wanted.contains(&document.revision) => {
            let code = if many {
                Code::RevisionConflict
            } else {
                Code::PreconditionFailed
            };
            let detail = format!("{} has revision {} now: read it again", item.key, document.revision);
            fail(Problem::new(code, detail))
        }
        (Precondition::Revisions(_) | Precondition::Any, None) => {
            let code = if many {
                Code::RevisionConflict
            } else {
                Code::PreconditionFailed
            };
            fail(Problem::new(code, format!("{} does not exist", item.key)))
        }
        (Precondition::Absent, Some(_)) if request.form != Form::Create => {
            fail(Problem::new(Code::PreconditionFailed, format!("{} exists", item.key)))
        }
        _ => Ok(()),
    }
}

/// A document as a user wrote it, checked by itself.
fn written(input: &DocumentInput, current: Option<&Document>) -> Result<Target, Box<Problem>> {
    let faults = spec::check(&input.key, &input.labels, &input.annotations, &input.spec);
    let bytes = spec::document_size(&input.labels, &input.annotations, &input.spec);
    if bytes > MAX_DOCUMENT_BYTES {
        let detail = format!(
            "{} has {bytes} bytes, at most {MAX_DOCUMENT_BYTES} are allowed",
            input.key
        );
        return Err(Box::new(Problem::new(Code::PayloadTooLarge, detail)));
    }
    if !faults.is_empty() {
        return Err(Box::new(Problem::faults(faults)));
    }
    let status = match (input.key.kind(), current) {
        // Its canaries are found once the rest of the request is known.
        (Kind::Rollout, None) => Some(json!({ "phase": "canary", "canaries": [] })),
        (Kind::Rollout, Some(current)) => {
            if !same_spec(&current.spec, &input.spec) {
                let detail = format!(
                    "{} has begun: its spec stays as it is; abort it and start another one",
                    input.key
                );
                let problem = Problem::new(Code::RolloutState, detail).at(current.revision);
                return Err(Box::new(problem));
            }
            current.status.clone()
        }
        _ => None,
    };
    Ok(Target {
        labels: input.labels.clone(),
        annotations: input.annotations.clone(),
        spec: input.spec.clone(),
        status,
        from_uid: None,
    })
}

/// What a merge patch makes of a document, as if the user had written it whole.
fn patch_input(state: &State, key: &Key, patch: &Value) -> Result<DocumentInput, Vec<FieldFault>> {
    let Some(held) = state.get(key) else {
        return Err(vec![invalid("", "it does not exist")]);
    };
    let Value::Object(members) = patch else {
        return Err(vec![invalid(
            "",
            "a patch is an object with labels, annotations or spec",
        )]);
    };
    let mut whole = json!({
        "labels": held.document.labels, "annotations": held.document.annotations, "spec": *held.shown.spec,
    });
    let known = ["labels", "annotations", "spec", "kind", "name", "service"];
    let server_set = ["uid", "revision", "create_time", "update_time", "updated_by", "status"];
    let mut own = Map::new();
    for (name, value) in members {
        if server_set.contains(&name.as_str()) {
            continue;
        }
        if !known.contains(&name.as_str()) {
            return Err(vec![invalid(&format!("/{name}"), "is no member of a document")]);
        }
        own.insert(name.clone(), value.clone());
    }
    let needed = ["kind", "name"]
        .into_iter()
        .chain(key.service_name().map(|_| "service"));
    for name in needed {
        if own.get(name).is_some_and(Value::is_null) {
            return Err(vec![invalid(&format!("/{name}"), "cannot be taken away")]);
        }
    }
    merge::merge_patch(&mut whole, &Value::Object(own));
    let envelope = spec::parse_envelope(whole, Some(key))?;
    Ok(DocumentInput {
        key: key.clone(),
        labels: envelope.labels,
        annotations: envelope.annotations,
        spec: envelope.spec,
    })
}

/// The roll-out of a key, if it can still be promoted or aborted.
fn canary_phase(state: &State, key: &Key) -> Result<Arc<Document>, Box<Problem>> {
    let Some(held) = state.get(key) else {
        return Err(Box::new(not_found(key)));
    };
    if is_active(&held.document) {
        return Ok(Arc::clone(&held.document));
    }
    let detail = format!(
        "{key} is {}; only one in phase canary can be promoted or aborted",
        phase(&held.document)
    );
    Err(Box::new(
        Problem::new(Code::RolloutState, detail).at(held.document.revision),
    ))
}

fn with_phase(rollout: &Document, phase: &str, reason: &str) -> Outcome {
    let mut status = rollout.status.clone().unwrap_or_else(|| json!({}));
    if let Value::Object(members) = &mut status {
        members.insert("phase".to_owned(), phase.into());
        if !reason.is_empty() {
            members.insert("reason".to_owned(), reason.into());
        }
    }
    Outcome::Put(Box::new(Target {
        labels: rollout.labels.clone(),
        annotations: rollout.annotations.clone(),
        spec: (*rollout.spec).clone(),
        status: Some(status),
        from_uid: None,
    }))
}

fn promote(state: &State, key: &Key) -> Result<Vec<(Key, Outcome, Op)>, Box<Problem>> {
    let rollout = canary_phase(state, key)?;
    let target = rollout_target(&rollout).unwrap_or_else(|| key.clone());
    let Some(held) = state.get(&target) else {
        return Err(Box::new(not_found(&target)));
    };
    let mut spec = (*held.document.spec).clone();
    if let Some(patch) = rollout.spec_member("patch") {
        merge::merge_patch(&mut spec, patch);
    }
    let shown = secret::redact(&spec);
    too_large(&held.document, &shown)?;
    let faults = spec::check(&target, &held.document.labels, &held.document.annotations, &shown);
    if !faults.is_empty() {
        return Err(Box::new(Problem::faults(faults)));
    }
    let changed = Outcome::Put(Box::new(Target {
        labels: held.document.labels.clone(),
        annotations: held.document.annotations.clone(),
        spec,
        status: held.document.status.clone(),
        from_uid: None,
    }));
    Ok(vec![
        (key.clone(), with_phase(&rollout, "promoted", ""), Op::Update),
        (target, changed, Op::Update),
    ])
}

fn abort(state: &State, key: &Key, reason: &str) -> Result<Vec<(Key, Outcome, Op)>, Box<Problem>> {
    let rollout = canary_phase(state, key)?;
    Ok(vec![(key.clone(), with_phase(&rollout, "aborted", reason), Op::Update)])
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

fn prune_into(
    state: &State,
    request: &Request,
    prune: &Prune,
    outcomes: &mut BTreeMap<Key, (Outcome, Op)>,
    order: &mut Vec<Key>,
) -> Result<(), Problem> {
    let view = view(&request.caller.claims);
    let gone: Vec<Key> = state
        .all()
        .filter(|(key, held)| {
            !outcomes.contains_key(*key)
                && prune.selector.matches(&held.document.labels)
                && view.sees_document(state, &held.document)
        })
        .map(|(key, _)| key.clone())
        .collect();
    let confirmed = prune.confirm == u64::try_from(gone.len()).ok();
    if gone.len() > PRUNE_FREELY && !confirmed {
        let detail = format!(
            "prune would delete {} documents; more than {PRUNE_FREELY} need prune_confirm={}",
            gone.len(),
            gone.len()
        );
        return Err(Problem::new(Code::LimitExceeded, detail).at(state.revision()));
    }
    for key in gone {
        order.push(key.clone());
        outcomes.insert(key, (Outcome::Remove, Op::Delete));
    }
    Ok(())
}

/// Adds what refers to what is deleted, until nothing is left over.
fn cascade_into(state: &State, outcomes: &mut BTreeMap<Key, (Outcome, Op)>, order: &mut Vec<Key>) {
    let mut open: Vec<Key> = outcomes
        .iter()
        .filter(|(_, (outcome, _))| matches!(outcome, Outcome::Remove))
        .map(|(key, _)| key.clone())
        .collect();
    let mut seen: BTreeSet<Key> = open.iter().cloned().collect();
    while let Some(key) = open.pop() {
        for referrer in refs::referrers(state, &key, usize::MAX) {
            if seen.insert(referrer.clone()) {
                outcomes.insert(referrer.clone(), (Outcome::Remove, Op::Delete));
                order.push(referrer.clone());
                open.push(referrer);
            }
        }
    }
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

/// Absent `config` and `overrides` mean `{}`.
fn same_spec(one: &Value, other: &Value) -> bool {
    let is_default = |name: &str, value: &Value| {
        matches!(name, "config" | "overrides") && value.as_object().is_some_and(Map::is_empty)
    };
    let (Some(one), Some(other)) = (one.as_object(), other.as_object()) else {
        return one == other;
    };
    let covered = |one: &Map<String, Value>, other: &Map<String, Value>| {
        one.iter().all(|(name, value)| match other.get(name) {
            Some(found) => same_value(found, value),
            None => is_default(name, value),
        })
    };
    covered(one, other) && covered(other, one)
}

/// `1` and `1.0` are the same number, as they are in the canonical text.
fn same_value(one: &Value, other: &Value) -> bool {
    match (one, other) {
        (Value::Number(one), Value::Number(other)) => one == other || one.as_f64() == other.as_f64(),
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len() && one.iter().zip(other).all(|(one, other)| same_value(one, other))
        }
        (Value::Object(one), Value::Object(other)) => {
            one.len() == other.len()
                && one
                    .iter()
                    .all(|(name, value)| other.get(name).is_some_and(|found| same_value(value, found)))
        }
        (one, other) => one == other,
    }
}

fn is_set(value: Option<&Value>) -> bool {
    value.is_some_and(|value| !value.is_null())
}

pub(super) fn invalid(pointer: &str, detail: &str) -> FieldFault {
    FieldFault {
        pointer: pointer.to_owned(),
        code: Code::ValidationFailed,
        detail: detail.to_owned(),
        document: None,
    }
}

fn twice(key: &Key) -> FieldFault {
    invalid("/name", &format!("{key} stands in the request twice"))
}

fn not_found(key: &Key) -> Problem {
    Problem::new(Code::NotFound, format!("there is no {key}"))
}

/// Names referrers as far as the token sees them, before the change (where what they stand on is there) or after it. How
/// many there are besides is nothing to who does not see them.
fn in_use(key: &Key, referrers: &[Key], states: [&State; 2], view: &View) -> Problem {
    let is_seen = |key: &&Key| {
        states.iter().any(|state| {
            let held = state.get(key);
            held.is_some_and(|held| view.sees_document(state, &held.document))
        })
    };
    let seen = referrers.iter().filter(is_seen).count();
    let named = referrers.iter().filter(is_seen).take(NAMED);
    let mut named: Vec<String> = named.map(ToString::to_string).collect();
    match seen - named.len() {
        0 => {}
        1 => named.push("1 other".to_owned()),
        others if referrers.len() == COUNTED => named.push(format!("{others} or more others")),
        others => named.push(format!("{others} others")),
    }
    if seen < referrers.len() {
        named.push("documents that the token does not see".to_owned());
    }
    let detail = format!(
        "{key} is referred to by {}: delete those first, or use cascade=true",
        named.join(", ")
    );
    Problem::new(Code::InUse, detail)
}

/// Faults of the documents of one request: all that are invalid first, then all that conflict.
struct Faults {
    form: Form,
    invalid: Vec<FieldFault>,
    conflicts: Vec<(usize, Problem)>,
}

impl Faults {
    fn new(form: Form) -> Self {
        Self {
            form,
            invalid: Vec::new(),
            conflicts: Vec::new(),
        }
    }

    /// How many more are told.
    fn room(&self) -> usize {
        MAX_FAULTS - self.invalid.len().min(MAX_FAULTS)
    }

    fn add(&mut self, index: usize, mut fault: FieldFault) {
        if self.room() == 0 {
            return;
        }
        if self.form == Form::Many {
            fault.document = Some(index);
        }
        self.invalid.push(fault);
    }

    fn has_room_for_conflicts(&self) -> bool {
        self.conflicts.len() < MAX_FAULTS
    }

    fn conflict(&mut self, index: usize, problem: Problem) {
        if self.has_room_for_conflicts() {
            self.conflicts.push((index, problem));
        }
    }

    /// A refusal of one document: of many, all are told; of one, it is the answer.
    fn problem(&mut self, index: usize, problem: Problem) -> Result<(), Problem> {
        if self.form != Form::Many || !matches!(problem.code.http_status(), Some(409 | 422)) {
            return Err(problem);
        }
        if problem.code.http_status() == Some(409) {
            self.conflict(index, problem);
        } else {
            problem.errors.into_iter().for_each(|fault| self.add(index, fault));
        }
        Ok(())
    }

    fn finish_invalid(&mut self) -> Result<(), Problem> {
        if self.invalid.is_empty() {
            return Ok(());
        }
        Err(Problem::faults(std::mem::take(&mut self.invalid)))
    }

    fn finish_conflicts(&mut self) -> Result<(), Problem> {
        let Some((_, first)) = self.conflicts.first() else {
            return Ok(());
        };
        let mut problem = first.clone();
        if self.form == Form::Many {
            let fault = |(index, problem): &(usize, Problem)| FieldFault {
                pointer: String::new(),
                code: problem.code,
                detail: problem.detail.clone(),
                document: Some(*index),
            };
            problem.errors = self.conflicts.iter().map(fault).collect();
        }
        Err(problem)
    }
}
