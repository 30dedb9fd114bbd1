//! From a token to its claims, or to the reason why not.

use blaze_domain::LayerName;
use serde_json::{Map, Value};

use crate::text::{shown, token_part};
use crate::{Claims, KeySet, LEEWAY_S, MAX_SUBJECT_BYTES, MAX_TOKEN_BYTES, Realm, Role};

/// Longest `kid` and `jti`, in bytes.
const MAX_ID_BYTES: usize = 256;
/// Roles of one token, at most.
const MAX_ROLES: usize = 32;
/// Longest role, in bytes.
const MAX_ROLE_BYTES: usize = 64;

/// Why a token is not accepted: for log and audit, never for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It names a key that is not known here; it may be known after the keys were fetched again.
    #[error("the token names key {}, which is not known here", shown(.0))]
    UnknownKey(String),
    /// Anything else.
    #[error("{0}")]
    Invalid(String),
}

impl From<String> for Refusal {
    fn from(reason: String) -> Self {
        Self::Invalid(reason)
    }
}

/// Checks a token: form, key, signature, then claims. `now_s` is in seconds since 1970.
///
/// # Errors
/// The first reason to refuse it.
pub fn verify(token: &str, keys: &KeySet, realm: &Realm, now_s: i64) -> Result<Claims, Refusal> {
    if token.len() > MAX_TOKEN_BYTES {
        let found = token.len();
        return Err(format!("the token has {found} bytes, more than {MAX_TOKEN_BYTES}").into());
    }
    let parts: Vec<&str> = token.splitn(4, '.').collect();
    let [header, claims, signature] = parts[..] else {
        return Err("the token does not have three parts".to_owned().into());
    };
    let header = token_part(header).map_err(|reason| format!("the token's header {reason}"))?;
    let algorithm = text(&header, "alg")?.ok_or_else(|| "the token has no alg".to_owned())?;
    if header.contains_key("crit") {
        return Err("the token has crit, and no extension is known here".to_owned().into());
    }
    let kid = text(&header, "kid")?.map(|kid| bounded("kid", kid, MAX_ID_BYTES)).transpose()?;
    let key = keys.find(kid)?;
    if algorithm != key.algorithm().as_str() {
        let (found, wanted) = (shown(algorithm), key.algorithm());
        return Err(format!("the token says alg {found}, its key is for {wanted}").into());
    }
    let message_bytes = token.len() - signature.len() - 1;
    if !key.verifies(&token.as_bytes()[..message_bytes], signature) {
        return Err("the signature does not match".to_owned().into());
    }
    let claims = token_part(claims).map_err(|reason| format!("the token's claims {reason}"))?;
    Ok(read_claims(&claims, realm, now_s)?)
}

fn read_claims(claims: &Map<String, Value>, realm: &Realm, now_s: i64) -> Result<Claims, String> {
    match text(claims, "iss")? {
        Some(issuer) if issuer == realm.issuer => {}
        found => {
            return Err(format!(
                "iss is {}, not {:?}",
                shown(found.unwrap_or("absent")),
                realm.issuer
            ));
        }
    }
    check_audience(claims, &realm.audience)?;
    let expires_s = check_times(claims, now_s)?;
    let subject = text(claims, "sub")?.ok_or("sub is missing")?;
    let subject = bounded("sub", subject, MAX_SUBJECT_BYTES)?;
    let roles = read_roles(claims)?;
    let layer = match text(claims, "layer")? {
        Some(layer) => Some(layer.parse::<LayerName>().map_err(|error| format!("layer: {error}"))?),
        None => None,
    };
    if layer.is_none() && roles.iter().any(|role| role == Role::Worker.as_str()) {
        return Err("a token with role worker needs a layer".to_owned());
    }
    let token_id = text(claims, "jti")?.map(|id| bounded("jti", id, MAX_ID_BYTES)).transpose()?;
    Ok(Claims {
        subject: subject.to_owned(),
        roles,
        layer,
        expires_s: Some(expires_s),
        token_id: token_id.map(str::to_owned),
    })
}

fn check_audience(claims: &Map<String, Value>, wanted: &str) -> Result<(), String> {
    let fits = match claims.get("aud") {
        Some(Value::String(audience)) => audience == wanted,
        Some(Value::Array(several)) if several.iter().all(Value::is_string) => {
            several.iter().any(|audience| audience == wanted)
        }
        Some(_) => return Err("aud is neither a string nor an array of strings".to_owned()),
        None => return Err("aud is missing".to_owned()),
    };
    if fits { Ok(()) } else { Err(format!("aud is not {wanted:?}")) }
}

/// `exp`, `nbf`, `iat` against the clock; gives `exp`.
fn check_times(claims: &Map<String, Value>, now_s: i64) -> Result<i64, String> {
    let expires_s = time(claims, "exp")?.ok_or("exp is missing")?;
    if now_s.saturating_sub(LEEWAY_S) >= expires_s {
        return Err(format!("the token ran out {} s ago", now_s.saturating_sub(expires_s)));
    }
    for name in ["nbf", "iat"] {
        let from_s = time(claims, name)?;
        if from_s.is_some_and(|from_s| from_s > now_s.saturating_add(LEEWAY_S)) {
            return Err(format!("{name} is in the future"));
        }
    }
    Ok(expires_s)
}

fn read_roles(claims: &Map<String, Value>) -> Result<Vec<String>, String> {
    let Some(Value::Array(roles)) = claims.get("roles") else {
        return Err("roles is missing or no array".to_owned());
    };
    if roles.len() > MAX_ROLES {
        return Err(format!("roles has {} entries, more than {MAX_ROLES}", roles.len()));
    }
    let one = |role: &Value| match role.as_str() {
        Some(role) if role.len() <= MAX_ROLE_BYTES => Ok(role.to_owned()),
        _ => Err(format!("roles holds what is no string of at most {MAX_ROLE_BYTES} bytes")),
    };
    roles.iter().map(one).collect()
}

/// A member that must be a string if it is there.
fn text<'a>(members: &'a Map<String, Value>, name: &str) -> Result<Option<&'a str>, String> {
    match members.get(name) {
        None => Ok(None),
        Some(Value::String(text)) => Ok(Some(text)),
        Some(_) => Err(format!("{name} is no string")),
    }
}

/// A time that must be a number of seconds if it is there; a fraction is dropped.
fn time(members: &Map<String, Value>, name: &str) -> Result<Option<i64>, String> {
    let Some(value) = members.get(name) else {
        return Ok(None);
    };
    let whole = value.as_i64().or_else(|| value.as_f64().map(|seconds| seconds.floor() as i64));
    whole.map(Some).ok_or_else(|| format!("{name} is no number of seconds"))
}

/// A text that goes into logs, audit and documents.
pub(crate) fn bounded<'a>(name: &str, text: &'a str, limit: usize) -> Result<&'a str, String> {
    if text.is_empty() || text.len() > limit {
        return Err(format!("{name} has {} bytes; 1 to {limit} are allowed", text.len()));
    }
    if text.chars().any(char::is_control) {
        return Err(format!("{name} holds a control character"));
    }
    Ok(text)
}
