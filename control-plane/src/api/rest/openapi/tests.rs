use std::collections::BTreeSet;
use std::path::PathBuf;

use blaze_domain::LayerKind;
use blaze_domain::config::selector::{MAX_LABEL_BYTES, MAX_SELECTOR_BYTES};
use blaze_domain::config::{Kind, MAX_DOCUMENTS, MAX_INTEGER, MAX_LABELS, spec};
use blaze_domain::names::MAX_TOPIC_BYTES;

use super::super::history::VIEWS;
use super::super::monitoring::MAX_TEXT;
use super::super::query::{CONSISTENCY, Param};
use super::super::requests::{MAX_LIFE_S, MAX_REASON};
use super::super::system::{MAX_ACTION, MAX_SUBJECT, OUTCOMES};
use super::super::watch::MAX_TIMEOUT_S;
use super::*;
use crate::auth::Role;
use crate::status::health::Health;
use crate::status::limits::{DEFAULT_PERIOD_MS, MAX_LISTED, PERIOD_MS};

fn committed(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../openapi").join(name)
}

fn both() -> [(&'static str, String); 2] {
    [("openapi.json", openapi_json()), ("openapi-3.0.json", openapi_3_0_json())]
}

#[test]
fn the_committed_documents_are_those_of_the_code() {
    for (name, text) in both() {
        let found = std::fs::read_to_string(committed(name)).unwrap_or_default();
        assert!(
            found == text,
            "openapi/{name} is not what the code says: cargo test -p blaze-config --lib \
             write_openapi -- --ignored"
        );
    }
}

#[test]
#[ignore = "writes the files that the test above compares"]
fn write_openapi() {
    std::fs::create_dir_all(committed("")).unwrap();
    for (name, text) in both() {
        std::fs::write(committed(name), text).unwrap();
    }
}

fn operations(document: &Value) -> Vec<(String, String, Value)> {
    let mut all = Vec::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            all.push((path.clone(), method.clone(), operation.clone()));
        }
    }
    all
}

#[test]
fn each_operation_is_complete() {
    for (path, method, operation) in operations(&document()) {
        let name = format!("{method} {path}");
        let responses = operation["responses"].as_object().unwrap();
        for status in ["400", "401", "403", "429", "500", "503"] {
            assert!(responses.contains_key(status), "{name} has no {status}");
        }
        let successes = responses.keys().filter(|status| status.starts_with('2')).count();
        assert!(successes > 0, "{name}");
        let parameters: Vec<(&str, &str)> = operation["parameters"]
            .as_array()
            .map(|list| {
                list.iter()
                    .map(|one| (one["in"].as_str().unwrap(), one["name"].as_str().unwrap()))
                    .collect()
            })
            .unwrap_or_default();
        let in_path = path.matches('{').count();
        assert_eq!(
            parameters.iter().filter(|(place, _)| *place == "path").count(),
            in_path,
            "{name}"
        );
        assert_eq!(operation.get("requestBody").is_some(), responses.contains_key("415"), "{name}");
        assert_eq!(
            responses.contains_key("428"),
            method == "put"
                || method == "patch"
                || (method == "delete" && !path.contains("tokens")),
            "{name}"
        );
        if responses.contains_key("428") {
            assert!(parameters.contains(&("header", "If-Match")), "{name}");
        }
        let repeats = method == "post" && !path.ends_with("/tokens");
        assert_eq!(parameters.contains(&("header", "Idempotency-Key")), repeats, "{name}");
    }
}

#[test]
fn words_and_limits_are_those_of_the_code() {
    let kinds: Vec<&str> = Kind::ALL.iter().map(|kind| kind.as_str()).collect();
    let layers: Vec<&str> = LayerKind::ALL.iter().map(|kind| kind.as_str()).collect();
    let nodes: Vec<&str> = spec::NodeType::ALL.iter().map(|kind| kind.as_str()).collect();
    let roles: Vec<&str> = Role::ALL.iter().map(|role| role.as_str()).collect();
    let (shortest, longest) = spec::GATE_WINDOW_S;
    for (place, value) in [
        ("/query/Kind/enum", json!(kinds)),
        ("/query/Consistency/enum", json!(CONSISTENCY)),
        ("/query/View/enum", json!(VIEWS)),
        ("/query/Outcome/enum", json!(OUTCOMES)),
        ("/query/Revision/maximum", json!(MAX_INTEGER)),
        ("/query/PruneConfirm/maximum", json!(MAX_DOCUMENTS)),
        ("/query/TimeoutS/maximum", json!(MAX_TIMEOUT_S)),
        ("/query/LiveTopic/maxLength", json!(MAX_TOPIC_BYTES)),
        ("/query/WhyTopic/maxLength", json!(MAX_TOPIC_BYTES)),
        ("/query/LiveView/enum", json!(super::super::live::VIEWS)),
        ("/query/HealthState/enum", json!(Health::WORDS)),
        ("/query/PeriodMs/minimum", json!(PERIOD_MS.start())),
        ("/query/PeriodMs/maximum", json!(PERIOD_MS.end())),
        ("/query/PeriodMs/default", json!(DEFAULT_PERIOD_MS)),
        ("/query/Names/maxLength", json!(MAX_TEXT)),
        ("HealthProblemPage/properties/items/maxItems", json!(MAX_LISTED)),
        ("/query/Subject/maxLength", json!(MAX_SUBJECT)),
        ("/query/Action/maxLength", json!(MAX_ACTION)),
        ("ApplyItem/properties/kind/enum", json!(kinds)),
        ("Document/properties/kind/enum", json!(kinds)),
        ("LayerSpec/properties/kind/enum", json!(layers)),
        ("NodeSpec/properties/type/enum", json!(nodes)),
        ("NodeSpec/properties/addresses/maxItems", json!(spec::MAX_ADDRESSES)),
        ("NodeSpec/properties/resources/properties/gpus/maximum", json!(spec::MAX_RESOURCE_UNITS)),
        ("NodeSpec/properties/resources/properties/cpus/maximum", json!(spec::MAX_RESOURCE_UNITS)),
        ("ServiceSpec/properties/description/maxLength", json!(spec::MAX_DESCRIPTION_CHARS)),
        ("ServiceSpec/properties/layers/maxItems", json!(spec::MAX_SERVICE_LAYERS)),
        ("RolloutSpec/properties/gate/properties/window_s/minimum", json!(shortest)),
        ("RolloutSpec/properties/gate/properties/window_s/maximum", json!(longest)),
        (
            "RolloutSpec/properties/gate/properties/max_unhealthy/maximum",
            json!(spec::MAX_UNHEALTHY),
        ),
        (
            "RolloutSpec/properties/canary/properties/node_selector/maxLength",
            json!(MAX_SELECTOR_BYTES),
        ),
        ("Labels/maxProperties", json!(MAX_LABELS)),
        ("Labels/additionalProperties/maxLength", json!(MAX_LABEL_BYTES)),
        ("Annotations/propertyNames/maxLength", json!(spec::MAX_ANNOTATION_KEY_CHARS)),
        ("AbortRequest/properties/reason/maxLength", json!(MAX_REASON)),
        ("TokenRequest/properties/roles/items/enum", json!(roles)),
        ("TokenRequest/properties/expires_in_s/maximum", json!(MAX_LIFE_S)),
    ] {
        let found = match place.starts_with('/') {
            true => PARTS.pointer(place),
            false => PARTS.pointer(&format!("/document/components/schemas/{place}")),
        };
        assert_eq!(found, Some(&value), "{place}");
    }
    for param in Param::ALL {
        assert!(PARTS["query"][format!("{param:?}")].is_object(), "{param:?}");
    }
}

fn references(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Array(items) => items.iter().for_each(|item| references(item, found)),
        Value::Object(members) => {
            found.extend(members.get("$ref").and_then(Value::as_str).map(str::to_owned));
            members.values().for_each(|member| references(member, found));
        }
        _ => {}
    }
}

#[test]
fn every_reference_leads_somewhere_and_every_component_is_used() {
    for document in [document(), twin::to_3_0(&document())] {
        let mut found = BTreeSet::new();
        references(&document, &mut found);
        for reference in &found {
            let pointer = reference.strip_prefix('#').unwrap();
            assert!(document.pointer(pointer).is_some(), "{reference}");
        }
        for group in ["schemas", "responses", "headers"] {
            for name in document["components"][group].as_object().unwrap().keys() {
                // Told in the text of the stream alone.
                let told = name == "WatchEvent";
                assert!(
                    told || found.contains(&format!("#/components/{group}/{name}")),
                    "{group}/{name} is not used"
                );
            }
        }
    }
}

#[test]
fn the_twin_has_nothing_of_3_1() {
    fn look(value: &Value, path: &str) {
        if ["/example", "/examples", "/default", "/enum"].iter().any(|end| path.ends_with(end)) {
            return;
        }
        match value {
            Value::Array(items) => {
                assert!(!path.ends_with("/type") || path.ends_with("/properties/type"), "{path}");
                items
                    .iter()
                    .enumerate()
                    .for_each(|(index, item)| look(item, &format!("{path}/{index}")));
            }
            Value::Object(members) => {
                for (name, member) in members {
                    let of_schema = !path.ends_with("/properties");
                    let newer = ["const", "propertyNames", "examples", "$schema", "webhooks"]
                        .contains(&name.as_str());
                    assert!(!(newer && of_schema), "{path}/{name}");
                    let bound = ["exclusiveMinimum", "exclusiveMaximum"].contains(&name.as_str());
                    assert!(!(bound && member.is_number()), "{path}");
                    assert!(
                        name != "$ref" || members.len() == 1,
                        "{path}: nothing counts beside a reference"
                    );
                    look(member, &format!("{path}/{name}"));
                }
            }
            Value::String(text) => assert!(!(path.ends_with("/type") && text == "null"), "{path}"),
            _ => {}
        }
    }
    let twin = twin::to_3_0(&document());
    assert_eq!(twin["openapi"], "3.0.3");
    look(&twin, "");
    for (path, method, operation) in operations(&twin) {
        let types = operation["requestBody"]["content"].as_object().map_or(0, serde_json::Map::len);
        assert!(types <= 1, "{method} {path}");
        let schemas: BTreeSet<String> = operation["responses"]
            .as_object()
            .unwrap()
            .iter()
            .filter(|(status, _)| status.starts_with('2'))
            .map(|(_, answer)| answer["content"].to_string())
            .collect();
        assert_eq!(schemas.len(), 1, "{method} {path} has answers of several kinds");
    }
}

#[test]
fn examples_are_what_the_schemas_take() {
    let document = document();
    let mut looked_at = 0;
    for (path, method, operation) in operations(&document) {
        let Some(content) = operation["requestBody"]["content"]["application/json"].as_object()
        else {
            continue;
        };
        let schema = json!({ "components": document["components"], "allOf": [content["schema"]] });
        let validator = jsonschema::draft202012::new(&schema).unwrap();
        let faults: Vec<String> =
            validator.iter_errors(&content["example"]).map(|fault| fault.to_string()).collect();
        assert!(faults.is_empty(), "{method} {path}: {faults:?}");
        looked_at += 1;
    }
    assert!(looked_at > 20);
}
