//! The key of the copies, `worker.key_file`.
//!
//! Each write of a copy has a key of its own, derived by HKDF-SHA256 from the key of the file and
//! 32 random bytes. So no number of writes comes near the limit that random nonces of 96 bits would
//! have.

use std::path::Path;
use std::sync::Arc;

use aws_lc_rs::aead::{AES_256_GCM, Aad, LessSafeKey, Nonce, UnboundKey};
use aws_lc_rs::hkdf::{HKDF_SHA256, Salt};
use aws_lc_rs::hmac;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use blaze_domain::config::Document;
use blaze_runtime::state::read_small;
use zeroize::{Zeroize as _, Zeroizing};

use super::CopyError;
use crate::core::messages::Delivery;

/// Bytes of a key.
pub(super) const KEY_BYTES: usize = 32;
/// Bytes of what a derived key is made with.
pub(super) const SALT_BYTES: usize = 32;
/// Bytes that something encrypted has more.
const TAG_BYTES: usize = 16;
/// Purpose of a derived key.
const FOR_COPIES: &[u8] = b"blaze worker copy: whole";
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
        let wrong =
            |detail: String| CopyError::Key { detail: format!("{} {detail}", path.display()) };
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
        Self { master: Some(Arc::new(Master { key, id })) }
    }

    /// By what the key is known: nothing of it follows from this.
    #[must_use]
    pub fn key_id(&self) -> Option<&str> {
        self.master.as_ref().map(|master| master.id.as_str())
    }

    /// The document as it may be written: without a key the texts of secrets are left out.
    pub(super) fn writable(&self, document: &Arc<Document>) -> Arc<Document> {
        match self.master {
            Some(_) => Arc::clone(document),
            None => Delivery::Redacted.kept(Arc::clone(document)),
        }
    }

    /// Encrypts a copy, bound to its first line; without a key it stays as it is.
    ///
    /// # Errors
    /// [`CopyError::Sealing`].
    pub(super) fn encrypt(
        &self,
        salt: &[u8; SALT_BYTES],
        header: &[u8],
        body: &mut Vec<u8>,
    ) -> Result<(), CopyError> {
        let Some(master) = &self.master else { return Ok(()) };
        make_room(body, TAG_BYTES);
        master
            .derive(salt)?
            .seal_in_place_append_tag(only_nonce(), Aad::from(header), body)
            .map_err(|_| CopyError::Sealing)
    }

    /// Decrypts what [`Self::encrypt`] has encrypted under the same key.
    ///
    /// # Errors
    /// [`CopyError::Sealing`].
    pub(super) fn decrypt(
        &self,
        salt: &[u8; SALT_BYTES],
        header: &[u8],
        body: &mut Vec<u8>,
    ) -> Result<(), CopyError> {
        let master = self.master.as_ref().ok_or(CopyError::Sealing)?;
        let opened = master.derive(salt)?.open_in_place(only_nonce(), Aad::from(header), body);
        let length = opened.map_err(|_| CopyError::Sealing)?.len();
        body.truncate(length);
        Ok(())
    }
}

impl Master {
    fn derive(&self, salt: &[u8; SALT_BYTES]) -> Result<LessSafeKey, CopyError> {
        let drawn = Salt::new(HKDF_SHA256, salt).extract(&*self.key);
        let purposes = [FOR_COPIES];
        let key = drawn.expand(&purposes, &AES_256_GCM).map_err(|_| CopyError::Sealing)?;
        Ok(LessSafeKey::new(UnboundKey::from(key)))
    }
}

/// Makes room for so many more bytes: a vector that grows by itself leaves texts behind in freed
/// memory.
pub(super) fn make_room(body: &mut Vec<u8>, more: usize) {
    if body.capacity() - body.len() < more {
        let mut room = Vec::with_capacity((body.len() + more).max(body.capacity() * 2));
        room.extend_from_slice(body);
        body.zeroize();
        *body = room;
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

#[cfg(test)]
mod tests {
    use super::*;

    const CANARY: &str = "canary-5f1c";
    const SALT: [u8; SALT_BYTES] = [1; SALT_BYTES];

    fn key() -> Vault {
        Vault::with_key([7; KEY_BYTES])
    }

    #[test]
    fn another_key_salt_or_header_opens_nothing() {
        let mut sealed = CANARY.as_bytes().to_vec();
        key().encrypt(&SALT, b"header", &mut sealed).unwrap();
        assert!(!String::from_utf8_lossy(&sealed).contains(CANARY));
        let opened = |vault: Vault, salt: [u8; SALT_BYTES], header: &[u8]| {
            let mut bytes = sealed.clone();
            vault.decrypt(&salt, header, &mut bytes).ok().map(|()| bytes)
        };
        assert_eq!(opened(key(), SALT, b"header").as_deref(), Some(CANARY.as_bytes()));
        let other = Vault::with_key([8; KEY_BYTES]);
        for (vault, salt, header) in [
            (other, SALT, b"header"),
            (Vault::default(), SALT, b"header"),
            (key(), [2; SALT_BYTES], b"header"),
            (key(), SALT, b"heads!"),
        ] {
            assert_eq!(opened(vault, salt, header), None);
        }
    }

    #[test]
    fn a_key_file_holds_32_bytes_as_base64() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        let missing = Vault::load(Some(&path)).err().unwrap().to_string();
        assert!(missing.contains("key is not there"), "{missing}");
        for (content, said) in [("AAAA", "holds 3 bytes"), ("not base64!", "is not base64")] {
            std::fs::write(&path, content).unwrap();
            let error = Vault::load(Some(&path)).err().unwrap().to_string();
            assert!(error.contains(said), "{error}");
        }
        std::fs::write(&path, format!("{}\n", STANDARD.encode([7; KEY_BYTES]))).unwrap();
        assert_eq!(Vault::load(Some(&path)).unwrap().key_id(), key().key_id());
        assert_eq!(Vault::load(None).unwrap().key_id(), None);
    }
}
