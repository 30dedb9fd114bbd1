//! What a token says, believed or not.

use serde_json::{Map, Value};

use crate::text::{from_base64url, token_part};

/// Header and claims of a token whose signature was not checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Inspected {
    /// How it is signed, and with which key.
    pub header: Map<String, Value>,
    /// What it claims.
    pub claims: Map<String, Value>,
}

/// Takes a token apart. Its signature is **not** checked: for people to look at.
///
/// # Errors
/// Which part is not what it should be.
pub fn inspect(token: &str) -> Result<Inspected, String> {
    let parts: Vec<&str> = token.trim().splitn(4, '.').collect();
    let [header, claims, signature] = parts[..] else {
        return Err("a token has three parts, joined by dots; this has not".to_owned());
    };
    from_base64url(signature).map_err(|reason| format!("the signature {reason}"))?;
    Ok(Inspected {
        header: token_part(header).map_err(|reason| format!("the header {reason}"))?,
        claims: token_part(claims).map_err(|reason| format!("the claims part {reason}"))?,
    })
}
