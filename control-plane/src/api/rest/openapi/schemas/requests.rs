//! Bodies of requests that are no documents.

use serde_json::json;

use super::super::super::documents::MAX_REASON;
use super::super::super::tokens::{MAX_LIFE_S, MAX_SUBJECT};
use super::super::shapes::{Shape, closed, flag, free, like, list, or_null, refer, said, text, whole, word};
use super::{kinds, name, real_revision, revision};
use crate::api::DEFAULT_TOKEN_LIFE_S;
use crate::auth::Role;

/// All of them.
pub(super) fn all() -> [(&'static str, Shape); 7] {
    [
        ("DocumentPatch", document_patch()),
        ("ApplyItem", apply_item()),
        ("TokenRequest", token_request()),
        (
            "RollbackRequest",
            revision_request("Content as it was at this revision."),
        ),
        ("RevertRequest", revert_request()),
        ("TrimRequest", trim_request()),
        ("AbortRequest", abort_request()),
    ]
}

fn document_patch() -> Shape {
    let open = |description: &str| said(or_null(free()), description);
    let patch = closed(
        &[],
        [
            ("labels", open("`null` for a key removes it.")),
            ("annotations", open("`null` for a key removes it.")),
            (
                "spec",
                open("`null` removes a member. To store a `null`, use PUT or apply."),
            ),
        ],
    );
    said(
        like(patch, json!({ "labels": { "site": "lab" } })),
        "RFC 7396 merge patch.",
    )
}

fn apply_item() -> Shape {
    let item = closed(
        &["kind", "name"],
        [
            ("kind", word(kinds()).into()),
            ("name", name().into()),
            ("service", said(name(), "Needed of an Instance, and only there.")),
            ("labels", refer("Labels")),
            ("annotations", refer("Annotations")),
            ("spec", said(free(), "Needed, but with `delete`.")),
            (
                "revision",
                said(revision(), "Precondition: the revision that the document must have."),
            ),
            ("delete", flag().default(Some(json!(false))).into()),
        ],
    );
    like(
        item,
        json!({ "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } }),
    )
    .into()
}

fn token_request() -> Shape {
    let request = closed(
        &["subject", "roles"],
        [
            (
                "subject",
                text().min_length(Some(1)).max_length(Some(MAX_SUBJECT)).into(),
            ),
            (
                "roles",
                list(word(Role::ALL.iter().map(|role| role.as_str())))
                    .min_items(Some(1))
                    .unique_items(true)
                    .into(),
            ),
            (
                "layer",
                said(
                    or_null(name()),
                    "Nothing outside its view is seen; needed with the role worker.",
                ),
            ),
            (
                "expires_in_s",
                whole(1, MAX_LIFE_S as i64)
                    .default(Some(json!(DEFAULT_TOKEN_LIFE_S)))
                    .into(),
            ),
        ],
    );
    let example = json!({ "subject": "ops@example.org", "roles": ["operator"], "layer": null, "expires_in_s": 86400 });
    like(request, example).into()
}

fn revision_request(description: &str) -> Shape {
    like(
        closed(&["revision"], [("revision", said(real_revision(), description))]),
        json!({ "revision": 7 }),
    )
    .into()
}

fn revert_request() -> Shape {
    let request = closed(
        &["revision"],
        [
            (
                "revision",
                said(real_revision(), "The commit whose changes are taken back."),
            ),
            (
                "force",
                said(
                    flag().default(Some(json!(false))),
                    "Also documents that were changed since.",
                ),
            ),
        ],
    );
    like(request, json!({ "revision": 7, "force": false })).into()
}

fn trim_request() -> Shape {
    let before = said(real_revision(), "Commits before this revision are forgotten.");
    like(closed(&["before"], [("before", before)]), json!({ "before": 1 })).into()
}

fn abort_request() -> Shape {
    let reason = said(text().max_length(Some(MAX_REASON)), "For people.");
    like(closed(&[], [("reason", reason)]), json!({ "reason": "too slow" })).into()
}
