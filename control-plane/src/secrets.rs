//! Secrets at rest: AES-256-GCM under keys of this machine.
//!
//! ```text
//! text ──[seal: first key, random nonce]──▶ {"$secret":{"key":"e1","nonce":"…","data":"…","version":412}} ──[open]──▶ text
//!                 ▲ bound to kind, service, name, uid: what is copied to another document does not open there
//! ```
//!
//! The first key encrypts, all decrypt. To rotate: put a new key first, `reencrypt`, take the old
//! one away (backups keep needing it). A random nonce of 96 bits allows 2^32 secrets per key.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use aws_lc_rs::aead::{AES_256_GCM, Aad, Nonce, RandomizedNonceKey};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_domain::ServiceName;
use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{Document, Key};
use blaze_domain::node_file::{EncryptionKey, EncryptionSection};
use blaze_runtime::Supervisor;
use parking_lot::Mutex;
use serde_json::Value;
use zeroize::Zeroizing;

use crate::reload::{self, Faults, read_file, watch_files};

/// Bytes of a key.
const KEY_BYTES: usize = 32;
/// Bytes that the encrypted text has more than the text: the tag.
const TAG_BYTES: usize = 16;

/// Why a text is not encrypted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// No key is configured.
    #[error(
        "the service has no key to encrypt secrets with; name one in control_plane.encryption.keys"
    )]
    NoKey,
    /// The library failed.
    #[error("the secret cannot be encrypted")]
    Failed,
}

/// Why a stored secret cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// Its key is not here.
    #[error("it is encrypted with key {0:?}, which is not among control_plane.encryption.keys")]
    UnknownKey(String),
    /// It is none, or its parts are broken.
    #[error("it has not the form of a stored secret")]
    Form,
    /// It was changed, belongs to another document, or the key of that id was replaced by another
    /// one.
    #[error(
        "it does not open with key {0:?}: it was changed, or the key is another one than that it \
         was made with"
    )]
    Refused(String),
    /// Encrypting it again failed.
    #[error("{0}")]
    Seal(#[from] SealError),
}

/// The keys. Clones share them.
#[derive(Clone)]
pub struct Keyring {
    shared: Arc<Shared>,
}

struct Shared {
    files: Vec<EncryptionKey>,
    keys: ArcSwap<Vec<NamedKey>>,
    /// Held while keys are read again, so that two who do so do not mix.
    reading: Mutex<()>,
}

#[derive(Clone)]
struct NamedKey {
    id: String,
    key: Arc<RandomizedNonceKey>,
}

impl Keyring {
    /// Reads the key files: 32 bytes as base64 each.
    ///
    /// # Errors
    /// Every fault, with its place in the node file and the file that has it.
    pub fn load(section: &EncryptionSection) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let mut keys = Vec::new();
        for (index, file) in section.keys.iter().enumerate() {
            match read_named(index, file) {
                Ok(key) => keys.push(key),
                Err(fault) => faults.push(fault),
            }
        }
        if faults.is_empty() { Ok(Self::build(section.keys.clone(), keys)) } else { Err(faults) }
    }

    /// Without keys: nothing is encrypted and nothing opens.
    #[must_use]
    pub fn empty() -> Self {
        Self::build(Vec::new(), Vec::new())
    }

    /// With these keys for ever: id and bytes, the first encrypts.
    ///
    /// # Errors
    /// If a key is refused by the library.
    pub fn with_keys(keys: &[(&str, [u8; KEY_BYTES])]) -> Result<Self, SealError> {
        let keys: Result<Vec<NamedKey>, SealError> =
            keys.iter().map(|(id, bytes)| NamedKey::new(id, bytes)).collect();
        Ok(Self::build(Vec::new(), keys?))
    }

    fn build(files: Vec<EncryptionKey>, keys: Vec<NamedKey>) -> Self {
        Self {
            shared: Arc::new(Shared {
                files,
                keys: ArcSwap::from_pointee(keys),
                reading: Mutex::new(()),
            }),
        }
    }

    /// Reads the files again when they change; one that is faulty leaves its key as it was.
    pub fn watch(&self, supervisor: &Supervisor) {
        self.watch_every(supervisor, reload::PERIOD);
    }

    fn watch_every(&self, supervisor: &Supervisor, period: Duration) {
        let files: Vec<PathBuf> = self.shared.files.iter().map(|key| key.file.clone()).collect();
        let shared = Arc::clone(&self.shared);
        watch_files(supervisor, "keys for secrets", files, period, move || shared.reload());
    }

    /// Whether a secret can be written.
    #[must_use]
    pub fn can_seal(&self) -> bool {
        !self.shared.keys.load().is_empty()
    }

    /// Encrypts a text for one document; `version` is the revision at which it changes. Gives the
    /// stored form.
    ///
    /// # Errors
    /// [`SealError`].
    pub fn seal(&self, key: &Key, uid: &str, text: &str, version: u64) -> Result<Value, SealError> {
        let keys = self.shared.keys.load();
        let first = keys.first().ok_or(SealError::NoKey)?;
        // Room for the tag from the start: bytes that grow leave a copy of the text behind.
        let mut bytes = Zeroizing::new(Vec::with_capacity(text.len() + TAG_BYTES));
        bytes.extend_from_slice(text.as_bytes());
        let bound = Aad::from(binding(key, uid));
        let nonce = first
            .key
            .seal_in_place_append_tag(bound, &mut *bytes)
            .map_err(|_| SealError::Failed)?;
        let stored = Secret::Stored {
            key: &first.id,
            nonce: &STANDARD.encode(nonce.as_ref()),
            data: &STANDARD.encode(&*bytes),
            version,
        };
        Ok(stored.to_json())
    }

    /// The text of a stored secret of one document.
    ///
    /// # Errors
    /// [`OpenError`].
    pub fn open(
        &self,
        key: &Key,
        uid: &str,
        stored: &Value,
    ) -> Result<Zeroizing<String>, OpenError> {
        let Some(Ok(Secret::Stored { key: id, nonce, data, .. })) = Secret::of(stored) else {
            return Err(OpenError::Form);
        };
        let keys = self.shared.keys.load();
        let unknown = || OpenError::UnknownKey(id.to_owned());
        let named = keys.iter().find(|key| key.id == id).ok_or_else(unknown)?;
        let nonce = STANDARD.decode(nonce).map_err(|_| OpenError::Form)?;
        let nonce = Nonce::try_assume_unique_for_key(&nonce).map_err(|_| OpenError::Form)?;
        let mut bytes = Zeroizing::new(STANDARD.decode(data).map_err(|_| OpenError::Form)?);
        let bound = Aad::from(binding(key, uid));
        let refused = || OpenError::Refused(id.to_owned());
        let text = named.key.open_in_place(nonce, bound, &mut bytes).map_err(|_| refused())?;
        let text = std::str::from_utf8(text).map_err(|_| OpenError::Form)?;
        Ok(Zeroizing::new(text.to_owned()))
    }

    /// The document with all its secrets under the first key, versions as they are; `None` if they
    /// are so already.
    ///
    /// # Errors
    /// The first secret that does not open.
    pub fn reseal(&self, document: &Document) -> Result<Option<Document>, OpenError> {
        let spec = self.resealed(document, &document.spec)?;
        let status = match &document.status {
            Some(status) => self.resealed(document, status)?,
            None => None,
        };
        if spec.is_none() && status.is_none() {
            return Ok(None);
        }
        let mut out = document.clone();
        if let Some(spec) = spec {
            out.spec = Arc::new(spec);
        }
        if status.is_some() {
            out.status = status;
        }
        Ok(Some(out))
    }

    /// As [`Keyring::reseal`] for one part of a document.
    fn resealed(&self, document: &Document, part: &Value) -> Result<Option<Value>, OpenError> {
        if !secret::contains(part) {
            return Ok(None);
        }
        let first = self.shared.keys.load().first().map(|key| key.id.clone());
        let mut failed = None;
        let mut changed = false;
        let mut out = part.clone();
        secret::map(&mut out, &mut |_, found| {
            let Some(Ok(Secret::Stored { key: id, version, .. })) = Secret::of(found) else {
                return None;
            };
            if failed.is_some() || first.as_deref() == Some(id) {
                return None;
            }
            let text = self.open(&document.key, &document.uid, found);
            let sealed = text
                .and_then(|text| Ok(self.seal(&document.key, &document.uid, &text, version)?));
            changed |= sealed.is_ok();
            sealed.map_err(|error| failed = Some(error)).ok()
        });
        match failed {
            Some(error) => Err(error),
            None => Ok(changed.then_some(out)),
        }
    }
}

/// Shows the ids alone.
impl fmt::Debug for Keyring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let keys = self.shared.keys.load();
        f.debug_list().entries(keys.iter().map(|key| &key.id)).finish()
    }
}

impl NamedKey {
    fn new(id: &str, bytes: &[u8; KEY_BYTES]) -> Result<Self, SealError> {
        let key = RandomizedNonceKey::new(&AES_256_GCM, bytes).map_err(|_| SealError::Failed)?;
        Ok(Self { id: id.to_owned(), key: Arc::new(key) })
    }
}

fn read_named(index: usize, file: &EncryptionKey) -> Result<NamedKey, String> {
    read_key(file).map_err(|fault| format!("control_plane.encryption.keys[{index}].file: {fault}"))
}

fn read_key(file: &EncryptionKey) -> Result<NamedKey, String> {
    let wrong = |detail: &str| format!("{} (key {}) {detail}", file.file.display(), file.id);
    let text = read_file(&file.file)?;
    let decoded = STANDARD.decode(text.trim_ascii()).map(Zeroizing::new);
    let decoded = decoded.map_err(|_| wrong("is not base64"))?;
    let bytes: &[u8; KEY_BYTES] = decoded.as_slice().try_into().map_err(|_| {
        let found = decoded.len();
        wrong(&format!("holds {found} bytes as base64; a key has {KEY_BYTES}"))
    })?;
    NamedKey::new(&file.id, bytes).map_err(|_| wrong("is refused"))
}

impl Shared {
    fn reload(&self) -> Faults {
        let _reading = self.reading.lock();
        let mut keys = Vec::clone(&self.keys.load());
        let mut faults = Vec::new();
        for (index, (file, held)) in self.files.iter().zip(&mut keys).enumerate() {
            match read_named(index, file) {
                Ok(key) => *held = key,
                Err(fault) => faults.push(fault),
            }
        }
        self.keys.store(Arc::new(keys));
        faults
    }
}

/// What a secret belongs to. None of the parts can hold the separator.
fn binding(key: &Key, uid: &str) -> Vec<u8> {
    let service = key.service_name().map_or("", ServiceName::as_str);
    [key.kind().as_str(), service, key.name().as_str(), uid].join("\0").into_bytes()
}

#[cfg(test)]
#[path = "secrets_tests.rs"]
mod tests;
