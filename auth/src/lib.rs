//! Tokens of the configuration service: JWTs that are signed, checked, and turned into rights.
//! Plain functions over bytes; files, network and clocks belong to the caller.
//!
//! ```text
//! key files, JWKS ─[read_key, read_jwks]─▶ KeySet ─┐
//! token ───────────────────────────────────────────┴[verify]─▶ Claims ─[allowed]─▶ yes, or why not
//! subject, roles, … + SignKey ─[sign]─▶ token
//! ```
//!
//! The server and the command line share it: a token that `blaze token create --key-file` makes is
//! one that the server takes.

mod algorithm;
mod claims;
mod inspect;
mod jwks;
mod keygen;
mod keys;
mod rights;
mod set;
mod sign;
#[cfg(test)]
mod tests;
mod text;
mod verify;

pub use algorithm::Algorithm;
pub use claims::{Claims, Role};
pub use inspect::{Inspected, inspect};
pub use jwks::{Jwks, read_jwks};
pub use keygen::{GeneratedKey, generate_encryption_key, generate_key, random_id};
pub use keys::{Key, KeyError, SignKey, VerifyKey, read_key};
pub use rights::{Right, allowed, unbound};
pub use set::KeySet;
pub use sign::{NewToken, sign, sign_locally};
pub use verify::{Refusal, verify};

/// Largest token, in bytes.
pub const MAX_TOKEN_BYTES: usize = 8 * 1024;
/// How far the clocks of issuer and server may differ, in seconds.
pub const LEEWAY_S: i64 = 30;
/// Smallest HS256 key, in bytes.
pub const MIN_SECRET_BYTES: usize = 32;
/// Longest subject, in bytes.
pub const MAX_SUBJECT_BYTES: usize = 256;

/// Who issues tokens, and for whom: both must stand in a token exactly so.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Realm {
    /// `iss`.
    pub issuer: String,
    /// `aud`.
    pub audience: String,
}

impl Default for Realm {
    fn default() -> Self {
        Self { issuer: "blaze".to_owned(), audience: "blaze-config".to_owned() }
    }
}
