//! Secrets at rest, under `worker.key_file`.
//!
//! ```text
//! {"$secret":…} ──[seal]──▶ with a key:    {"$secret":{"key":"worker.key_file","nonce":salt,"data":…,"version":n}}
//!                           without a key: {"$secret":{"redacted":true,"version":n}}
//!               ◀─[open]──  with the key:  as it was; else redacted, and counted
//! ```
//!
//! Each secret and each file gets a key of its own, derived by HKDF-SHA256 from the key of the file and 32 random bytes.
//! So no number of writes, with however many secrets, comes near the limit that random nonces of 96 bits would have.
//! A secret is bound to kind, service, name and uid of its document, and does not open in another one.

use std::fmt;
use std::path::Path;
use std::sync::Arc;

use aws_lc_rs::aead::{AES_256_GCM, Aad, LessSafeKey, Nonce, UnboundKey};
use aws_lc_rs::hkdf::{HKDF_SHA256, Salt};
use aws_lc_rs::hmac;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_domain::ServiceName;
use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, Key};
use blaze_runtime::state::read_small;
use serde_json::Value;
use zeroize::Zeroizing;

use super::CopyError;

/// Bytes of a key.
pub(super) const KEY_BYTES: usize = 32;
/// Bytes of what a derived key is made with.
pub(super) const SALT_BYTES: usize = 32;
/// Bytes that something encrypted has more.
pub(super) const TAG_BYTES: usize = 16;
/// By which secrets that are encrypted here are known. No key of a main service has such an id: it is no name.
const OWN: &str = "worker.key_file";
/// What a derived key is for: one for this is none for that.
const FOR_SECRETS: &[u8] = b"blaze worker copy: secret";
const FOR_FILES: &[u8] = b"blaze worker copy: file";
const FOR_ID: &[u8] = b"blaze worker copy: id";

/// The key of the copies, or none. Clones share it.
#[derive(Clone, Default)]
pub struct Vault {
    master: Option<Arc<Master>>,
}

struct Master {
    key: Zeroizing<[u8; KEY_BYTES]>,
    id: String,
}

impl Vault {
    /// Reads the key: 32 bytes as base64. Without a file there is none.
    ///
    /// # Errors
    /// [`CopyError::Key`], with the path.
    pub fn load(key_file: Option<&Path>) -> Result<Self, CopyError> {
        let Some(path) = key_file else {
            return Ok(Self::default());
        };
        let wrong = |detail: String| CopyError::Key {
            detail: format!("{} {detail}", path.display()),
        };
        let found = read_small(path).map_err(|error| wrong(format!("cannot be read: {error}")))?;
        let text = Zeroizing::new(found.ok_or_else(|| wrong("is not there".to_owned()))?);
        let decoded = STANDARD.decode(text.trim_ascii()).map(Zeroizing::new);
        let decoded = decoded.map_err(|_| wrong("is not base64".to_owned()))?;
        let bytes = <[u8; KEY_BYTES]>::try_from(decoded.as_slice()).map_err(|_| {
            let found = decoded.len();
            wrong(format!("holds {found} bytes as base64; a key has {KEY_BYTES}"))
        })?;
        Ok(Self::with_key(bytes))
    }

    /// With this key.
    #[must_use]
    pub fn with_key(bytes: [u8; KEY_BYTES]) -> Self {
        let tag = hmac::sign(&hmac::Key::new(hmac::HMAC_SHA256, &bytes), FOR_ID);
        let id = tag.as_ref().iter().take(8).map(|byte| format!("{byte:02x}")).collect();
        let key = Zeroizing::new(bytes);
        Self {
            master: Some(Arc::new(Master { key, id })),
        }
    }

    /// By what the key is known: nothing of it follows from this.
    #[must_use]
    pub fn key_id(&self) -> Option<&str> {
        self.master.as_ref().map(|master| master.id.as_str())
    }

    /// The key of one file; `None` without a key.
    ///
    /// # Errors
    /// [`CopyError::Sealing`].
    pub(super) fn file_key(&self, salt: &[u8; SALT_BYTES]) -> Result<Option<LessSafeKey>, CopyError> {
        let master = self.master.as_ref();
        master.map(|master| master.derive(salt, FOR_FILES)).transpose()
    }

    /// The document as it may be written. The same one if it has no secret.
    ///
    /// # Errors
    /// [`CopyError::Sealing`].
    pub fn seal(&self, document: &Arc<Document>) -> Result<Arc<Document>, CopyError> {
        let mut failed = None;
        let sealed = with_secrets(document, &mut |secret| match self.sealed(document, secret) {
            Ok(sealed) => sealed,
            Err(error) => {
                failed = Some(error);
                // Not written: the error is what comes of it.
                None
            }
        });
        failed.map_or(Ok(sealed), Err)
    }

    fn sealed(&self, document: &Document, secret: &Value) -> Result<Option<Value>, CopyError> {
        let version = match Secret::of(secret) {
            Some(Ok(Secret::Redacted { .. })) => return Ok(None),
            // Encrypted by somebody else, it needs no more.
            Some(Ok(Secret::Stored { key, .. })) if key != OWN => return Ok(None),
            Some(Ok(other)) => other.version(),
            Some(Err(_)) | None => 0,
        };
        let Some(master) = &self.master else {
            return Ok(Some(Secret::Redacted { version }.to_json()));
        };
        let salt = new_salt()?;
        // The whole value, so that it is afterwards in the same form.
        let mut bytes = Zeroizing::new(secret.to_string().into_bytes());
        // Room for the tag from the start: bytes that grow leave a copy of the text behind.
        let mut room = Zeroizing::new(Vec::with_capacity(bytes.len() + TAG_BYTES));
        room.append(&mut bytes);
        let key = master.derive(&salt, FOR_SECRETS)?;
        key.seal_in_place_append_tag(only_nonce(), Aad::from(binding(document)), &mut *room)
            .map_err(|_| CopyError::Sealing)?;
        let stored = Secret::Stored {
            key: OWN,
            nonce: &STANDARD.encode(salt),
            data: &STANDARD.encode(&*room),
            version,
        };
        Ok(Some(stored.to_json()))
    }

    /// The document as it was before it was sealed, and how many of its secrets do not open: these are redacted.
    #[must_use]
    pub fn open(&self, document: Document) -> (Document, usize) {
        let mut lost = 0;
        let document = Arc::new(document);
        let opened = with_secrets(&document, &mut |secret| {
            let Some(Ok(Secret::Stored {
                key: OWN,
                nonce,
                data,
                version,
            })) = Secret::of(secret)
            else {
                return None;
            };
            let text = self.opened(&document, nonce, data);
            if text.is_none() {
                lost += 1;
            }
            Some(text.unwrap_or_else(|| Secret::Redacted { version }.to_json()))
        });
        drop(document);
        (Arc::unwrap_or_clone(opened), lost)
    }

    fn opened(&self, document: &Document, salt: &str, data: &str) -> Option<Value> {
        let salt: [u8; SALT_BYTES] = STANDARD.decode(salt).ok()?.try_into().ok()?;
        let key = self.master.as_ref()?.derive(&salt, FOR_SECRETS).ok()?;
        let mut bytes = Zeroizing::new(STANDARD.decode(data).ok()?);
        let bound = Aad::from(binding(document));
        let text = key.open_in_place(only_nonce(), bound, &mut bytes).ok()?;
        serde_json::from_slice(text).ok()
    }
}

/// Shows by what the key is known, not the key.
impl fmt::Debug for Vault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Vault").field(&self.key_id()).finish()
    }
}

impl Master {
    fn derive(&self, salt: &[u8; SALT_BYTES], purpose: &[u8]) -> Result<LessSafeKey, CopyError> {
        let drawn = Salt::new(HKDF_SHA256, salt).extract(&*self.key);
        let purposes = [purpose];
        let key = drawn.expand(&purposes, &AES_256_GCM).map_err(|_| CopyError::Sealing)?;
        Ok(LessSafeKey::new(UnboundKey::from(key)))
    }
}

/// Random bytes to derive a key with.
///
/// # Errors
/// [`CopyError::Sealing`] if the system has none.
pub(super) fn new_salt() -> Result<[u8; SALT_BYTES], CopyError> {
    let mut salt = [0; SALT_BYTES];
    aws_lc_rs::rand::fill(&mut salt).map_err(|_| CopyError::Sealing)?;
    Ok(salt)
}

/// A key that encrypts one thing needs no other.
fn only_nonce() -> Nonce {
    Nonce::assume_unique_for_key([0; 12])
}

/// What a secret belongs to. None of the parts but the last can hold the separator.
fn binding(document: &Document) -> Vec<u8> {
    let key: &Key = &document.key;
    let service = key.service_name().map_or("", ServiceName::as_str);
    [key.kind().as_str(), service, key.name().as_str(), &document.uid]
        .join("\0")
        .into_bytes()
}

/// The document with something else in place of its secrets; where `change` gives `None`, the secret stays.
fn with_secrets(document: &Arc<Document>, change: &mut impl FnMut(&Value) -> Option<Value>) -> Arc<Document> {
    let status_has = document.status.as_ref().is_some_and(secret::contains);
    if !secret::contains(&document.spec) && !status_has {
        return Arc::clone(document);
    }
    let mut changed = |value: &Value| {
        let mut value = value.clone();
        secret::map(&mut value, &mut |_, secret| change(secret));
        value
    };
    let mut out = (**document).clone();
    out.spec = Arc::new(changed(&document.spec));
    out.status = document.status.as_ref().map(&mut changed);
    Arc::new(out)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::copy::samples::{any_document, service, with_secret};

    const CANARY: &str = "canary-5f1c";

    fn key() -> Vault {
        Vault::with_key([7; KEY_BYTES])
    }

    proptest! {
        #[test]
        fn what_was_sealed_opens_as_it_was(document in any_document()) {
            let document = Arc::new(document);
            let sealed = key().seal(&document).unwrap();
            let (opened, lost) = key().open((*sealed).clone());
            prop_assert_eq!((opened, lost), ((*document).clone(), 0));
        }

        #[test]
        fn without_a_key_only_texts_are_lost(document in any_document()) {
            let document = Arc::new(document);
            let sealed = Vault::default().seal(&document).unwrap();
            prop_assert_eq!(&*sealed.spec, &*secret::redact(&document.spec));
            let (opened, lost) = Vault::default().open((*sealed).clone());
            prop_assert_eq!((opened, lost), ((*sealed).clone(), 0));
        }
    }

    #[test]
    fn no_text_is_written_with_or_without_a_key() {
        let document = Arc::new(with_secret("slam", 7, CANARY));
        for vault in [key(), Vault::default()] {
            let text = vault.seal(&document).unwrap().to_json().to_string();
            assert!(!text.contains(CANARY), "{text}");
            assert!(text.contains("\"version\":7"), "{text}");
        }
    }

    #[test]
    fn another_key_or_document_opens_nothing() {
        let document = Arc::new(with_secret("slam", 7, CANARY));
        let sealed = key().seal(&document).unwrap();
        let redacted = secret::redact(&document.spec).into_owned();
        for vault in [Vault::with_key([8; KEY_BYTES]), Vault::default()] {
            let (opened, lost) = vault.open((*sealed).clone());
            assert_eq!((&*opened.spec, lost), (&redacted, 2));
        }
        let elsewhere = Document {
            uid: "another".to_owned(),
            ..(*sealed).clone()
        };
        assert_eq!(key().open(elsewhere).1, 2);
        let mut broken = (*sealed).clone();
        broken.spec = Arc::new(json!({ "config": { "a": { "$secret": {
            "key": OWN, "nonce": "AAAA", "data": "!", "version": 3 } } } }));
        let (opened, lost) = key().open(broken);
        assert_eq!(lost, 1);
        assert_eq!(
            *opened.spec,
            json!({ "config": { "a": { "$secret": { "redacted": true, "version": 3 } } } })
        );
    }

    #[test]
    fn two_secrets_never_look_alike() {
        let document = Arc::new(with_secret("slam", 7, CANARY));
        assert_ne!(key().seal(&document).unwrap(), key().seal(&document).unwrap());
        let plain = Arc::new(service("slam", 7, json!({ "config": {} })));
        assert!(Arc::ptr_eq(&key().seal(&plain).unwrap(), &plain));
    }

    #[test]
    fn a_key_file_holds_32_bytes_as_base64() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let missing = Vault::load(Some(&path)).unwrap_err().to_string();
        assert!(missing.contains("key is not there"), "{missing}");
        for (content, said) in [("AAAA", "holds 3 bytes"), ("not base64!", "is not base64")] {
            std::fs::write(&path, content).unwrap();
            let error = Vault::load(Some(&path)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
        std::fs::write(&path, format!("{}\n", STANDARD.encode([7; KEY_BYTES]))).unwrap();
        assert_eq!(Vault::load(Some(&path)).unwrap().key_id(), key().key_id());
        assert_eq!(Vault::load(None).unwrap().key_id(), None);
    }
}
