//! Parameters of the operations: of the path, of the query, and headers.

use blaze_domain::config::{Kind, MAX_DOCUMENTS, MAX_INTEGER};
use serde_json::{Value, json};
use utoipa::openapi::Required;
use utoipa::openapi::path::{Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::ObjectBuilder;

use super::super::history::VIEWS;
use super::super::query::{CONSISTENCY, Param};
use super::super::routes::{Action, Payload, Route, Verb};
use super::super::system::{MAX_ACTION, MAX_SUBJECT, OUTCOMES};
use super::super::watch::MAX_TIMEOUT_S;
use super::patterns;
use super::schemas::name;
use super::shapes::{flag, formed, text, time, whole, word};

/// All parameters of an operation.
pub(super) fn of(route: &Route) -> Vec<Parameter> {
    let mut all = path(route);
    all.extend(route.query.iter().map(|param| query(*param, needs(route, *param))));
    all.extend(headers(route));
    all
}

fn path(route: &Route) -> Vec<Parameter> {
    let mut all = Vec::new();
    let mut add = |name: &str, shape: ObjectBuilder, said: &str| {
        let parameter = ParameterBuilder::new()
            .name(name)
            .parameter_in(ParameterIn::Path)
            .required(Required::True);
        all.push(parameter.description(Some(said)).schema(Some(shape)).build());
    };
    for segment in route.path.split('/') {
        match segment {
            "{service}" if matches!(route.action, Action::List(_)) => {
                add(
                    "service",
                    formed(patterns::NAME_OR_ALL, 1, 63),
                    "Name of the service; `-`: of all services.",
                );
            }
            "{service}" => add("service", name(), "Name of the service."),
            "{name}" => add("name", name(), "Name of the document."),
            "{id}" => add("id", formed(patterns::TOKEN_ID, 1, 128), "Id of the token (`jti`)."),
            _ => {}
        }
    }
    all
}

/// What an operation cannot do without.
fn needs(route: &Route, param: Param) -> bool {
    matches!(
        (route.action, param),
        (Action::Diff(_), Param::From) | (Action::Digest, Param::DigestLayer)
    )
}

fn query(param: Param, needed: bool) -> Parameter {
    let parameter = ParameterBuilder::new()
        .name(param.name())
        .parameter_in(ParameterIn::Query)
        .required(if needed { Required::True } else { Required::False })
        .description(Some(param.description()))
        .schema(Some(shape(param)));
    parameter.build()
}

fn shape(param: Param) -> ObjectBuilder {
    match param {
        Param::Limit => whole(1, 1000).default(Some(json!(100))),
        // Without a greatest length: far too long ones are refused as a URI, with 414, and not for their form.
        Param::PageToken => text().pattern(Some(patterns::PAGE_TOKEN)),
        Param::LabelSelector | Param::Prune => text()
            .pattern(Some(patterns::SELECTOR))
            .min_length(Some(1))
            .examples([json!("site=lab")]),
        Param::Layer
        | Param::Node
        | Param::Service
        | Param::Instance
        | Param::AtLayer
        | Param::AtNode
        | Param::Name
        | Param::AuditName
        | Param::DigestLayer => name(),
        Param::Revision | Param::From | Param::To => whole(1, MAX_INTEGER),
        Param::MinRevision | Param::Since => whole(0, MAX_INTEGER),
        Param::Consistency => words(CONSISTENCY),
        Param::View => words(VIEWS),
        Param::Reveal | Param::Cascade | Param::DryRun | Param::Explain => flag().default(Some(json!(false))),
        Param::PruneConfirm => whole(0, MAX_DOCUMENTS as i64),
        Param::Kind => word(Kind::ALL.iter().map(|kind| kind.as_str())),
        Param::TimeoutS => whole(1, MAX_TIMEOUT_S as i64),
        Param::Subject => text().min_length(Some(1)).max_length(Some(MAX_SUBJECT)),
        Param::Action => formed(patterns::ACTION, 1, MAX_ACTION),
        Param::Outcome => word(OUTCOMES.iter().copied()),
        Param::SinceTime | Param::UntilTime => time(),
    }
}

/// Words of which the first is what absence means.
fn words(words: &[&'static str]) -> ObjectBuilder {
    let default = words.first().map_or(Value::Null, |first| json!(first));
    word(words.iter().copied()).default(Some(default))
}

fn headers(route: &Route) -> Vec<Parameter> {
    let mut all = Vec::new();
    let mut add = |name: &str, pattern: &str, most: usize, said: &str, example: &str| {
        let parameter = ParameterBuilder::new()
            .name(name)
            .parameter_in(ParameterIn::Header)
            .required(Required::False)
            .description(Some(said))
            .schema(Some(formed(pattern, 0, most)))
            .example(Some(json!(example)));
        all.push(parameter.build());
    };
    let if_match = |action| match action {
        Action::Replace(_) | Action::Patch(_) | Action::Delete(_) => Some(
            "The ETag of the document that is changed, a list of them, or `*`. Without it a document that exists is refused with 428.",
        ),
        Action::Rollback(_) => Some("The ETag of the document that is set back, a list of them, or `*`."),
        _ => None,
    };
    if let Some(said) = if_match(route.action) {
        add("If-Match", patterns::IF_MATCH, 4096, said, "*");
    }
    match route.action {
        // GET takes `If-None-Match` too; it is told in words only, as a generated client that sent it by itself would get
        // an answer without a document.
        Action::Replace(_) => {
            let said = "`*`: the document must be new. Not together with `If-Match`.";
            add("If-None-Match", patterns::STAR, 1, said, "*");
        }
        Action::Watch => {
            let said = "The id of the last event that came; goes before `since`.";
            add("Last-Event-ID", patterns::EVENT_ID, 16, said, "412");
        }
        _ => {}
    }
    if route.verb == Verb::Post && route.payload != Payload::Token {
        let said = "A key of the client's for this request: the same key and body again get the first answer again, for 24 hours.";
        add(
            "Idempotency-Key",
            patterns::IDEMPOTENCY_KEY,
            130,
            said,
            "8e03978e-40d5-43e8-bc93-6894a57f9324",
        );
    }
    all
}
