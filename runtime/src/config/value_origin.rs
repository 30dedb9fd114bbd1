//! Where a value of the configuration comes from, and faults that say so.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// Begins the detail of the fault that a text has more documents than allowed.
pub(super) const TOO_MANY_DOCUMENTS: &str = "holds too many documents";

/// Where a value of the configuration comes from.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum ValueOrigin {
    /// Nowhere in particular: there is no file.
    Nowhere,
    /// A line of a file, counted from 1; 0: the file as a whole.
    File {
        /// The file as it was named.
        file: Arc<str>,
        /// The line.
        line: usize,
    },
    /// A line of a text that is no file, counted from 1.
    Line(usize),
    /// A tree that counts over the file.
    Overlay {
        /// Who gives it.
        origin: Arc<str>,
        /// Which state of it.
        revision: u64,
    },
    /// A variable of the environment.
    Environment(Arc<str>),
    /// An override on the command line: its path, without the value.
    Override(Arc<str>),
}

impl fmt::Display for ValueOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nowhere => f.write_str("configuration"),
            Self::File { file, line: 0 } => f.write_str(file),
            Self::File { file, line } => write!(f, "{file}:{line}"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Overlay { origin, revision } => write!(f, "{origin} revision {revision}"),
            Self::Environment(name) => write!(f, "environment {name}"),
            Self::Override(path) => write!(f, "--set {path}"),
        }
    }
}

/// A fault or a warning, with its place: `FILE:LINE: flow.bandwidth.limit_mbps: …`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct LocatedFault {
    /// Where it stands.
    pub place: ValueOrigin,
    /// Which value, such as `flow.topics[0].match`; empty: the whole.
    pub path: String,
    /// What is wrong with it.
    pub detail: String,
}

impl LocatedFault {
    /// Whether it is that a text has more documents than [`yaml_documents`](super::yaml_documents)
    /// was to read.
    #[must_use]
    pub fn is_too_many_documents(&self) -> bool {
        self.path.is_empty() && self.detail.starts_with(TOO_MANY_DOCUMENTS)
    }
}

impl fmt::Display for LocatedFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.place)?;
        if !self.path.is_empty() {
            write!(f, "{}: ", self.path)?;
        }
        f.write_str(&self.detail)
    }
}

impl std::error::Error for LocatedFault {}

/// The place of every value of a document, by its path.
#[derive(Debug, Clone, Default)]
pub(super) struct Places {
    by_path: BTreeMap<String, ValueOrigin>,
}

impl Places {
    pub(super) fn set(&mut self, path: &str, place: ValueOrigin) {
        self.by_path.insert(path.to_owned(), place);
    }

    pub(super) fn knows(&self, path: &str) -> bool {
        self.by_path.contains_key(path)
    }

    /// Forgets what stands below a path, for its value is replaced.
    pub(super) fn forget_below(&mut self, path: &str) {
        let below =
            |key: &str| key.strip_prefix(path).is_some_and(|rest| rest.starts_with(['.', '[']));
        self.by_path.retain(|key, _| !below(key));
    }

    /// The place of a path, or of the nearest ancestor that has one.
    pub(super) fn locate(&self, path: &str) -> ValueOrigin {
        let mut path = path;
        loop {
            if let Some(place) = self.by_path.get(path) {
                return place.clone();
            }
            if path.is_empty() {
                return ValueOrigin::Nowhere;
            }
            path = path.rfind(['.', '[']).map_or("", |end| &path[..end]);
        }
    }
}

/// The path of a key below a path.
pub(super) fn join(path: &str, key: &str) -> String {
    if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_paths_have_the_place_of_their_ancestor() {
        let line = |line| ValueOrigin::File { file: Arc::from("a.yaml"), line };
        let mut places = Places::default();
        assert_eq!(places.locate("flow"), ValueOrigin::Nowhere);
        places.set("", line(1));
        places.set("flow", line(2));
        places.set("flow.topics[0]", line(5));
        places.set("flower", line(9));
        assert_eq!(places.locate("node.name"), line(1));
        assert_eq!(places.locate("flow.bandwidth.links.cloud"), line(2));
        assert_eq!(places.locate("flow.topics[0].match"), line(5));
        assert_eq!(places.locate("flow.topics[10].match"), line(2));
        places.forget_below("flow");
        assert_eq!(places.locate("flow.topics[0]"), line(2));
        assert_eq!(places.locate("flower"), line(9));
    }

    #[test]
    fn a_fault_reads_as_documented() {
        let fault = LocatedFault {
            place: ValueOrigin::File { file: Arc::from("blaze.yaml"), line: 12 },
            path: "flow.bandwidth.limit_mbps".to_owned(),
            detail: "expected a number".to_owned(),
        };
        assert_eq!(
            fault.to_string(),
            "blaze.yaml:12: flow.bandwidth.limit_mbps: expected a number"
        );
    }
}
