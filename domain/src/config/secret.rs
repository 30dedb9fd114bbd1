//! Secrets in configurations: `{"$secret": …}` in place of a text.
//!
//! ```text
//! a user writes      {"$secret":"text"}                                      or a form that was read, to keep the text
//! the store holds    {"$secret":{"key":"e1","nonce":"…","data":"…","version":412}}
//! a user reads       {"$secret":{"redacted":true,"version":412}}             with the right: {"text":"…","version":412}
//! the hash covers    {"$secret":{"version":412}}
//! ```
//!
//! The version is the revision at which the text last changed. An object with the member `$secret`
//! is one value: it is merged and compared whole, and no other member may stand beside it.

use std::borrow::Cow;
use std::fmt;

use serde_json::{Map, Value, json};

use super::json::{append, append_index};

/// The one member of a secret.
pub const MEMBER: &str = "$secret";

/// A secret in one of its forms.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Secret<'a> {
    /// As a user writes it.
    Text(&'a str),
    /// As a user reads it.
    Redacted {
        /// Revision at which the text last changed.
        version: u64,
    },
    /// As a user with the right to do so reads it.
    Revealed {
        /// The text.
        text: &'a str,
        /// Revision at which the text last changed.
        version: u64,
    },
    /// As the store holds it.
    Stored {
        /// Id of the key that it is encrypted with.
        key: &'a str,
        /// In Base64.
        nonce: &'a str,
        /// The encrypted text, in Base64.
        data: &'a str,
        /// Revision at which the text last changed.
        version: u64,
    },
}

/// Never shows the text.
impl fmt::Debug for Secret<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let form = match self {
            Self::Text(_) => "Text",
            Self::Redacted { .. } => "Redacted",
            Self::Revealed { .. } => "Revealed",
            Self::Stored { .. } => "Stored",
        };
        write!(f, "{form}(version {})", self.version())
    }
}

impl<'a> Secret<'a> {
    /// The secret that a value is; `None` if it is none.
    ///
    /// # Errors
    /// In words that never repeat a text, if the value has the member `$secret` and is none of the
    /// forms.
    #[must_use]
    pub fn of(value: &'a Value) -> Option<Result<Self, String>> {
        let members = value.as_object()?;
        let inner = members.get(MEMBER)?;
        if members.len() > 1 {
            return Some(Err("has other members beside $secret".to_owned()));
        }
        let secret = match inner {
            Value::String(text) => Some(Self::Text(text)),
            Value::Object(inner) => Self::of_members(inner),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::Array(_) => None,
        };
        let wanted = "is no secret: write {\"$secret\":\"text\"}, or keep the stored one with \
                      {\"$secret\":{\"redacted\":true,\"version\":n}} as it was read";
        Some(secret.ok_or_else(|| wanted.to_owned()))
    }

    fn of_members(inner: &'a Map<String, Value>) -> Option<Self> {
        let text = |name: &str| inner.get(name).and_then(Value::as_str);
        let version = inner.get("version")?.as_u64()?;
        match inner.len() {
            2 if inner.get("redacted") == Some(&Value::Bool(true)) => {
                Some(Self::Redacted { version })
            }
            2 => Some(Self::Revealed { text: text("text")?, version }),
            4 => Some(Self::Stored {
                key: text("key")?,
                nonce: text("nonce")?,
                data: text("data")?,
                version,
            }),
            _ => None,
        }
    }

    /// Revision at which the text last changed; 0 where that is not known yet.
    #[must_use]
    pub fn version(&self) -> u64 {
        match self {
            Self::Text(_) => 0,
            Self::Redacted { version }
            | Self::Revealed { version, .. }
            | Self::Stored { version, .. } => *version,
        }
    }

    /// The object as it stands in a configuration.
    #[must_use]
    pub fn to_json(&self) -> Value {
        match self {
            Self::Text(text) => json!({ MEMBER: text }),
            Self::Redacted { version } => {
                json!({ MEMBER: { "redacted": true, "version": version } })
            }
            Self::Revealed { text, version } => {
                json!({ MEMBER: { "text": text, "version": version } })
            }
            Self::Stored { key, nonce, data, version } => {
                json!({ MEMBER: { "key": key, "nonce": nonce, "data": data, "version": version } })
            }
        }
    }
}

/// Whether a value is a secret, in whatever form, also a faulty one.
#[must_use]
pub fn is_secret(value: &Value) -> bool {
    value.as_object().is_some_and(|members| members.contains_key(MEMBER))
}

/// Whether there is a secret anywhere in a value.
#[must_use]
pub fn contains(value: &Value) -> bool {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => false,
        Value::Array(items) => items.iter().any(contains),
        Value::Object(members) => members.contains_key(MEMBER) || members.values().any(contains),
    }
}

/// Shows every secret of a value, in whatever form, with the JSON pointer to it.
pub fn walk(value: &Value, visit: &mut impl FnMut(&str, &Value)) {
    walk_at(value, &mut String::new(), visit);
}

fn walk_at(value: &Value, pointer: &mut String, visit: &mut impl FnMut(&str, &Value)) {
    if is_secret(value) {
        return visit(pointer, value);
    }
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
        Value::Array(items) => {
            for (index, item) in items.iter().enumerate() {
                let length = append_index(pointer, index);
                walk_at(item, pointer, visit);
                pointer.truncate(length);
            }
        }
        Value::Object(members) => {
            for (name, member) in members {
                let length = append(pointer, name);
                walk_at(member, pointer, visit);
                pointer.truncate(length);
            }
        }
    }
}

/// Puts something else in place of every secret of a value; where `change` gives `None`, the secret
/// stays.
pub fn map(value: &mut Value, change: &mut impl FnMut(&str, &Value) -> Option<Value>) {
    map_at(value, &mut String::new(), change);
}

fn map_at(
    value: &mut Value,
    pointer: &mut String,
    change: &mut impl FnMut(&str, &Value) -> Option<Value>,
) {
    if is_secret(value) {
        if let Some(other) = change(pointer, value) {
            *value = other;
        }
        return;
    }
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
        Value::Array(items) => {
            for (index, item) in items.iter_mut().enumerate() {
                let length = append_index(pointer, index);
                map_at(item, pointer, change);
                pointer.truncate(length);
            }
        }
        Value::Object(members) => {
            for (name, member) in members {
                let length = append(pointer, name);
                map_at(member, pointer, change);
                pointer.truncate(length);
            }
        }
    }
}

/// A value as users may see it: every secret redacted, a faulty one to version 0.
#[must_use]
pub fn redact(value: &Value) -> Cow<'_, Value> {
    replaced(value, |secret| {
        let version = Secret::of(secret).and_then(Result::ok).map_or(0, |secret| secret.version());
        Secret::Redacted { version }.to_json()
    })
}

/// A value as its hash covers it: of every secret the version alone. Doing it twice changes
/// nothing.
#[must_use]
pub fn for_hash(value: &Value) -> Cow<'_, Value> {
    replaced(value, |secret| {
        let version =
            secret.get(MEMBER).and_then(|inner| inner.get("version")).and_then(Value::as_u64);
        json!({ MEMBER: { "version": version.unwrap_or(0) } })
    })
}

fn replaced(value: &Value, form: impl Fn(&Value) -> Value) -> Cow<'_, Value> {
    if !contains(value) {
        return Cow::Borrowed(value);
    }
    let mut out = value.clone();
    map(&mut out, &mut |_, secret| Some(form(secret)));
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::config::arbitrary::{any_json, any_part};

    fn stored() -> Value {
        json!({ "$secret": { "key": "e1", "nonce": "bm9uY2U=", "data": "ZGF0YQ==", "version": 7 } })
    }

    #[test]
    fn the_forms_are_told_apart() {
        for (value, expected) in [
            (json!({ "$secret": "s3cret" }), Secret::Text("s3cret")),
            (json!({ "$secret": "" }), Secret::Text("")),
            (
                json!({ "$secret": { "redacted": true, "version": 3 } }),
                Secret::Redacted { version: 3 },
            ),
            (
                json!({ "$secret": { "text": "s3cret", "version": 3 } }),
                Secret::Revealed { text: "s3cret", version: 3 },
            ),
            (
                stored(),
                Secret::Stored { key: "e1", nonce: "bm9uY2U=", data: "ZGF0YQ==", version: 7 },
            ),
        ] {
            assert_eq!(Secret::of(&value), Some(Ok(expected)), "{value}");
            assert_eq!(expected.to_json(), value);
        }
        for value in [
            json!(null),
            json!("$secret"),
            json!({}),
            json!({ "secret": "x" }),
            json!([{ "$secret": "x" }]),
        ] {
            assert_eq!(Secret::of(&value), None, "{value}");
        }
    }

    #[test]
    fn other_forms_are_faulty() {
        for value in [
            json!({ "$secret": "x", "a": 1 }),
            json!({ "$secret": null }),
            json!({ "$secret": 5 }),
            json!({ "$secret": ["x"] }),
            json!({ "$secret": {} }),
            json!({ "$secret": { "redacted": true } }),
            json!({ "$secret": { "redacted": false, "version": 1 } }),
            json!({ "$secret": { "redacted": true, "version": -1 } }),
            json!({ "$secret": { "redacted": true, "version": 1.0 } }),
            json!({ "$secret": { "redacted": true, "text": "x", "version": 1 } }),
            json!({ "$secret": { "text": 5, "version": 1 } }),
            json!({ "$secret": { "text": "x" } }),
            json!({ "$secret": { "key": "e1", "nonce": "", "data": 5, "version": 1 } }),
            json!({ "$secret": { "$secret": "x" } }),
        ] {
            assert!(matches!(Secret::of(&value), Some(Err(_))), "{value}");
            assert!(is_secret(&value) && contains(&value));
            assert_eq!(*redact(&value), json!({ "$secret": { "redacted": true, "version": 0 } }));
        }
    }

    #[test]
    fn no_text_is_shown() {
        let value = json!({ "$secret": { "text": "canary", "version": 3 } });
        let text = json!({ "$secret": "canary" });
        for value in [&value, &text] {
            let secret = Secret::of(value).unwrap().unwrap();
            assert!(!format!("{secret:?}").contains("canary"));
            assert!(!redact(value).to_string().contains("canary"));
            assert!(!for_hash(value).to_string().contains("canary"));
        }
        let beside = json!({ "$secret": "canary", "a": "canary" });
        assert!(!Secret::of(&beside).unwrap().unwrap_err().contains("canary"));
    }

    #[test]
    fn secrets_are_found_with_their_place() {
        let value =
            json!({ "a/b": { "$secret": "x" }, "list": [1, { "in": stored() }], "none": {} });
        let mut found = Vec::new();
        walk(&value, &mut |pointer, secret| {
            assert!(is_secret(secret));
            assert_eq!(value.pointer(pointer), Some(secret));
            found.push(pointer.to_owned());
        });
        assert_eq!(found, ["/a~1b", "/list/1/in"]);
        let mut changed = value.clone();
        map(&mut changed, &mut |pointer, _| (pointer != "/a~1b").then(|| "text".into()));
        assert_eq!(
            changed,
            json!({ "a/b": { "$secret": "x" }, "list": [1, { "in": "text" }], "none": {} })
        );
    }

    #[test]
    fn versions_make_the_hash() {
        let value =
            json!({ "a": stored(), "b": { "$secret": "x" }, "c": { "$secret": { "version": 5 } } });
        let covered = for_hash(&value).into_owned();
        assert_eq!(
            covered,
            json!({ "a": { "$secret": { "version": 7 } }, "b": { "$secret": { "version": 0 } },
                    "c": { "$secret": { "version": 5 } } })
        );
        assert_eq!(*for_hash(&covered), covered);
    }

    proptest! {
        #[test]
        fn without_secrets_nothing_is_copied(value in any_json()) {
            prop_assert!(matches!(redact(&value), Cow::Borrowed(_)));
            prop_assert!(matches!(for_hash(&value), Cow::Borrowed(_)));
        }

        #[test]
        fn redacting_is_done_once(value in any_part()) {
            let once = redact(&value).into_owned();
            prop_assert_eq!(&*redact(&once), &once);
            prop_assert_eq!(for_hash(&once).into_owned(), for_hash(&value).into_owned());
        }
    }
}
