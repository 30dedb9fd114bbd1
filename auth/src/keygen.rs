//! New keys, as the files that [`read_key`](crate::read_key) and the node file take.

use aws_lc_rs::encoding::{AsDer, Pkcs8V1Der, PublicKeyX509Der};
use aws_lc_rs::rand::{self, SystemRandom};
use aws_lc_rs::rsa::KeySize;
use aws_lc_rs::signature::{Ed25519KeyPair, KeyPair as _, RsaKeyPair};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use zeroize::Zeroizing;

use crate::Algorithm;
use crate::text::{pem, to_base64url};

/// Random bytes in a new HS256 key.
const SECRET_BYTES: usize = 48;
/// Bytes of a key that secrets are encrypted with (AES-256).
const ENCRYPTION_KEY_BYTES: usize = 32;

/// The files of a new key.
#[derive(Debug, Clone)]
pub struct GeneratedKey {
    /// Signs and checks; to be kept from other eyes (mode 0600).
    pub private: Zeroizing<String>,
    /// Checks only (SPKI); HS256 has none.
    pub public: Option<String>,
}

/// A new key: HS256 as one line of 64 characters, RS256 (3072 bit) and EdDSA as PEM (PKCS#8).
///
/// # Errors
/// If the system gives no random numbers.
pub fn generate_key(algorithm: Algorithm) -> Result<GeneratedKey, String> {
    let failed = |_| "the key could not be made".to_owned();
    let (private, public) = match algorithm {
        Algorithm::Hs256 => {
            let mut bytes = Zeroizing::new([0_u8; SECRET_BYTES]);
            rand::fill(&mut *bytes).map_err(failed)?;
            let text = Zeroizing::new(to_base64url(&*bytes));
            return Ok(GeneratedKey {
                private: Zeroizing::new(format!("{}\n", *text)),
                public: None,
            });
        }
        Algorithm::Rs256 => {
            let pair = RsaKeyPair::generate(KeySize::Rsa3072).map_err(failed)?;
            let private: Pkcs8V1Der<'_> = pair.as_der().map_err(failed)?;
            let public: PublicKeyX509Der<'_> = pair.public_key().as_der().map_err(failed)?;
            (pem("PRIVATE KEY", private.as_ref()), pem("PUBLIC KEY", public.as_ref()))
        }
        Algorithm::EdDsa => {
            // Version 1 is what every tool reads.
            let private = Ed25519KeyPair::generate_pkcs8v1(&SystemRandom::new()).map_err(failed)?;
            let pair = Ed25519KeyPair::from_pkcs8(private.as_ref())
                .map_err(|_| failed(aws_lc_rs::error::Unspecified))?;
            let public: PublicKeyX509Der<'_> = pair.public_key().as_der().map_err(failed)?;
            (pem("PRIVATE KEY", private.as_ref()), pem("PUBLIC KEY", public.as_ref()))
        }
    };
    Ok(GeneratedKey { private, public: Some(public.as_str().to_owned()) })
}

/// The file of a new key for `control_plane.encryption`: 32 random bytes as base64.
///
/// # Errors
/// If the system gives no random numbers.
pub fn generate_encryption_key() -> Result<Zeroizing<String>, String> {
    let mut bytes = Zeroizing::new([0_u8; ENCRYPTION_KEY_BYTES]);
    rand::fill(&mut *bytes).map_err(|_| "the key could not be made".to_owned())?;
    let text = Zeroizing::new(STANDARD.encode(bytes.as_slice()));
    Ok(Zeroizing::new(format!("{}\n", *text)))
}

/// A new `jti`: 128 random bits in hexadecimal.
///
/// # Errors
/// If the system gives no random numbers.
pub fn random_id() -> Result<String, String> {
    let mut bytes = [0_u8; 16];
    rand::fill(&mut bytes).map_err(|_| "there are no random numbers".to_owned())?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}
