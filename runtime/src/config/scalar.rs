//! Plain scalars of YAML 1.2.

use serde_json::{Number, Value};

/// The value of a plain scalar by the core schema of YAML 1.2.
pub(super) fn core_schema(text: &str) -> Result<Value, String> {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Ok(Value::Null),
        "true" | "True" | "TRUE" => return Ok(Value::Bool(true)),
        "false" | "False" | "FALSE" => return Ok(Value::Bool(false)),
        ".nan" | ".NaN" | ".NAN" => return Err("is not a number".to_owned()),
        _ => {}
    }
    let unsigned = text.strip_prefix(['-', '+']).unwrap_or(text);
    if matches!(unsigned, ".inf" | ".Inf" | ".INF") {
        return Err("is not a finite number".to_owned());
    }
    if let Some(radix) = radix_number(text) {
        return radix;
    }
    if is_decimal(unsigned) {
        return decimal(text);
    }
    Ok(Value::String(text.to_owned()))
}

/// `0o17` and `0xff`.
fn radix_number(text: &str) -> Option<Result<Value, String>> {
    let (digits, radix) = match (text.strip_prefix("0o"), text.strip_prefix("0x")) {
        (Some(digits), _) => (digits, 8),
        (_, Some(digits)) => (digits, 16),
        _ => return None,
    };
    if digits.is_empty() || !digits.chars().all(|c| c.is_digit(radix)) {
        return None;
    }
    Some(
        u64::from_str_radix(digits, radix)
            .map(Value::from)
            .map_err(|_| "is a number too large to hold".to_owned()),
    )
}

/// `[0-9]+ | (\.[0-9]+ | [0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?`, without the sign.
fn is_decimal(text: &str) -> bool {
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    let (mantissa, exponent) = match text.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => {
            (mantissa, Some(exponent.strip_prefix(['-', '+']).unwrap_or(exponent)))
        }
        None => (text, None),
    };
    let (before, after) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    digits(before)
        && digits(after)
        && !(before.is_empty() && after.is_empty())
        && exponent.is_none_or(|exponent| !exponent.is_empty() && digits(exponent))
}

fn decimal(text: &str) -> Result<Value, String> {
    let plain = text.strip_prefix('+').unwrap_or(text);
    if let Ok(value) = plain.parse::<i64>() {
        return Ok(value.into());
    }
    if let Ok(value) = plain.parse::<u64>() {
        return Ok(value.into());
    }
    // An integer that fits neither must not become a float, which would be another number.
    let is_integer = plain.trim_start_matches('-').bytes().all(|byte| byte.is_ascii_digit());
    let number = plain.parse::<f64>().ok().filter(|_| !is_integer).and_then(Number::from_f64);
    number.map(Value::Number).ok_or_else(|| "is a number too large to hold".to_owned())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn scalars_follow_the_core_schema() {
        for (text, expected) in [
            ("150", json!(150)),
            ("-7", json!(-7)),
            ("+7", json!(7)),
            ("18446744073709551615", json!(u64::MAX)),
            ("1.5", json!(1.5)),
            (".5", json!(0.5)),
            ("1.", json!(1.0)),
            ("1e3", json!(1000.0)),
            ("0x1F", json!(31)),
            ("0o17", json!(15)),
            ("017", json!(17)),
            ("off", json!("off")),
            ("yes", json!("yes")),
            ("True", json!(true)),
            ("~", json!(null)),
            ("", json!(null)),
            ("1_000", json!("1_000")),
            ("1.2.3", json!("1.2.3")),
            (".", json!(".")),
            ("-", json!("-")),
            ("e3", json!("e3")),
            ("1e", json!("1e")),
            ("0x", json!("0x")),
            ("10.0.1.1", json!("10.0.1.1")),
        ] {
            assert_eq!(core_schema(text), Ok(expected), "{text}");
        }
        for text in [
            ".inf",
            "-.Inf",
            ".nan",
            "1e999",
            "0xfffffffffffffffff",
            "18446744073709551616",
            "-9223372036854775809",
        ] {
            assert!(core_schema(text).is_err(), "{text}");
        }
    }
}
