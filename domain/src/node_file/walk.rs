//! Reads a tree of values into types and collects every fault on the way, instead of stopping at
//! the first.
//!
//! A [`Section`] is one mapping of the file. Each of its methods reads one key and remembers that
//! the key is known; what is left over at the end is refused. A reader is a function `&Node ->
//! Option<T>` that reports what is wrong and answers `None`.

use std::cell::RefCell;

use serde_json::{Map, Value};

use super::{Fault, Warning};

/// Most entries of a list or of a mapping with free keys.
const MAX_ENTRIES: usize = 1024;

/// Everything that was found to be wrong or worth a word.
#[derive(Default)]
pub(super) struct Report {
    pub(super) faults: RefCell<Vec<Fault>>,
    pub(super) warnings: RefCell<Vec<Warning>>,
}

/// One value and where it stands.
#[derive(Clone)]
pub(super) struct Node<'v> {
    pub(super) path: String,
    pub(super) value: &'v Value,
    report: &'v Report,
}

impl<'v> Node<'v> {
    pub(super) fn root(value: &'v Value, report: &'v Report) -> Self {
        Self { path: String::new(), value, report }
    }

    /// The same report, another place.
    pub(super) fn at(&self, path: String) -> Self {
        Self { path, ..self.clone() }
    }

    /// Reports a fault of this value; answers `None` so that a reader can end with it.
    pub(super) fn fault<T>(&self, detail: impl Into<String>) -> Option<T> {
        self.report
            .faults
            .borrow_mut()
            .push(Fault { path: self.path.clone(), detail: detail.into() });
        None
    }

    pub(super) fn warn(&self, detail: impl Into<String>) {
        self.report
            .warnings
            .borrow_mut()
            .push(Warning { path: self.path.clone(), detail: detail.into() });
    }

    /// Reports that the value is of another type than `wanted`.
    pub(super) fn expected<T>(&self, wanted: &str) -> Option<T> {
        let hint = match self.value {
            Value::Number(_) | Value::Bool(_) if wanted.starts_with("text") => "; put it in quotes",
            _ => "",
        };
        self.fault(format!("expected {wanted}, found {}{hint}", describe(self.value)))
    }

    fn child(&self, key: &str, value: &'v Value) -> Self {
        let path =
            if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) };
        Self { path, value, report: self.report }
    }

    /// The value as a mapping; `null` is an empty one.
    pub(super) fn section<T>(&self, read: impl FnOnce(&mut Section<'v>) -> T) -> Option<T> {
        let map = match self.value {
            Value::Null => None,
            Value::Object(map) => Some(map),
            Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Array(_) => {
                return self.expected("a mapping");
            }
        };
        let mut section = Section { node: self.clone(), map, known: Vec::new() };
        let out = read(&mut section);
        section.refuse_unknown();
        Some(out)
    }

    /// The value as a mapping with free keys.
    pub(super) fn entries(&self) -> Vec<(&'v str, Node<'v>)> {
        let Value::Object(map) = self.value else {
            if !self.value.is_null() {
                self.expected::<()>("a mapping");
            }
            return Vec::new();
        };
        if map.len() > MAX_ENTRIES {
            self.fault::<()>(format!(
                "has {} entries, at most {MAX_ENTRIES} are allowed",
                map.len()
            ));
            return Vec::new();
        }
        map.iter().map(|(key, value)| (key.as_str(), self.child(key, value))).collect()
    }

    /// The value as a list; entries that cannot be read are reported and left out.
    pub(super) fn list<T>(&self, read: impl Fn(&Node<'v>) -> Option<T>) -> Option<Vec<T>> {
        let Value::Array(items) = self.value else {
            return self.expected("a list");
        };
        if items.len() > MAX_ENTRIES {
            return self
                .fault(format!("has {} entries, at most {MAX_ENTRIES} are allowed", items.len()));
        }
        let item = |(index, value)| {
            read(&Node { path: format!("{}[{index}]", self.path), value, report: self.report })
        };
        Some(items.iter().enumerate().filter_map(item).collect())
    }
}

/// One mapping with a closed set of keys.
pub(super) struct Section<'v> {
    pub(super) node: Node<'v>,
    map: Option<&'v Map<String, Value>>,
    known: Vec<&'static str>,
}

impl<'v> Section<'v> {
    fn get(&mut self, key: &'static str) -> Option<Node<'v>> {
        self.known.push(key);
        self.map.and_then(|map| map.get(key)).map(|value| self.node.child(key, value))
    }

    /// The value of a key that may be missing; `null` is missing.
    pub(super) fn opt<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&Node<'v>) -> Option<T>,
    ) -> Option<T> {
        self.get(key).filter(|node| !node.value.is_null()).and_then(|node| read(&node))
    }

    /// The value of a key, or its default.
    pub(super) fn or<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&Node<'v>) -> Option<T>,
        default: T,
    ) -> T {
        self.opt(key, read).unwrap_or(default)
    }

    /// The value of a key that must be there.
    pub(super) fn need<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&Node<'v>) -> Option<T>,
    ) -> Option<T> {
        let Some(node) = self.get(key).filter(|node| !node.value.is_null()) else {
            return self.node.child(key, &Value::Null).fault("is required");
        };
        read(&node)
    }

    /// A list that may be missing: then it is empty.
    pub(super) fn list<T>(
        &mut self,
        key: &'static str,
        read: impl Fn(&Node<'v>) -> Option<T>,
    ) -> Vec<T> {
        self.opt(key, |node| node.list(read)).unwrap_or_default()
    }

    /// A nested section that may be missing.
    pub(super) fn sub<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&mut Section<'v>) -> Option<T>,
    ) -> Option<T> {
        self.opt(key, |node| node.section(read).flatten())
    }

    /// A nested section that reads like an empty one when it is missing.
    pub(super) fn sub_or_empty<T>(
        &mut self,
        key: &'static str,
        read: impl FnOnce(&mut Section<'v>) -> T,
    ) -> T {
        let given = self.get(key);
        let map = given.as_ref().and_then(|node| match node.value {
            Value::Object(map) => Some(map),
            Value::Null => None,
            _ => node.expected("a mapping"),
        });
        let node = given.unwrap_or_else(|| self.node.child(key, &Value::Null));
        let mut section = Section { node, map, known: Vec::new() };
        let out = read(&mut section);
        section.refuse_unknown();
        out
    }

    /// Exactly one of several keys, each with a section of its own; `null` is an empty section
    /// here.
    pub(super) fn one_of<T>(&mut self, choices: &[Choice<'v, T>]) -> Option<T> {
        let names = choices.iter().map(|(key, _)| *key).collect::<Vec<_>>().join(", ");
        let mut given = Vec::new();
        for (key, read) in choices {
            if let Some(node) = self.get(key) {
                given.push((*key, node.section(read).flatten()));
            }
        }
        if given.len() > 1 {
            let found = given.iter().map(|(key, _)| *key).collect::<Vec<_>>().join(" and ");
            return self.node.fault(format!("holds {found}; only one of {names} is allowed"));
        }
        match given.pop() {
            Some((_, value)) => value,
            None => self.node.fault(format!("needs one of {names}")),
        }
    }

    fn refuse_unknown(&self) {
        for key in self.map.into_iter().flat_map(Map::keys) {
            if self.known.contains(&key.as_str()) {
                continue;
            }
            let hint = match nearest(key, &self.known) {
                Some(known) => format!("; did you mean {known}?"),
                None if self.known.is_empty() => "; nothing is known here".to_owned(),
                None => format!("; known are {}", self.known.join(", ")),
            };
            self.node.child(key, &Value::Null).fault::<()>(format!("unknown key{hint}"));
        }
    }
}

/// What a section reads when nothing is given: the one source of its defaults.
pub(super) fn from_empty<T>(read: fn(&mut Section<'_>) -> T) -> T {
    let report = Report::default();
    read(&mut Section { node: Node::root(&Value::Null, &report), map: None, known: Vec::new() })
}

/// A key and how its section is read.
pub(super) type Choice<'v, T> = (&'static str, fn(&mut Section<'v>) -> Option<T>);

/// What a value is, for people.
pub(crate) fn describe(value: &Value) -> String {
    match value {
        Value::Null => "nothing".to_owned(),
        Value::Bool(value) => format!("{value}"),
        Value::Number(number) => format!("the number {number}"),
        // The text is not repeated: it may be a secret in the wrong place.
        Value::String(_) => "text".to_owned(),
        Value::Array(_) => "a list".to_owned(),
        Value::Object(_) => "a mapping".to_owned(),
    }
}

/// The known word that was probably meant.
pub(crate) fn nearest(found: &str, known: &[&'static str]) -> Option<&'static str> {
    if found.len() > 64 {
        return None;
    }
    let allowed = (found.chars().count() / 3).clamp(1, 3);
    let close = |word: &&'static str| {
        let distance = strsim::osa_distance(&found.to_ascii_lowercase(), word);
        (distance <= allowed).then_some((distance, *word))
    };
    known.iter().filter_map(close).min().map(|(_, word)| word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_near_words_are_suggested() {
        let known = ["limit_mbps", "overhead", "share", "node"];
        assert_eq!(nearest("ndoe", &known), Some("node"), "a swap counts once");
        assert_eq!(nearest("limit_mbs", &known), Some("limit_mbps"));
        assert_eq!(nearest("LIMIT_MBPS", &known), Some("limit_mbps"));
        assert_eq!(nearest("colour", &known), None);
    }
}
