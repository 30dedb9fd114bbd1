//! Keywords of a schema that look at a text: `pattern`, `minLength` and `maxLength`. They are our own for two reasons.
//!
//! - What matching takes is the text times the states of the pattern, at worst. It is counted while it is done, and ends
//!   where it has taken too much: see [`counted`].
//! - Of a secret nothing may be told, so they hold at what stands in its place: see [`placeholder`].

use std::cell::Cell;
use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use jsonschema::paths::Location;
use jsonschema::{Keyword, ValidationError};
use parking_lot::Mutex;
use regex_automata::meta::Regex;
use regex_automata::nfa::thompson::{self, NFA, WhichCaptures};
use serde_json::{Map, Value};

/// Bytes that a compiled pattern may take.
pub(super) const MAX_BYTES: usize = 128 * 1024;
/// The same of all patterns of one schema.
const MAX_BYTES_OF_ALL: usize = 1024 * 1024;
/// Bytes that matching one pattern may keep for the next time.
pub(super) const CACHE_BYTES: usize = 64 * 1024;
/// Bytes that matching a pattern may take beside that: a place for each of its groups in each of its states.
const MAX_GROUP_BYTES: usize = 256 * 1024;
/// Patterns in one schema.
const MAX_PATTERNS: usize = 200;
/// States of patterns that a byte meets in the time of one step, at worst: 3 ns each were measured.
const STATES_PER_STEP: u64 = 10;
/// Stands for secrets; nobody can write it, for it is another one in each process.
static PLACEHOLDER: LazyLock<String> = LazyLock::new(|| format!("secret {}", uuid::Uuid::new_v4()));

thread_local! {
    /// Steps that matching on this thread may still take; `None`: they were too many.
    static LEFT: Cell<Option<u64>> = const { Cell::new(Some(u64::MAX)) };
}

/// How large a pattern is, compiled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Pattern {
    /// Each byte of a text may meet so many.
    pub(super) states: u64,
    pub(super) bytes: usize,
}

/// Matching took more steps than it may.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Exhausted;

/// Steps that it takes when a byte meets a state of a pattern so many times.
pub(super) fn steps_of_states(states: u64) -> u64 {
    states / STATES_PER_STEP
}

/// What stands in place of a secret. They differ, as secrets may.
pub(super) fn placeholder(number: usize) -> Value {
    Value::from(format!("{} {number}", *PLACEHOLDER))
}

/// Does a check in which matching patterns takes no more than so many steps, and tells how many it took. What it says
/// means nothing where they did not suffice.
pub(super) fn counted<T>(steps: u64, check: impl FnOnce() -> T) -> Result<(T, u64), Exhausted> {
    LEFT.set(Some(steps));
    let out = check();
    let left = LEFT.replace(Some(u64::MAX));
    left.map(|left| (out, steps.saturating_sub(left))).ok_or(Exhausted)
}

/// Takes from what is left; `false` if that does not suffice.
fn take(steps: u64) -> bool {
    let left = LEFT.get().and_then(|left| left.checked_sub(steps));
    LEFT.set(left);
    left.is_some()
}

/// The patterns of a schema, or what looks like one, with their sizes. Those that are none are left out: that is told where
/// they are compiled.
pub(super) fn sizes(schema: &Value) -> Result<HashMap<&str, Pattern>, String> {
    let mut found: HashMap<&str, WhichCaptures> = HashMap::new();
    let mut count = 0;
    find(schema, &mut |text, groups| {
        count += 1;
        let known = found.entry(text).or_insert(groups);
        if matches!(groups, WhichCaptures::All) {
            *known = groups;
        }
    });
    if count > MAX_PATTERNS {
        return Err(format!("it has {count} patterns; {MAX_PATTERNS} are allowed"));
    }
    let mut sizes = HashMap::new();
    for (text, groups) in found {
        if let Some(size) = measured(text, groups)? {
            sizes.insert(text, size);
        }
    }
    let bytes: usize = sizes.values().map(|size| size.bytes).sum();
    match bytes > MAX_BYTES_OF_ALL {
        true => Err(format!(
            "its patterns take {bytes} bytes, compiled; {MAX_BYTES_OF_ALL} are allowed"
        )),
        false => Ok(sizes),
    }
}

/// Those of `patternProperties` are compiled with their groups: there the library gives no choice.
fn find<'s>(schema: &'s Value, found: &mut impl FnMut(&'s str, WhichCaptures)) {
    match schema {
        Value::Object(members) => {
            for (name, value) in members {
                match (name.as_str(), value) {
                    ("pattern", Value::String(text)) => found(text, WhichCaptures::None),
                    ("patternProperties", Value::Object(named)) => {
                        named.keys().for_each(|name| found(name, WhichCaptures::All));
                    }
                    _ => {}
                }
                find(value, found);
            }
        }
        Value::Array(list) => list.iter().for_each(|one| find(one, found)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

fn measured(text: &str, groups: WhichCaptures) -> Result<Option<Pattern>, String> {
    let Ok(translated) = jsonschema_regex::to_rust_regex(text) else {
        return Ok(None);
    };
    let limited = thompson::Config::new()
        .nfa_size_limit(Some(MAX_BYTES))
        .which_captures(groups);
    match NFA::compiler().configure(limited).build(&translated) {
        Ok(automaton) => {
            let states = automaton.states().len();
            // Two tables of them while it matches.
            let slots = automaton.group_info().slot_len().saturating_mul(2 * size_of::<usize>());
            if states.saturating_mul(slots) > MAX_GROUP_BYTES {
                let start = beginning(text);
                return Err(format!(
                    "the pattern of names that begins with {start:?} has too many groups for its size: write (?:…) for (…)"
                ));
            }
            Ok(Some(Pattern {
                states: u64::try_from(states).unwrap_or(u64::MAX),
                bytes: automaton.memory_usage(),
            }))
        }
        Err(error) if error.size_limit().is_some() => Err(too_large(text)),
        Err(_) => Ok(None),
    }
}

fn beginning(text: &str) -> String {
    text.chars().take(50).collect()
}

fn too_large(text: &str) -> String {
    let start = beginning(text);
    format!(
        "the pattern that begins with {start:?} takes more than {MAX_BYTES} bytes, compiled: make its counts smaller"
    )
}

/// Patterns that are compiled once for all forms of a schema.
#[derive(Clone, Default)]
pub(super) struct Patterns(Arc<Mutex<HashMap<String, Matcher>>>);

#[derive(Clone)]
struct Matcher {
    regex: Regex,
    states: u64,
}

type Made<'a> = Result<Box<dyn for<'i> Keyword<'i>>, ValidationError<'a>>;

impl Patterns {
    /// The keyword `pattern`.
    #[allow(clippy::result_large_err, reason = "the form of jsonschema")]
    pub(super) fn keyword<'a>(&self, _: &'a Map<String, Value>, schema: &'a Value, _: Location) -> Made<'a> {
        let text = schema.as_str().unwrap_or_default();
        let matcher = self.matcher(text).map_err(ValidationError::custom)?;
        Ok(Box::new(matcher))
    }

    fn matcher(&self, text: &str) -> Result<Matcher, String> {
        let mut known = self.0.lock();
        if let Some(found) = known.get(text) {
            return Ok(found.clone());
        }
        let wrong = |why: &dyn std::fmt::Display| {
            let linear = "look-around and back-references are not part of what is understood";
            format!("the pattern {text:?} cannot be used: {why} ({linear})")
        };
        let translated = jsonschema_regex::to_rust_regex(text).map_err(|()| wrong(&"it is no regular expression"))?;
        let limits = Regex::config()
            .nfa_size_limit(Some(MAX_BYTES))
            // Only whether it matches is asked; places of groups would take memory and time.
            .which_captures(WhichCaptures::None)
            .hybrid_cache_capacity(CACHE_BYTES);
        let regex = Regex::builder().configure(limits).build(&translated);
        let regex = regex.map_err(|error| match error.size_limit() {
            Some(_) => too_large(text),
            None => {
                let syntax = error.syntax_error().map(ToString::to_string);
                let syntax = syntax.unwrap_or_else(|| error.to_string());
                wrong(&syntax.lines().last().unwrap_or_default().trim_start_matches("error: "))
            }
        })?;
        let states = measured(text, WhichCaptures::None)?.map_or(u64::MAX, |pattern| pattern.states);
        let matcher = Matcher { regex, states };
        known.insert(text.to_owned(), matcher.clone());
        Ok(matcher)
    }
}

/// The text that a keyword is about; `None`: it holds, for the value is no text, or stands for a secret.
fn looked_at(instance: &Value) -> Option<&str> {
    instance.as_str().filter(|text| !text.starts_with(PLACEHOLDER.as_str()))
}

impl<'i> Keyword<'i> for Matcher {
    fn validate(&self, instance: &'i Value) -> Result<(), ValidationError<'i>> {
        match self.is_valid(instance) {
            true => Ok(()),
            false => Err(ValidationError::custom("the text does not match the pattern")),
        }
    }

    fn is_valid(&self, instance: &'i Value) -> bool {
        looked_at(instance).is_none_or(|text| {
            // The end is a place to look at too.
            let bytes = u64::try_from(text.len()).unwrap_or(u64::MAX).saturating_add(1);
            take(steps_of_states(bytes.saturating_mul(self.states))) && self.regex.is_match(text)
        })
    }
}

/// `minLength` or `maxLength`.
struct Length {
    limit: f64,
    is_least: bool,
}

impl Length {
    fn holds(&self, instance: &Value) -> bool {
        looked_at(instance).is_none_or(|text| {
            #[allow(clippy::cast_precision_loss, reason = "no text has 2^53 characters")]
            let length = text.chars().count() as f64;
            match self.is_least {
                true => length >= self.limit,
                false => length <= self.limit,
            }
        })
    }
}

impl<'i> Keyword<'i> for Length {
    fn validate(&self, instance: &'i Value) -> Result<(), ValidationError<'i>> {
        let Self { limit, is_least } = self;
        match (self.holds(instance), is_least) {
            (true, _) => Ok(()),
            (false, true) => Err(ValidationError::custom(format!(
                "the text is shorter than {limit} characters"
            ))),
            (false, false) => Err(ValidationError::custom(format!(
                "the text is longer than {limit} characters"
            ))),
        }
    }

    fn is_valid(&self, instance: &'i Value) -> bool {
        self.holds(instance)
    }
}

/// The keyword `minLength`, or `maxLength`.
#[allow(
    clippy::unnecessary_wraps,
    clippy::result_large_err,
    reason = "the form of jsonschema"
)]
pub(super) fn length<'a>(schema: &Value, is_least: bool) -> Made<'a> {
    // That it is a number was checked with the schema.
    let limit = schema.as_f64().unwrap_or_default();
    Ok(Box::new(Length { limit, is_least }))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::schema::Schemas;
    use super::*;

    fn is_valid(schema: &Value, value: &Value) -> bool {
        let compiled = Schemas::default().compiled(schema).unwrap();
        compiled.validator(true).is_valid(value)
    }

    #[test]
    fn texts_are_measured_in_characters_and_matched_anywhere() {
        for (schema, text, expected) in [
            (json!({ "minLength": 3 }), "äöü", true),
            (json!({ "minLength": 4.0 }), "äöü", false),
            (json!({ "maxLength": 3 }), "äöü", true),
            (json!({ "minLength": 1, "maxLength": 2 }), "äöü", false),
            (json!({ "pattern": "b+" }), "abbc", true),
            (json!({ "pattern": "^b+$" }), "abbc", false),
            (
                json!({ "pattern": "^\\d\\w\\s\\cA\\u0041\\p{Lu}\\/$" }),
                "1_ \u{1}AÄ/",
                true,
            ),
            // As ECMAScript reads them: ASCII digits alone.
            (json!({ "pattern": "^\\d$" }), "٣", false),
            (json!({ "propertyNames": { "pattern": "^a" } }), "no object", true),
        ] {
            assert_eq!(is_valid(&schema, &json!(text)), expected, "{schema} {text:?}");
        }
        for no_text in [json!(7), json!([]), json!(null)] {
            assert!(is_valid(
                &json!({ "minLength": 3, "maxLength": 0, "pattern": "a" }),
                &no_text
            ));
        }
        let names = json!({ "propertyNames": { "pattern": "^a" } });
        assert!(is_valid(&names, &json!({ "ab": 1 })) && !is_valid(&names, &json!({ "b": 1 })));
    }

    #[test]
    fn what_stands_for_a_secret_holds() {
        let schema = json!({ "minLength": 1000, "maxLength": 0, "pattern": "^$" });
        assert!(is_valid(&schema, &placeholder(1)));
        assert!(!is_valid(&schema, &json!("secret 1")));
        assert_ne!(placeholder(1), placeholder(2));
        assert!(!is_valid(&json!({ "type": "integer" }), &placeholder(1)));
    }

    #[test]
    fn matching_ends_where_it_takes_too_much() {
        let compiled = Schemas::default()
            .compiled(&json!({ "pattern": "(a|b)*a(a|b){100}c$" }))
            .unwrap();
        let text = json!("ab".repeat(10_000));
        let check = |steps| counted(steps, || compiled.validator(true).is_valid(&text));
        let (is_valid, taken) = check(u64::MAX).unwrap();
        assert!(!is_valid);
        assert!(taken > 20_000 * 100 / STATES_PER_STEP, "{taken}");
        assert_eq!(check(taken), Ok((false, taken)));
        assert_eq!(check(taken - 1), Err(Exhausted));
        // The next one has its own.
        assert_eq!(check(taken), Ok((false, taken)));
        // Nothing is for free.
        let compiled = Schemas::default()
            .compiled(&json!({ "pattern": "^(?:a?){100}$" }))
            .unwrap();
        let (is_valid, taken) = counted(1000, || compiled.validator(true).is_valid(&json!(""))).unwrap();
        assert!(is_valid && taken >= 10, "{taken}");
    }

    #[test]
    fn a_pattern_takes_linear_time() {
        let text = Value::from("a".repeat(200_000) + "!");
        assert!(!is_valid(&json!({ "pattern": "^(a+)+$" }), &text));
    }

    #[test]
    fn groups_take_no_more_than_is_measured() {
        let groups = format!("^[ab]*{}c$", "()".repeat(1900));
        let compiled = Schemas::default().compiled(&json!({ "pattern": groups })).unwrap();
        assert!(!compiled.validator(true).is_valid(&json!("ab".repeat(1000))));
        let error = Schemas::default()
            .check(&json!({ "patternProperties": { groups: true } }))
            .unwrap_err();
        assert!(
            error.contains("too many groups") || error.contains("takes more than"),
            "{error}"
        );
        assert!(
            Schemas::default()
                .check(&json!({ "patternProperties": { "^(a|b)(c|d){2,9}$": true } }))
                .is_ok()
        );
    }

    #[test]
    fn patterns_are_counted_and_measured() {
        let schemas = Schemas::default();
        let of = |count: usize| {
            let list: Vec<Value> = (0..count)
                .map(|number| json!({ "pattern": format!("^{number}$") }))
                .collect();
            json!({ "anyOf": list, "properties": { "pattern": { "type": "string" } }, "patternProperties": { "^a": true } })
        };
        assert!(schemas.check(&of(199)).is_ok());
        let error = schemas.check(&of(200)).unwrap_err();
        assert!(error.contains("201 patterns"), "{error}");
        let error = schemas.check(&json!({ "pattern": "[a-z]{100000}" })).unwrap_err();
        assert!(error.contains("takes more than 131072 bytes"), "{error}");
        let many: Vec<Value> = (0..50)
            .map(|number| json!({ "pattern": format!("{number}[a-z]{{1000}}") }))
            .collect();
        let error = schemas.check(&json!({ "allOf": many })).unwrap_err();
        assert!(error.contains("1048576 are allowed"), "{error}");
        // Letters of all scripts fit.
        assert!(schemas.check(&json!({ "pattern": "^\\p{L}+$" })).is_ok());
        assert!(schemas.check(&json!({ "pattern": "^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?(\\.[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?)*$" })).is_ok());
    }
}
