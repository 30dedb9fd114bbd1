//! The spec of a roll-out.

use super::configuration::{check_configuration, check_override};
use super::fields::{At, Fields};
use super::{GATE_WINDOW_S, MAX_UNHEALTHY, members_of};
use crate::config::selector::{LabelSelector, MAX_SELECTOR_BYTES};
use crate::config::{Kind, json};
use crate::names::{DocumentName, ServiceName};

pub(super) fn check_rollout(spec: &Fields<'_>) {
    let target = spec.need("target").and_then(|at| at.fields(&["kind", "name", "service"]));
    let kind = target.as_ref().and_then(check_target);
    if let Some(patch) = spec.need("patch") {
        check_patch(&patch, kind);
    }
    if let Some(canary) = spec.need("canary").and_then(|at| at.fields(&["node_selector"]))
        && let Some(at) = canary.need("node_selector")
        && let Some(text) = at.text(MAX_SELECTOR_BYTES)
        && let Err(error) = text.parse::<LabelSelector>()
    {
        at.refuse::<()>(format!("the selector {error}"));
    }
    if let Some(gate) = spec.get("gate").and_then(|at| at.fields(&["window_s", "max_unhealthy"])) {
        gate.get("window_s").and_then(|at| at.whole(GATE_WINDOW_S.0, GATE_WINDOW_S.1));
        gate.get("max_unhealthy").and_then(|at| at.whole(0, MAX_UNHEALTHY));
    }
}

fn check_target(target: &Fields<'_>) -> Option<Kind> {
    target.need("name").and_then(|at| at.parsed::<DocumentName>());
    let service = target.get("service");
    if let Some(at) = &service {
        at.parsed::<ServiceName>();
    }
    let at = target.need("kind")?;
    let kind: Kind = at.parsed()?;
    match (kind, service) {
        (Kind::Rollout, _) => return at.refuse("a Rollout cannot be the target of another one"),
        (Kind::Instance, None) => target
            .at
            .faults
            .add(&json::push(&target.at.pointer, "service"), "is required of an Instance"),
        (Kind::Instance, Some(_)) | (_, None) => {}
        (_, Some(service)) => {
            service.refuse::<()>(format!("a {kind} has no service"));
        }
    }
    Some(kind)
}

/// A merge patch on the target's spec: `null` removes, also whole configurations. What comes out of
/// it is checked when the target is known.
fn check_patch(patch: &At<'_>, kind: Option<Kind>) {
    let Some(kind) = kind else {
        if !patch.value.is_object() {
            patch.expected::<()>("an object");
        }
        return;
    };
    let Some(patch) = patch.fields(members_of(kind)) else {
        return;
    };
    let is_there = |at: &At<'_>| !at.value.is_null();
    if let Some(at) = patch.get("config").filter(is_there) {
        check_configuration(&at);
    }
    if let Some(at) = patch.get("overrides").filter(is_there) {
        for (service, at) in at.entries() {
            check_override(service, &at);
            if is_there(&at) {
                check_configuration(&at);
            }
        }
    }
}
