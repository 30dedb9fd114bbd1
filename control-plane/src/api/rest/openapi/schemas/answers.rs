//! Answers that are no documents. Later versions may add members.

use blaze_domain::config::{Code, MAX_INTEGER};
use serde_json::json;
use utoipa::openapi::schema::{ObjectBuilder, Type};

use super::super::patterns::HASH;
use super::super::shapes::{
    Shape, answer, anything, flag, formed, free, like, list, map, or_null, refer, refer_or_null, said, text, time,
    whole, word,
};
use super::{kinds, name, page, real_revision, revision};

/// All of them.
pub(super) fn all() -> [(&'static str, Shape); 22] {
    [
        ("Problem", problem()),
        ("FieldFault", field_fault()),
        ("Delta", delta()),
        ("Place", place()),
        ("ApplyResult", apply_result()),
        ("ApplyReport", apply_report()),
        ("Effective", effective()),
        ("Explanation", explanation()),
        ("HistoryEntry", history_entry()),
        ("HistoryPage", page("HistoryEntry")),
        ("DiffReport", diff_report()),
        ("WatchEvent", watch_event()),
        ("Topology", topology()),
        ("Worker", worker()),
        ("WorkerPage", page("Worker")),
        ("Digest", digest()),
        ("AuditEntry", audit_entry()),
        ("AuditPage", page("AuditEntry")),
        ("Token", token()),
        ("TokenPage", page("Token")),
        ("NewToken", new_token()),
        ("OldestRevision", oldest_revision()),
    ]
}

fn code() -> ObjectBuilder {
    like(formed("^[a-z_]+$", 1, 64), json!(Code::ValidationFailed.as_str()))
}

fn field_fault() -> Shape {
    answer(
        &["pointer", "code", "detail"],
        [
            ("pointer", said(text(), "Where in the document, as a JSON pointer.")),
            ("code", code().into()),
            ("detail", text().into()),
            (
                "document",
                said(whole(0, 999), "Which document of the request, from 0."),
            ),
        ],
    )
    .into()
}

fn problem() -> Shape {
    let problem = answer(
        &[
            "type",
            "title",
            "status",
            "detail",
            "instance",
            "code",
            "request_id",
            "applied",
        ],
        [
            ("type", said(text(), "Path of a page about the code.")),
            ("title", text().into()),
            ("status", whole(400, 599).into()),
            ("detail", text().into()),
            ("instance", said(text(), "Path of the request.")),
            ("code", code().into()),
            ("request_id", text().into()),
            (
                "applied",
                said(word(["no", "unknown"]), "Whether a change took effect."),
            ),
            ("errors", list(refer("FieldFault")).into()),
            ("revision", revision().into()),
            (
                "oldest_revision",
                said(revision(), "The smallest revision that a watch may start after."),
            ),
            ("retry_after_s", whole(0, MAX_INTEGER).into()),
        ],
    );
    said(
        problem,
        "A refusal (RFC 9457). In the stream of a watch `status` may be missing.",
    )
}

fn delta() -> Shape {
    answer(
        &["op", "path"],
        [
            ("op", word(["add", "remove", "replace"]).into()),
            ("path", text().into()),
            ("old", anything("What was there; not of `add`.")),
            ("value", anything("What is there now; not of `remove`.")),
        ],
    )
    .into()
}

fn place() -> Shape {
    answer(
        &["service", "instance", "layer", "node"],
        [
            ("service", or_null(text()).into()),
            ("instance", or_null(text()).into()),
            ("layer", or_null(text()).into()),
            ("node", or_null(text()).into()),
        ],
    )
    .into()
}

fn apply_result() -> Shape {
    answer(
        &["kind", "name", "action", "revision", "changes"],
        [
            ("kind", word(kinds()).into()),
            ("name", name().into()),
            ("service", name().into()),
            ("action", word(["created", "updated", "deleted", "unchanged"]).into()),
            ("revision", revision().into()),
            ("changes", list(refer("Delta")).into()),
        ],
    )
    .into()
}

fn apply_report() -> Shape {
    answer(
        &["dry_run", "revision", "results", "affected", "affected_total"],
        [
            ("dry_run", flag().into()),
            ("revision", revision().into()),
            (
                "results",
                list(refer("ApplyResult"))
                    .description(Some("In the order of the request, then what was pruned."))
                    .into(),
            ),
            (
                "affected",
                list(refer("Place"))
                    .description(Some("Whose effective configuration changes; the first 1,000."))
                    .into(),
            ),
            ("affected_total", whole(0, MAX_INTEGER).into()),
        ],
    )
    .into()
}

fn effective() -> Shape {
    answer(
        &[
            "service", "instance", "layer", "node", "revision", "hash", "rollout", "config",
        ],
        [
            ("service", or_null(text()).into()),
            ("instance", or_null(text()).into()),
            ("layer", or_null(text()).into()),
            ("node", or_null(text()).into()),
            ("revision", revision().into()),
            ("hash", formed(HASH, 71, 71).into()),
            (
                "rollout",
                said(or_null(text()), "Name of the roll-out that is part of it."),
            ),
            ("config", said(free(), "All parts, merged.")),
            (
                "explain",
                said(
                    map(refer("Explanation")),
                    "By JSON pointer: where each value comes from.",
                ),
            ),
        ],
    )
    .into()
}

fn explanation() -> Shape {
    answer(
        &["kind", "name", "revision"],
        [
            ("kind", word(kinds()).into()),
            ("service", name().into()),
            ("name", name().into()),
            ("revision", revision().into()),
            ("override", said(flag(), "It comes from `overrides`.")),
            ("removed", said(flag(), "A `null` took the key away.")),
            (
                "overridden",
                list(free())
                    .description(Some("Weaker parts that had a value here."))
                    .into(),
            ),
        ],
    )
    .into()
}

fn history_entry() -> Shape {
    answer(
        &["revision", "op", "time", "subject", "request_id", "paths"],
        [
            ("revision", real_revision().into()),
            ("op", word(["create", "update", "delete", "rollback"]).into()),
            ("time", time().into()),
            ("subject", text().into()),
            ("request_id", text().into()),
            ("paths", list(text()).into()),
            (
                "document",
                refer_or_null("Document", "With `view=full`; `null` of a deletion."),
            ),
        ],
    )
    .into()
}

fn diff_report() -> Shape {
    answer(
        &["from", "to", "changes"],
        [
            ("from", revision().into()),
            ("to", revision().into()),
            ("changes", list(refer("Delta")).into()),
        ],
    )
    .into()
}

fn watch_event() -> Shape {
    let change = answer(
        &["op", "kind", "name", "document"],
        [
            ("op", word(["create", "update", "delete", "leave"]).into()),
            ("kind", word(kinds()).into()),
            ("name", name().into()),
            ("service", name().into()),
            ("document", refer("Document")),
        ],
    );
    let event = answer(
        &["revision", "time", "subject", "changes"],
        [
            ("revision", real_revision().into()),
            ("time", time().into()),
            ("subject", text().into()),
            ("changes", list(change).min_items(Some(1)).into()),
        ],
    );
    said(event, "`data` of an event `change`: one commit.")
}

fn topology() -> Shape {
    let nullable_time = || or_null(time());
    let worker = answer(
        &["connected", "revision", "in_sync", "last_seen"],
        [
            ("connected", or_null(flag()).into()),
            ("revision", or_null(revision()).into()),
            ("in_sync", or_null(flag()).into()),
            ("last_seen", nullable_time().into()),
        ],
    );
    let service = answer(
        &["service", "instance", "state", "config_revision"],
        [
            ("service", text().into()),
            ("instance", or_null(text()).into()),
            ("state", or_null(text()).into()),
            ("config_revision", or_null(revision()).into()),
        ],
    );
    let node = answer(
        &["name", "type", "worker", "services"],
        [
            ("name", name().into()),
            ("type", text().into()),
            ("worker", worker.into()),
            ("services", list(service).into()),
        ],
    );
    let layer = answer(
        &["name", "kind", "nodes"],
        [
            ("name", name().into()),
            ("kind", text().into()),
            ("nodes", list(node).into()),
        ],
    );
    let number = || or_null(ObjectBuilder::new().schema_type(Type::Number));
    let link = answer(
        &["from_node", "to_node", "latency_ms", "loss"],
        [
            ("from_node", text().into()),
            ("to_node", text().into()),
            ("latency_ms", number().into()),
            ("loss", number().into()),
        ],
    );
    let topology = answer(
        &["revision", "layers", "links"],
        [
            ("revision", revision().into()),
            ("layers", list(layer).into()),
            ("links", list(link).into()),
        ],
    );
    said(topology, "What is known; unknown values are `null`.")
}

fn worker() -> Shape {
    answer(
        &["layer", "node", "worker_id"],
        [
            ("layer", text().into()),
            ("node", or_null(text()).into()),
            ("worker_id", text().into()),
            ("version", or_null(text()).into()),
            ("connected", or_null(flag()).into()),
            ("revision", or_null(revision()).into()),
            ("digest", or_null(text()).into()),
            ("in_sync", or_null(flag()).into()),
            ("last_seen", or_null(time()).into()),
        ],
    )
    .into()
}

fn digest() -> Shape {
    answer(
        &["revision", "digest"],
        [("revision", revision().into()), ("digest", formed(HASH, 71, 71).into())],
    )
    .into()
}

fn audit_entry() -> Shape {
    answer(
        &[
            "id",
            "time",
            "revision",
            "subject",
            "roles",
            "action",
            "kind",
            "service",
            "name",
            "outcome",
            "code",
            "paths",
            "request_id",
            "address",
        ],
        [
            ("id", text().into()),
            ("time", time().into()),
            (
                "revision",
                said(or_null(revision()), "Of the change; `null` for what changed nothing."),
            ),
            ("subject", text().into()),
            ("roles", list(text()).into()),
            ("action", text().into()),
            ("kind", or_null(text()).into()),
            ("service", or_null(text()).into()),
            ("name", or_null(text()).into()),
            ("outcome", word(["allowed", "denied"]).into()),
            ("code", or_null(text()).into()),
            ("paths", list(text()).into()),
            ("request_id", text().into()),
            ("address", text().into()),
            ("detail", said(or_null(text()), "Why a token was refused.")),
        ],
    )
    .into()
}

fn token() -> Shape {
    answer(
        &[
            "id",
            "subject",
            "roles",
            "layer",
            "create_time",
            "expire_time",
            "revoke_time",
        ],
        [
            ("id", text().into()),
            ("subject", text().into()),
            ("roles", list(text()).into()),
            ("layer", or_null(text()).into()),
            ("create_time", time().into()),
            ("expire_time", time().into()),
            ("revoke_time", or_null(time()).into()),
        ],
    )
    .into()
}

fn new_token() -> Shape {
    answer(
        &["id", "token", "subject", "roles", "layer", "expire_time"],
        [
            ("id", text().into()),
            ("token", said(text(), "The token itself: shown here and never again.")),
            ("subject", text().into()),
            ("roles", list(text()).into()),
            ("layer", or_null(text()).into()),
            ("expire_time", time().into()),
        ],
    )
    .into()
}

fn oldest_revision() -> Shape {
    answer(
        &["oldest_revision"],
        [(
            "oldest_revision",
            said(revision(), "The smallest revision that a watch may start after."),
        )],
    )
    .into()
}
