//! From secrets as users write them to secrets as they are stored.

use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Code, Document, FieldFault, Key};
use serde_json::Value;
use zeroize::Zeroizing;

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
    /// Uid under which encrypted secrets in what is written were encrypted: of a version that is brought back.
    pub(crate) from_uid: &'a str,
    /// Revision of the change.
    pub(crate) revision: u64,
}

impl Vault<'_> {
    /// The spec with every secret encrypted. One whose text is the same as now stays as it is.
    pub(crate) fn store(&self, spec: &mut Value) -> Result<(), Vec<FieldFault>> {
        if !secret::contains(spec) {
            return Ok(());
        }
        let mut faults = Vec::new();
        secret::map(spec, &mut |pointer, value| match self.one(pointer, value) {
            Ok(stored) => stored,
            Err((code, detail)) => {
                faults.push(FieldFault {
                    pointer: format!("/spec{pointer}"),
                    code,
                    detail,
                    document: None,
                });
                None
            }
        });
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    fn one(&self, pointer: &str, value: &Value) -> Result<Option<Value>, (Code, String)> {
        let now = self.current.and_then(|document| document.spec.pointer(pointer));
        let stored_now = now.filter(|value| matches!(Secret::of(value), Some(Ok(Secret::Stored { .. }))));
        let text = match Secret::of(value) {
            Some(Ok(Secret::Redacted { .. })) => {
                let kept = stored_now.ok_or_else(|| {
                    let detail = "there is no stored secret here to keep; write its text";
                    (Code::SecretUnknown, detail.to_owned())
                })?;
                return self.keep(kept).map(Some);
            }
            Some(Ok(Secret::Text(text) | Secret::Revealed { text, .. })) => Zeroizing::new(text.to_owned()),
            Some(Ok(Secret::Stored { .. })) => self.keyring.open(self.key, self.from_uid, value).map_err(|error| {
                (
                    Code::SecretUnknown,
                    format!("the stored secret cannot be read: {error}"),
                )
            })?,
            Some(Err(reason)) => return Err((Code::ValidationFailed, reason)),
            None => return Ok(None),
        };
        if let (Some(stored), Some(current)) = (stored_now, self.current)
            && let Ok(same) = self.keyring.open(self.key, &current.uid, stored)
            && *same == *text
        {
            return self.keep(stored).map(Some);
        }
        let sealed = self.keyring.seal(self.key, self.uid, &text, self.revision);
        sealed
            .map(Some)
            .map_err(|error| (Code::ValidationFailed, error.to_string()))
    }

    /// A secret that is there already, under the uid that the document has from now on.
    fn keep(&self, stored: &Value) -> Result<Value, (Code, String)> {
        let current = self.current.map_or("", |document| document.uid.as_str());
        if current == self.uid {
            return Ok(stored.clone());
        }
        let unreadable = |error: String| (Code::SecretUnknown, error);
        let text = self
            .keyring
            .open(self.key, current, stored)
            .map_err(|error| unreadable(error.to_string()))?;
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

/// A value with its secrets as text in place of the secret objects: what a service gets. What cannot be decrypted
/// becomes empty.
pub(crate) fn as_text(keyring: &Keyring, document: &Document, value: &Value) -> Value {
    replaced(keyring, document, value, |text, _| {
        Value::from(text.unwrap_or_default())
    })
}

/// A value with its secrets as `{"$secret":{"text","version"}}`. What cannot be decrypted stays redacted: an empty
/// text, written back, would take the place of the secret.
pub(crate) fn revealed(keyring: &Keyring, document: &Document, value: &Value) -> Value {
    replaced(keyring, document, value, |text, version| match text {
        Some(text) => Secret::Revealed { text, version }.to_json(),
        None => Secret::Redacted { version }.to_json(),
    })
}

fn replaced(keyring: &Keyring, document: &Document, value: &Value, form: impl Fn(Option<&str>, u64) -> Value) -> Value {
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
