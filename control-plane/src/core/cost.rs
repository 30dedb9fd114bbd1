//! A bound on what it takes to check a configuration against a schema, known before it is checked.
//!
//! ```text
//! schema ─▶ steps for each value ─┐
//!                                 ├─▶ steps × values ≤ MAX_WORK
//! configuration ─▶ values in it ──┘
//! ```
//!
//! References make the bound necessary: thirty definitions that each refer twice to the next one
//! take 2^30 steps. What matching texts takes is left to the deadline of a check, see
//! [`super::pattern`].

use std::collections::HashMap;

use blaze_domain::config::MAX_DEPTH;
use serde_json::{Map, Value};

use super::schema::{ONE, find_anchors, own_dialect, resolve};

/// Subschemas that may be visited on the way to one leaf of a configuration. References that meet
/// again multiply them.
const MAX_STEPS: u64 = 10_000;
/// Subschemas within each other: each takes a part of the stack.
const MAX_NESTING: usize = 512;
/// Steps of a pattern for the name of a member or for a text.
const PATTERN_STEPS: u64 = 20;
/// Names, or values to choose from, of one keyword that take as long as one subschema.
const NAMES_PER_STEP: usize = 10;
/// Bytes of a text that take as long as one value.
const BYTES_PER_VALUE: usize = 100;
/// Steps that may be needed for one effective configuration: about half a second.
pub(super) const MAX_WORK: u64 = 10_000_000;
/// The same up to which the places of the faults are given: one fault of a choice lists those of
/// each alternative.
pub(super) const MAX_WORK_OF_FAULTS: u64 = 50_000;

/// Values in a configuration. A long text counts as several.
pub(super) fn values(config: &Value) -> u64 {
    let text = |text: &str| u64::try_from(text.len() / BYTES_PER_VALUE).unwrap_or(u64::MAX);
    1 + match config {
        Value::Null | Value::Bool(_) | Value::Number(_) => 0,
        Value::String(found) => text(found),
        Value::Array(items) => items.iter().map(values).sum(),
        Value::Object(members) => {
            members.iter().map(|(name, member)| text(name) + values(member)).sum()
        }
    }
}

/// Steps that a schema takes for each value of a configuration, at most.
///
/// # Errors
/// The schema is small, but could take for ever, or the whole stack.
pub(super) fn steps(schema: &Value) -> Result<u64, String> {
    let mut anchors = HashMap::new();
    find_anchors(schema, true, &mut anchors)?;
    let mut bound = Bound { root: schema, anchors, known: HashMap::new() };
    Ok(bound.effort(schema, MAX_DEPTH, 1)?.steps)
}

/// What checking one leaf of a configuration comes to, at most.
#[derive(Clone, Copy, Default)]
struct Effort {
    steps: u64,
    nesting: usize,
}

impl Effort {
    /// Both subschemas are visited.
    fn and(self, other: Self) -> Self {
        Self {
            steps: self.steps.saturating_add(other.steps),
            nesting: self.nesting.max(other.nesting),
        }
    }

    /// One of the subschemas is visited.
    fn or(self, other: Self) -> Self {
        Self { steps: self.steps.max(other.steps), nesting: self.nesting.max(other.nesting) }
    }
}

struct Bound<'s> {
    root: &'s Value,
    anchors: HashMap<&'s str, &'s Value>,
    /// By subschema and by the levels of the configuration that may still come. `None` while it is
    /// being computed.
    known: HashMap<(*const Value, usize), Option<Effort>>,
}

impl<'s> Bound<'s> {
    fn effort(
        &mut self,
        schema: &'s Value,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        let Value::Object(members) = schema else {
            return Ok(Effort { steps: 1, nesting: 1 });
        };
        let id = (std::ptr::from_ref(schema), levels);
        if let Some(Some(known)) = self.known.get(&id) {
            return Ok(*known);
        }
        if nesting > MAX_NESTING {
            return Err(too_much());
        }
        // A reference may lead to what is not looked at as a schema otherwise.
        if let Some(dialect) = own_dialect(members) {
            return Err(dialect);
        }
        self.known.insert(id, None);
        let (mut same, mut within) = (Effort::default(), Effort::default());
        for (name, value) in members {
            same = same.and(self.same_value(name, value, levels, nesting + 1)?);
            if let Some(levels) = levels.checked_sub(1) {
                within = within.and(self.within_value(name, value, levels, nesting + 1)?);
            }
        }
        if members.contains_key("unevaluatedProperties") || members.contains_key("unevaluatedItems")
        {
            // To know what is left over, everything is visited once more.
            same = same.and(same);
        }
        let mut effort = same.and(within);
        effort.steps = effort.steps.saturating_add(own_steps(members));
        effort.nesting += 1;
        if effort.steps > MAX_STEPS || effort.nesting > MAX_NESTING {
            return Err(too_much());
        }
        self.known.insert(id, Some(effort));
        Ok(effort)
    }

    /// What a keyword visits for the same value.
    fn same_value(
        &mut self,
        name: &str,
        value: &'s Value,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        match (name, value) {
            ("$ref" | "$dynamicRef", Value::String(reference)) => {
                self.referred(reference, levels, nesting)
            }
            ("not" | "if" | "then" | "else", value) => self.effort(value, levels, nesting),
            ("allOf" | "anyOf" | "oneOf", Value::Array(list)) => self.all(list, levels, nesting),
            // The second one is of an older dialect, and applied all the same.
            ("dependentSchemas" | "dependencies", Value::Object(named)) => {
                self.all(named.values(), levels, nesting)
            }
            _ => Ok(Effort::default()),
        }
    }

    /// What a keyword visits for the members and items of the value, of which so many levels may
    /// still come.
    fn within_value(
        &mut self,
        name: &str,
        value: &'s Value,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        match (name, value) {
            // A member has one name, and an item one place.
            ("properties", Value::Object(named)) => self.any(named.values(), levels, nesting),
            ("prefixItems", Value::Array(list)) => self.any(list, levels, nesting),
            ("patternProperties", Value::Object(named)) => {
                self.all(named.values(), levels, nesting)
            }
            ("not" | "if" | "then" | "else", _) => Ok(Effort::default()),
            (name, value) if ONE.contains(&name) || name == "additionalItems" => {
                self.effort(value, levels, nesting)
            }
            _ => Ok(Effort::default()),
        }
    }

    fn all(
        &mut self,
        schemas: impl IntoIterator<Item = &'s Value>,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        schemas
            .into_iter()
            .try_fold(Effort::default(), |sum, one| Ok(sum.and(self.effort(one, levels, nesting)?)))
    }

    fn any(
        &mut self,
        schemas: impl IntoIterator<Item = &'s Value>,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        schemas.into_iter().try_fold(Effort::default(), |most, one| {
            Ok(most.or(self.effort(one, levels, nesting)?))
        })
    }

    /// What a reference leads to. A subschema that leads back to itself at the same value has no
    /// bound.
    fn referred(
        &mut self,
        reference: &str,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        let target = resolve(self.root, &self.anchors, reference);
        let target = target.filter(|target| target.is_object() || target.is_boolean());
        let target = target.ok_or_else(|| {
            let known = "#, #/… (without percent-encoding) or #anchor";
            format!("$ref {reference:?} leads nowhere; it is {known}")
        })?;
        if let Some(None) = self.known.get(&(std::ptr::from_ref(target), levels)) {
            return Err(format!(
                "$ref {reference:?} leads back to itself at the same value; a schema may refer to \
                 itself only for what is \
                 within the value: below properties, items or the like"
            ));
        }
        self.effort(target, levels, nesting)
    }
}

/// Steps of a subschema without those within it: lists of names or values are gone through, and
/// patterns are matched.
fn own_steps(members: &Map<String, Value>) -> u64 {
    let one = |(name, value): (&String, &Value)| match (name.as_str(), value) {
        ("patternProperties", Value::Object(named)) => {
            PATTERN_STEPS.saturating_mul(named.len() as u64)
        }
        ("pattern", _) => PATTERN_STEPS,
        (_, Value::Array(list)) => (list.len() / NAMES_PER_STEP) as u64,
        (_, Value::Object(named)) => (named.len() / NAMES_PER_STEP) as u64,
        _ => 0,
    };
    1 + members.iter().map(one).sum::<u64>()
}

fn too_much() -> String {
    format!(
        "its references meet again and again: more than {MAX_STEPS} subschemas for one value, or \
         {MAX_NESTING} within \
         each other"
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_configuration_counts_by_its_values_and_long_texts() {
        assert_eq!(values(&json!({ "a": 1, "b": [true, null, { "name": "text" }] })), 7);
        assert_eq!(values(&json!("x".repeat(1000))), 11);
    }

    #[test]
    fn names_to_go_through_and_patterns_count() {
        let names: Vec<String> = (0..200).map(|number| format!("n{number}")).collect();
        assert_eq!(steps(&json!({ "enum": names })), Ok(21));
        assert_eq!(steps(&json!({ "type": "object", "required": ["a"] })), Ok(1));
        assert_eq!(steps(&json!({ "pattern": "a" })), Ok(1 + PATTERN_STEPS));
        assert_eq!(
            steps(&json!({ "patternProperties": { "a": true, "b": true } })),
            Ok(1 + 2 * (PATTERN_STEPS + 1))
        );
    }

    #[test]
    fn dependencies_of_the_older_dialects_count() {
        let twice = |target: String| {
            json!({ "dependencies": { "a": { "$ref": target },
            "b": { "$ref": target } } })
        };
        let mut defs: Map<String, Value> = (0..30)
            .map(|number| (format!("d{number}"), twice(format!("#/$defs/d{}", number + 1))))
            .collect();
        defs.insert("d30".to_owned(), json!(true));
        let error = steps(&json!({ "$ref": "#/$defs/d0", "$defs": defs })).unwrap_err();
        assert!(error.contains("meet again"), "{error}");
        assert_eq!(steps(&json!({ "dependencies": { "a": ["b"] } })), Ok(2));
    }

    #[test]
    fn what_leads_back_to_itself_at_the_same_value_is_refused() {
        let refused = |schema: &Value| {
            let error = steps(schema).unwrap_err();
            assert!(error.contains("leads back to itself"), "{error}");
        };
        refused(&json!({ "$ref": "#" }));
        refused(&json!({ "allOf": [{ "$ref": "#" }, { "$ref": "#" }] }));
        refused(&json!({ "not": { "$ref": "#" } }));
        refused(&json!({ "dependencies": { "a": { "$ref": "#" } } }));
        refused(&json!({ "$anchor": "top", "anyOf": [true, { "$dynamicRef": "#top" }] }));
        // Each level refers to all of its own and to the next, so that it seems cheap as long as it
        // is not known.
        let level = |number: usize| {
            let own = (0..30).map(|_| json!({ "$ref": format!("#/$defs/l{number}") }));
            let next = (0..30).map(|_| json!({ "$ref": format!("#/$defs/l{}", number + 1) }));
            (format!("l{number}"), json!({ "anyOf": own.chain(next).collect::<Vec<Value>>() }))
        };
        let mut defs: Map<String, Value> = (0..10).map(level).collect();
        defs.insert("l10".to_owned(), json!(true));
        refused(&json!({ "$ref": "#/$defs/l0", "$defs": defs }));
    }

    #[test]
    fn a_reference_is_not_read_in_two_ways() {
        // A validator decodes it, and would come to the other one.
        let defs = json!({ "a%25b": true, "a%b": { "type": "string" } });
        assert!(steps(&json!({ "$ref": "#/$defs/a%25b", "$defs": defs })).is_err());
        let anchors =
            json!({ "one": { "$anchor": "a" }, "two": { "$anchor": "a", "type": "string" } });
        let error = steps(&json!({ "$ref": "#a", "$defs": anchors })).unwrap_err();
        assert!(error.contains("twice"), "{error}");
    }
}
