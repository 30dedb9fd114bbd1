//! What a roll-out needs to begin: nodes to try its change on, and a change that its target may
//! have.

use std::sync::Arc;

use blaze_domain::config::{Code, Document, Kind, MAX_DOCUMENT_BYTES, Problem, merge, spec};
use serde_json::{Value, json};

use super::evaluate::invalid;
use blaze_domain::config::effective::{canaries, patched};
use blaze_domain::config::placement::{placement, rollout_target};
use blaze_domain::config::state::State;

/// Nodes that one roll-out is tried on, at most: each has its line in the status.
const MAX_CANARIES: usize = 1000;

/// The status of a roll-out that begins in a state of which it is part.
pub(super) fn begin(after: &State, rollout: &Document) -> Result<Value, Box<Problem>> {
    let nodes = nodes(after, rollout);
    if nodes.is_empty() {
        let detail = "matches no node on which the target counts; at least one must try the change";
        return Err(refusal("/spec/canary/node_selector", detail));
    }
    if nodes.len() > MAX_CANARIES {
        let detail =
            format!("matches more than {MAX_CANARIES} nodes; choose fewer to try the change on");
        return Err(refusal("/spec/canary/node_selector", &detail));
    }
    let target = rollout_target(rollout).and_then(|key| after.get(&key));
    if let Some(target) = target {
        let mut changed = (*target.shown.spec).clone();
        if let Some(patch) = rollout.spec_member("patch") {
            merge::merge_patch(&mut changed, patch);
        }
        let document = &target.document;
        too_large(document, &changed)?;
        let faults = spec::check(&document.key, &document.labels, &document.annotations, &changed);
        if let Some(fault) = faults.first() {
            let detail = format!(
                "makes of {} a document with a fault: {}: {}",
                document.key, fault.pointer, fault.detail
            );
            return Err(refusal("/spec/patch", &detail));
        }
    }
    Ok(json!({ "phase": "canary", "canaries": nodes }))
}

fn refusal(pointer: &str, detail: &str) -> Box<Problem> {
    Box::new(Problem::faults(vec![invalid(pointer, detail)]))
}

/// The nodes that a roll-out is tried on, as its status tells them.
fn nodes(after: &State, rollout: &Document) -> Vec<Value> {
    let target = rollout_target(rollout).and_then(|key| after.get(&key));
    let Some(selector) = canaries(rollout) else {
        return Vec::new();
    };
    let place = target.map(|target| placement(after, &target.document));
    // A change of what a node never sees cannot be tried there.
    let counts = |node: &Document| {
        let on = placement(after, node);
        place.as_ref().is_none_or(|place| {
            on.layer.is_some_and(|layer| place.visible.contains(&layer))
                && (place.node.is_none() || place.node == on.node)
        })
    };
    after
        .of_kind(Kind::Node, None)
        .filter(|(_, held)| selector.matches(&held.document.labels) && counts(&held.document))
        // One more, to tell that they are too many.
        .take(MAX_CANARIES + 1)
        .map(|(key, _)| {
            json!({ "node": key.name().as_str(), "phase": "pending", "revision": null,
            "reason": "" })
        })
        .collect()
}

/// Puts into a status how it goes on a canary; a node that became one after the beginning is added.
pub(super) fn tell_canary(
    status: &mut Value,
    node: &str,
    phase: &str,
    revision: u64,
    reason: &str,
) {
    let Some(lines) = status.get_mut("canaries").and_then(Value::as_array_mut) else {
        return;
    };
    let line = json!({ "node": node, "phase": phase, "revision": revision, "reason": reason });
    let is_of_node = |line: &Value| line.get("node").and_then(Value::as_str) == Some(node);
    match lines.iter().position(is_of_node) {
        Some(index) => lines[index] = line,
        None if lines.len() < MAX_CANARIES => lines.push(line),
        None => {}
    }
}

/// Refuses a roll-out whose target would have another size than a document may have.
pub(super) fn too_large(target: &Document, changed: &Value) -> Result<(), Box<Problem>> {
    let bytes = spec::document_size(&target.labels, &target.annotations, changed);
    if bytes <= MAX_DOCUMENT_BYTES {
        return Ok(());
    }
    let detail = format!(
        "the patch makes of {} a document of {bytes} bytes, at most {MAX_DOCUMENT_BYTES} are \
         allowed",
        target.key
    );
    Err(Box::new(Problem::new(Code::PayloadTooLarge, detail)))
}

/// The target of a roll-out, and what its patch makes of it.
pub(super) fn tried(state: &State, rollout: &Document) -> Option<(Arc<Document>, Document)> {
    let target = Arc::clone(&state.get(&rollout_target(rollout)?)?.document);
    let patched = patched(&target, rollout.spec_member("patch")?);
    Some((target, patched))
}
