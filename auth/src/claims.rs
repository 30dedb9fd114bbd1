//! What a token says.

use blaze_domain::LayerName;

use crate::LEEWAY_S;

/// What a token's owner may do, weakest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// Reads.
    Viewer,
    /// Reads and writes documents.
    Operator,
    /// Everything but `Sync`.
    Admin,
    /// A worker of one layer.
    Worker,
}

impl Role {
    /// All roles.
    pub const ALL: &'static [Self] = &[Self::Viewer, Self::Operator, Self::Admin, Self::Worker];

    /// The word in a token.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Admin => "admin",
            Self::Worker => "worker",
        }
    }
}

impl std::str::FromStr for Role {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.iter().copied().find(|role| role.as_str() == text);
        found.ok_or_else(|| format!("{text:?} is no role; there are viewer, operator, admin, worker"))
    }
}

/// The claims of a token that was accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claims {
    /// `sub`.
    pub subject: String,
    /// `roles` as they stand in the token. One that is unknown makes every request 403, so it is kept.
    pub roles: Vec<String>,
    /// `layer`: nothing outside its view is seen.
    pub layer: Option<LayerName>,
    /// `exp`, in seconds since 1970; `None` without a token (`--dev`).
    pub expires_s: Option<i64>,
    /// `jti`.
    pub token_id: Option<String>,
}

impl Claims {
    /// Whether the token has run out at `now_s` (seconds since 1970), leeway included. What was accepted once is to be
    /// asked again while it is in use: a stream may outlive its token.
    #[must_use]
    pub fn is_expired(&self, now_s: i64) -> bool {
        self.expires_s
            .is_some_and(|expires_s| now_s.saturating_sub(LEEWAY_S) >= expires_s)
    }

    /// Whether a role is among those of the token.
    #[must_use]
    pub fn has_role(&self, role: Role) -> bool {
        self.roles.iter().any(|text| text == role.as_str())
    }
}
