//! How a token is signed.

use blaze_domain::word_enum;

word_enum!(
    /// Signature of a token. The algorithm belongs to the key: what a token says of itself only has
    /// to agree.
    Algorithm {
        /// HMAC with SHA-256: who can check a token can also make one.
        Hs256 = "HS256",
        /// RSA, PKCS #1 v1.5, with SHA-256.
        Rs256 = "RS256",
        /// Ed25519.
        EdDsa = "EdDSA",
    }
);

impl Algorithm {
    pub(crate) fn of_library(self) -> jsonwebtoken::Algorithm {
        match self {
            Self::Hs256 => jsonwebtoken::Algorithm::HS256,
            Self::Rs256 => jsonwebtoken::Algorithm::RS256,
            Self::EdDsa => jsonwebtoken::Algorithm::EdDSA,
        }
    }
}
