//! Merging: a patch into a value, and the parts of an effective configuration with where each key
//! of it comes from.
//!
//! ```text
//! {} ◀─ S.config ◀─ L.config ◀─ L.overrides[S] ◀─ N.config ◀─ N.overrides[S] ◀─ I.config      weakest first
//! ```
//!
//! Merging is that of RFC 7396: objects are merged member by member, everything else replaces,
//! `null` removes. A secret ([`secret`]) is one value and replaces as a text would.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use super::json::append;
use super::{Key, secret};

/// Where a part of an effective configuration stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Source {
    /// The document.
    pub key: Key,
    /// Its revision.
    pub revision: u64,
    /// Whether it is an entry of `overrides` instead of `config`.
    pub is_override: bool,
}

impl Source {
    fn write_to(&self, out: &mut Map<String, Value>) {
        out.insert("kind".to_owned(), json!(self.key.kind()));
        if let Some(service) = self.key.service_name() {
            out.insert("service".to_owned(), json!(service));
        }
        out.insert("name".to_owned(), json!(self.key.name()));
        out.insert("revision".to_owned(), self.revision.into());
        if self.is_override {
            out.insert("override".to_owned(), true.into());
        }
    }
}

/// One part of an effective configuration: an object that is there, even if it is empty. A part
/// that is absent from its document is left out.
#[derive(Debug, Clone, PartialEq)]
pub struct Part<'v> {
    /// Where it stands.
    pub source: Source,
    /// What it says.
    pub value: &'v Value,
}

/// Merges a patch into a value (RFC 7396, `MergePatch`).
pub fn merge_patch(target: &mut Value, patch: &Value) {
    let Some(members) = plain_object(patch) else {
        *target = patch.clone();
        return;
    };
    if plain_object(target).is_none() {
        *target = Value::Object(Map::new());
    }
    let Value::Object(out) = target else { return };
    // All at once: removing one by one from a map that keeps its order takes time in proportion to
    // both.
    if members.values().any(Value::is_null) {
        out.retain(|name, _| members.get(name).is_none_or(|value| !value.is_null()));
    }
    for (name, value) in members.iter().filter(|(_, value)| !value.is_null()) {
        match out.get_mut(name) {
            Some(present) => merge_patch(present, value),
            None => {
                let mut fresh = Value::Null;
                merge_patch(&mut fresh, value);
                out.insert(name.clone(), fresh);
            }
        }
    }
}

/// An object that is merged member by member.
fn plain_object(value: &Value) -> Option<&Map<String, Value>> {
    value.as_object().filter(|members| !members.contains_key(secret::MEMBER))
}

/// Where each key of the effective configuration of parts (weakest first) comes from: JSON pointer
/// → source.
///
/// There is one entry for each leaf: a value that is no object, or an object without members. It
/// names the strongest part that says something of that key, and in `overridden` the weaker ones
/// that do, the strongest of them first, each with its `value`. A key that a `null` took away has
/// an entry with `"removed": true`, as long as something stronger has not put a value there again.
/// Values are as they stand in the parts: redact secrets before.
#[must_use]
pub fn explain(parts: &[Part<'_>]) -> Value {
    let parts: Vec<&Part<'_>> =
        parts.iter().filter(|part| plain_object(part.value).is_some()).collect();
    let mut trace = None;
    for (index, part) in parts.iter().enumerate() {
        follow(&mut trace, part.value, index);
    }
    let mut entries = BTreeMap::new();
    if let Some(trace) = &trace {
        let here: Vec<Option<&Value>> = parts.iter().map(|part| Some(part.value)).collect();
        collect(trace, &parts, &here, &mut String::new(), &mut entries);
    }
    Value::Object(entries.into_iter().collect())
}

/// What became of one key; the numbers are those of the strongest part that says something of it.
enum Trace<'v> {
    Leaf(usize),
    Removed(usize),
    Object { touched: usize, members: BTreeMap<&'v str, Trace<'v>> },
}

/// Does to the trace what [`merge_patch`] does to the value.
fn follow<'v>(trace: &mut Option<Trace<'v>>, value: &'v Value, index: usize) {
    let Some(given) = plain_object(value) else {
        *trace = Some(Trace::Leaf(index));
        return;
    };
    let mut members = match trace.take() {
        Some(Trace::Object { members, .. }) => members,
        Some(Trace::Leaf(_) | Trace::Removed(_)) | None => BTreeMap::new(),
    };
    for (name, value) in given {
        if value.is_null() {
            // A null that finds nothing takes nothing away.
            if let Some(member) = members.get_mut(name.as_str()) {
                *member = Trace::Removed(index);
            }
        } else {
            let mut member = members.remove(name.as_str());
            follow(&mut member, value, index);
            members.extend(member.map(|member| (name.as_str(), member)));
        }
    }
    *trace = Some(Trace::Object { touched: index, members });
}

/// Writes the entries of a key and of everything below it; `here` is what each part says of it.
fn collect(
    trace: &Trace<'_>,
    parts: &[&Part<'_>],
    here: &[Option<&Value>],
    pointer: &mut String,
    entries: &mut BTreeMap<String, Value>,
) {
    let (strongest, removed, members) = match trace {
        Trace::Leaf(index) => (Some(*index), false, None),
        Trace::Removed(index) => (Some(*index), true, None),
        Trace::Object { touched, members } => {
            let is_empty = members.values().all(|member| matches!(member, Trace::Removed(_)));
            (is_empty.then_some(*touched), false, Some(members))
        }
    };
    if let Some((source, index)) =
        strongest.and_then(|index| Some((&parts.get(index)?.source, index)))
    {
        let mut entry = Map::new();
        if removed {
            entry.insert("removed".to_owned(), true.into());
        }
        source.write_to(&mut entry);
        entry.insert("overridden".to_owned(), overridden(parts, here, index));
        entries.insert(pointer.clone(), Value::Object(entry));
    }
    for (name, member) in members.into_iter().flatten() {
        let inner: Vec<Option<&Value>> = here
            .iter()
            .map(|value| value.and_then(plain_object).and_then(|members| members.get(*name)))
            .collect();
        let length = append(pointer, name);
        collect(member, parts, &inner, pointer, entries);
        pointer.truncate(length);
    }
}

fn overridden(parts: &[&Part<'_>], here: &[Option<&Value>], index: usize) -> Value {
    let weaker = parts.iter().zip(here).take(index).rev();
    let entry = |(part, value): (&&Part<'_>, &Option<&Value>)| {
        let mut entry = Map::new();
        part.source.write_to(&mut entry);
        entry.insert("value".to_owned(), (*value)?.clone());
        Some(Value::Object(entry))
    };
    weaker.filter_map(entry).collect()
}

#[cfg(test)]
#[path = "merge_tests.rs"]
mod tests;
