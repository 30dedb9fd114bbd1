//! A refusal, as every interface of the configuration tells it.

use std::fmt;

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::Code;
use crate::qos::word_enum;

word_enum!(
    /// Whether a refused change took effect.
    Applied {
        /// It did not.
        No = "no",
        /// Nobody knows: look before trying again.
        Unknown = "unknown",
    }
);

/// One fault of several.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FieldFault {
    /// Where in the document, as a JSON pointer (RFC 6901).
    pub pointer: String,
    /// What kind of fault.
    pub code: Code,
    /// In words; never holds a secret.
    pub detail: String,
    /// Which document of the request, from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub document: Option<usize>,
}

/// A refusal (RFC 9457), without what the interface adds: type, instance, request id.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// What kind.
    pub code: Code,
    /// What was wrong, where, what to do; never holds a secret, a path of the machine or another
    /// subject's data.
    pub detail: String,
    /// Whether a change took effect.
    pub applied: Applied,
    /// The faults, where there may be several.
    pub errors: Vec<FieldFault>,
    /// The current revision, where it helps.
    pub revision: Option<u64>,
    /// The smallest revision that a watch may start after.
    pub oldest_revision: Option<u64>,
    /// When to try again, in seconds.
    pub retry_after_s: Option<u64>,
    /// What was wrong with the token or the right, for log and audit alone.
    pub internal: Option<String>,
}

impl Problem {
    /// A refusal that changed nothing.
    #[must_use]
    pub fn new(code: Code, detail: impl Into<String>) -> Self {
        let applied = match code {
            Code::OutcomeUnknown => Applied::Unknown,
            _ => Applied::No,
        };
        Self {
            code,
            detail: detail.into(),
            applied,
            errors: Vec::new(),
            revision: None,
            oldest_revision: None,
            retry_after_s: None,
            internal: None,
        }
    }

    /// A refusal with its places; the code and words of the first fault stand for all.
    #[must_use]
    pub fn faults(errors: Vec<FieldFault>) -> Self {
        let first = errors.first().map(|fault| (fault.code, told(&fault.pointer, &fault.detail)));
        let (code, mut detail) = first.unwrap_or((Code::ValidationFailed, String::new()));
        if errors.len() > 1 {
            detail.push_str(&format!(" (and {} more)", errors.len() - 1));
        }
        let mut problem = Self::new(code, detail);
        problem.errors = errors;
        problem
    }

    /// With the current revision.
    #[must_use]
    pub fn at(mut self, revision: u64) -> Self {
        self.revision = Some(revision);
        self
    }

    /// With the time after which another try makes sense, in seconds.
    #[must_use]
    pub fn retry_after(mut self, seconds: u64) -> Self {
        self.retry_after_s = Some(seconds);
        self
    }

    /// With what log and audit should say besides.
    #[must_use]
    pub fn because(mut self, internal: impl Into<String>) -> Self {
        self.internal = Some(internal.into());
        self
    }

    /// With whether the change took effect.
    #[must_use]
    pub fn applied(mut self, applied: Applied) -> Self {
        self.applied = applied;
        self
    }

    /// The members of `application/problem+json`; `path` is that of the request.
    #[must_use]
    pub fn to_json(&self, path: &str, request_id: &str) -> Value {
        let mut out = Map::new();
        let mut put = |name: &str, value: Value| {
            out.insert(name.to_owned(), value);
        };
        put("type", format!("/docs/errors/{}", self.code).into());
        put("title", self.code.title().into());
        if let Some(status) = self.code.http_status() {
            put("status", status.into());
        }
        put("detail", self.detail.as_str().into());
        put("instance", path.into());
        put("code", self.code.as_str().into());
        put("request_id", request_id.into());
        put("applied", self.applied.as_str().into());
        if !self.errors.is_empty() {
            put("errors", json!(self.errors));
        }
        for (name, value) in [
            ("revision", self.revision),
            ("oldest_revision", self.oldest_revision),
            ("retry_after_s", self.retry_after_s),
        ] {
            if let Some(value) = value {
                put(name, value.into());
            }
        }
        Value::Object(out)
    }
}

/// A fault with its place; that of the whole document is empty.
fn told(pointer: &str, detail: &str) -> String {
    match pointer {
        "" => detail.to_owned(),
        pointer => format!("{pointer}: {detail}"),
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.code, self.detail)
    }
}

impl std::error::Error for Problem {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_fault_stands_for_all() {
        let fault = |pointer: &str, detail: &str| FieldFault {
            pointer: pointer.to_owned(),
            code: Code::ReferenceNotFound,
            detail: detail.to_owned(),
            document: None,
        };
        let whole = Problem::faults(vec![fault("", "expected an object")]);
        assert_eq!(
            (whole.code, whole.detail.as_str()),
            (Code::ReferenceNotFound, "expected an object")
        );
        let two = Problem::faults(vec![fault("/spec/layer", "no layer edge"), fault("", "x")]);
        assert_eq!(two.detail, "/spec/layer: no layer edge (and 1 more)");
        assert_eq!(Problem::faults(Vec::new()).code, Code::ValidationFailed);
    }
}
