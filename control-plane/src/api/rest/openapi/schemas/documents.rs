//! Documents: what users write, and what is read.

use blaze_domain::LayerKind;
use blaze_domain::config::selector::MAX_LABEL_BYTES;
use blaze_domain::config::{Kind, MAX_INTEGER, MAX_LABELS, spec};
use serde_json::json;
use utoipa::openapi::schema::{ObjectBuilder, OneOfBuilder, Type};

use super::super::patterns::{ADDRESS, ARCHITECTURE, LABEL_KEY, LABEL_VALUE};
use super::super::shapes::{
    Shape, answer, closed, flag, formed, free, like, list, map, or_null, refer, said, text, time, whole, word,
};
use super::{kinds, name, real_revision, revision, selector};

/// Parts of documents, and documents of any kind.
pub(super) fn all() -> [(&'static str, Shape); 6] {
    [
        ("Labels", labels()),
        ("Annotations", annotations()),
        ("Configuration", configuration()),
        ("Overrides", overrides()),
        ("Document", any_document()),
        ("RolloutStatus", rollout_status()),
    ]
}

fn labels() -> Shape {
    let value = formed(LABEL_VALUE, 0, MAX_LABEL_BYTES);
    let labels = map(value)
        .property_names(Some(formed(LABEL_KEY, 1, 317)))
        .max_properties(Some(MAX_LABELS));
    said(
        like(labels, json!({ "site": "lab" })),
        "For selecting. Keys are `[dns-prefix/]name`; a value may be empty.",
    )
}

fn annotations() -> Shape {
    let key = text()
        .min_length(Some(1))
        .max_length(Some(spec::MAX_ANNOTATION_KEY_CHARS));
    let annotations = map(text()).property_names(Some(key));
    said(annotations, "For people and tools; nothing is selected by them.")
}

fn configuration() -> Shape {
    let configuration = like(free(), json!({ "log": { "level": "info" } }));
    let description = "A part of a configuration: any JSON, merged with the other parts by RFC 7396. A secret is \
        `{\"$secret\":\"text\"}`; it is read back as `{\"$secret\":{\"redacted\":true,\"version\":n}}`, and that form keeps the stored \
        text. Top-level members that are sections of the node file follow its schema.";
    said(configuration, description)
}

fn overrides() -> Shape {
    let overrides = map(refer("Configuration")).property_names(Some(name()));
    said(
        overrides,
        "Configurations for single services, by their names; stronger than `config`.",
    )
}

pub(super) fn spec_of(kind: Kind) -> ObjectBuilder {
    match kind {
        Kind::Layer => closed(
            &["kind"],
            [
                ("kind", word(LayerKind::ALL.iter().map(|kind| kind.as_str())).into()),
                ("config", refer("Configuration")),
                ("overrides", refer("Overrides")),
            ],
        ),
        Kind::Node => node_spec(),
        Kind::Service => closed(
            &[],
            [
                (
                    "description",
                    text().max_length(Some(spec::MAX_DESCRIPTION_CHARS)).into(),
                ),
                ("config", refer("Configuration")),
                ("schema", json_schema()),
                (
                    "layers",
                    list(name())
                        .max_items(Some(spec::MAX_SERVICE_LAYERS))
                        .unique_items(true)
                        .description(Some("Layers that may see the service; absent: all."))
                        .into(),
                ),
            ],
        ),
        Kind::Instance => closed(
            &[],
            [
                ("node", said(name(), "Node that it runs on; not together with `layer`.")),
                ("layer", said(name(), "Layer that it runs in; with neither, anywhere.")),
                ("config", refer("Configuration")),
            ],
        ),
        Kind::Rollout => rollout_spec(),
    }
}

/// It is an object, or `true` or `false`.
fn json_schema() -> Shape {
    let description = "JSON Schema 2020-12 of the effective configuration; `$ref` within the schema only.";
    // Not one schema of two types, of which generators of clients make an object without members.
    OneOfBuilder::new()
        .item(free())
        .item(flag())
        .description(Some(description))
        .examples([json!({ "type": "object" })])
        .into()
}

fn node_spec() -> ObjectBuilder {
    let units = i64::from(spec::MAX_RESOURCE_UNITS);
    let resources = closed(
        &[],
        [
            (
                "cpus",
                ObjectBuilder::new()
                    .schema_type(Type::Number)
                    .exclusive_minimum(Some(0))
                    .maximum(Some(units))
                    .into(),
            ),
            ("memory_bytes", whole(0, MAX_INTEGER).into()),
            ("gpus", whole(0, units).into()),
            ("arch", formed(ARCHITECTURE, 1, 63).into()),
        ],
    );
    let addresses = list(formed(ADDRESS, 1, 253))
        .max_items(Some(spec::MAX_ADDRESSES))
        .description(Some("IP addresses or host names."));
    closed(
        &["layer"],
        [
            ("layer", name().into()),
            (
                "type",
                word(spec::NodeType::ALL.iter().map(|kind| kind.as_str()))
                    .default(Some(json!("static")))
                    .into(),
            ),
            ("addresses", addresses.into()),
            ("resources", resources.into()),
            ("config", refer("Configuration")),
            ("overrides", refer("Overrides")),
        ],
    )
}

fn rollout_spec() -> ObjectBuilder {
    let targets = [Kind::Layer, Kind::Node, Kind::Service, Kind::Instance].map(Kind::as_str);
    let target = closed(
        &["kind", "name"],
        [
            ("kind", word(targets).into()),
            ("name", name().into()),
            ("service", said(name(), "Of an Instance.")),
        ],
    );
    let (shortest, longest) = spec::GATE_WINDOW_S;
    let gate = closed(
        &[],
        [
            ("window_s", whole(shortest as i64, longest as i64).into()),
            ("max_unhealthy", whole(0, spec::MAX_UNHEALTHY as i64).into()),
        ],
    );
    closed(
        &["target", "patch", "canary"],
        [
            ("target", target.into()),
            ("patch", said(free(), "RFC 7396 merge patch on the target's spec.")),
            (
                "canary",
                closed(
                    &["node_selector"],
                    [(
                        "node_selector",
                        said(selector(), "Labels of the nodes that try it first."),
                    )],
                )
                .into(),
            ),
            ("gate", gate.into()),
        ],
    )
}

/// What POST and PUT take.
pub(super) fn input(kind: Kind) -> Shape {
    let input = closed(
        &["spec"],
        [
            (
                "kind",
                said(word([kind.as_str()]), "May be left out: the path says it."),
            ),
            ("name", said(name(), "Needed in POST; in PUT the path says it.")),
            ("labels", refer("Labels")),
            ("annotations", refer("Annotations")),
            ("spec", refer(&format!("{kind}Spec"))),
        ],
    );
    let input = match kind {
        Kind::Instance => input.property("service", said(name(), "May be left out: the path says it.")),
        Kind::Layer | Kind::Node | Kind::Service | Kind::Rollout => input,
    };
    said(input, "What a user writes. Members that the server sets are ignored.")
}

/// What is read.
pub(super) fn document(kind: Kind) -> Shape {
    let document = envelope(word([kind.as_str()]), refer(&format!("{kind}Spec")));
    match kind {
        Kind::Instance => document.property("service", name()).required("service").into(),
        Kind::Rollout => document
            .property("status", refer("RolloutStatus"))
            .required("status")
            .into(),
        Kind::Layer | Kind::Node | Kind::Service => document.into(),
    }
}

/// A document of any kind.
fn any_document() -> Shape {
    let document = envelope(word(kinds()), free().into())
        .property("service", said(name(), "Of an Instance."))
        .property("status", said(free(), "Of a Rollout."));
    said(document, "A document of any kind.")
}

fn envelope(kind: ObjectBuilder, spec: Shape) -> ObjectBuilder {
    answer(
        &[
            "kind",
            "name",
            "labels",
            "annotations",
            "spec",
            "uid",
            "revision",
            "create_time",
            "update_time",
            "updated_by",
        ],
        [
            ("kind", kind.into()),
            ("name", name().into()),
            ("labels", refer("Labels")),
            ("annotations", refer("Annotations")),
            ("spec", spec),
            ("uid", said(text(), "UUIDv7; a new one after delete and recreate.")),
            ("revision", said(real_revision(), "Of its last change; also its ETag.")),
            ("create_time", time().into()),
            ("update_time", time().into()),
            ("updated_by", said(text(), "Subject of the token.")),
        ],
    )
}

fn rollout_status() -> Shape {
    let canary = answer(
        &["node", "phase"],
        [
            ("node", name().into()),
            ("phase", text().into()),
            ("revision", or_null(revision()).into()),
            ("reason", text().into()),
        ],
    );
    answer(
        &["phase", "canaries"],
        [
            ("phase", word(["canary", "promoted", "aborted", "failed"]).into()),
            ("canaries", list(canary).into()),
            ("reason", text().into()),
        ],
    )
    .into()
}
