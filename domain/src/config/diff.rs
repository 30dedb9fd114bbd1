//! What differs between two values or documents.
//!
//! Objects are compared member by member, everything else as a whole; a secret ([`secret`]) is one
//! value. A difference is an operation of RFC 6902 at a pointer of RFC 6901: an object that is new
//! is one `add`, not one per member.

use std::borrow::Cow;
use std::collections::BTreeSet;

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::json::append;
use super::{Document, Labels, secret};

/// Differences that are told one by one. Beyond, whole objects are told instead of what differs in
/// them.
const MAX_DELTAS: usize = 10_000;
/// Paths of differences are told in so many bytes, with the same way out.
const MAX_DELTA_PATH_BYTES: usize = 1024 * 1024;
/// As above, for what is written beside every change.
const MAX_PATHS: usize = 1_000;
/// As above.
const MAX_PATH_BYTES: usize = 64 * 1024;
/// Members of a spec that mean `{}` when they are absent.
const EMPTY_IF_ABSENT: [&str; 2] = ["config", "overrides"];

/// One difference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Delta {
    /// `add`, `remove` or `replace`.
    pub op: &'static str,
    /// Where, as a JSON pointer.
    pub path: String,
    /// What was there; not of `add`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub old: Option<Value>,
    /// What is there now; not of `remove`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<Value>,
}

impl Delta {
    fn new(path: &str, old: Option<&Value>, value: Option<&Value>) -> Self {
        let op = match (old, value) {
            (None, _) => "add",
            (Some(_), None) => "remove",
            (Some(_), Some(_)) => "replace",
        };
        Self { op, path: path.to_owned(), old: old.cloned(), value: value.cloned() }
    }

    /// The members of the contract; `old` and `value` as far as they are there, for `null` is a
    /// value.
    #[must_use]
    pub fn to_json(&self) -> Value {
        json!(self)
    }

    /// The difference that [`Delta::to_json`] wrote.
    #[must_use]
    pub fn from_json(value: &Value) -> Option<Self> {
        let path = value.get("path")?.as_str()?;
        let delta = Self::new(path, value.get("old"), value.get("value"));
        (value.get("op")?.as_str()? == delta.op).then_some(delta)
    }
}

/// What leads from one value to another, in the order of the paths, each of which begins with
/// `prefix`.
#[must_use]
pub fn diff(old: &Value, new: &Value, prefix: &str) -> Vec<Delta> {
    within_limits(|found| found.values(Some(old), Some(new), &mut prefix.to_owned()))
}

/// What leads from one document to another, over labels, annotations and spec. No document is one
/// without any members; absent `spec.config` and `spec.overrides` are `{}`. Secrets are redacted,
/// in whatever form they are.
#[must_use]
pub fn document_diff(old: Option<&Document>, new: Option<&Document>) -> Vec<Delta> {
    let (old_spec, new_spec) = (redacted_spec(old), redacted_spec(new));
    within_limits(|found| {
        for (pointer, of) in [
            ("/labels", labels as fn(&Document) -> &Labels),
            ("/annotations", annotations as fn(&Document) -> &Labels),
        ] {
            let (old, new) = (object(old.map(of)), object(new.map(of)));
            found.values(Some(&old), Some(&new), &mut pointer.to_owned())?;
        }
        let pointer = &mut "/spec".to_owned();
        match (&*old_spec, &*new_spec) {
            (Value::Object(old), Value::Object(new)) => {
                found.members(old, new, &EMPTY_IF_ABSENT, pointer)
            }
            (old, new) => found.values(Some(old), Some(new), pointer),
        }
    })
}

fn labels(document: &Document) -> &Labels {
    &document.labels
}

fn annotations(document: &Document) -> &Labels {
    &document.annotations
}

fn object(labels: Option<&Labels>) -> Value {
    labels.map_or_else(|| json!({}), |labels| json!(labels))
}

fn redacted_spec(document: Option<&Document>) -> Cow<'_, Value> {
    match document {
        Some(document) => secret::redact(&document.spec),
        None => Cow::Owned(json!({})),
    }
}

/// The paths of differences, sorted. If they are too many or too long, they are cut to as many
/// segments as fit.
#[must_use]
pub fn paths(deltas: &[Delta]) -> Vec<String> {
    let mut out: BTreeSet<&str> = deltas.iter().map(|delta| delta.path.as_str()).collect();
    let mut segments = out.iter().map(|path| path.matches('/').count()).max().unwrap_or(0);
    while segments > 1
        && (out.len() > MAX_PATHS
            || out.iter().map(|path| path.len()).sum::<usize>() > MAX_PATH_BYTES)
    {
        segments -= 1;
        out = out.into_iter().map(|path| beginning(path, segments)).collect();
    }
    out.into_iter().take(MAX_PATHS).map(str::to_owned).collect()
}

/// The first segments of a pointer.
fn beginning(path: &str, segments: usize) -> &str {
    path.match_indices('/').nth(segments).map_or(path, |(end, _)| &path[..end])
}

/// There are too many differences to tell them so far down.
struct TooMany;

/// Differences as they are found, down to so many levels of objects.
struct Found {
    deltas: Vec<Delta>,
    path_bytes: usize,
    levels: usize,
}

/// Tries with all levels of objects, then with fewer and fewer.
fn within_limits(search: impl Fn(&mut Found) -> Result<(), TooMany>) -> Vec<Delta> {
    for levels in [usize::MAX, 8, 4, 3, 2, 1, 0] {
        let mut found = Found { deltas: Vec::new(), path_bytes: 0, levels };
        if search(&mut found).is_ok() || levels == 0 {
            found.deltas.sort_by(|one, other| one.path.cmp(&other.path));
            return found.deltas;
        }
    }
    Vec::new()
}

impl Found {
    fn add(&mut self, path: &str, old: Option<&Value>, new: Option<&Value>) -> Result<(), TooMany> {
        self.path_bytes += path.len();
        if self.deltas.len() >= MAX_DELTAS || self.path_bytes > MAX_DELTA_PATH_BYTES {
            return Err(TooMany);
        }
        self.deltas.push(Delta::new(path, old, new));
        Ok(())
    }

    fn values(
        &mut self,
        old: Option<&Value>,
        new: Option<&Value>,
        pointer: &mut String,
    ) -> Result<(), TooMany> {
        if old == new {
            return Ok(());
        }
        match (old.and_then(plain_object), new.and_then(plain_object)) {
            (Some(old), Some(new)) if self.levels > 0 => self.members(old, new, &[], pointer),
            _ => self.add(pointer, old, new),
        }
    }

    /// Compares two objects; absent members named in `empty` are empty objects.
    fn members(
        &mut self,
        old: &Map<String, Value>,
        new: &Map<String, Value>,
        empty: &[&str],
        pointer: &mut String,
    ) -> Result<(), TooMany> {
        let nothing = Value::Object(Map::new());
        let default = |name: &str| empty.contains(&name).then_some(&nothing);
        let added = new.keys().filter(|name| !old.contains_key(*name));
        self.levels = self.levels.saturating_sub(1);
        for name in old.keys().chain(added) {
            let length = append(pointer, name);
            let (old, new) =
                (old.get(name).or_else(|| default(name)), new.get(name).or_else(|| default(name)));
            self.values(old, new, pointer)?;
            pointer.truncate(length);
        }
        self.levels = self.levels.saturating_add(1);
        Ok(())
    }
}

/// An object that is compared member by member.
fn plain_object(value: &Value) -> Option<&Map<String, Value>> {
    value.as_object().filter(|members| !members.contains_key(secret::MEMBER))
}

#[cfg(test)]
#[path = "diff_tests.rs"]
mod tests;
