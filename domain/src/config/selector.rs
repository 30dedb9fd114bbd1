//! Labels, and selectors over them as in Kubernetes: `site=lab,tier in (a,b),!spare`.

use std::fmt;
use std::str::FromStr;

use super::Labels;

/// Longest selector, in bytes.
pub const MAX_SELECTOR_BYTES: usize = 4096;
/// Longest name of a label (after the prefix) and longest value, in bytes.
pub const MAX_LABEL_BYTES: usize = 63;
/// Longest prefix of a label's key, in bytes.
pub const MAX_PREFIX_BYTES: usize = 253;

/// Why a text is no key or no value of a label; the words follow the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LabelError {
    /// The name is empty.
    #[error("has an empty name")]
    Empty,
    /// Name or value is too long.
    #[error("is longer than {MAX_LABEL_BYTES} bytes")]
    TooLong,
    /// Name or value holds something else.
    #[error("may hold A-Z, a-z, 0-9, -, _ and ., and begins and ends with a letter or digit")]
    Form,
    /// What stands before the slash is no DNS name.
    #[error(
        "has a prefix that is no DNS name of at most {MAX_PREFIX_BYTES} characters in lower case"
    )]
    Prefix,
}

/// Checks the key of a label: `[dns-prefix/]name`.
///
/// # Errors
/// [`LabelError`].
pub fn check_label_key(key: &str) -> Result<(), LabelError> {
    let name = match key.split_once('/') {
        Some((prefix, _)) if !is_dns_name(prefix) => return Err(LabelError::Prefix),
        Some((_, name)) => name,
        None => key,
    };
    if name.is_empty() {
        return Err(LabelError::Empty);
    }
    check_label_value(name)
}

/// Checks the value of a label; it may be empty.
///
/// # Errors
/// [`LabelError`].
pub fn check_label_value(value: &str) -> Result<(), LabelError> {
    let inside = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.');
    let bytes = value.as_bytes();
    if !bytes.iter().all(inside) {
        return Err(LabelError::Form);
    }
    if bytes.len() > MAX_LABEL_BYTES {
        return Err(LabelError::TooLong);
    }
    let ends = [bytes.first(), bytes.last()];
    if ends.into_iter().flatten().all(u8::is_ascii_alphanumeric) {
        Ok(())
    } else {
        Err(LabelError::Form)
    }
}

/// Whether a text is a DNS name in lower case, at most [`MAX_PREFIX_BYTES`] long.
pub(super) fn is_dns_name(text: &str) -> bool {
    let label = |label: &str| {
        let inside = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
        !label.is_empty()
            && label.len() <= 63
            && label.bytes().all(inside)
            && !label.starts_with('-')
            && !label.ends_with('-')
    };
    text.len() <= MAX_PREFIX_BYTES && text.split('.').all(label)
}

/// A label selector; all requirements must hold.
///
/// ```
/// use blaze_domain::config::selector::LabelSelector;
/// let selector: LabelSelector = "site=lab, tier notin (test), !spare".parse().unwrap();
/// let labels = [("site".to_owned(), "lab".to_owned())].into();
/// assert!(selector.matches(&labels));
/// assert_eq!(selector.to_string(), "site=lab,tier notin (test),!spare");
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct LabelSelector(Vec<Requirement>);

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Requirement {
    key: String,
    condition: Condition,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Condition {
    Is(String),
    IsNot(String),
    In(Vec<String>),
    NotIn(Vec<String>),
    Exists,
    Absent,
}

/// Why a text is no selector.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectorError {
    /// Nothing is selected by nothing: a slip must not become "all".
    #[error("is empty; write a requirement, such as site=lab")]
    Empty,
    /// The text is too long.
    #[error("has {0} bytes, at most {MAX_SELECTOR_BYTES} are allowed")]
    TooLong(usize),
    /// Syntax error: `wanted` expected at character `at`.
    #[error("needs {wanted} at character {at}")]
    Form {
        /// What.
        wanted: &'static str,
        /// Where, from 1.
        at: usize,
    },
    /// A key that no label has.
    #[error("has the key {key:?}, which {error}")]
    Key {
        /// The key.
        key: String,
        /// Why not.
        error: LabelError,
    },
    /// A value that no label has.
    #[error("has the value {value:?}, which {error}")]
    Value {
        /// The value.
        value: String,
        /// Why not.
        error: LabelError,
    },
}

impl LabelSelector {
    /// Whether labels fulfil every requirement.
    #[must_use]
    pub fn matches(&self, labels: &Labels) -> bool {
        self.0.iter().all(|requirement| requirement.condition.holds(labels.get(&requirement.key)))
    }
}

impl Condition {
    fn holds(&self, value: Option<&String>) -> bool {
        match self {
            Self::Is(wanted) => value == Some(wanted),
            Self::IsNot(wanted) => value != Some(wanted),
            Self::In(wanted) => value.is_some_and(|value| wanted.contains(value)),
            Self::NotIn(wanted) => value.is_none_or(|value| !wanted.contains(value)),
            Self::Exists => value.is_some(),
            Self::Absent => value.is_none(),
        }
    }
}

impl FromStr for LabelSelector {
    type Err = SelectorError;

    fn from_str(text: &str) -> Result<Self, SelectorError> {
        if text.len() > MAX_SELECTOR_BYTES {
            return Err(SelectorError::TooLong(text.len()));
        }
        if text.trim().is_empty() {
            return Err(SelectorError::Empty);
        }
        let mut cursor = Cursor { text, at: 0 };
        let mut requirements = Vec::new();
        loop {
            requirements.push(cursor.requirement()?);
            if cursor.is_at_end() {
                return Ok(Self(requirements));
            }
            if !cursor.take(",") {
                return Err(cursor.needs("a comma or the end"));
            }
        }
    }
}

/// A text that is read from left to right.
struct Cursor<'t> {
    text: &'t str,
    /// In bytes; always between two characters.
    at: usize,
}

impl<'t> Cursor<'t> {
    fn rest(&self) -> &'t str {
        self.text.get(self.at..).unwrap_or_default()
    }

    fn skip_space(&mut self) {
        let rest = self.rest();
        self.at += rest.len() - rest.trim_start_matches([' ', '\t']).len();
    }

    fn is_at_end(&mut self) -> bool {
        self.skip_space();
        self.rest().is_empty()
    }

    /// Steps over a sign, if it is next.
    fn take(&mut self, sign: &str) -> bool {
        self.skip_space();
        let found = self.rest().starts_with(sign);
        if found {
            self.at += sign.len();
        }
        found
    }

    /// The characters up to the next sign or space; perhaps none.
    fn word(&mut self) -> &'t str {
        self.skip_space();
        let rest = self.rest();
        let ends =
            |c: char| matches!(c, ',' | '=' | '!' | '(' | ')' | '<' | '>') || c.is_whitespace();
        let word = &rest[..rest.find(ends).unwrap_or(rest.len())];
        self.at += word.len();
        word
    }

    fn needs(&self, wanted: &'static str) -> SelectorError {
        let before = self.text.get(..self.at).unwrap_or_default();
        SelectorError::Form { wanted, at: before.chars().count() + 1 }
    }

    fn key(&mut self) -> Result<String, SelectorError> {
        let key = self.word();
        if key.is_empty() {
            return Err(self.needs("the key of a label"));
        }
        let refuse = |error| SelectorError::Key { key: key.to_owned(), error };
        check_label_key(key).map_err(refuse)?;
        Ok(key.to_owned())
    }

    fn value(&mut self) -> Result<String, SelectorError> {
        let value = self.word();
        let refuse = |error| SelectorError::Value { value: value.to_owned(), error };
        check_label_value(value).map_err(refuse)?;
        Ok(value.to_owned())
    }

    fn requirement(&mut self) -> Result<Requirement, SelectorError> {
        if self.take("!") {
            let key = self.key()?;
            return Ok(Requirement { key, condition: Condition::Absent });
        }
        let key = self.key()?;
        let condition = if self.take("!=") {
            Condition::IsNot(self.value()?)
        } else if self.take("==") || self.take("=") {
            Condition::Is(self.value()?)
        } else if self.is_at_end() || self.rest().starts_with(',') {
            Condition::Exists
        } else {
            match self.word() {
                "in" => Condition::In(self.set()?),
                "notin" => Condition::NotIn(self.set()?),
                word => {
                    self.at -= word.len();
                    return Err(self.needs("=, ==, !=, in, notin, a comma or the end"));
                }
            }
        };
        Ok(Requirement { key, condition })
    }

    fn set(&mut self) -> Result<Vec<String>, SelectorError> {
        if !self.take("(") {
            return Err(self.needs("( and values"));
        }
        let mut values = Vec::new();
        loop {
            values.push(self.value()?);
            if self.take(")") {
                values.sort_unstable();
                values.dedup();
                return Ok(values);
            }
            if !self.take(",") {
                return Err(self.needs("a comma or )"));
            }
        }
    }
}

impl fmt::Display for LabelSelector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, Requirement { key, condition }) in self.0.iter().enumerate() {
            if index > 0 {
                f.write_str(",")?;
            }
            match condition {
                Condition::Is(value) => write!(f, "{key}={value}")?,
                Condition::IsNot(value) => write!(f, "{key}!={value}")?,
                Condition::In(values) => write!(f, "{key} in ({})", values.join(","))?,
                Condition::NotIn(values) => write!(f, "{key} notin ({})", values.join(","))?,
                Condition::Exists => write!(f, "{key}")?,
                Condition::Absent => write!(f, "!{key}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "selector_tests.rs"]
mod tests;
