//! JSON, read strictly: what two readers could understand differently is refused, with its place.
//!
//! ```text
//! bytes ──[parse]──▶ Value            refused: members given twice, integers outside ±(2^53 - 1), numbers that are not
//! Value ──[check]──▶ ()               finite, nesting deeper than 32, text after the value, bytes that are not UTF-8
//! ```
//!
//! A float beyond ±(2^53 - 1) is whole, so it counts as an integer: `1e300` is refused as
//! `10000000000000000` is.

use std::borrow::Cow;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Number, Value};

use super::{MAX_DEPTH, MAX_INTEGER};

/// Longest pointer that a fault repeats, in bytes.
const MAX_SHOWN_BYTES: usize = 512;
/// The same bound for a number that was written as a float. Beyond it every float is whole.
const MAX_WHOLE: f64 = 9_007_199_254_740_991.0;
const NOT_FINITE: &str = "is a number too large to hold";

/// Why a text is not taken as JSON.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JsonFault {
    /// Where in the value, as a JSON pointer (RFC 6901); empty: the whole, or not known.
    pub pointer: String,
    /// Line of the text, from 1; 0: there is no text.
    pub line: usize,
    /// Column in the line, in bytes from 1; 0: before the line's first byte, or there is no text.
    pub column: usize,
    /// What is wrong, in words that follow the place; never repeats a value.
    pub detail: String,
}

impl fmt::Display for JsonFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.line > 0 {
            write!(f, "line {} column {}: ", self.line, self.column)?;
        }
        if !self.pointer.is_empty() {
            write!(f, "{}: ", self.pointer)?;
        }
        f.write_str(&self.detail)
    }
}

impl std::error::Error for JsonFault {}

/// Reads one JSON value, nested at most [`MAX_DEPTH`] deep.
///
/// # Errors
/// The first fault, with its place.
pub fn parse(bytes: &[u8]) -> Result<Value, JsonFault> {
    parse_within(bytes, MAX_DEPTH)
}

/// As [`parse`], with another depth: an array of documents may be one deeper than a document.
///
/// # Errors
/// The first fault, with its place.
pub fn parse_within(bytes: &[u8], max_depth: usize) -> Result<Value, JsonFault> {
    let mut reading = Reading { path: Vec::new(), max_depth, refused: None };
    let mut source = serde_json::Deserializer::from_slice(bytes);
    let read = Seed(&mut reading).deserialize(&mut source);
    read.and_then(|value| source.end().map(|()| value)).map_err(|error| JsonFault {
        pointer: shown(&pointer_of(&reading.path)),
        line: error.line(),
        column: error.column(),
        detail: reading.refused.take().unwrap_or_else(|| without_place(&error)),
    })
}

/// Checks a value that came from elsewhere (YAML) for the same limits.
///
/// # Errors
/// The first fault, with its pointer.
pub fn check(value: &Value) -> Result<(), JsonFault> {
    let mut pointer = String::new();
    check_at(value, &mut pointer, 0).map_err(|detail| JsonFault {
        pointer: shown(&pointer),
        line: 0,
        column: 0,
        detail,
    })
}

/// On a fault `pointer` stays where it is.
fn check_at(value: &Value, pointer: &mut String, depth: usize) -> Result<(), String> {
    if depth >= MAX_DEPTH && (value.is_array() || value.is_object()) {
        return Err(too_deep(MAX_DEPTH));
    }
    match value {
        Value::Null | Value::Bool(_) | Value::String(_) => Ok(()),
        Value::Number(number) => check_number(number),
        Value::Array(items) => items.iter().enumerate().try_for_each(|(index, item)| {
            let length = append_index(pointer, index);
            check_at(item, pointer, depth + 1)?;
            pointer.truncate(length);
            Ok(())
        }),
        Value::Object(members) => members.iter().try_for_each(|(name, member)| {
            let length = append(pointer, name);
            check_at(member, pointer, depth + 1)?;
            pointer.truncate(length);
            Ok(())
        }),
    }
}

fn check_number(number: &Number) -> Result<(), String> {
    let exact = match (number.as_i64(), number.as_u64(), number.as_f64()) {
        (Some(value), _, _) => is_exact(value.unsigned_abs()),
        (_, Some(value), _) => is_exact(value),
        (_, _, Some(value)) if value.is_finite() => value.abs() <= MAX_WHOLE,
        _ => return Err(NOT_FINITE.to_owned()),
    };
    if exact { Ok(()) } else { Err(too_wide()) }
}

/// How deep objects and arrays are nested: 0 for a scalar. A secret counts as two, as it does once
/// it is redacted.
#[must_use]
pub fn depth(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => 0,
        Value::Array(items) => 1 + items.iter().map(depth).max().unwrap_or(0),
        Value::Object(members) if members.contains_key(super::secret::MEMBER) => 2,
        Value::Object(members) => 1 + members.values().map(depth).max().unwrap_or(0),
    }
}

/// A segment of a JSON pointer, escaped.
#[must_use]
pub fn escape(segment: &str) -> Cow<'_, str> {
    if segment.contains(['~', '/']) {
        Cow::Owned(segment.replace('~', "~0").replace('/', "~1"))
    } else {
        Cow::Borrowed(segment)
    }
}

/// The pointer to a member (or, as text, an index) of what another pointer leads to.
#[must_use]
pub fn push(pointer: &str, segment: &str) -> String {
    format!("{pointer}/{}", escape(segment))
}

/// Appends a member to a pointer; gives the length that leads back.
pub(super) fn append(pointer: &mut String, segment: &str) -> usize {
    let length = pointer.len();
    pointer.push('/');
    pointer.push_str(&escape(segment));
    length
}

/// Appends an index to a pointer; gives the length that leads back.
pub(super) fn append_index(pointer: &mut String, index: usize) -> usize {
    let length = pointer.len();
    pointer.push('/');
    pointer.push_str(&index.to_string());
    length
}

/// A pointer as faults show it: one that is too long loses its end.
pub(super) fn shown(pointer: &str) -> String {
    if pointer.len() <= MAX_SHOWN_BYTES {
        return pointer.to_owned();
    }
    let end = (0..=MAX_SHOWN_BYTES).rev().find(|end| pointer.is_char_boundary(*end));
    format!("{}…", &pointer[..end.unwrap_or(0)])
}

fn is_exact(magnitude: u64) -> bool {
    magnitude <= MAX_INTEGER.unsigned_abs()
}

fn too_wide() -> String {
    format!(
        "is an integer outside ±{MAX_INTEGER}, which not every reader holds exactly; write it as \
         text"
    )
}

fn too_deep(max_depth: usize) -> String {
    format!("is nested deeper than {max_depth}")
}

/// The words of the parser without its place, which is told apart.
fn without_place(error: &serde_json::Error) -> String {
    let text = error.to_string();
    let end = text.rfind(" at line ").unwrap_or(text.len());
    text[..end].to_owned()
}

enum Segment {
    Name(String),
    Index(usize),
}

fn pointer_of(path: &[Segment]) -> String {
    let mut pointer = String::new();
    for segment in path {
        match segment {
            Segment::Name(name) => append(&mut pointer, name),
            Segment::Index(index) => append_index(&mut pointer, *index),
        };
    }
    pointer
}

/// What is known while a text is read.
struct Reading {
    /// Where the value stands that is read now. It stays there when reading fails.
    path: Vec<Segment>,
    max_depth: usize,
    /// Why reading was ended, if it was not the text's form.
    refused: Option<String>,
}

impl Reading {
    fn refuse<E: Error>(&mut self, detail: String) -> E {
        self.refused = Some(detail);
        E::custom("refused")
    }

    fn enter<E: Error>(&mut self) -> Result<(), E> {
        if self.path.len() >= self.max_depth {
            return Err(self.refuse(too_deep(self.max_depth)));
        }
        Ok(())
    }
}

/// Reads one value.
struct Seed<'r>(&'r mut Reading);

impl<'de> DeserializeSeed<'de> for Seed<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<Value, D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Seed<'_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        if is_exact(value.unsigned_abs()) {
            Ok(value.into())
        } else {
            Err(self.0.refuse(too_wide()))
        }
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        if is_exact(value) { Ok(value.into()) } else { Err(self.0.refuse(too_wide())) }
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        if value.is_finite() && value.abs() > MAX_WHOLE {
            return Err(self.0.refuse(too_wide()));
        }
        match Number::from_f64(value) {
            Some(number) => Ok(Value::Number(number)),
            None => Err(self.0.refuse(NOT_FINITE.to_owned())),
        }
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Value, E> {
        Ok(Value::String(value.to_owned()))
    }

    fn visit_string<E: Error>(self, value: String) -> Result<Value, E> {
        Ok(Value::String(value))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let reading = self.0;
        reading.enter::<A::Error>()?;
        let mut out = Vec::new();
        loop {
            reading.path.push(Segment::Index(out.len()));
            let item = items.next_element_seed(Seed(&mut *reading))?;
            reading.path.pop();
            match item {
                Some(item) => out.push(item),
                None => return Ok(Value::Array(out)),
            }
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Value, A::Error> {
        let reading = self.0;
        reading.enter::<A::Error>()?;
        let mut out = Map::new();
        while let Some(name) = members.next_key::<String>()? {
            let repeated = out.contains_key(&name);
            reading.path.push(Segment::Name(name));
            if repeated {
                return Err(reading.refuse("is given twice".to_owned()));
            }
            let value = members.next_value_seed(Seed(&mut *reading))?;
            if let Some(Segment::Name(name)) = reading.path.pop() {
                out.insert(name, value);
            }
        }
        Ok(Value::Object(out))
    }
}

#[cfg(test)]
#[path = "json_tests.rs"]
mod tests;
