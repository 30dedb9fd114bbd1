//! JSON Schemas of services: whether they are sound, and whether effective configurations match
//! them.

use std::collections::{HashMap, HashSet};
use std::num::NonZeroUsize;
use std::sync::Arc;

use blaze_domain::config::secret;
use jsonschema::{Draft, Validator};
use lru::LruCache;
use parking_lot::Mutex;
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};

use super::{cost, pattern};

/// Compiled schemas that are kept.
const CACHED: NonZeroUsize = NonZeroUsize::MIN.saturating_add(511);
/// Patterns in one schema.
const MAX_PATTERNS: usize = 200;
/// The dialect that schemas are in.
const DIALECT: &str = "https://json-schema.org/draft/2020-12/schema";

/// A schema, in full and without `required`.
pub(super) struct Compiled {
    full: Validator,
    partial: Validator,
    /// Steps for each value of a configuration, at most.
    pub(super) steps: u64,
}

/// Compiled schemas, the most recently used, by their texts' hashes.
pub(crate) struct Schemas(Mutex<LruCache<[u8; 32], Arc<Compiled>>>);

impl Default for Schemas {
    fn default() -> Self {
        Self(Mutex::new(LruCache::new(CACHED)))
    }
}

impl Compiled {
    /// The form for an instance, and the one for a service without instance.
    pub(super) fn validator(&self, is_instance: bool) -> &Validator {
        match is_instance {
            true => &self.full,
            false => &self.partial,
        }
    }
}

impl Schemas {
    /// What is wrong with the schema itself.
    pub(crate) fn check(&self, schema: &Value) -> Result<(), String> {
        self.compiled(schema).map(drop)
    }

    pub(super) fn compiled(&self, schema: &Value) -> Result<Arc<Compiled>, String> {
        let text = schema.to_string();
        let id: [u8; 32] = Sha256::digest(text.as_bytes()).into();
        if let Some(found) = self.0.lock().get(&id) {
            return Ok(Arc::clone(found));
        }
        if let Some(reference) = foreign_reference(schema) {
            return Err(format!("$ref {reference:?} leads out of the schema; only #… is followed"));
        }
        if let Some(dialect) = foreign_dialect(schema) {
            return Err(dialect);
        }
        jsonschema::draft202012::meta::validate(schema).map_err(|error| {
            // A schema holds no secret, so its words may be told.
            let text: String = error.to_string().chars().take(500).collect();
            format!("at {:?}: {text}", error.instance_path().as_str())
        })?;
        let patterns = patterns(schema);
        if patterns > MAX_PATTERNS {
            return Err(format!("it has {patterns} patterns; {MAX_PATTERNS} are allowed"));
        }
        let compiled = Arc::new(Compiled {
            steps: cost::steps(schema)?,
            full: built(schema)?,
            // What refers into a keyword that goes leads nowhere: then only the full form can be
            // judged.
            partial: built(&without_required(schema)).or_else(|_| built(&Value::Bool(true)))?,
        });
        self.0.lock().put(id, Arc::clone(&compiled));
        Ok(compiled)
    }
}

fn built(schema: &Value) -> Result<Validator, String> {
    jsonschema::options()
        .with_draft(Draft::Draft202012)
        .offline()
        .with_pattern_options(pattern::options())
        .with_keyword("maxLength", |_, limit, _| pattern::keyword("maxLength", limit))
        .with_keyword("minLength", |_, limit, _| pattern::keyword("minLength", limit))
        .with_keyword("pattern", |_, text, _| pattern::keyword("pattern", text))
        .build(schema)
        .map_err(|error| {
            let text: String = error.to_string().chars().take(500).collect();
            match error.schema_path().as_str() {
                "" => text,
                place => format!("at {place:?}: {text}"),
            }
        })
}

/// Patterns in a schema, or what looks like one.
fn patterns(schema: &Value) -> usize {
    let own = |(name, value): (&String, &Value)| match (name.as_str(), value) {
        ("pattern", Value::String(_)) => 1,
        ("patternProperties", Value::Object(named)) => named.len(),
        _ => 0,
    };
    match schema {
        Value::Object(members) => {
            members.iter().map(own).sum::<usize>() + members.values().map(patterns).sum::<usize>()
        }
        Value::Array(list) => list.iter().map(patterns).sum(),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => 0,
    }
}

/// A configuration with a text in place of each secret that says nothing of it, and where they are.
/// Whether a text has a length or matches a pattern would tell it, one try after the other, to who
/// may not read it.
pub(super) fn with_placeholders(mut config: Value) -> (Value, HashSet<String>) {
    let mut found = HashSet::new();
    if secret::contains(&config) {
        secret::map(&mut config, &mut |pointer, _| {
            found.insert(pointer.to_owned());
            Some(pattern::placeholder(found.len()))
        });
    }
    (config, found)
}

/// What is wrong with the dialect that a schema, or a part of it, says it is in: only one is taken.
/// A part in another one would be read by other rules than those that its cost is told by.
fn foreign_dialect(schema: &Value) -> Option<String> {
    let members = schema.as_object()?;
    let own = own_dialect(members);
    own.or_else(|| {
        members.iter().find_map(|(name, value)| match (name.as_str(), value) {
            (name, value) if ONE.contains(&name) => foreign_dialect(value),
            (name, Value::Array(list)) if LIST.contains(&name) => {
                list.iter().find_map(foreign_dialect)
            }
            (name, Value::Object(named)) if NAMED.contains(&name) => {
                named.values().find_map(foreign_dialect)
            }
            _ => None,
        })
    })
}

/// The same of one subschema without those within it.
pub(super) fn own_dialect(members: &Map<String, Value>) -> Option<String> {
    let dialect = members.get("$schema")?;
    let text = dialect.as_str().map(|text| text.strip_suffix('#').unwrap_or(text));
    (text != Some(DIALECT))
        .then(|| format!("$schema {dialect} is another dialect; only {DIALECT} is taken"))
}

/// Keywords whose value is one schema.
pub(super) const ONE: &[&str] = &[
    "additionalProperties",
    "contains",
    "contentSchema",
    "else",
    "if",
    "items",
    "not",
    "propertyNames",
    "then",
    "unevaluatedItems",
    "unevaluatedProperties",
];
/// Keywords whose value is a list of schemas.
const LIST: &[&str] = &["allOf", "anyOf", "oneOf", "prefixItems"];
/// Keywords whose value is an object of schemas under free names.
const NAMED: &[&str] = &[
    "$defs",
    "definitions",
    "dependencies",
    "dependentSchemas",
    "patternProperties",
    "properties",
];

/// Keywords that can come to hold because something below them fails: with `required` below they
/// cannot be judged without it, so they go whole. What stands beside them has no meaning then.
const TURNING: &[(&str, &[&str])] = &[
    ("contains", &["contains", "minContains", "maxContains"]),
    ("if", &["if", "then", "else"]),
    ("not", &["not"]),
    ("oneOf", &["oneOf"]),
];

/// The same schema with the keyword `required` taken out wherever it is a keyword (a property may
/// be called so), and with it what cannot be judged without it.
pub(crate) fn without_required(schema: &Value) -> Value {
    let mut anchors = HashMap::new();
    // What has faults is refused elsewhere.
    let _ = find_anchors(schema, true, &mut anchors);
    let mut strip = Strip {
        root: schema,
        anchors,
        with: HashSet::new(),
        without: HashSet::new(),
        is_any_dropped: false,
    };
    let out = strip.stripped(schema);
    // What is left over depends on what was looked at, which is less now.
    if strip.is_any_dropped { without_unevaluated(&out) } else { out }
}

struct Strip<'s> {
    root: &'s Value,
    anchors: HashMap<&'s str, &'s Value>,
    /// Subschemas with `required` in them or in what they refer to.
    with: HashSet<*const Value>,
    /// Those without.
    without: HashSet<*const Value>,
    is_any_dropped: bool,
}

impl<'s> Strip<'s> {
    fn stripped(&mut self, schema: &'s Value) -> Value {
        let Value::Object(members) = schema else {
            return schema.clone();
        };
        let mut dropped: Vec<&str> = vec!["required"];
        for (name, with) in TURNING {
            if members.get(*name).is_some_and(|below| self.requires(below)) {
                dropped.extend(*with);
                self.is_any_dropped = true;
            }
        }
        let kept = members.iter().filter(|(name, _)| !dropped.contains(&name.as_str()));
        let kept = kept.map(|(name, value)| {
            (name.clone(), subschemas(name, value, &mut |one| self.stripped(one)))
        });
        Value::Object(kept.collect())
    }

    /// Whether `required` is in a subschema, in one of a list of them, or in what they refer to.
    fn requires(&mut self, schema: &'s Value) -> bool {
        let mut seen = HashSet::new();
        let found = self.finds(schema, &mut seen);
        if found {
            self.with.insert(std::ptr::from_ref(schema));
        } else {
            // All that was looked at on the way is without it.
            self.without.extend(seen);
        }
        found
    }

    fn finds(&self, schema: &'s Value, seen: &mut HashSet<*const Value>) -> bool {
        let members = match schema {
            Value::Object(members) => members,
            Value::Array(list) => return list.iter().any(|one| self.finds(one, seen)),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => return false,
        };
        let id = std::ptr::from_ref(schema);
        if self.with.contains(&id) {
            return true;
        }
        if self.without.contains(&id) || !seen.insert(id) {
            return false;
        }
        members.iter().any(|(name, value)| match (name.as_str(), value) {
            ("required", _) => true,
            ("$ref" | "$dynamicRef", Value::String(target)) => {
                let target = resolve(self.root, &self.anchors, target);
                target.is_some_and(|target| self.finds(target, seen))
            }
            (name, value) if ONE.contains(&name) || LIST.contains(&name) => self.finds(value, seen),
            (name, Value::Object(named))
                if NAMED.contains(&name) && !matches!(name, "$defs" | "definitions") =>
            {
                named.values().any(|one| self.finds(one, seen))
            }
            _ => false,
        })
    }
}

/// The value of a keyword with each subschema in it changed.
fn subschemas<'s>(
    name: &str,
    value: &'s Value,
    change: &mut dyn FnMut(&'s Value) -> Value,
) -> Value {
    match value {
        value if ONE.contains(&name) => change(value),
        Value::Array(list) if LIST.contains(&name) => list.iter().map(change).collect(),
        Value::Object(named) if NAMED.contains(&name) => named
            .iter()
            .map(|(name, value)| (name.clone(), change(value)))
            .collect::<Map<_, _>>()
            .into(),
        _ => value.clone(),
    }
}

fn without_unevaluated(schema: &Value) -> Value {
    let Value::Object(members) = schema else {
        return schema.clone();
    };
    let kept = members
        .iter()
        .filter(|(name, _)| !matches!(name.as_str(), "unevaluatedItems" | "unevaluatedProperties"));
    let kept =
        kept.map(|(name, value)| (name.clone(), subschemas(name, value, &mut without_unevaluated)));
    Value::Object(kept.collect())
}

/// What a reference within a schema leads to. Percent-encoding leads nowhere: decoded it could be
/// another place.
pub(super) fn resolve<'s>(
    root: &'s Value,
    anchors: &HashMap<&str, &'s Value>,
    reference: &str,
) -> Option<&'s Value> {
    let fragment = reference.strip_prefix('#').unwrap_or(reference);
    if fragment.contains('%') {
        return None;
    }
    match fragment.is_empty() || fragment.starts_with('/') {
        true => root.pointer(fragment),
        false => anchors.get(fragment).copied(),
    }
}

/// A `$ref` that is not within the document.
fn foreign_reference(value: &Value) -> Option<String> {
    match value {
        Value::Object(members) => {
            members.iter().find_map(|(name, value)| match (name.as_str(), value) {
                ("$ref" | "$dynamicRef", Value::String(target)) if !target.starts_with('#') => {
                    Some(target.clone())
                }
                (_, value) => foreign_reference(value),
            })
        }
        Value::Array(list) => list.iter().find_map(foreign_reference),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => None,
    }
}

/// Anchors by name. Within a subschema with an `$id` of its own, `#` would be something else.
pub(super) fn find_anchors<'s>(
    value: &'s Value,
    is_root: bool,
    out: &mut HashMap<&'s str, &'s Value>,
) -> Result<(), String> {
    match value {
        Value::Object(members) => {
            if !is_root && members.get("$id").is_some_and(Value::is_string) {
                return Err("only the schema as a whole may have an $id".to_owned());
            }
            for name in ["$anchor", "$dynamicAnchor"] {
                if let Some(anchor) = members.get(name).and_then(Value::as_str) {
                    let other = out.insert(anchor, value);
                    if other.is_some_and(|other| !std::ptr::eq(other, value)) {
                        return Err(format!("the anchor {anchor:?} is there twice"));
                    }
                }
            }
            members.values().try_for_each(|inner| find_anchors(inner, false, out))
        }
        Value::Array(list) => list.iter().try_for_each(|inner| find_anchors(inner, false, out)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn required_goes_as_a_keyword_and_stays_as_a_property() {
        let schema = json!({
            "type": "object", "required": ["a"],
            "properties": {
                "required": { "type": "array" },
                "a": { "required": ["b"], "type": "object" },
            },
            "allOf": [{ "required": ["c"] }], "enum": [{ "required": 1 }],
            "dependencies": { "a": { "required": ["b"] }, "b": ["a"] },
        });
        let expected = json!({
            "type": "object",
            "properties": { "required": { "type": "array" }, "a": { "type": "object" } },
            "allOf": [{}], "enum": [{ "required": 1 }], "dependencies": { "a": {}, "b": ["a"] },
        });
        assert_eq!(without_required(&schema), expected);
    }

    #[test]
    fn a_schema_is_judged_by_itself() {
        let schemas = Schemas::default();
        assert!(schemas.check(&json!({ "type": "object" })).is_ok());
        assert!(schemas.check(&json!(true)).is_ok());
        for (bad, why) in [
            (json!({ "properties": { "a": { "type": "objekt" } } }), "/properties/a/type"),
            (json!({ "properties": { "a": { "pattern": "(" } } }), "/properties/a"),
            (json!({ "pattern": "(a)\\1" }), "back-references"),
            (json!({ "pattern": "a(?=b)" }), "look-around"),
            (json!({ "patternProperties": { "(": true } }), "/patternProperties"),
            (
                json!({ "properties": { "a": { "$ref": "http://example.org/s" } } }),
                "leads out of the schema",
            ),
            (json!({ "$ref": "#/$defs/missing" }), "leads nowhere"),
        ] {
            let error = schemas.check(&bad).unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }

    #[test]
    fn a_small_schema_that_takes_for_ever_is_refused() {
        let schemas = Schemas::default();
        let refused = |schema: &Value| {
            let error = schemas.check(schema).unwrap_err();
            assert!(error.contains("meet again"), "{error}");
        };
        let twice = |target: String| json!({ "allOf": [{ "$ref": target }, { "$ref": target }] });
        // Each definition leads twice to the next one.
        let mut defs: Map<String, Value> =
            (0..30).map(|n| (format!("d{n}"), twice(format!("#/$defs/d{}", n + 1)))).collect();
        defs.insert("d30".to_owned(), json!(true));
        refused(&json!({ "$ref": "#/$defs/d0", "$defs": defs }));
        // Each level of the configuration is checked twice as often as the one above it.
        refused(&json!({ "properties": { "a": twice("#".to_owned()) } }));
        refused(&json!({ "$anchor": "top", "properties": { "a": twice("#top".to_owned()) } }));
        // Each level takes as much stack as there are definitions.
        let mut chain: Map<String, Value> = (0..300)
            .map(|n| (format!("d{n}"), json!({ "$ref": format!("#/$defs/d{}", n + 1) })))
            .collect();
        chain.insert("d300".to_owned(), json!({ "properties": { "a": { "$ref": "#" } } }));
        refused(&json!({ "$ref": "#/$defs/d0", "$defs": chain }));
    }

    #[test]
    fn a_schema_may_lead_back_to_itself() {
        let schemas = Schemas::default();
        for schema in [
            json!({ "properties": { "left": { "$ref": "#" }, "right": { "$ref": "#" },
                "value": true } }),
            json!({ "type": ["object", "string"], "additionalProperties": { "$ref": "#" } }),
            json!({
                "properties": { "shape": { "$ref": "#shape" } },
                "$defs": { "shape": { "$anchor": "shape",
                    "anyOf": [true, { "items": { "$ref": "#shape" } }] } },
            }),
        ] {
            assert!(schemas.check(&schema).is_ok(), "{schema}");
        }
    }

    #[test]
    fn what_turns_on_required_goes_with_it() {
        let required = || json!({ "required": ["a"], "type": "object" });
        let schema = json!({
            "not": required(), "if": { "properties": { "x": required() } },
            "then": { "type": "object" }, "else": false,
            "oneOf": [true, { "$ref": "#/$defs/d" }], "contains": required(), "maxContains": 1,
            "properties": { "y": { "not": { "type": "null" }, "if": true, "then": required() } },
            "unevaluatedProperties": false, "$defs": {
                "d": { "allOf": [{ "$ref": "#e" }] },
                "e": { "$anchor": "e", "required": [] },
            },
        });
        let expected = json!({
            "properties": { "y": { "not": { "type": "null" }, "if": true,
                "then": { "type": "object" } } },
            "$defs": { "d": { "allOf": [{ "$ref": "#e" }] }, "e": { "$anchor": "e" } },
        });
        assert_eq!(without_required(&schema), expected);
        // What refers into a part that goes leads nowhere: then the partial form takes all.
        let schemas = Schemas::default();
        let into = json!({ "not": required(), "properties": { "x": { "$ref": "#/not" } } });
        let compiled = schemas.compiled(&into).unwrap();
        assert!(
            compiled.partial.is_valid(&json!({ "x": 1 }))
                && !compiled.full.is_valid(&json!({ "x": 1 }))
        );
    }

    #[test]
    fn another_dialect_is_refused() {
        let schemas = Schemas::default();
        for good in [DIALECT.to_owned(), format!("{DIALECT}#")] {
            assert!(schemas.check(&json!({ "$schema": good, "type": "object" })).is_ok());
        }
        for bad in [
            json!("http://json-schema.org/draft-07/schema#"),
            json!("https://example.org/meta"),
            json!(7),
        ] {
            let part = json!({ "$schema": bad });
            for schema in [
                part.clone(),
                json!({ "properties": { "a": part } }),
                json!({ "$defs": { "a": { "anyOf": [part] } } }),
                json!({ "$ref": "#/enum/0", "enum": [part] }),
            ] {
                let error = schemas.check(&schema).unwrap_err();
                assert!(error.contains("another dialect"), "{schema}: {error}");
            }
        }
        let own =
            json!({ "properties": { "a": { "$schema": DIALECT } }, "enum": [{ "$schema": "x" }] });
        assert!(schemas.check(&own).is_ok());
        let named = json!({ "properties": { "$schema": { "type": "string" } } });
        assert!(schemas.check(&named).is_ok());
    }

    #[test]
    fn a_schema_has_so_many_patterns() {
        let of = |count: usize| {
            let list: Vec<Value> =
                (0..count).map(|number| json!({ "pattern": format!("^{number}$") })).collect();
            json!({
                "properties": { "pattern": { "prefixItems": list } },
                "patternProperties": { "^a": true },
            })
        };
        let schemas = Schemas::default();
        assert_eq!(schemas.check(&of(199)), Ok(()));
        let error = schemas.check(&of(200)).unwrap_err();
        assert!(error.contains("201 patterns"), "{error}");
    }
}
