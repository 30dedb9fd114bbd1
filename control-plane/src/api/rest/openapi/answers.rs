//! Answers of the operations: what they give when all goes well, and every refusal.

use blaze_domain::config::{Code, Kind, MAX_INTEGER};
use serde_json::json;
use utoipa::openapi::content::ContentBuilder;
use utoipa::openapi::header::HeaderBuilder;
use utoipa::openapi::{Header, Ref, RefOr, Response, ResponseBuilder, Responses, ResponsesBuilder};

use super::super::negotiate::EVENT_STREAM;
use super::super::reply::{JSON, PROBLEM};
use super::super::routes::{Action, Payload, Route, Verb};
use super::shapes::{refer, text, whole};

/// Refusals that any operation may meet.
const ALWAYS: &[u16] = &[400, 401, 403, 406, 414, 429, 431, 500, 503, 504];

/// All statuses of an operation.
pub(super) fn statuses(route: &Route) -> Vec<u16> {
    let mut all: Vec<u16> = ALWAYS.iter().chain(route.statuses).copied().collect();
    if route.path.contains('{')
        || matches!(
            route.action,
            Action::Effective | Action::Digest | Action::Revert | Action::Apply
        )
    {
        all.push(404);
    }
    all.sort_unstable();
    all
}

/// All answers of an operation.
pub(super) fn of(route: &Route) -> Responses {
    let answers = statuses(route).into_iter().map(|status| {
        let answer: RefOr<Response> = match status {
            200..=399 => success(route, status).into(),
            refusal => Ref::from_response_name(refusal_name(refusal)).into(),
        };
        (status.to_string(), answer)
    });
    ResponsesBuilder::new().responses_from_iter(answers).build()
}

/// The schema of what an operation gives.
fn schema(action: Action) -> Option<String> {
    let whole = |kind: Kind| kind.as_str().to_owned();
    Some(match action {
        Action::List(kind) => format!("{kind}Page"),
        Action::Create(kind)
        | Action::Get(kind)
        | Action::Replace(kind)
        | Action::Patch(kind)
        | Action::Rollback(kind) => whole(kind),
        Action::Promote | Action::Abort => whole(Kind::Rollout),
        Action::Delete(_) | Action::RevokeToken | Action::Watch => return None,
        Action::History(_) => "HistoryPage".to_owned(),
        Action::Diff(_) => "DiffReport".to_owned(),
        Action::Apply | Action::Revert => "ApplyReport".to_owned(),
        Action::Effective => "Effective".to_owned(),
        Action::Topology => "Topology".to_owned(),
        Action::Workers => "WorkerPage".to_owned(),
        Action::Digest => "Digest".to_owned(),
        Action::Audit => "AuditPage".to_owned(),
        Action::Tokens => "TokenPage".to_owned(),
        Action::CreateToken => "NewToken".to_owned(),
        Action::Trim => "OldestRevision".to_owned(),
    })
}

fn gives_document(action: Action) -> bool {
    matches!(
        action,
        Action::Create(_)
            | Action::Get(_)
            | Action::Replace(_)
            | Action::Patch(_)
            | Action::Rollback(_)
            | Action::Promote
            | Action::Abort
    )
}

fn success(route: &Route, status: u16) -> Response {
    let said = match status {
        201 => "It is made.",
        204 => "It is gone.",
        304 => "The client has it already.",
        _ if route.action == Action::Watch => "Events as they come, without end.",
        _ => "Done.",
    };
    let mut answer = ResponseBuilder::new().description(said);
    for name in ["X-Request-Id", "Blaze-Revision"] {
        answer = answer.header_ref(name, header_ref(name));
    }
    if gives_document(route.action) {
        answer = answer.header_ref("ETag", header_ref("ETag"));
    }
    if status == 201 && route.action != Action::CreateToken {
        answer = answer.header_ref("Location", header_ref("Location"));
    }
    if route.verb == Verb::Post && route.payload != Payload::Token {
        answer = answer.header_ref("Idempotent-Replayed", header_ref("Idempotent-Replayed"));
    }
    if matches!(status, 204 | 304) {
        return answer.build();
    }
    match schema(route.action) {
        Some(name) => answer
            .content(JSON, ContentBuilder::new().schema(Some(refer(&name))).build())
            .build(),
        None => answer.content(EVENT_STREAM, events()).build(),
    }
}

fn events() -> utoipa::openapi::Content {
    let example = "retry: 2731\nid: 413\nevent: change\ndata: {\"revision\":413,\"time\":\"2026-11-21T07:01:12.345Z\",\
        \"subject\":\"ops\",\"changes\":[]}\n\nid: 419\nevent: bookmark\ndata: {\"revision\":419}\n\n";
    let said =
        "Server-sent events: `change` with a `WatchEvent`, `bookmark` with `{\"revision\"}`, `error` with a `Problem`.";
    ContentBuilder::new()
        .schema(Some(text().description(Some(said))))
        .example(Some(json!(example)))
        .build()
}

fn header_ref(name: &str) -> Ref {
    Ref::new(format!("#/components/headers/{name}"))
}

/// Headers of answers.
pub(super) fn headers() -> Vec<(&'static str, Header)> {
    let header = |said: &str, shape: utoipa::openapi::schema::ObjectBuilder| {
        HeaderBuilder::new().schema(Some(shape)).description(Some(said)).build()
    };
    vec![
        (
            "X-Request-Id",
            header("The id of the request: its own if it fits, else a new one.", text()),
        ),
        (
            "Blaze-Revision",
            header(
                "The revision that the answer reflects; of a write, its own.",
                whole(0, MAX_INTEGER),
            ),
        ),
        ("ETag", header("The revision of the document, in quotes.", text())),
        ("Location", header("Path of the new document.", text())),
        ("Idempotent-Replayed", header("`true`: the first answer again.", text())),
        (
            "Retry-After",
            header("When to try again, in seconds.", whole(0, MAX_INTEGER)),
        ),
        (
            "WWW-Authenticate",
            header("`Bearer`, with an error if a token was sent.", text()),
        ),
        ("Accept-Patch", header("Types that PATCH takes.", text())),
    ]
}

fn refusal_name(status: u16) -> String {
    format!("Refusal{status}")
}

/// Every refusal by its status.
pub(super) fn refusals() -> Vec<(String, Response)> {
    let mut statuses: Vec<u16> = Code::ALL.iter().filter_map(|code| code.http_status()).collect();
    statuses.sort_unstable();
    statuses.dedup();
    // A path of this document takes the method of its operation.
    statuses.retain(|status| *status != 405);
    statuses
        .into_iter()
        .map(|status| (refusal_name(status), refusal(status)))
        .collect()
}

fn refusal(status: u16) -> Response {
    let codes: Vec<String> = Code::ALL
        .iter()
        .filter(|code| code.http_status() == Some(status))
        .map(|code| format!("`{code}`: {}", code.title()))
        .collect();
    let mut answer = ResponseBuilder::new()
        .description(codes.join(" "))
        .content(PROBLEM, ContentBuilder::new().schema(Some(refer("Problem"))).build())
        .header_ref("X-Request-Id", header_ref("X-Request-Id"));
    let further: &[&str] = match status {
        401 => &["WWW-Authenticate"],
        415 => &["Accept-Patch"],
        429 | 503 => &["Retry-After"],
        _ => &[],
    };
    for name in further {
        answer = answer.header_ref(*name, header_ref(name));
    }
    answer.build()
}
