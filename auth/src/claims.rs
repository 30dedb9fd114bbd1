//! What a token says.

use blaze_domain::{LayerName, word_enum};

use crate::LEEWAY_S;

word_enum!(
    /// What a token's owner may do, weakest first.
    Role {
        /// Reads.
        Viewer = "viewer",
        /// Reads and writes documents.
        Operator = "operator",
        /// Everything but `Sync`.
        Admin = "admin",
        /// A worker of one layer.
        Worker = "worker",
    }
);

/// The claims of a token that was accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claims {
    /// `sub`.
    pub subject: String,
    /// `roles` as they stand in the token. One that is unknown makes every request 403, so it is
    /// kept.
    pub roles: Vec<String>,
    /// `layer`: nothing outside its view is seen.
    pub layer: Option<LayerName>,
    /// `exp`, in seconds since 1970; `None` without a token (`--dev`).
    pub expires_s: Option<i64>,
    /// `jti`.
    pub token_id: Option<String>,
}

impl Claims {
    /// Whether the token has run out at `now_s` (seconds since 1970), leeway included. What was
    /// accepted once is to be asked again while it is in use: a stream may outlive its token.
    #[must_use]
    pub fn is_expired(&self, now_s: i64) -> bool {
        self.expires_s.is_some_and(|expires_s| now_s.saturating_sub(LEEWAY_S) >= expires_s)
    }
}
