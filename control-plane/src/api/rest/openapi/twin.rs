//! From OpenAPI 3.1 to 3.0.3: the same paths and answers for tools that read no 3.1.
//!
//! - `type: [T, "null"]` and `oneOf: [X, null]` become `nullable`
//! - numeric `exclusiveMinimum` and `exclusiveMaximum` become `minimum` and `maximum` with a flag
//! - `const` becomes an `enum` of one, `examples` of a schema its first as `example`
//! - `propertyNames`, `$schema`, `webhooks`, `jsonSchemaDialect` and the license's `identifier` have no place
//! - of several types of a body `application/json` stays: generators of 3.0 know no others
//! - `additionalProperties: false` goes: clients made from it must take members that come later

use serde_json::{Map, Value, json};

/// Members whose values are examples, not parts of the document.
const OPAQUE: &[&str] = &["example", "examples", "default", "enum", "value"];

/// The twin of a document.
pub(super) fn to_3_0(document: &Value) -> Value {
    let mut out = walk(document);
    if let Value::Object(members) = &mut out {
        members.insert("openapi".to_owned(), "3.0.3".into());
        for name in ["webhooks", "jsonSchemaDialect", "$schema", "$self"] {
            members.remove(name);
        }
        if let Some(license) = members
            .get_mut("info")
            .and_then(|info| info.get_mut("license")?.as_object_mut())
        {
            license.remove("identifier");
        }
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
                    ("schemas", Value::Object(shapes)) => each(shapes, schema),
                    ("requestBody", body) => one_type(&walk(body)),
                    (_, member) => walk(member),
                };
                (name.clone(), member)
            });
            Value::Object(converted.collect())
        }
    }
}

fn each(members: &Map<String, Value>, convert: impl Fn(&Value) -> Value) -> Value {
    let converted = members.iter().map(|(name, member)| (name.clone(), convert(member)));
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

fn is_null(shape: &Value) -> bool {
    shape.get("type").is_some_and(|found| found == "null")
}

fn schema(shape: &Value) -> Value {
    let Value::Object(members) = shape else {
        return shape.clone();
    };
    let mut out = Map::new();
    for (name, member) in members {
        match (name.as_str(), member) {
            ("type", Value::Array(types)) => set_types(&mut out, types),
            ("properties", Value::Object(properties)) => {
                out.insert(name.clone(), each(properties, schema));
            }
            ("items" | "not", member) => {
                out.insert(name.clone(), schema(member));
            }
            ("additionalProperties", Value::Bool(false)) | ("propertyNames" | "$schema", _) => {}
            ("additionalProperties", member) => {
                out.insert(name.clone(), schema(member));
            }
            ("oneOf" | "anyOf" | "allOf", Value::Array(parts)) => set_parts(&mut out, name, parts),
            ("exclusiveMinimum", bound @ Value::Number(_)) => {
                out.insert("minimum".to_owned(), bound.clone());
                out.insert(name.clone(), true.into());
            }
            ("exclusiveMaximum", bound @ Value::Number(_)) => {
                out.insert("maximum".to_owned(), bound.clone());
                out.insert(name.clone(), true.into());
            }
            ("const", value) => {
                out.insert("enum".to_owned(), json!([value]));
            }
            ("examples", Value::Array(examples)) => {
                out.extend(examples.first().map(|first| ("example".to_owned(), first.clone())));
            }
            _ => {
                out.insert(name.clone(), member.clone());
            }
        }
    }
    alone(out)
}

/// `[T, "null"]` is `T` that may be null; of several other types any one.
fn set_types(out: &mut Map<String, Value>, types: &[Value]) {
    let others: Vec<&Value> = types.iter().filter(|found| *found != "null").collect();
    if others.len() < types.len() {
        out.insert("nullable".to_owned(), true.into());
    }
    match others.as_slice() {
        [one] => {
            out.insert("type".to_owned(), (*one).clone());
        }
        several => {
            let parts: Vec<Value> = several.iter().map(|found| json!({ "type": found })).collect();
            out.insert("anyOf".to_owned(), parts.into());
        }
    }
}

/// `[X, null]` is `X` that may be null.
fn set_parts(out: &mut Map<String, Value>, name: &str, parts: &[Value]) {
    let others: Vec<Value> = parts.iter().filter(|part| !is_null(part)).map(schema).collect();
    if others.len() == parts.len() {
        out.insert(name.to_owned(), others.into());
        return;
    }
    out.insert("nullable".to_owned(), true.into());
    // Beside a reference nothing else counts in 3.0, so that it is wrapped.
    let name = if others.len() == 1 { "allOf" } else { name };
    out.insert(name.to_owned(), others.into());
}

/// Nothing may stand beside a reference in 3.0.
fn alone(mut out: Map<String, Value>) -> Value {
    match out.remove("$ref") {
        Some(reference) if out.is_empty() => json!({ "$ref": reference }),
        Some(reference) => {
            out.insert("allOf".to_owned(), json!([{ "$ref": reference }]));
            Value::Object(out)
        }
        None => Value::Object(out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schemas_lose_what_3_0_does_not_know() {
        for (newer, older) in [
            (
                json!({ "type": ["string", "null"], "maxLength": 3 }),
                json!({ "nullable": true, "type": "string", "maxLength": 3 }),
            ),
            (
                json!({ "type": ["object", "boolean"] }),
                json!({ "anyOf": [{ "type": "object" }, { "type": "boolean" }] }),
            ),
            (
                json!({ "oneOf": [{ "$ref": "#/a" }, { "type": "null" }], "description": "d" }),
                json!({ "nullable": true, "allOf": [{ "$ref": "#/a" }], "description": "d" }),
            ),
            (
                json!({ "type": "number", "exclusiveMinimum": 0, "maximum": 5 }),
                json!({ "type": "number", "minimum": 0, "exclusiveMinimum": true, "maximum": 5 }),
            ),
            (json!({ "const": "a" }), json!({ "enum": ["a"] })),
            (
                json!({ "type": "string", "examples": ["a", "b"] }),
                json!({ "type": "string", "example": "a" }),
            ),
            (
                json!({ "$ref": "#/a", "description": "d" }),
                json!({ "allOf": [{ "$ref": "#/a" }], "description": "d" }),
            ),
            (json!({ "$ref": "#/a" }), json!({ "$ref": "#/a" })),
            (
                json!({ "type": "object", "additionalProperties": { "type": ["string", "null"] }, "propertyNames": { "pattern": "a" } }),
                json!({ "type": "object", "additionalProperties": { "nullable": true, "type": "string" } }),
            ),
            (
                json!({ "type": "object", "properties": { "const": { "const": 1 }, "type": { "type": "string" } }, "additionalProperties": false }),
                json!({ "type": "object", "properties": { "const": { "enum": [1] }, "type": { "type": "string" } } }),
            ),
        ] {
            assert_eq!(schema(&newer), older);
        }
    }

    #[test]
    fn examples_stay_as_they_are() {
        let document = json!({
            "openapi": "3.1.0", "webhooks": {}, "info": { "license": { "name": "x", "identifier": "x" } },
            "paths": { "/a": { "post": { "requestBody": { "content": {
                "application/json": { "schema": { "type": ["string", "null"] }, "example": { "const": 1, "schema": { "type": ["a"] } } },
                "application/yaml": {},
            } } } } },
        });
        assert_eq!(
            to_3_0(&document),
            json!({
                "openapi": "3.0.3", "info": { "license": { "name": "x" } },
                "paths": { "/a": { "post": { "requestBody": { "content": {
                    "application/json": { "schema": { "nullable": true, "type": "string" }, "example": { "const": 1, "schema": { "type": ["a"] } } },
                } } } } },
            })
        );
    }
}
