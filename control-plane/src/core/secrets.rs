//! From secrets as users write them to secrets as they are stored.

use std::collections::{HashMap, HashSet};

use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Code, Document, FieldFault, Key, canonical, json};
use serde_json::Value;
use zeroize::Zeroizing;

use super::edited::Edited;
use crate::secrets::{Keyring, OpenError};

/// Where secrets of a document go and come from.
pub(crate) struct Vault<'a> {
    pub(crate) keyring: &'a Keyring,
    /// Of the document that is written.
    pub(crate) key: &'a Key,
    /// Its uid.
    pub(crate) uid: &'a str,
    /// The document as it is now.
    pub(crate) current: Option<&'a Document>,
    /// Uid under which encrypted secrets in what is written were encrypted: of a version that is
    /// brought back.
    pub(crate) from_uid: &'a str,
    /// Revision of the change.
    pub(crate) revision: u64,
}

/// What a part of a document is now.
#[derive(Clone, Copy)]
enum Counterpart<'c> {
    /// This.
    Is(&'c Value),
    /// It is new.
    Nothing,
    /// One of several; which one cannot be told.
    Unclear,
}

impl Counterpart<'_> {
    fn member(self, name: &str) -> Self {
        match self {
            Self::Is(value) => value.get(name).map_or(Self::Nothing, Self::Is),
            Self::Nothing | Self::Unclear => self,
        }
    }
}

impl Vault<'_> {
    /// The spec with every secret encrypted. One whose text is the same as now stays as it is.
    pub(crate) fn store(&self, spec: &mut Value) -> Result<(), Vec<FieldFault>> {
        if !secret::contains(spec) {
            return Ok(());
        }
        let mut faults = Vec::new();
        let now =
            self.current.map_or(Counterpart::Nothing, |document| Counterpart::Is(&document.spec));
        self.fill("", spec, now, &mut faults);
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    /// Walks what is written along with what is there now: members by name, items as
    /// [`counterparts`] says.
    fn fill(
        &self,
        pointer: &str,
        value: &mut Value,
        now: Counterpart<'_>,
        faults: &mut Vec<FieldFault>,
    ) {
        if secret::is_secret(value) {
            match self.one(value, now) {
                Ok(Some(stored)) => *value = stored,
                Ok(None) => {}
                Err((code, detail)) => faults.push(FieldFault {
                    pointer: format!("/spec{pointer}"),
                    code,
                    detail,
                    document: None,
                }),
            }
            return;
        }
        match value {
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
            Value::Array(items) => {
                let found = match now {
                    Counterpart::Is(Value::Array(current)) => self.counterparts(items, current),
                    Counterpart::Is(_) | Counterpart::Nothing => {
                        vec![Counterpart::Nothing; items.len()]
                    }
                    Counterpart::Unclear => vec![Counterpart::Unclear; items.len()],
                };
                for (index, (item, now)) in items.iter_mut().zip(found).enumerate() {
                    if secret::contains(item) {
                        self.fill(&format!("{pointer}/{index}"), item, now, faults);
                    }
                }
            }
            Value::Object(members) => {
                for (name, member) in members {
                    if secret::contains(member) {
                        self.fill(&json::push(pointer, name), member, now.member(name), faults);
                    }
                }
            }
        }
    }

    /// Which item of a list as it is now each item of the list as it is written stands for. An item
    /// has no name, so it is known by what it holds: a secret must not go to another item because
    /// the items before it went away.
    ///
    /// ```text
    /// equal to one item as it is shown      that one
    /// equal to several                      any, if their secrets are the same; in order, if there are as many as there
    ///                                       were; at the same place, if the list is as long as it was and none moved
    /// equal to none, so it was edited       as `Edited` tells by the versions of its secrets, and by its place
    /// otherwise                             nobody knows
    /// ```
    fn counterparts<'c>(&self, items: &[Value], current: &'c [Value]) -> Vec<Counterpart<'c>> {
        let shown = |item: &Value| canonical::to_string(&secret::redact(item));
        let mut places: HashMap<String, Vec<usize>> = HashMap::new();
        for (index, item) in current.iter().enumerate() {
            places.entry(shown(item)).or_default().push(index);
        }
        let texts: Vec<String> = items.iter().map(shown).collect();
        let mut written: HashMap<&str, usize> = HashMap::new();
        for text in &texts {
            *written.entry(text).or_default() += 1;
        }
        // Places are in order.
        let is_at = |found: &[usize], index: usize| found.binary_search(&index).is_ok();
        let is_in_place = items.len() == current.len()
            && texts
                .iter()
                .enumerate()
                .all(|(index, text)| places.get(text).is_none_or(|found| is_at(found, index)));
        // An item that is written as often as it was there is itself; in place, so is each that is
        // still there.
        let left: HashSet<usize> = match is_in_place {
            true => (0..items.len()).filter(|index| !places.contains_key(&texts[*index])).collect(),
            false => {
                let is_left = |text: &str, found: usize| {
                    written.get(text).copied().unwrap_or_default() < found
                };
                let left = places.iter().filter(|(text, found)| is_left(text, found.len()));
                left.flat_map(|(_, found)| found.iter().copied()).collect()
            }
        };
        let changed: Vec<&Value> = items
            .iter()
            .zip(&texts)
            .filter(|(_, text)| !places.contains_key(*text))
            .map(|(item, _)| item)
            .collect();
        let edited = Edited::new(current, left, &changed, is_in_place);
        let at = |index: usize| current.get(index).map_or(Counterpart::Unclear, Counterpart::Is);
        let mut met: HashMap<&str, usize> = HashMap::new();
        // To compare them is to decrypt them.
        let mut same: HashMap<&str, bool> = HashMap::new();
        let mut out = Vec::with_capacity(items.len());
        for (index, (item, text)) in items.iter().zip(&texts).enumerate() {
            let equal = places.get(text).map_or(&[][..], Vec::as_slice);
            let before = met.entry(text).or_default();
            let nth = *before;
            *before += 1;
            if !secret::contains(item) {
                out.push(Counterpart::Nothing);
                continue;
            }
            out.push(match equal {
                [] => edited.place_of(item, index).map_or(Counterpart::Unclear, at),
                [only] => at(*only),
                [first, ..]
                    if *same.entry(text).or_insert_with(|| self.same_texts(equal, current)) =>
                {
                    at(*first)
                }
                [_, ..] if written.get(text.as_str()) == Some(&equal.len()) => at(equal[nth]),
                _ if is_in_place => at(index),
                _ => Counterpart::Unclear,
            });
        }
        out
    }

    /// Whether these items hold the same secrets.
    fn same_texts(&self, indices: &[usize], current: &[Value]) -> bool {
        let uid = self.current.map_or("", |document| document.uid.as_str());
        let texts = |index: usize| {
            let mut out: Option<Vec<Zeroizing<String>>> = Some(Vec::new());
            secret::walk(current.get(index)?, &mut |_, value| {
                if let Some(texts) = &mut out {
                    match self.open(uid, value) {
                        Ok(text) => texts.push(text),
                        Err(_) => out = None,
                    }
                }
            });
            out
        };
        let Some(first) = indices.first().and_then(|index| texts(*index)) else {
            return false;
        };
        indices.iter().skip(1).all(|index| texts(*index).as_ref() == Some(&first))
    }

    /// The text of a stored secret of the document.
    fn open(&self, uid: &str, stored: &Value) -> Result<Zeroizing<String>, OpenError> {
        #[cfg(test)]
        tests::OPENED.with(|opened| opened.set(opened.get() + 1));
        self.keyring.open(self.key, uid, stored)
    }

    fn one(&self, value: &Value, now: Counterpart<'_>) -> Result<Option<Value>, (Code, String)> {
        let stored_now = match now {
            Counterpart::Is(now) => Some(now),
            Counterpart::Nothing | Counterpart::Unclear => None,
        };
        let stored_now =
            stored_now.filter(|value| matches!(Secret::of(value), Some(Ok(Secret::Stored { .. }))));
        let text = match Secret::of(value) {
            Some(Ok(Secret::Redacted { .. })) => {
                let kept = stored_now.ok_or_else(|| {
                    let detail = match now {
                        Counterpart::Unclear => {
                            "it is not clear whose stored secret this item of a list keeps, for \
                             items were changed and moved \
                             at once; write its text, or change the list in two steps"
                        }
                        Counterpart::Is(_) | Counterpart::Nothing => {
                            "there is no stored secret here to keep; write its text"
                        }
                    };
                    (Code::SecretUnknown, detail.to_owned())
                })?;
                return self.keep(kept).map(Some);
            }
            Some(Ok(Secret::Text(text) | Secret::Revealed { text, .. })) => {
                Zeroizing::new(text.to_owned())
            }
            Some(Ok(Secret::Stored { .. })) => {
                self.open(self.from_uid, value).map_err(|error| {
                    (Code::SecretUnknown, format!("the stored secret cannot be read: {error}"))
                })?
            }
            Some(Err(reason)) => return Err((Code::ValidationFailed, reason)),
            None => return Ok(None),
        };
        if let (Some(stored), Some(current)) = (stored_now, self.current)
            && let Ok(same) = self.open(&current.uid, stored)
            && *same == *text
        {
            return self.keep(stored).map(Some);
        }
        let sealed = self.keyring.seal(self.key, self.uid, &text, self.revision);
        sealed.map(Some).map_err(|error| (Code::ValidationFailed, error.to_string()))
    }

    /// A secret that is there already, under the uid that the document has from now on.
    fn keep(&self, stored: &Value) -> Result<Value, (Code, String)> {
        let current = self.current.map_or("", |document| document.uid.as_str());
        if current == self.uid {
            return Ok(stored.clone());
        }
        let unreadable = |error: String| (Code::SecretUnknown, error);
        let text = self.open(current, stored).map_err(|error| unreadable(error.to_string()))?;
        let sealed = self.keyring.seal(self.key, self.uid, &text, self.revision);
        sealed.map_err(|error| unreadable(error.to_string()))
    }
}

/// Why a secret of a document cannot be read here, if there is one such.
pub(crate) fn unreadable(keyring: &Keyring, document: &Document) -> Option<OpenError> {
    let mut found = None;
    secret::walk(&document.spec, &mut |_, value| {
        if found.is_none() {
            found = keyring.open(&document.key, &document.uid, value).err();
        }
    });
    found
}

/// A value with its secrets as `{"$secret":{"text","version"}}`. What cannot be decrypted stays
/// redacted: an empty text, written back, would take the place of the secret.
pub(crate) fn revealed(keyring: &Keyring, document: &Document, value: &Value) -> Value {
    replaced(keyring, document, value, |text, version| match text {
        Some(text) => Secret::Revealed { text, version }.to_json(),
        None => Secret::Redacted { version }.to_json(),
    })
}

fn replaced(
    keyring: &Keyring,
    document: &Document,
    value: &Value,
    form: impl Fn(Option<&str>, u64) -> Value,
) -> Value {
    let mut out = value.clone();
    secret::map(&mut out, &mut |_, found| {
        let version = match Secret::of(found) {
            Some(Ok(Secret::Stored { version, .. })) => version,
            _ => 0,
        };
        let text = keyring.open(&document.key, &document.uid, found).ok();
        Some(form(text.as_ref().map(|text| text.as_str()), version))
    });
    out
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use serde_json::json;

    use super::*;
    use crate::core::check::tests::document;

    thread_local! {
        /// Secrets that were decrypted.
        pub(super) static OPENED: Cell<usize> = const { Cell::new(0) };
    }

    fn stored(
        keyring: &Keyring,
        current: Option<&Document>,
        spec: &Value,
    ) -> Result<Value, Vec<FieldFault>> {
        let mut spec = spec.clone();
        let key: Key = "Service/s".parse().unwrap();
        let vault = Vault { keyring, key: &key, uid: "u", current, from_uid: "u", revision: 1 };
        vault.store(&mut spec).map(|()| spec)
    }

    #[test]
    fn many_items_that_look_the_same_are_compared_once() {
        let keyring = Keyring::with_keys(&[("e1", [7; 32])]).unwrap();
        let twins: Vec<Value> = (0..3000).map(|_| json!({ "pw": { "$secret": "A" } })).collect();
        let mut spec = stored(&keyring, None, &json!({ "config": { "list": twins } })).unwrap();
        let current = Document { uid: "u".to_owned(), ..document("Service/s", spec.clone()) };
        spec = secret::redact(&spec).into_owned();
        spec["config"]["list"].as_array_mut().unwrap().pop();
        OPENED.with(|opened| opened.set(0));
        let kept = stored(&keyring, Some(&current), &spec).unwrap();
        assert_eq!(kept["config"]["list"].as_array().unwrap().len(), 2999);
        assert_eq!(OPENED.with(Cell::get), 3000);
        // Nor is each that was edited compared with each.
        for user in spec["config"]["list"].as_array_mut().unwrap() {
            user["name"] = "x".into();
        }
        assert!(stored(&keyring, Some(&current), &spec).is_err(), "one went away");
    }
}
