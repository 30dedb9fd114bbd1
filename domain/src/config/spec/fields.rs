//! Values of a document with their pointers: what reads them collects every fault instead of
//! stopping at the first.

use std::cell::RefCell;
use std::fmt::Display;
use std::str::FromStr;

use serde_json::{Map, Value};

use crate::config::json::{push, shown};
use crate::config::{Code, FieldFault};
use crate::node_file::{describe, nearest, words};

/// More faults than these help nobody.
const MAX_FAULTS: usize = 100;
/// Longest text of a closed form (a name, an address, a word) that is read at all, in bytes.
const MAX_FORM_BYTES: usize = 256;

/// Everything that was found to be wrong.
#[derive(Default)]
pub(super) struct Faults(RefCell<Vec<FieldFault>>);

impl Faults {
    pub(super) fn add(&self, pointer: &str, detail: impl Into<String>) {
        if !self.are_enough() {
            self.0.borrow_mut().push(FieldFault {
                pointer: shown(pointer),
                code: Code::ValidationFailed,
                detail: detail.into(),
                document: None,
            });
        }
    }

    pub(super) fn count(&self) -> usize {
        self.0.borrow().len()
    }

    /// Whether looking further is of no use.
    pub(super) fn are_enough(&self) -> bool {
        self.count() >= MAX_FAULTS
    }

    pub(super) fn into_vec(self) -> Vec<FieldFault> {
        self.0.into_inner()
    }
}

/// A value and where it stands.
#[derive(Clone)]
pub(super) struct At<'v> {
    pub(super) value: &'v Value,
    pub(super) pointer: String,
    pub(super) faults: &'v Faults,
}

impl<'v> At<'v> {
    pub(super) fn new(value: &'v Value, pointer: &str, faults: &'v Faults) -> Self {
        Self { value, pointer: pointer.to_owned(), faults }
    }

    fn below(&self, value: &'v Value, segment: &str) -> Self {
        Self { value, pointer: push(&self.pointer, segment), faults: self.faults }
    }

    /// Reports a fault; answers `None` so that a reader can end with it.
    pub(super) fn refuse<T>(&self, detail: impl Into<String>) -> Option<T> {
        self.faults.add(&self.pointer, detail);
        None
    }

    /// Reports that the value is of another type than `wanted`.
    pub(super) fn expected<T>(&self, wanted: &str) -> Option<T> {
        let hint = match self.value {
            Value::Null => "; leave it out instead",
            Value::Number(_) | Value::Bool(_) if wanted.starts_with("text") => "; put it in quotes",
            _ => "",
        };
        self.refuse(format!("expected {wanted}, found {}{hint}", describe(self.value)))
    }

    /// Text of at most so many characters.
    pub(super) fn text(&self, most: usize) -> Option<&'v str> {
        let Value::String(text) = self.value else {
            return self.expected("text");
        };
        match text.chars().count() {
            count if count > most => {
                self.refuse(format!("has {count} characters, at most {most} are allowed"))
            }
            _ => Some(text),
        }
    }

    /// Text that a type reads: names, words of a closed set.
    pub(super) fn parsed<T: FromStr<Err: Display>>(&self) -> Option<T> {
        let Value::String(text) = self.value else {
            return self.expected("text");
        };
        if text.len() > MAX_FORM_BYTES {
            return self
                .refuse(format!("has {} bytes, at most {MAX_FORM_BYTES} are allowed", text.len()));
        }
        text.parse().map_or_else(|error| self.refuse(words(text, &error)), Some)
    }

    /// A whole number between two bounds, both included.
    pub(super) fn whole(&self, least: u64, most: u64) -> Option<u64> {
        let Value::Number(number) = self.value else {
            return self.expected(&format!("a whole number from {least} to {most}"));
        };
        match number.as_u64().filter(|value| (least..=most).contains(value)) {
            Some(value) => Some(value),
            None => self.refuse(format!("{number} is not a whole number from {least} to {most}")),
        }
    }

    /// A number above zero and up to a bound.
    pub(super) fn positive(&self, most: f64) -> Option<f64> {
        let Value::Number(number) = self.value else {
            return self.expected(&format!("a number above 0, at most {most}"));
        };
        match number.as_f64().filter(|value| *value > 0.0 && *value <= most) {
            Some(value) => Some(value),
            None => self.refuse(format!("{number} is not above 0 and at most {most}")),
        }
    }

    /// The entries of a list of at most so many.
    pub(super) fn list(&self, most: usize) -> Vec<At<'v>> {
        let Value::Array(items) = self.value else {
            self.expected::<()>("a list");
            return Vec::new();
        };
        if items.len() > most {
            self.refuse::<()>(format!("has {} entries, at most {most} are allowed", items.len()));
            return Vec::new();
        }
        items.iter().enumerate().map(|(index, item)| self.below(item, &index.to_string())).collect()
    }

    /// The members of an object with free names.
    pub(super) fn entries(&self) -> Vec<(&'v str, At<'v>)> {
        let Value::Object(members) = self.value else {
            self.expected::<()>("an object");
            return Vec::new();
        };
        members.iter().map(|(name, value)| (name.as_str(), self.below(value, name))).collect()
    }

    /// The members of an object of which these are known; others are reported.
    pub(super) fn fields(&self, known: &'static [&'static str]) -> Option<Fields<'v>> {
        let Value::Object(members) = self.value else {
            return self.expected("an object");
        };
        for name in members.keys().filter(|name| !known.contains(&name.as_str())) {
            if self.faults.are_enough() {
                break;
            }
            let hint = match nearest(name, known) {
                Some(near) => format!("did you mean {near}?"),
                None => format!("known are {}", known.join(", ")),
            };
            self.faults.add(&push(&self.pointer, name), format!("unknown member; {hint}"));
        }
        Some(Fields { at: self.clone(), members })
    }
}

/// An object with a closed set of members.
pub(super) struct Fields<'v> {
    pub(super) at: At<'v>,
    pub(super) members: &'v Map<String, Value>,
}

impl<'v> Fields<'v> {
    pub(super) fn get(&self, name: &str) -> Option<At<'v>> {
        self.members.get(name).map(|value| self.at.below(value, name))
    }

    /// A member that must be there.
    pub(super) fn need(&self, name: &str) -> Option<At<'v>> {
        let found = self.get(name);
        if found.is_none() {
            self.at.faults.add(&push(&self.at.pointer, name), "is required");
        }
        found
    }
}
