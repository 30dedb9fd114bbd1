//! The text forms around a token: base64url, JSON objects, PEM.

use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use serde_json::{Map, Value};
use zeroize::Zeroizing;

/// A part of a token, or a number of a JWK.
pub(crate) fn from_base64url(text: &str) -> Result<Vec<u8>, String> {
    URL_SAFE_NO_PAD.decode(text).map_err(|error| format!("is not base64url: {error}"))
}

pub(crate) fn to_base64url(bytes: &[u8]) -> String {
    URL_SAFE_NO_PAD.encode(bytes)
}

/// JSON without duplicate members: two readers of one token must not see different claims.
pub(crate) fn strict_json(bytes: &[u8]) -> Result<Value, String> {
    blaze_domain::config::json::parse(bytes)
        .map_err(|error| format!("is not JSON as it must be: {error}"))
}

/// A part of a token as a JSON object.
pub(crate) fn token_part(text: &str) -> Result<Map<String, Value>, String> {
    match strict_json(&from_base64url(text)?)? {
        Value::Object(members) => Ok(members),
        _ => Err("is no JSON object".to_owned()),
    }
}

/// A text from outside as it may stand in a log: short, and without control characters.
pub(crate) fn shown(text: &str) -> String {
    const SHOWN_CHARS: usize = 64;
    let mut out: String = text.chars().take(SHOWN_CHARS).collect();
    if out.len() < text.len() {
        out.push('…');
    }
    format!("{out:?}")
}

/// One PEM section.
pub(crate) fn pem(label: &str, der: &[u8]) -> Zeroizing<String> {
    const LINE_CHARS: usize = 64;
    let body = Zeroizing::new(STANDARD.encode(der));
    // Large enough from the start: a text that grows leaves copies behind.
    let mut out = Zeroizing::new(String::with_capacity(
        body.len() + body.len() / LINE_CHARS + 2 * label.len() + 64,
    ));
    out.push_str("-----BEGIN ");
    out.push_str(label);
    out.push_str("-----\n");
    let mut rest = body.as_str();
    while !rest.is_empty() {
        let (line, after) = rest.split_at(rest.len().min(LINE_CHARS));
        out.push_str(line);
        out.push('\n');
        rest = after;
    }
    out.push_str("-----END ");
    out.push_str(label);
    out.push_str("-----\n");
    out
}
