//! From JSON to a type of the service's.

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::ConfigError;

/// Reads a value into a type.
///
/// # Errors
/// [`ConfigError::Type`].
pub(super) fn read<T: DeserializeOwned>(value: &Value) -> Result<T, ConfigError> {
    T::deserialize(value)
        .map_err(|error| ConfigError::Type { reason: without_values(&error.to_string()) })
}

/// What the library says quotes the value that does not fit, which may be a secret; what was
/// expected quotes none.
fn without_values(text: &str) -> String {
    let names_a_member = ["missing field ", "unknown field ", "duplicate field "];
    if names_a_member.iter().any(|beginning| text.starts_with(beginning)) {
        return text.to_owned();
    }
    match text.rsplit_once(", expected ") {
        Some((_, expected)) => format!("expected {expected}"),
        None => "a value is not one that the type can have".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;
    use serde_json::json;

    use super::*;

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(deny_unknown_fields)]
    struct Camera {
        rate_hz: u32,
    }

    #[test]
    fn what_does_not_fit_is_told_without_its_value() {
        assert_eq!(read::<Camera>(&json!({"rate_hz": 10})), Ok(Camera { rate_hz: 10 }));
        for (value, expected) in [
            (json!({"rate_hz": "geheim"}), "expected u32"),
            (json!({"rate_hz": -4_711}), "expected u32"),
            (json!("geheim, expected geheim"), "expected struct Camera"),
            (json!({}), "missing field `rate_hz`"),
            (json!({"rate": 1}), "unknown field `rate`"),
        ] {
            let reason = read::<Camera>(&value).unwrap_err().to_string();
            assert!(reason.contains(expected), "{reason}");
            assert!(!reason.contains("geheim") && !reason.contains("4711"), "{reason}");
        }
    }
}
