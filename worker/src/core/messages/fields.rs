//! Members of a message that came in.

use std::fmt::Display;
use std::str::FromStr;

use blaze_domain::config::{MAX_DEPTH, json};
use serde_json::{Map, Value};

/// Longest message that is read, in bytes (64 KiB).
pub const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// The object that a message is.
///
/// # Errors
/// In words that follow "the message", never with a value of it.
pub(super) fn object(bytes: &[u8]) -> Result<Map<String, Value>, String> {
    if bytes.len() > MAX_MESSAGE_BYTES {
        return Err(format!("has {} bytes, at most {MAX_MESSAGE_BYTES} are allowed", bytes.len()));
    }
    // Where a member is given twice, the last one counts: whoever sent it gets an answer instead of
    // silence.
    match serde_json::from_slice::<Value>(bytes) {
        Ok(Value::Object(members)) => Ok(members),
        Ok(
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Array(_),
        ) => Err("is no JSON object".to_owned()),
        Err(error) => Err(format!("is no JSON: line {} column {}", error.line(), error.column())),
    }
}

/// Refuses an object that is nested deeper than any message of ours.
pub(super) fn check_depth(members: &Map<String, Value>) -> Result<(), String> {
    let deepest = members.values().map(json::depth).max().unwrap_or(0);
    if deepest < MAX_DEPTH {
        Ok(())
    } else {
        Err(format!("the message: is nested deeper than {MAX_DEPTH}"))
    }
}

/// A text; `None` if the member is absent or `null`.
///
/// # Errors
/// In words that begin with the member's name.
pub(super) fn text<'m>(
    members: &'m Map<String, Value>,
    name: &str,
    max_bytes: usize,
) -> Result<Option<&'m str>, String> {
    match members.get(name) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::String(text)) if text.len() > max_bytes => {
            Err(format!("{name}: has {} bytes, at most {max_bytes} are allowed", text.len()))
        }
        Some(Value::String(text)) if text.chars().any(char::is_control) => {
            Err(format!("{name}: holds control characters"))
        }
        Some(Value::String(text)) => Ok(Some(text)),
        Some(Value::Bool(_) | Value::Number(_) | Value::Array(_) | Value::Object(_)) => {
            Err(format!("{name}: must be a text"))
        }
    }
}

/// A text that is a value of a type, such as a name.
///
/// # Errors
/// In words that begin with the member's name.
pub(super) fn parsed<T>(members: &Map<String, Value>, name: &str) -> Result<Option<T>, String>
where
    T: FromStr<Err: Display>,
{
    let text = text(members, name, 1024)?;
    text.map(|text| text.parse().map_err(|error| format!("{name}: {error}"))).transpose()
}

/// A whole number that is not negative, also as a text: the fields of a Redis hash are texts.
///
/// # Errors
/// In words that begin with the member's name.
pub(super) fn whole(members: &Map<String, Value>, name: &str) -> Result<Option<u64>, String> {
    let value = match members.get(name) {
        None | Some(Value::Null) => return Ok(None),
        Some(Value::Number(number)) => number.as_u64(),
        Some(Value::String(text)) => text.parse().ok(),
        Some(Value::Bool(_) | Value::Array(_) | Value::Object(_)) => None,
    };
    match value {
        Some(value) => Ok(Some(value)),
        None => Err(format!("{name}: must be a whole number that is not negative")),
    }
}

/// What must be there.
///
/// # Errors
/// In words that begin with the member's name.
pub(super) fn need<T>(value: Option<T>, name: &str) -> Result<T, String> {
    value.ok_or_else(|| format!("{name}: is missing"))
}
