//! Who may come in: keys, tokens, roles, and what the service checks of itself before it starts.
//!
//! ```text
//! node file ─[startup]─▶ may it start so?
//! key files, JWKS ─[authenticator, jwks: read again when they change]─▶ keys ─┐
//! token ─────────────────────────────────────────────────────────────────────┴▶ Claims ─[rights]─▶ yes or no
//! TokenStore ─(core polls)─▶ Revocations ─▶ open streams end
//! ```
//!
//! What a token is made of is in the crate `blaze-auth`, which the command line shares.

mod authenticator;
#[cfg(test)]
mod authenticator_tests;
pub mod dev;
mod jwks;
mod revocations;
pub mod startup;

pub use authenticator::{Authenticator, NamedKey};
pub use blaze_auth::{
    Algorithm, Claims, Key as TokenKey, NewToken, Realm, Right, Role, allowed, read_key, unbound,
};
pub use revocations::Revocations;
