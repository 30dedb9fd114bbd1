//! The OpenAPI document, made from the table of routes.
//!
//! ```text
//! routes ─▶ paths ─┐
//! schemas, answers ┴─▶ 3.1.0 ──[twin]──▶ 3.0.3, for tools that do not read 3.1
//! ```
//!
//! Both are committed in `openapi/`; a test compares them, and another one, which is asked for by name, writes them anew:
//! `cargo test -p blaze-config --lib write_openapi -- --ignored`.

mod answers;
mod parameters;
mod patterns;
mod schemas;
mod shapes;
#[cfg(test)]
mod tests;
mod twin;

use blaze_domain::config::Kind;
use serde_json::{Value, json};
use utoipa::openapi::content::ContentBuilder;
use utoipa::openapi::path::{HttpMethod, OperationBuilder, Paths, PathsBuilder};
use utoipa::openapi::request_body::{RequestBody, RequestBodyBuilder};
use utoipa::openapi::schema::ComponentsBuilder;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::tag::TagBuilder;
use utoipa::openapi::{InfoBuilder, LicenseBuilder, OpenApi, OpenApiBuilder, PathItem, Required, Server};

use super::body::Media;
use super::routes::{self, Action, Payload, Route, Verb};
use shapes::{Shape, list, refer, refer_or_null};

pub(super) use schemas::{layer_or_null, roles};
pub(super) use twin::to_3_0;

/// Name of the only security scheme.
const BEARER: &str = "bearer";
/// Groups of operations.
const TAGS: &[(&str, &str)] = &[
    ("layers", "Clusters: edge, fog, cloud."),
    ("nodes", "Machines of layers."),
    ("services", "Programs, with the defaults of their configuration."),
    ("instances", "Running copies of services."),
    ("rollouts", "Changes that are tried on some nodes first."),
    (
        "configuration",
        "Many documents at once, what comes out of them, and what changes.",
    ),
    ("system", "What runs, and whether it is in sync."),
    ("administration", "Tokens, audit, history."),
];

/// The document of OpenAPI 3.1.0, as it is served and committed.
#[must_use]
pub fn openapi_json() -> String {
    pretty(&finished(&document()))
}

/// Its twin of OpenAPI 3.0.3.
#[must_use]
pub fn openapi_3_0_json() -> String {
    pretty(&to_3_0(&finished(&document())))
}

/// The document without a router; it is the same as the router's.
fn document() -> OpenApi {
    let mut document = frame();
    for route in routes::all() {
        document.paths.merge(paths(route));
    }
    document
}

/// A document as JSON.
pub(super) fn finished(document: &OpenApi) -> Value {
    // Maps with text keys cannot fail to be written.
    serde_json::to_value(document).unwrap_or(Value::Null)
}

/// JSON as it is committed.
pub(super) fn pretty(document: &Value) -> String {
    format!("{document:#}\n")
}

/// Everything but the paths.
pub(super) fn frame() -> OpenApi {
    let info = InfoBuilder::new()
        .title("BlazeConfig")
        .version("1.0.0")
        .description(Some(
            "The configuration of a whole system: layers, nodes, services, instances and roll-outs. Every refusal is a \
             problem object (RFC 9457) whose `type` leads to a page about its code.",
        ))
        .license(Some(
            LicenseBuilder::new()
                .name("Apache-2.0")
                .identifier(Some("Apache-2.0"))
                .build(),
        ))
        .build();
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .bearer_format("JWT")
        .description(Some(
            "A token of `POST /api/v1/tokens`, of `blaze token create`, or of the identity provider.",
        ))
        .build();
    let mut components = ComponentsBuilder::new()
        .schemas_from_iter(schemas::all())
        .security_scheme(BEARER, SecurityScheme::Http(bearer))
        .responses_from_iter(answers::refusals());
    for (name, header) in answers::headers() {
        components = components.header(name, header);
    }
    let tags = TAGS
        .iter()
        .map(|(name, said)| TagBuilder::new().name(*name).description(Some(*said)).build());
    OpenApiBuilder::new()
        .info(info)
        .servers(Some([Server::new("/")]))
        .components(Some(components.build()))
        .security(Some([SecurityRequirement::new(BEARER, Vec::<String>::new())]))
        .tags(Some(tags))
        .build()
}

/// The path of one route with its operation.
pub(super) fn paths(route: &Route) -> Paths {
    let operation = OperationBuilder::new()
        .operation_id(Some(route.operation))
        .tag(tag(route.action))
        .summary(Some(summary(route.action)))
        .parameters(Some(parameters::of(route)))
        .request_body(request_body(route.payload))
        .responses(answers::of(route));
    let method = match route.verb {
        Verb::Get => HttpMethod::Get,
        Verb::Post => HttpMethod::Post,
        Verb::Put => HttpMethod::Put,
        Verb::Patch => HttpMethod::Patch,
        Verb::Delete => HttpMethod::Delete,
    };
    PathsBuilder::new()
        .path(route.path, PathItem::new(method, operation))
        .build()
}

fn tag(action: Action) -> &'static str {
    match (action.kind(), action) {
        (Some(kind), _) => kind.collection(),
        (None, Action::Apply | Action::Revert | Action::Effective | Action::Watch) => "configuration",
        (None, Action::Topology | Action::Workers | Action::Digest) => "system",
        (None, _) => "administration",
    }
}

fn summary(action: Action) -> String {
    let word = action.kind().map_or("document", Kind::word);
    match action {
        Action::List(kind) => format!("Lists {}", kind.collection()),
        Action::Create(_) => format!("Makes a new {word}"),
        Action::Get(_) => format!("Reads a {word}, as it is or as it was"),
        Action::Replace(_) => format!("Replaces labels, annotations and spec of a {word}, or makes it"),
        Action::Patch(_) => format!("Changes a {word} by a merge patch"),
        Action::Delete(_) => format!("Deletes a {word}"),
        Action::History(_) => format!("Lists what was done to a {word}, newest first"),
        Action::Diff(_) => format!("Compares two revisions of a {word}"),
        Action::Rollback(_) => format!("Sets a {word} back to what it was, or makes it again"),
        Action::Promote => "Makes the change of a roll-out the content of its target".to_owned(),
        Action::Abort => "Ends a roll-out without effect".to_owned(),
        Action::Apply => "Writes and deletes many documents in one commit, or none".to_owned(),
        Action::Revert => "Takes back what one commit did, in one commit".to_owned(),
        Action::Effective => "The configuration that a service, a node or a layer gets".to_owned(),
        Action::Watch => "Commits as they come, in order, none missing".to_owned(),
        Action::Topology => "Layers, nodes and what runs on them".to_owned(),
        Action::Workers => "Workers, and how far they are".to_owned(),
        Action::Digest => "A digest of what the worker of a layer holds when it is in sync".to_owned(),
        Action::Audit => "What was done and what was refused, newest first".to_owned(),
        Action::Tokens => "Tokens that were given out and have not run out".to_owned(),
        Action::CreateToken => "Gives out a token".to_owned(),
        Action::RevokeToken => "Takes a token back".to_owned(),
        Action::Trim => "Forgets history before a revision".to_owned(),
    }
}

fn request_body(payload: Payload) -> Option<RequestBody> {
    let (shape, example): (Shape, Value) = match payload {
        Payload::None => return None,
        Payload::Document(kind) => (refer(&format!("{kind}Input")), example(kind)),
        Payload::MergePatch => (refer("DocumentPatch"), json!({ "labels": { "site": "lab" } })),
        Payload::Documents => {
            let example = json!([{ "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } }]);
            // The greatest number is no matter of form: one document more is 413, as is one byte more.
            (list(refer("ApplyItem")).into(), example)
        }
        Payload::Rollback => (refer("RollbackRequest"), json!({ "revision": 7 })),
        Payload::Revert => (refer("RevertRequest"), json!({ "revision": 7, "force": false })),
        Payload::Trim => (refer("TrimRequest"), json!({ "before": 1 })),
        Payload::Token => (
            refer("TokenRequest"),
            json!({ "subject": "ops@example.org", "roles": ["operator"], "expires_in_s": 86400 }),
        ),
        Payload::Abort => (refer("AbortRequest"), json!({ "reason": "too slow" })),
    };
    let mut body = RequestBodyBuilder::new().required(Some(Required::True));
    for media in payload.media() {
        let content = match media {
            Media::Json | Media::MergePatch => ContentBuilder::new()
                .schema(Some(shape.clone()))
                .example(Some(example.clone())),
            Media::Yaml => {
                let said = "One document; `---` begins another one, and empty ones count as none. YAML 1.2, core schema, no \
                            anchors, aliases or tags.";
                ContentBuilder::new()
                    .schema(Some(refer_or_null("ApplyItem", said)))
                    .example(Some(
                        json!({ "kind": "Layer", "name": "edge", "spec": { "kind": "edge" } }),
                    ))
            }
        };
        body = body.content(media.as_str(), content.build());
    }
    Some(body.build())
}

/// A document that can be written as it stands, if what it refers to is there.
fn example(kind: Kind) -> Value {
    match kind {
        Kind::Layer => json!({ "name": "edge", "labels": { "site": "lab" }, "spec": { "kind": "edge" } }),
        Kind::Node => {
            json!({ "name": "robot-1", "spec": { "layer": "edge", "type": "mobile", "addresses": ["10.0.1.7"] } })
        }
        Kind::Service => json!({ "name": "slam", "spec": { "config": { "camera": { "rate_hz": 30 } } } }),
        Kind::Instance => {
            json!({ "name": "0", "spec": { "node": "robot-1", "config": { "camera": { "rate_hz": 10 } } } })
        }
        Kind::Rollout => json!({ "name": "slam-slower", "spec": {
            "target": { "kind": "Service", "name": "slam" },
            "patch": { "config": { "camera": { "rate_hz": 10 } } },
            "canary": { "node_selector": "canary=true" },
            "gate": { "window_s": 60, "max_unhealthy": 0 },
        } }),
    }
}
