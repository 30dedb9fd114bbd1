//! What becomes of each document of a request, and of others along with it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use blaze_domain::config::{
    Code, Document, FieldFault, Key, Kind, Labels, MAX_DOCUMENT_BYTES, Problem, merge, secret, spec,
};
use serde_json::{Map, Value, json};

use super::super::refs;
use super::super::rollouts::{tell_canary, too_large};
use super::super::types::{DocumentInput, Precondition};
use super::super::view::view;
use super::faults::{invalid, not_found};
use super::{Content, Failed, Form, Item, Prune, Request};
use crate::store::Op;
use blaze_domain::config::placement::{is_active, phase, rollout_target};
use blaze_domain::config::state::State;

/// Deletions by `prune` that need no confirmation.
const PRUNE_FREELY: usize = 20;

/// A document that is to be there after the change.
pub(super) struct Target {
    pub(super) labels: Labels,
    pub(super) annotations: Labels,
    pub(super) spec: Value,
    pub(super) status: Option<Value>,
    /// Uid under which encrypted secrets in `spec` were encrypted, if it is not the document's
    /// present one.
    pub(super) from_uid: Option<String>,
}

pub(super) enum Outcome {
    Put(Box<Target>),
    Remove,
    Keep,
}

/// What becomes of the document of one item, and of others that it changes along.
pub(super) fn outcome_of(
    state: &State,
    request: &Request,
    item: &Item,
) -> Result<Vec<(Key, Outcome, Op)>, Box<Problem>> {
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
            let input = patch_input(state, &item.key, patch)
                .map_err(|faults| Box::new(Problem::faults(faults)))?;
            one(Outcome::Put(Box::new(written(&input, Some(current))?)), Op::Update)
        }
        Content::Leave => one(Outcome::Keep, Op::Update),
        Content::Delete => match current {
            Some(_) => one(Outcome::Remove, Op::Delete),
            None if request.form == Form::Many => one(Outcome::Keep, Op::Delete),
            None => Err(Box::new(not_found(&item.key))),
        },
        Content::Restore(None) => {
            one(if current.is_some() { Outcome::Remove } else { Outcome::Keep }, Op::Delete)
        }
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
        Content::Fail(failed) => one(fail(current, failed), Op::Update),
    }
}

fn precondition(
    state: &State,
    request: &Request,
    item: &Item,
    current: Option<&Document>,
) -> Result<(), Box<Problem>> {
    // Of what is missing, that of the store is told.
    let revision = current.map_or(state.revision(), |document| document.revision);
    let fail = |problem: Problem| Err(Box::new(problem.at(revision)));
    let many = request.form == Form::Many;
    let rolls_back = matches!(
        item.content,
        Content::Restore(_) | Content::Promote | Content::Abort(_) | Content::Fail(_)
    );
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
        (Precondition::Revisions(wanted), Some(document))
            if !wanted.contains(&document.revision) =>
        {
            let code = if many { Code::RevisionConflict } else { Code::PreconditionFailed };
            let detail =
                format!("{} has revision {} now: read it again", item.key, document.revision);
            fail(Problem::new(code, detail))
        }
        (Precondition::Revisions(_) | Precondition::Any, None) => {
            let code = if many { Code::RevisionConflict } else { Code::PreconditionFailed };
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
        let detail =
            format!("{} has {bytes} bytes, at most {MAX_DOCUMENT_BYTES} are allowed", input.key);
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
        return Err(vec![invalid("", "a patch is an object with labels, annotations or spec")]);
    };
    let mut whole = json!({
        "labels": held.document.labels, "annotations": held.document.annotations,
        "spec": *held.shown.spec,
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
    let needed = ["kind", "name"].into_iter().chain(key.service_name().map(|_| "service"));
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
    Err(Box::new(Problem::new(Code::RolloutState, detail).at(held.document.revision)))
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

/// What becomes of a roll-out that failed on a canary; one that has ended, or is another one, stays
/// as it is.
fn fail(current: Option<&Document>, failed: &Failed) -> Outcome {
    let is_it = |rollout: &&Document| rollout.uid == failed.uid && is_active(rollout);
    let Some(rollout) = current.filter(is_it) else {
        return Outcome::Keep;
    };
    let Failed { node, reason, revision, .. } = failed;
    let mut outcome = with_phase(rollout, "failed", &format!("{node}: {reason}"));
    if let Outcome::Put(target) = &mut outcome
        && let Some(status) = &mut target.status
    {
        tell_canary(status, node.as_str(), "failed", *revision, reason);
    }
    outcome
}

pub(super) fn prune_into(
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
pub(super) fn cascade_into(
    state: &State,
    outcomes: &mut BTreeMap<Key, (Outcome, Op)>,
    order: &mut Vec<Key>,
) {
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

/// Absent `config` and `overrides` mean `{}`.
pub(super) fn same_spec(one: &Value, other: &Value) -> bool {
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
        (Value::Number(one), Value::Number(other)) => {
            one == other || one.as_f64() == other.as_f64()
        }
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len()
                && one.iter().zip(other).all(|(one, other)| same_value(one, other))
        }
        (Value::Object(one), Value::Object(other)) => {
            one.len() == other.len()
                && one.iter().all(|(name, value)| {
                    other.get(name).is_some_and(|found| same_value(value, found))
                })
        }
        (one, other) => one == other,
    }
}
