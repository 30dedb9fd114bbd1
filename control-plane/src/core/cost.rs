//! What it costs to check a configuration against a schema, known before it is done.
//!
//! ```text
//! schema ─▶ steps for one value, at most ─┐
//!                                         ├─▶ steps × values ─▶ of one place, of all places of a commit: at most so many
//! configuration ─▶ values in it ──────────┘
//! ```
//!
//! What a text takes that is matched against a pattern is counted while it is done, in [`super::pattern`].

use std::collections::HashMap;

use blaze_domain::config::MAX_DEPTH;
use serde_json::{Map, Value};

use super::pattern::{self, Pattern, steps_of_states};
use super::schema::{ONE, find_anchors, own_dialect, resolve};

/// Subschemas that may be looked at on the way to one leaf of a configuration. References that meet again multiply it.
const MAX_STEPS: u64 = 10_000;
/// How many of them may lie within each other: each takes a part of the stack.
const MAX_NESTING: usize = 512;
/// How many of them may lie within each other for one value: choices within choices are looked at again and again.
const MAX_IN_PLACE: usize = 64;
/// Subschemas that `uniqueItems` counts as: it looks at all that a list holds.
const UNIQUE_STEPS: u64 = 50;
/// Names, or values to choose from, of one keyword that take as long as one subschema.
const NAMES_PER_STEP: usize = 10;
/// Bytes of a text that take as long as one value.
const BYTES_PER_VALUE: usize = 100;
/// Steps that may be needed for one effective configuration: about half a second.
pub(super) const MAX_WORK: u64 = 10_000_000;
/// The same for all effective configurations that one commit concerns: nobody can write meanwhile.
pub(super) const MAX_WORK_OF_COMMIT: u64 = 100_000_000;
/// The same up to which it is told where the faults are: each takes memory, and one of them may tell of many.
pub(super) const MAX_WORK_OF_FAULTS: u64 = 50_000;
/// Steps in the time that it takes to compile a byte of a schema, or of its patterns: 150 ns were measured.
const STEPS_PER_BYTE: u64 = 3;
/// Steps that a schema that is refused counts as: those of the most costly one.
pub(super) const STEPS_OF_REFUSED: u64 = 4_000_000;
/// Keywords with names, or with values to choose from, that are gone through one after the other.
const NAMES: &[&str] = &[
    "dependencies",
    "dependentRequired",
    "dependentSchemas",
    "enum",
    "properties",
    "required",
];

/// What checking one leaf of a configuration comes to, at most.
#[derive(Clone, Copy, Default)]
struct Effort {
    steps: u64,
    nesting: usize,
    /// Of `nesting`, what is for the same value.
    in_place: usize,
    /// States of the patterns that each byte of the names of the value's own members is matched against.
    states: u64,
    /// The same of the names on whatever level within them, at most.
    deeper: u64,
}

impl Effort {
    const ONE: Self = Self {
        steps: 1,
        nesting: 1,
        in_place: 1,
        states: 0,
        deeper: 0,
    };

    /// Both are looked at.
    fn and(self, other: Self) -> Self {
        Self {
            steps: self.steps.saturating_add(other.steps),
            states: self.states.saturating_add(other.states),
            deeper: self.deeper.saturating_add(other.deeper),
            ..self.or(other)
        }
    }

    /// One of them is looked at.
    fn or(self, other: Self) -> Self {
        Self {
            steps: self.steps.max(other.steps),
            nesting: self.nesting.max(other.nesting),
            in_place: self.in_place.max(other.in_place),
            states: self.states.max(other.states),
            deeper: self.deeper.max(other.deeper),
        }
    }
}

/// What a schema takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cost {
    /// Steps for each value of a configuration, at most.
    steps: u64,
    /// States of patterns for each byte of a name in it, at most.
    states: u64,
    /// Steps to compile it.
    pub(super) compiling: u64,
    /// Patterns in it.
    pub(super) patterns: usize,
}

impl Cost {
    /// Steps that a check of so much takes, at most.
    pub(super) fn work(&self, size: &Size) -> u64 {
        let names = steps_of_states(size.names.saturating_mul(self.states));
        size.values.saturating_mul(self.steps).saturating_add(names)
    }

    /// What makes a check of so much costly.
    pub(super) fn why(&self, size: &Size) -> String {
        let Size { values, names } = size;
        let mut out = format!(
            "{values} values, for each of which the schema takes up to {} steps",
            self.steps
        );
        if self.states > 0 {
            out.push_str(&format!(
                ", and names of {names} bytes, each matched by patterns of up to {} states",
                self.states
            ));
        }
        out
    }
}

/// How large a configuration is to who checks it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Size {
    /// Values; a long text counts as several.
    pub(super) values: u64,
    /// Bytes of the names of members, each with its end.
    names: u64,
}

impl Size {
    pub(super) fn of(config: &Value) -> Self {
        let mut size = Self::default();
        size.add(config);
        size
    }

    fn add(&mut self, value: &Value) {
        let text = |text: &str| u64::try_from(text.len() / BYTES_PER_VALUE).unwrap_or(u64::MAX);
        self.values += 1;
        match value {
            Value::Null | Value::Bool(_) | Value::Number(_) => {}
            Value::String(found) => self.values += text(found),
            Value::Array(items) => items.iter().for_each(|item| self.add(item)),
            Value::Object(members) => {
                for (name, member) in members {
                    self.values += text(name);
                    self.names += u64::try_from(name.len()).unwrap_or(u64::MAX).saturating_add(1);
                    self.add(member);
                }
            }
        }
    }
}

/// What a schema takes. Refuses one that could take for ever, or the whole stack, although it is small.
pub(super) fn of_schema(schema: &Value, text: &str) -> Result<Cost, String> {
    let patterns = pattern::sizes(schema)?;
    let mut anchors = HashMap::new();
    find_anchors(schema, true, &mut anchors)?;
    let mut estimate = Estimate {
        root: schema,
        anchors,
        patterns: &patterns,
        known: HashMap::new(),
    };
    let effort = estimate.effort(schema, MAX_DEPTH, 1)?;
    let compiled: usize = patterns.values().map(|pattern| pattern.bytes).sum();
    let bytes = u64::try_from(text.len() + compiled).unwrap_or(u64::MAX);
    Ok(Cost {
        steps: effort.steps,
        states: effort.states.max(effort.deeper),
        compiling: bytes.saturating_mul(STEPS_PER_BYTE),
        patterns: patterns.len(),
    })
}

struct Estimate<'s, 'e> {
    root: &'s Value,
    anchors: HashMap<&'s str, &'s Value>,
    patterns: &'e HashMap<&'s str, Pattern>,
    /// By subschema, and how many levels of the configuration may still come; nothing while it is being worked out.
    known: HashMap<(*const Value, usize), Option<Effort>>,
}

impl<'s> Estimate<'s, '_> {
    fn effort(&mut self, schema: &'s Value, levels: usize, nesting: usize) -> Result<Effort, String> {
        let members = match schema {
            Value::Object(members) => members,
            // No form of this dialect, but one that is still followed where a reference leads to it.
            Value::Array(list) => return self.all(list.iter(), levels, nesting),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => return Ok(Effort::ONE),
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
        let mut here = self.here(members, levels, nesting)?;
        let below = match levels {
            0 => Effort::default(),
            _ => Effort {
                in_place: 0,
                ..self.below(members, levels - 1, nesting)?
            },
        };
        if members.contains_key("unevaluatedProperties") || members.contains_key("unevaluatedItems") {
            // To know what is left over, everything is looked at once more.
            here = here.and(here);
        }
        let within = here.and(below);
        let states = here.states.saturating_add(self.states_of_names(members));
        let effort = Effort {
            steps: within.steps.saturating_add(own_steps(members)),
            nesting: within.nesting + 1,
            in_place: within.in_place + 1,
            states,
            // Names of one level alone: each is a member of one object.
            deeper: here.deeper.saturating_add(below.states.max(below.deeper)),
        };
        if effort.steps > MAX_STEPS || effort.nesting > MAX_NESTING || effort.in_place > MAX_IN_PLACE {
            return Err(too_much());
        }
        self.known.insert(id, Some(effort));
        Ok(effort)
    }

    /// What is looked at for the same value.
    fn here(&mut self, members: &'s Map<String, Value>, levels: usize, nesting: usize) -> Result<Effort, String> {
        let mut here = Effort::default();
        for (name, value) in members {
            let more = match (name.as_str(), value) {
                ("$ref" | "$dynamicRef", Value::String(reference)) => self.referred(reference, levels, nesting)?,
                ("not" | "if" | "then" | "else", value) => self.effort(value, levels, nesting + 1)?,
                ("allOf" | "anyOf" | "oneOf", Value::Array(list)) => self.all(list.iter(), levels, nesting)?,
                ("dependentSchemas", Value::Object(named)) => self.all(named.values(), levels, nesting)?,
                // Of an older dialect, and applied all the same; a list in it holds names.
                ("dependencies", Value::Object(named)) => {
                    let schemas = named.values().filter(|value| !value.is_array());
                    self.all(schemas, levels, nesting)?
                }
                _ => Effort::default(),
            };
            here = here.and(more);
        }
        Ok(here)
    }

    /// What is looked at for the members and items of the value, of which so many levels may still come.
    fn below(&mut self, members: &'s Map<String, Value>, levels: usize, nesting: usize) -> Result<Effort, String> {
        let mut below = Effort::default();
        for (name, value) in members {
            let more = match (name.as_str(), value) {
                // A member has one name, and an item one place.
                ("properties", Value::Object(named)) => self.any(named.values(), levels, nesting)?,
                ("prefixItems", Value::Array(list)) => self.any(list.iter(), levels, nesting)?,
                ("patternProperties", Value::Object(named)) => self.all(named.values(), levels, nesting)?,
                ("not" | "if" | "then" | "else", _) => Effort::default(),
                (name, value) if ONE.contains(&name) || name == "additionalItems" => {
                    self.effort(value, levels, nesting + 1)?
                }
                _ => Effort::default(),
            };
            below = below.and(more);
        }
        Ok(below)
    }

    /// States of the patterns that names of the value's members are matched against by this subschema itself.
    fn states_of_names(&self, members: &Map<String, Value>) -> u64 {
        let named = members.get("patternProperties").and_then(Value::as_object);
        let names = named.into_iter().flat_map(Map::keys);
        let sizes = names.filter_map(|name| self.patterns.get(name.as_str()));
        sizes.map(|pattern| pattern.states).sum()
    }

    fn all(
        &mut self,
        mut schemas: impl Iterator<Item = &'s Value>,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        schemas.try_fold(Effort::default(), |sum, one| {
            Ok(sum.and(self.effort(one, levels, nesting + 1)?))
        })
    }

    fn any(
        &mut self,
        mut schemas: impl Iterator<Item = &'s Value>,
        levels: usize,
        nesting: usize,
    ) -> Result<Effort, String> {
        schemas.try_fold(Effort::default(), |most, one| {
            Ok(most.or(self.effort(one, levels, nesting + 1)?))
        })
    }

    /// What a reference leads to. What leads back to a subschema that is being looked at for the same value would be looked
    /// at for ever, and how often the other references on the way double it cannot be told.
    fn referred(&mut self, reference: &str, levels: usize, nesting: usize) -> Result<Effort, String> {
        let target = resolve(self.root, &self.anchors, reference).ok_or_else(|| {
            let known = "#, #/… (without percent-encoding) or #anchor";
            format!("$ref {reference:?} leads nowhere; it is {known}")
        })?;
        if let Some(None) = self.known.get(&(std::ptr::from_ref(target), levels)) {
            return Err(format!(
                "$ref {reference:?} leads back to itself at the same value; a schema may refer to itself only for what is \
                 within the value: below properties, items or the like"
            ));
        }
        self.effort(target, levels, nesting + 1)
    }
}

/// Steps of a subschema without those within it.
fn own_steps(members: &Map<String, Value>) -> u64 {
    let names = members.iter().filter(|(name, _)| NAMES.contains(&name.as_str()));
    let count = |value: &Value| match value {
        Value::Array(list) => list.len(),
        Value::Object(named) => named.len(),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => 0,
    };
    let names: usize = names.map(|(_, value)| count(value)).sum();
    let unique = members.get("uniqueItems").and_then(Value::as_bool) == Some(true);
    let names = u64::try_from(names / NAMES_PER_STEP).unwrap_or(u64::MAX);
    names.saturating_add(1 + if unique { UNIQUE_STEPS } else { 0 })
}

fn too_much() -> String {
    format!(
        "its references meet again and again: more than {MAX_STEPS} subschemas for one value, or {MAX_NESTING} within \
         each other, or {MAX_IN_PLACE} for the same value"
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn steps(schema: &Value) -> Result<u64, String> {
        of_schema(schema, "").map(|cost| cost.steps)
    }

    #[test]
    fn a_configuration_counts_by_its_values_and_long_texts() {
        let size = Size::of(&json!({ "a": 1, "b": [true, null, { "name": "text" }] }));
        assert_eq!(size, Size { values: 7, names: 9 });
        assert_eq!(Size::of(&json!("x".repeat(1000))).values, 11);
    }

    #[test]
    fn names_to_go_through_count() {
        let names: Vec<String> = (0..200).map(|number| format!("n{number}")).collect();
        assert_eq!(steps(&json!({ "enum": names })), Ok(21));
        assert_eq!(steps(&json!({ "type": "object", "required": ["a"] })), Ok(1));
    }

    #[test]
    fn names_that_are_matched_count_by_their_bytes() {
        let of = |schema: Value| of_schema(&schema, "").unwrap();
        let one = of(json!({ "patternProperties": { "^[a-z]{1,40}$": true } }));
        let two = of(json!({ "patternProperties": { "^[a-z]{1,40}$": true, "^[0-9]{1,40}$": true } }));
        assert!(one.states >= 40, "{one:?}");
        assert!(two.states >= 80, "{two:?}");
        let size = |names| Size { values: 1, names };
        assert_eq!(one.work(&size(0)), one.steps);
        assert!(one.work(&size(100_000)) > 400_000);
        assert_eq!(of(json!({ "pattern": "^[a-z]{1,40}$" })).states, 0);
        // A name is on one level.
        let nested = of(json!({ "patternProperties": { "^[a-z]{1,40}$": { "$ref": "#" } } }));
        assert_eq!(nested.states, one.states);
        let apart = json!({ "patternProperties": { "^[a-z]{1,40}$": true } });
        let both = of(json!({ "allOf": [apart, apart], "properties": { "a": apart } }));
        assert_eq!(both.states, 2 * one.states);
    }

    #[test]
    fn choices_lie_within_each_other_so_deep_only() {
        let nested =
            |depth: usize| (0..depth).fold(json!({ "type": "object" }), |inner, _| json!({ "anyOf": [inner] }));
        assert!(steps(&nested(MAX_IN_PLACE - 1)).is_ok());
        let error = steps(&nested(MAX_IN_PLACE)).unwrap_err();
        assert!(error.contains("for the same value"), "{error}");
        // Each level of a configuration may have as many.
        assert!(steps(&json!({ "properties": { "a": nested(MAX_IN_PLACE - 2) }, "anyOf": [nested(10)] })).is_ok());
    }

    #[test]
    fn dependencies_of_the_older_dialects_count() {
        let twice = |target: String| json!({ "dependencies": { "a": { "$ref": target }, "b": { "$ref": target } } });
        let mut defs: Map<String, Value> = (0..30)
            .map(|number| (format!("d{number}"), twice(format!("#/$defs/d{}", number + 1))))
            .collect();
        defs.insert("d30".to_owned(), json!(true));
        let error = steps(&json!({ "$ref": "#/$defs/d0", "$defs": defs })).unwrap_err();
        assert!(error.contains("meet again"), "{error}");
        assert_eq!(steps(&json!({ "dependencies": { "a": ["b"] } })), Ok(1));
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
        // Each level refers to all of its own and to the next, so that it seems cheap as long as it is not known.
        let level = |number: usize| {
            let own = (0..30).map(|_| json!({ "$ref": format!("#/$defs/l{number}") }));
            let next = (0..30).map(|_| json!({ "$ref": format!("#/$defs/l{}", number + 1) }));
            (
                format!("l{number}"),
                json!({ "anyOf": own.chain(next).collect::<Vec<Value>>() }),
            )
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
        let anchors = json!({ "one": { "$anchor": "a" }, "two": { "$anchor": "a", "type": "string" } });
        let error = steps(&json!({ "$ref": "#a", "$defs": anchors })).unwrap_err();
        assert!(error.contains("twice"), "{error}");
    }
}
