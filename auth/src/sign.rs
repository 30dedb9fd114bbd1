//! From what a token is to say to the token.

use blaze_domain::LayerName;
use jsonwebtoken::Header;
use serde_json::{Map, Value};

use crate::verify::bounded;
use crate::{Algorithm, MAX_SUBJECT_BYTES, MAX_TOKEN_BYTES, Realm, Role, SignKey, read_key};

/// What a new token says, beside its realm.
#[derive(Debug, Clone, Copy)]
pub struct NewToken<'a> {
    /// `sub`.
    pub subject: &'a str,
    /// `roles`.
    pub roles: &'a [String],
    /// `layer`.
    pub layer: Option<&'a str>,
    /// `iat`, in seconds since 1970.
    pub issued_s: i64,
    /// `exp`, in seconds since 1970.
    pub expires_s: i64,
    /// `jti`.
    pub id: &'a str,
}

impl NewToken<'_> {
    /// Whether a token that says this would be of use.
    ///
    /// # Errors
    /// The first member that is wrong, and how; fit for who asked for the token.
    pub fn check(&self) -> Result<(), String> {
        bounded("subject", self.subject, MAX_SUBJECT_BYTES)?;
        if self.roles.is_empty() {
            return Err(
                "roles is empty; name at least one of viewer, operator, admin, worker".to_owned()
            );
        }
        for (index, role) in self.roles.iter().enumerate() {
            let role: Role = role.parse().map_err(|error| format!("role {error}"))?;
            if self.roles[..index].iter().any(|before| before == role.as_str()) {
                return Err(format!("role {} is named twice", role.as_str()));
            }
            if role == Role::Worker && self.layer.is_none() {
                return Err("role worker needs a layer".to_owned());
            }
        }
        if let Some(layer) = self.layer {
            layer.parse::<LayerName>().map_err(|error| format!("layer: {error}"))?;
        }
        if self.expires_s <= self.issued_s {
            return Err("the token would have run out already".to_owned());
        }
        Ok(())
    }
}

/// Signs a token; `kid` is the id under which who checks it knows the key.
///
/// # Errors
/// As [`NewToken::check`], or that the key cannot sign.
pub fn sign(
    realm: &Realm,
    kid: Option<&str>,
    key: &SignKey,
    token: &NewToken<'_>,
) -> Result<String, String> {
    token.check()?;
    let mut header = Header::new(key.algorithm.of_library());
    header.kid = kid.map(str::to_owned);
    let mut claims = Map::new();
    let mut put = |name: &str, value: Value| {
        claims.insert(name.to_owned(), value);
    };
    put("iss", realm.issuer.as_str().into());
    put("aud", realm.audience.as_str().into());
    put("sub", token.subject.into());
    put("roles", token.roles.into());
    if let Some(layer) = token.layer {
        put("layer", layer.into());
    }
    put("iat", token.issued_s.into());
    put("exp", token.expires_s.into());
    put("jti", token.id.into());
    let text = jsonwebtoken::encode(&header, &Value::Object(claims), &key.key)
        .map_err(|error| format!("the key does not sign: {error}"))?;
    if text.len() > MAX_TOKEN_BYTES {
        return Err(format!(
            "the token would have {} bytes, more than {MAX_TOKEN_BYTES}",
            text.len()
        ));
    }
    Ok(text)
}

/// Signs a token with the bytes of a key file, for who has the file at hand and needs no server.
///
/// # Errors
/// What is wrong with the key file (its name is to stand before) or with the token.
pub fn sign_locally(
    realm: &Realm,
    key_file: &[u8],
    algorithm: Algorithm,
    kid: Option<&str>,
    token: &NewToken<'_>,
) -> Result<String, String> {
    let key =
        read_key(algorithm, key_file, true).map_err(|error| format!("the key file {error}"))?;
    let key = key.sign.ok_or("the key file cannot sign")?;
    sign(realm, kid, &key, token)
}
