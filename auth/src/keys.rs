//! Keys that check and sign tokens, from the bytes of their files.

use std::fmt;

use aws_lc_rs::rsa;
use aws_lc_rs::signature::{Ed25519KeyPair, KeyPair as _, RsaKeyPair};
use jsonwebtoken::{DecodingKey, EncodingKey};
use rustls_pki_types::pem::{PemObject as _, SectionKind};
use zeroize::Zeroizing;

use crate::{Algorithm, MIN_SECRET_BYTES};

/// Bytes of a public Ed25519 key.
const ED25519_BYTES: usize = 32;

/// What is wrong with a key file, in words that follow its name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// Too few bytes to withstand guessing.
    #[error("holds {found} bytes; an HS256 key needs at least {}", MIN_SECRET_BYTES)]
    ShortSecret {
        /// Without the newline at the end.
        found: usize,
    },
    /// A PEM file may be public, and then anybody could sign.
    #[error(
        "holds PEM text, which is no HS256 key; take random bytes, or set alg to RS256 or EdDSA"
    )]
    SecretIsPem,
    /// No PEM, or another number of sections than one.
    #[error("holds no single key in PEM form ({0})")]
    Pem(String),
    /// PEM of something else.
    #[error(
        "holds a PEM section {found}; {algorithm} needs PUBLIC KEY (SPKI) or PRIVATE KEY (PKCS#8): \
         convert with `openssl pkcs8 -topk8 -nocrypt`"
    )]
    Section {
        /// What the key should be for.
        algorithm: Algorithm,
        /// The label of the section.
        found: &'static str,
    },
    /// Another kind of key, a broken one, or one that is too small.
    #[error("holds no {}", wanted(.0))]
    Unusable(Algorithm),
    /// `sign` without a private key.
    #[error("holds a public key; to sign, the private key (PKCS#8) is needed")]
    CannotSign,
}

fn wanted(algorithm: &Algorithm) -> &'static str {
    match algorithm {
        Algorithm::Hs256 => "HS256 key",
        Algorithm::Rs256 => "RSA key of 2048 to 8192 bit",
        Algorithm::EdDsa => "Ed25519 key",
    }
}

/// A key that checks signatures.
#[derive(Clone)]
pub struct VerifyKey {
    algorithm: Algorithm,
    key: DecodingKey,
}

impl VerifyKey {
    pub(crate) fn new(algorithm: Algorithm, key: DecodingKey) -> Self {
        Self { algorithm, key }
    }

    /// Its algorithm.
    #[must_use]
    pub fn algorithm(&self) -> Algorithm {
        self.algorithm
    }

    /// Whether `signature` (base64url) is that of `message`.
    pub(crate) fn verifies(&self, message: &[u8], signature: &str) -> bool {
        let algorithm = self.algorithm.of_library();
        jsonwebtoken::crypto::verify(signature, message, &self.key, algorithm).unwrap_or(false)
    }
}

impl fmt::Debug for VerifyKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "VerifyKey({})", self.algorithm)
    }
}

/// A key that signs.
#[derive(Clone)]
pub struct SignKey {
    pub(crate) algorithm: Algorithm,
    pub(crate) key: EncodingKey,
}

impl SignKey {
    /// Its algorithm.
    #[must_use]
    pub fn algorithm(&self) -> Algorithm {
        self.algorithm
    }
}

impl fmt::Debug for SignKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SignKey({})", self.algorithm)
    }
}

/// What one key file holds.
#[derive(Debug, Clone)]
pub struct Key {
    /// Checks.
    pub verify: VerifyKey,
    /// Signs; a public key does not.
    pub sign: Option<SignKey>,
}

/// Reads a key file. HS256: the file's bytes less one newline at the end. RS256, EdDSA: one PEM
/// section, SPKI or PKCS#8; with `needs_sign` PKCS#8.
///
/// # Errors
/// [`KeyError`].
pub fn read_key(algorithm: Algorithm, file: &[u8], needs_sign: bool) -> Result<Key, KeyError> {
    let key = match algorithm {
        Algorithm::Hs256 => secret(file)?,
        Algorithm::Rs256 | Algorithm::EdDsa => from_pem(algorithm, file)?,
    };
    if needs_sign && key.sign.is_none() {
        return Err(KeyError::CannotSign);
    }
    Ok(key)
}

fn secret(file: &[u8]) -> Result<Key, KeyError> {
    let bytes = file.strip_suffix(b"\n").unwrap_or(file);
    if bytes.len() < MIN_SECRET_BYTES {
        return Err(KeyError::ShortSecret { found: bytes.len() });
    }
    if bytes.starts_with(b"-----BEGIN ") {
        return Err(KeyError::SecretIsPem);
    }
    Ok(Key {
        verify: VerifyKey::new(Algorithm::Hs256, DecodingKey::from_secret(bytes)),
        sign: Some(SignKey { algorithm: Algorithm::Hs256, key: EncodingKey::from_secret(bytes) }),
    })
}

fn from_pem(algorithm: Algorithm, file: &[u8]) -> Result<Key, KeyError> {
    let (kind, der) = only_section(file)?;
    let is_private = match kind {
        SectionKind::PrivateKey => true,
        SectionKind::PublicKey => false,
        other => return Err(KeyError::Section { algorithm, found: label(other) }),
    };
    if !is_private {
        let verify = public_key(algorithm, &der)?;
        return Ok(Key { verify, sign: None });
    }
    let unusable = || KeyError::Unusable(algorithm);
    let (verify, sign) = match algorithm {
        Algorithm::Rs256 => {
            let pair = RsaKeyPair::from_pkcs8(&der).map_err(|_| unusable())?;
            let public = DecodingKey::from_rsa_der(pair.public_key().as_ref());
            // `from_rsa_pem` unwraps PKCS#8 itself.
            (public, EncodingKey::from_rsa_pem(file).map_err(|_| unusable())?)
        }
        Algorithm::EdDsa => {
            let pair = Ed25519KeyPair::from_pkcs8(&der).map_err(|_| unusable())?;
            let public = DecodingKey::from_ed_der(pair.public_key().as_ref());
            (public, EncodingKey::from_ed_der(&der))
        }
        Algorithm::Hs256 => return Err(unusable()),
    };
    Ok(Key {
        verify: VerifyKey::new(algorithm, verify),
        sign: Some(SignKey { algorithm, key: sign }),
    })
}

/// The label of a PEM section that is no key which can be used.
fn label(kind: SectionKind) -> &'static str {
    match kind {
        SectionKind::RsaPrivateKey => "RSA PRIVATE KEY",
        SectionKind::EcPrivateKey => "EC PRIVATE KEY",
        SectionKind::Certificate => "CERTIFICATE",
        SectionKind::Csr => "CERTIFICATE REQUEST",
        SectionKind::Crl => "X509 CRL",
        _ => "of another kind",
    }
}

fn only_section(file: &[u8]) -> Result<(SectionKind, Zeroizing<Vec<u8>>), KeyError> {
    let mut found = None;
    for section in <(SectionKind, Vec<u8>)>::pem_slice_iter(file) {
        // The text of the fault could hold a part of the key.
        let (kind, der) = section.map_err(|_| KeyError::Pem("a section is broken".to_owned()))?;
        if found.replace((kind, Zeroizing::new(der))).is_some() {
            return Err(KeyError::Pem("it has several sections".to_owned()));
        }
    }
    found.ok_or_else(|| KeyError::Pem("it has no section".to_owned()))
}

/// A public key from the DER of its SPKI.
pub(crate) fn public_key(algorithm: Algorithm, spki: &[u8]) -> Result<VerifyKey, KeyError> {
    let unusable = || KeyError::Unusable(algorithm);
    let key = match algorithm {
        Algorithm::Rs256 => {
            // Checks the size, which the next line does not.
            rsa::PublicEncryptingKey::from_der(spki).map_err(|_| unusable())?;
            let public = rsa::PublicKey::from_der(spki).map_err(|_| unusable())?;
            DecodingKey::from_rsa_der(public.as_ref())
        }
        Algorithm::EdDsa => DecodingKey::from_ed_der(ed25519_of_spki(spki).ok_or_else(unusable)?),
        Algorithm::Hs256 => return Err(unusable()),
    };
    Ok(VerifyKey::new(algorithm, key))
}

/// The key within an Ed25519 SPKI (RFC 8410): what stands before it is always the same.
fn ed25519_of_spki(spki: &[u8]) -> Option<&[u8]> {
    const BEFORE: &[u8] = &[0x30, 0x2a, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x03, 0x21, 0x00];
    spki.strip_prefix(BEFORE).filter(|key| key.len() == ED25519_BYTES)
}

/// A public Ed25519 key from its bytes.
pub(crate) fn ed25519(bytes: &[u8]) -> Result<VerifyKey, KeyError> {
    if bytes.len() != ED25519_BYTES {
        return Err(KeyError::Unusable(Algorithm::EdDsa));
    }
    Ok(VerifyKey::new(Algorithm::EdDsa, DecodingKey::from_ed_der(bytes)))
}
