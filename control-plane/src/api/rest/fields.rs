//! Reads the small bodies (`{"revision":412}`) strictly: all faults at once, unknown members refused.

use blaze_domain::config::{Code, FieldFault, MAX_INTEGER, Problem};
use serde_json::{Map, Value};

/// The members of a body while they are read.
pub(super) struct Fields<'a> {
    members: Option<&'a Map<String, Value>>,
    known: Vec<&'static str>,
    faults: Vec<FieldFault>,
}

impl<'a> Fields<'a> {
    /// Begins with a body.
    pub(super) fn of(body: &'a Value) -> Self {
        let mut fields = Self {
            members: body.as_object(),
            known: Vec::new(),
            faults: Vec::new(),
        };
        if fields.members.is_none() {
            fields.fault("", "is not an object");
        }
        fields
    }

    fn fault(&mut self, pointer: &str, detail: impl Into<String>) {
        self.faults.push(FieldFault {
            pointer: pointer.to_owned(),
            code: Code::ValidationFailed,
            detail: detail.into(),
            document: None,
        });
    }

    fn member(&mut self, name: &'static str) -> Option<&'a Value> {
        self.known.push(name);
        self.members?.get(name)
    }

    fn needed(&mut self, name: &'static str) -> Option<&'a Value> {
        let value = self.member(name);
        if value.is_none() && self.members.is_some() {
            self.fault(&format!("/{name}"), "is missing");
        }
        value
    }

    /// A revision that must be there.
    pub(super) fn revision(&mut self, name: &'static str) -> u64 {
        let Some(value) = self.needed(name) else { return 0 };
        self.whole(name, value, 1, MAX_INTEGER.unsigned_abs())
    }

    /// A whole number that may be absent.
    pub(super) fn number(&mut self, name: &'static str, least: u64, most: u64, default: u64) -> u64 {
        match self.member(name) {
            Some(value) => self.whole(name, value, least, most),
            None => default,
        }
    }

    fn whole(&mut self, name: &str, value: &Value, least: u64, most: u64) -> u64 {
        match value.as_u64().filter(|number| (least..=most).contains(number)) {
            Some(number) => number,
            None => {
                self.fault(
                    &format!("/{name}"),
                    format!("is no whole number from {least} to {most}"),
                );
                least
            }
        }
    }

    /// `true` or `false`; absent is `false`.
    pub(super) fn flag(&mut self, name: &'static str) -> bool {
        match self.member(name) {
            None => false,
            Some(Value::Bool(flag)) => *flag,
            Some(_) => {
                self.fault(&format!("/{name}"), "is neither true nor false");
                false
            }
        }
    }

    /// A text that must be there, of so many characters at most.
    pub(super) fn text(&mut self, name: &'static str, most: usize) -> String {
        let Some(value) = self.needed(name) else {
            return String::new();
        };
        let text = self.short(name, value, most);
        if text.as_deref() == Some("") {
            self.fault(&format!("/{name}"), "is empty");
        }
        text.unwrap_or_default()
    }

    /// A text that may be absent or `null`.
    pub(super) fn optional_text(&mut self, name: &'static str, most: usize) -> Option<String> {
        let value = self.member(name).filter(|value| !value.is_null())?;
        self.short(name, value, most)
    }

    /// A text that may be absent, which is the empty one.
    pub(super) fn free_text(&mut self, name: &'static str, most: usize) -> String {
        match self.member(name) {
            Some(value) => self.short(name, value, most).unwrap_or_default(),
            None => String::new(),
        }
    }

    fn short(&mut self, name: &str, value: &Value, most: usize) -> Option<String> {
        match value.as_str() {
            Some(text) if text.chars().count() <= most => return Some(text.to_owned()),
            Some(_) => self.fault(&format!("/{name}"), format!("has more than {most} characters")),
            None => self.fault(&format!("/{name}"), "is no text"),
        }
        None
    }

    /// A list of words that must be there; each comes once.
    pub(super) fn words(&mut self, name: &'static str, allowed: &[&str]) -> Vec<String> {
        let Some(value) = self.needed(name) else {
            return Vec::new();
        };
        let Some(items) = value.as_array().filter(|items| !items.is_empty()) else {
            self.fault(&format!("/{name}"), "is no list, or an empty one");
            return Vec::new();
        };
        let mut words: Vec<String> = Vec::new();
        for (index, item) in items.iter().enumerate() {
            match item.as_str().filter(|word| allowed.contains(word)) {
                Some(word) if words.iter().any(|other| other == word) => {
                    self.fault(&format!("/{name}/{index}"), "comes twice");
                }
                Some(word) => words.push(word.to_owned()),
                None => self.fault(
                    &format!("/{name}/{index}"),
                    format!("is not one of {}", allowed.join(", ")),
                ),
            }
        }
        words
    }

    /// A fault that only the caller can see.
    pub(super) fn refuse(&mut self, name: &str, detail: impl Into<String>) {
        self.fault(&format!("/{name}"), detail);
    }

    /// Ends the reading.
    ///
    /// # Errors
    /// `validation_failed` with all faults.
    pub(super) fn done(mut self) -> Result<(), Problem> {
        let unknown: Vec<&String> = match self.members {
            Some(members) => members
                .keys()
                .filter(|name| !self.known.contains(&name.as_str()))
                .collect(),
            None => Vec::new(),
        };
        for name in unknown {
            let pointer = format!("/{}", name.replace('~', "~0").replace('/', "~1"));
            let detail = format!("is unknown; known are {}", self.known.join(", "));
            self.fault(&pointer, detail);
        }
        if self.faults.is_empty() {
            Ok(())
        } else {
            Err(Problem::faults(self.faults))
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn faults(body: &Value, read: impl FnOnce(&mut Fields<'_>)) -> Vec<(String, String)> {
        let mut fields = Fields::of(body);
        read(&mut fields);
        match fields.done() {
            Ok(()) => Vec::new(),
            Err(problem) => problem
                .errors
                .into_iter()
                .map(|fault| (fault.pointer, fault.detail))
                .collect(),
        }
    }

    #[test]
    fn all_faults_come_at_once() {
        let body = json!({ "revision": -1, "force": "yes", "a/b": 1 });
        let found = faults(&body, |fields| {
            fields.revision("revision");
            fields.flag("force");
            fields.text("subject", 10);
        });
        let pointers: Vec<&str> = found.iter().map(|(pointer, _)| pointer.as_str()).collect();
        assert_eq!(pointers, ["/revision", "/force", "/subject", "/a~1b"]);
    }

    #[test]
    fn what_fits_is_read() {
        let body = json!({ "revision": 7, "roles": ["viewer", "admin"], "layer": null, "reason": "" });
        let mut fields = Fields::of(&body);
        assert_eq!(fields.revision("revision"), 7);
        assert_eq!(fields.words("roles", &["viewer", "admin"]), ["viewer", "admin"]);
        assert_eq!(fields.optional_text("layer", 63), None);
        assert_eq!(fields.free_text("reason", 10), "");
        assert_eq!(fields.number("expires_in_s", 1, 10, 5), 5);
        assert!(!fields.flag("force"));
        assert!(fields.done().is_ok());
    }

    #[test]
    fn other_shapes_are_refused() {
        for body in [
            json!([]),
            json!(null),
            json!("x"),
            json!({ "revision": 1.5 }),
            json!({ "revision": "1" }),
            json!({}),
        ] {
            assert!(
                !faults(&body, |fields| {
                    fields.revision("revision");
                })
                .is_empty(),
                "{body}"
            );
        }
        for roles in [
            json!([]),
            json!("admin"),
            json!(["root"]),
            json!(["admin", "admin"]),
            json!([1]),
        ] {
            let body = json!({ "roles": roles });
            assert!(
                !faults(&body, |fields| {
                    fields.words("roles", &["admin"]);
                })
                .is_empty(),
                "{body}"
            );
        }
    }
}
