//! The OpenAPI document, made from the table of routes and the parts that it does not give.
//!
//! ```text
//! routes ────┐
//! parts.yaml ┴─▶ 3.1.0 ──[twin]──▶ 3.0.3, for tools that do not read 3.1
//! ```
//!
//! Both are committed in `openapi/`; a test compares them, and another one, which is asked for by
//! name, writes them anew: `cargo test -p blaze-config --lib write_openapi -- --ignored`.

#[cfg(test)]
mod tests;
mod twin;

use std::collections::BTreeMap;
use std::sync::LazyLock;

use blaze_domain::config::Code;
use blaze_runtime::config::yaml_documents;
use serde_json::{Map, Value, json};

use super::body::Media;
use super::negotiate::EVENT_STREAM;
use super::reply::{JSON, PROBLEM};
use super::routes::{self, Action, Payload, Route};

/// The parts of `parts.yaml`; a test reads them.
static PARTS: LazyLock<Value> = LazyLock::new(|| {
    let read = yaml_documents(include_str!("parts.yaml"), 1);
    read.ok().and_then(|mut all| all.pop()).unwrap_or_default()
});
/// Refusals that any operation may meet.
const ALWAYS: &[u16] = &[400, 401, 403, 406, 414, 429, 431, 500, 503, 504];

/// The document of OpenAPI 3.1.0, as it is served and committed.
#[must_use]
pub fn openapi_json() -> String {
    pretty(&document())
}

/// Its twin of OpenAPI 3.0.3.
#[must_use]
pub fn openapi_3_0_json() -> String {
    pretty(&twin::to_3_0(&document()))
}

/// JSON as it is committed.
fn pretty(document: &Value) -> String {
    format!("{document:#}\n")
}

fn document() -> Value {
    let mut document = PARTS["document"].clone();
    document["paths"] = paths();
    document["components"]["responses"] = refusals();
    document
}

fn paths() -> Value {
    let mut rows: Vec<&Route> = routes::all().collect();
    rows.sort_by_key(|route| (route.path, route.verb));
    let mut paths = Map::new();
    for route in rows {
        let item = paths.entry(route.path).or_insert_with(|| json!({}));
        item[route.verb.name()] = operation(route);
    }
    Value::Object(paths)
}

fn operation(route: &Route) -> Value {
    let action = action(route.action);
    let mut operation = json!({
        "tags": [action["tag"]],
        "summary": action["summary"],
        "operationId": route.operation,
        "parameters": parameters(route, &action),
    });
    if let Some(name) = action["body"].as_str() {
        operation["requestBody"] = body(route.payload, &PARTS["bodies"][name]);
    }
    operation["responses"] = answers(route, &action);
    operation
}

/// What the parts say of an action, for its kind of document.
fn action(action: Action) -> Value {
    let said = &PARTS["actions"][action.audit_word()];
    let Some(kind) = action.kind() else {
        return said.clone();
    };
    let text = said
        .to_string()
        .replace("{Kind}", kind.as_str())
        .replace("{word}", kind.word())
        .replace("{collection}", kind.collection());
    serde_json::from_str(&text).unwrap_or_default()
}

fn parameters(route: &Route, action: &Value) -> Vec<Value> {
    let parts = &PARTS["parameters"];
    let in_path = route.path.split('/').filter(|segment| segment.starts_with('{'));
    let in_path = in_path.map(|segment| match (segment, route.action) {
        ("{service}", Action::List(_)) => parts["service_or_all"].clone(),
        _ => parts[segment.trim_matches(['{', '}'])].clone(),
    });
    let in_query = route.query.iter().map(|param| {
        json!({
            "name": param.name(),
            "in": "query",
            "description": param.description(),
            "required": words(&action["needs"]).any(|name| name == param.name()),
            "schema": PARTS["query"][format!("{param:?}")],
        })
    });
    let headers = words(&action["headers"]).map(|name| parts[name].clone());
    in_path.chain(in_query).chain(headers).collect()
}

fn words(list: &Value) -> impl Iterator<Item = &str> {
    list.as_array().into_iter().flatten().filter_map(Value::as_str)
}

fn body(payload: Payload, said: &Value) -> Value {
    let content = payload.media().iter().map(|media| {
        let form = match media {
            Media::Json | Media::MergePatch => "json",
            Media::Yaml => "yaml",
        };
        (media.as_str(), &said[form])
    });
    json!({ "content": content.collect::<BTreeMap<_, _>>(), "required": true })
}

/// All answers of an operation.
fn answers(route: &Route, action: &Value) -> Value {
    let mut statuses: Vec<u16> = ALWAYS.iter().chain(route.statuses).copied().collect();
    if route.path.contains('{') {
        statuses.push(404);
    }
    statuses.sort_unstable();
    let answers = statuses.into_iter().map(|status| {
        let answer = match status {
            200..=399 => success(status, action),
            refusal => reference("responses", &refusal_name(refusal)),
        };
        (status.to_string(), answer)
    });
    Value::Object(answers.collect())
}

fn success(status: u16, action: &Value) -> Value {
    let stream = &action["stream"];
    let said = match status {
        201 => "It is made.",
        204 => "It is gone.",
        304 => "The client has it already.",
        _ if stream.is_object() => "Events as they come, without end.",
        _ => "Done.",
    };
    let own = words(&action["gives"]).filter(|name| status == 201 || *name != "Location");
    let mut answer = json!({
        "description": said,
        "headers": headers(own.chain(["Blaze-Revision", "X-Request-Id"])),
    });
    if !matches!(status, 204 | 304) {
        answer["content"] = match action["answer"].as_str() {
            Some(name) => json!({ JSON: { "schema": reference("schemas", name) } }),
            None => json!({ EVENT_STREAM: stream }),
        };
    }
    answer
}

fn reference(group: &str, name: &str) -> Value {
    json!({ "$ref": format!("#/components/{group}/{name}") })
}

fn headers<'a>(names: impl IntoIterator<Item = &'a str>) -> Value {
    let mut names: Vec<&str> = names.into_iter().collect();
    names.sort_unstable();
    let headers = names.into_iter().map(|name| (name.to_owned(), reference("headers", name)));
    Value::Object(headers.collect())
}

fn refusal_name(status: u16) -> String {
    format!("Refusal{status}")
}

/// Every refusal by its status.
fn refusals() -> Value {
    let mut statuses: Vec<u16> = Code::ALL.iter().filter_map(|code| code.http_status()).collect();
    statuses.sort_unstable();
    statuses.dedup();
    // A path of this document takes the method of its operation.
    statuses.retain(|status| *status != 405);
    let refusals = statuses.into_iter().map(|status| (refusal_name(status), refusal(status)));
    Value::Object(refusals.collect())
}

fn refusal(status: u16) -> Value {
    let codes: Vec<String> = Code::ALL
        .iter()
        .filter(|code| code.http_status() == Some(status))
        .map(|code| format!("`{code}`: {}", code.title()))
        .collect();
    let further = match status {
        401 => Some("WWW-Authenticate"),
        415 => Some("Accept-Patch"),
        429 | 503 => Some("Retry-After"),
        _ => None,
    };
    json!({
        "description": codes.join(" "),
        "headers": headers(further.into_iter().chain(["X-Request-Id"])),
        "content": { PROBLEM: { "schema": reference("schemas", "Problem") } },
    })
}
