//! Bodies of requests that are no documents.

use serde_json::json;
use utoipa::PartialSchema;

use super::super::super::requests::{AbortRequest, RevertRequest, RollbackRequest, TokenRequest, TrimRequest};
use super::super::shapes::{Shape, closed, flag, free, like, list, or_null, refer, said, word};
use super::{kinds, name, revision};
use crate::auth::Role;

/// All of them.
pub(super) fn all() -> [(&'static str, Shape); 7] {
    [
        ("DocumentPatch", document_patch()),
        ("ApplyItem", apply_item()),
        ("TokenRequest", TokenRequest::schema()),
        ("RollbackRequest", RollbackRequest::schema()),
        ("RevertRequest", RevertRequest::schema()),
        ("TrimRequest", TrimRequest::schema()),
        ("AbortRequest", AbortRequest::schema()),
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

/// Roles of a token.
pub(in super::super::super) fn roles() -> Shape {
    list(word(Role::ALL.iter().map(|role| role.as_str())))
        .min_items(Some(1))
        .unique_items(true)
        .into()
}

/// Layer of a token.
pub(in super::super::super) fn layer_or_null() -> Shape {
    let said_of = "Nothing outside its view is seen; needed with the role worker.";
    said(or_null(name()), said_of)
}
