//! Small texts: durations, ages, what may be printed on a terminal, and one line of values.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use blaze_domain::config::Timestamp;
use serde::Serialize;
use serde_json::Value;

use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Longest value in a table or a listing of differences, in characters.
const MAX_SHOWN: usize = 160;

/// Milliseconds since 1970.
pub(crate) fn now_ms() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}

/// A duration such as `500ms`, `30s`, `5m`, `24h`, `7d`; a bare number counts seconds. At most 400
/// days.
pub(crate) fn parse_duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let scale = match unit {
        "ms" => 0.001,
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3_600.0,
        "d" => 86_400.0,
        _ => return Err(format!("unit {unit:?} is not one of ms, s, m, h, d")),
    };
    let value: f64 = number
        .parse()
        .map_err(|_| format!("{text:?} is no duration; one looks like 30s, 5m or 24h"))?;
    match Duration::try_from_secs_f64(value * scale) {
        Ok(duration) if duration <= Duration::from_secs(400 * 86_400) => Ok(duration),
        _ => Err("at most 400d are allowed".to_owned()),
    }
}

/// A duration with its largest unit, for people: `12s`, `5m`, `3h`, `9d`.
pub(crate) fn short_duration(seconds: i64) -> String {
    match seconds {
        i64::MIN..60 => format!("{}s", seconds.max(0)),
        60..3_600 => format!("{}m", seconds / 60),
        3_600..86_400 => format!("{}h", seconds / 3_600),
        86_400.. => format!("{}d", seconds / 86_400),
    }
}

/// How long ago a time of the server was; a dash where there is none.
pub(crate) fn age(time: Option<&Value>, now_ms: i64) -> String {
    let then = time.and_then(Value::as_str).and_then(|text| text.parse::<Timestamp>().ok());
    then.map_or_else(|| "-".to_owned(), |then| short_duration((now_ms - then.as_millis()) / 1_000))
}

/// A text of the server without what could play tricks on a terminal.
pub(crate) fn printable(text: &str) -> String {
    let harmless = |c: char| if c.is_control() { '\u{fffd}' } else { c };
    text.chars().map(harmless).collect()
}

/// A text of several lines of the server: as [`printable`], but with its lines.
pub(crate) fn printable_lines(text: &str) -> String {
    text.lines().map(printable).collect::<Vec<_>>().join("\n")
}

/// A member that is text, made printable; empty where there is none.
pub(crate) fn member(value: &Value, name: &str) -> String {
    value.get(name).and_then(Value::as_str).map(printable).unwrap_or_default()
}

/// The entries of a member that is a list; none where there is none.
pub(crate) fn list<'v>(value: &'v Value, name: &str) -> &'v [Value] {
    value.get(name).and_then(Value::as_array).map_or(&[][..], Vec::as_slice)
}

/// A member that is a whole number; 0 where there is none.
pub(crate) fn whole(value: &Value, name: &str) -> u64 {
    value.get(name).and_then(Value::as_u64).unwrap_or(0)
}

/// Whether a member is `true`.
pub(crate) fn flag(value: &Value, name: &str) -> bool {
    value.get(name).and_then(Value::as_bool).unwrap_or(false)
}

/// Texts joined, or a dash where there are none.
pub(crate) fn joined(texts: &[String], separator: &str) -> String {
    match texts {
        [] => "-".to_owned(),
        texts => texts.join(separator),
    }
}

/// A member as one cell: texts as they are, `null` and what is absent as a dash, the rest as JSON.
pub(crate) fn cell(value: Option<&Value>) -> String {
    match value {
        None | Some(Value::Null) => "-".to_owned(),
        Some(Value::String(text)) if text.is_empty() => "-".to_owned(),
        Some(Value::String(text)) => shortened(&printable(text)),
        Some(Value::Array(items))
            if items.iter().all(|item| !item.is_array() && !item.is_object()) =>
        {
            let items: Vec<String> = items.iter().map(|item| cell(Some(item))).collect();
            shortened(&joined(&items, ","))
        }
        Some(other) => compact(other),
    }
}

/// A value as JSON in one line, shortened where it is long.
pub(crate) fn compact(value: &Value) -> String {
    shortened(&printable(&value.to_string()))
}

fn shortened(text: &str) -> String {
    match text.char_indices().nth(MAX_SHOWN) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

/// `1 document`, `2 documents`.
pub(crate) fn count(number: usize, one: &str) -> String {
    if number == 1 { format!("1 {one}") } else { format!("{number} {one}s") }
}

/// Tells people something on stderr. With JSON or YAML nothing but failures stands there.
pub(crate) fn note(format: Format, text: &str) {
    if format == Format::Table {
        eprintln!("blaze: {text}");
    }
}

/// Prints a value: as JSON or YAML, or what `table` makes of it for people.
pub(crate) fn print(
    value: &Value,
    format: Format,
    table: impl FnOnce(&Value) -> String,
) -> Result<Exit, CliError> {
    output::print(&match format {
        Format::Table => table(value),
        Format::Json => json_pretty(value)?,
        Format::Yaml => yaml::document(value),
    })?;
    Ok(Exit::Done)
}

/// JSON on several lines.
pub(crate) fn json_pretty(value: &impl Serialize) -> Result<String, CliError> {
    serde_json::to_string_pretty(value).map_err(|error| CliError::Failed(error.to_string()))
}

/// JSON on one line.
pub(crate) fn json_line(value: &Value) -> Result<String, CliError> {
    serde_json::to_string(value).map_err(|error| CliError::Failed(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn durations_have_units() {
        for (text, ms) in [
            ("500ms", 500),
            ("30s", 30_000),
            ("30", 30_000),
            ("1.5m", 90_000),
            ("24h", 86_400_000),
            ("7d", 604_800_000),
        ] {
            assert_eq!(parse_duration(text).unwrap(), Duration::from_millis(ms), "{text}");
        }
        for bad in ["", "s", "-5s", "5 s", "1y", "401d", "1e9", "nan", "..s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn ages_are_short() {
        let at = |text: &str| age(Some(&json!(text)), 1_795_244_472_345);
        assert_eq!(at("2026-11-21T07:01:12.345Z"), "0s");
        assert_eq!(at("2026-11-21T07:00:42.345Z"), "30s");
        assert_eq!(at("2026-11-21T06:01:12.345Z"), "1h");
        assert_eq!(at("2026-11-01T07:01:12.345Z"), "20d");
        // A clock that is behind the server's.
        assert_eq!(at("2026-11-21T08:01:12.345Z"), "0s");
        assert_eq!(at("yesterday"), "-");
        assert_eq!(age(None, 0), "-");
    }

    #[test]
    fn nothing_plays_tricks_on_the_terminal() {
        assert_eq!(printable("a\u{1b}[31mb\n"), "a\u{fffd}[31mb\u{fffd}");
        assert_eq!(printable_lines("a\nb\u{7}"), "a\nb\u{fffd}");
        assert_eq!(cell(Some(&json!("\u{1b}x"))), "\u{fffd}x");
    }

    #[test]
    fn cells_are_one_line() {
        assert_eq!(cell(None), "-");
        assert_eq!(cell(Some(&json!(["a", "b"]))), "a,b");
        assert_eq!(cell(Some(&json!([]))), "-");
        assert_eq!(cell(Some(&json!({"a": 1}))), "{\"a\":1}");
        let long = "ä".repeat(500);
        assert_eq!(cell(Some(&json!(long))).chars().count(), MAX_SHOWN + 1);
    }
}
