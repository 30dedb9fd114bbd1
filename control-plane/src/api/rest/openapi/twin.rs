//! From OpenAPI 3.1 to 3.0.3: the same paths and answers for tools that read no 3.1. Of 3.1 it
//! knows what the document uses; a test fails when that is more.
//!
//! - `type: [T, "null"]` and `oneOf: [X, null]` become `nullable`
//! - a numeric `exclusiveMinimum` becomes a `minimum` with a flag, `examples` of a schema its first
//!   as `example`
//! - `propertyNames` and the license's `identifier` have no place
//! - of several types of a body `application/json` stays: generators of 3.0 know no others
//! - `additionalProperties: false` goes: clients made from it must take members that come later

use serde_json::{Map, Value};

/// Members whose values are examples, not parts of the document.
const OPAQUE: &[&str] = &["example", "examples", "default", "enum", "value"];

/// The twin of a document.
pub(super) fn to_3_0(document: &Value) -> Value {
    let mut out = walk(document);
    out["openapi"] = "3.0.3".into();
    if let Some(license) = out.pointer_mut("/info/license").and_then(Value::as_object_mut) {
        license.remove("identifier");
    }
    out
}

/// Anything but a schema.
fn walk(value: &Value) -> Value {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => value.clone(),
        Value::Array(items) => items.iter().map(walk).collect(),
        Value::Object(members) => {
            let converted = members.iter().map(|(name, member)| {
                let member = match (name.as_str(), member) {
                    (name, member) if OPAQUE.contains(&name) => member.clone(),
                    ("schema", shape) => schema(shape),
                    ("schemas", Value::Object(shapes)) => each(shapes),
                    ("requestBody", body) => one_type(&walk(body)),
                    (_, member) => walk(member),
                };
                (name.clone(), member)
            });
            Value::Object(converted.collect())
        }
    }
}

/// Schemas by their names.
fn each(members: &Map<String, Value>) -> Value {
    let converted = members.iter().map(|(name, member)| (name.clone(), schema(member)));
    Value::Object(converted.collect())
}

/// Of several types of a body the one that every generator knows.
fn one_type(body: &Value) -> Value {
    let mut body = body.clone();
    if let Some(content) = body.get_mut("content").and_then(Value::as_object_mut)
        && content.contains_key("application/json")
    {
        content.retain(|name, _| name == "application/json");
    }
    body
}

fn schema(shape: &Value) -> Value {
    let Value::Object(members) = shape else {
        return shape.clone();
    };
    let mut out = Map::new();
    let mut put = |name: &str, value: Value| drop(out.insert(name.to_owned(), value));
    for (name, member) in members {
        match (name.as_str(), member) {
            ("type", Value::Array(types)) => {
                put("nullable", true.into());
                let other = types.iter().find(|found| *found != "null");
                put("type", other.cloned().unwrap_or_default());
            }
            ("oneOf", Value::Array(parts)) => {
                let is_null = |part: &&Value| part.get("type").is_some_and(|found| found == "null");
                let others: Vec<Value> =
                    parts.iter().filter(|part| !is_null(part)).map(schema).collect();
                // Beside a reference nothing else counts in 3.0, so that one that may be null is
                // wrapped.
                let name = match others.len() == parts.len() {
                    true => "oneOf",
                    false => {
                        put("nullable", true.into());
                        "allOf"
                    }
                };
                put(name, others.into());
            }
            ("properties", Value::Object(properties)) => put(name, each(properties)),
            ("additionalProperties", Value::Bool(false)) | ("propertyNames", _) => {}
            ("items" | "additionalProperties", member) => put(name, schema(member)),
            ("exclusiveMinimum", bound @ Value::Number(_)) => {
                put("minimum", bound.clone());
                put(name, true.into());
            }
            ("examples", Value::Array(examples)) => {
                put("example", examples.first().cloned().unwrap_or_default());
            }
            _ => put(name, member.clone()),
        }
    }
    Value::Object(out)
}
