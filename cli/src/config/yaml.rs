//! Values as YAML that reads back as exactly the same values.
//!
//! What a general writer leaves bare may read back as something else under another version of YAML
//! (`off`, `0o17`, `1_000`). Here only plain words stay bare; every other text is quoted as in
//! JSON, or a block where it has lines.

use serde_json::Value;

/// Words that mean something else than themselves somewhere in the history of YAML, in small
/// letters.
const RESERVED: [&str; 13] = [
    "null",
    "true",
    "false",
    "yes",
    "no",
    "on",
    "off",
    "y",
    "n",
    "nan",
    "inf",
    "infinity",
    "undefined",
];

/// Longest key, in characters, that YAML takes before a bare `:` (1,024 with what surrounds it).
const MAX_SIMPLE_KEY: usize = 1_000;

/// One document; ends with a newline.
pub(crate) fn document(value: &Value) -> String {
    let mut out = String::new();
    match value {
        Value::Object(members) if !members.is_empty() => mapping(&mut out, value, 0),
        Value::Array(items) if !items.is_empty() => sequence(&mut out, value, 0),
        other => {
            out.push_str(&inline(other));
            out.push('\n');
        }
    }
    out
}

/// Several documents, each behind `---`.
pub(crate) fn documents<'a>(values: impl IntoIterator<Item = &'a Value>) -> String {
    let mut out = String::new();
    for value in values {
        out.push_str("---\n");
        out.push_str(&document(value));
    }
    out
}

fn mapping(out: &mut String, value: &Value, indent: usize) {
    let Value::Object(members) = value else {
        return;
    };
    for (index, (name, member)) in members.iter().enumerate() {
        // The first member of an entry of a list stands behind its dash.
        if index > 0 || !out.ends_with("- ") {
            pad(out, indent);
        }
        let name = text(name);
        if name.chars().count() <= MAX_SIMPLE_KEY {
            out.push_str(&name);
        } else {
            out.push_str(&format!("? {name}\n"));
            pad(out, indent);
        }
        out.push(':');
        below(out, member, indent);
    }
}

/// A value behind `name:`.
fn below(out: &mut String, value: &Value, indent: usize) {
    match value {
        Value::Object(members) if !members.is_empty() => {
            out.push('\n');
            mapping(out, value, indent + 2);
        }
        Value::Array(items) if !items.is_empty() => {
            if items.iter().all(|item| !item.is_object() && !item.is_array()) && is_short(items) {
                let items: Vec<String> = items.iter().map(inline).collect();
                out.push_str(&format!(" [{}]\n", items.join(", ")));
            } else {
                out.push('\n');
                sequence(out, value, indent + 2);
            }
        }
        Value::String(words) if is_block(words) => block(out, words, indent + 2),
        other => {
            out.push(' ');
            out.push_str(&inline(other));
            out.push('\n');
        }
    }
}

fn sequence(out: &mut String, value: &Value, indent: usize) {
    let Value::Array(items) = value else {
        return;
    };
    for (index, item) in items.iter().enumerate() {
        if index > 0 || !out.ends_with("- ") {
            pad(out, indent);
        }
        out.push_str("- ");
        match item {
            Value::Object(members) if !members.is_empty() => mapping(out, item, indent + 2),
            Value::Array(inner) if !inner.is_empty() => sequence(out, item, indent + 2),
            other => {
                out.push_str(&inline(other));
                out.push('\n');
            }
        }
    }
}

fn pad(out: &mut String, indent: usize) {
    out.extend(std::iter::repeat_n(' ', indent));
}

/// A list of scalars that fits on a line.
fn is_short(items: &[Value]) -> bool {
    items.iter().map(|item| item.to_string().len() + 2).sum::<usize>() <= 80
}

/// Scalars, and collections that are empty.
fn inline(value: &Value) -> String {
    match value {
        Value::String(words) => text(words),
        Value::Object(_) => "{}".to_owned(),
        Value::Array(_) => "[]".to_owned(),
        Value::Null | Value::Bool(_) | Value::Number(_) => value.to_string(),
    }
}

/// A text, bare if it cannot be taken for anything else.
fn text(words: &str) -> String {
    if is_plain(words) { words.to_owned() } else { quoted(words) }
}

fn is_plain(words: &str) -> bool {
    let first = |c: char| c.is_ascii_alphabetic() || matches!(c, '_' | '/' | '$');
    let rest =
        |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '/' | '$' | '.' | '-' | '@');
    words.len() <= 120
        && words.starts_with(first)
        && words.chars().all(rest)
        && !RESERVED.contains(&words.to_ascii_lowercase().as_str())
}

/// As JSON writes it; beyond that, what YAML takes for a line end or a mark is escaped.
fn quoted(words: &str) -> String {
    let mut out = String::with_capacity(words.len() + 2);
    out.push('"');
    for c in words.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            '\t' => out.push_str("\\t"),
            '\r' => out.push_str("\\r"),
            c if c.is_control()
                || matches!(c, '\u{2028}' | '\u{2029}' | '\u{feff}' | '\u{fffe}' | '\u{ffff}') =>
            {
                out.push_str(&format!("\\u{:04x}", u32::from(c)));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// Whether a text is shown as a block of lines: several lines of printable ASCII, none of them
/// special.
fn is_block(words: &str) -> bool {
    let body = words.strip_suffix('\n').unwrap_or(words);
    body.contains('\n')
        && !body.ends_with('\n')
        && !body.starts_with([' ', '\n'])
        && body.split('\n').all(|line| !line.ends_with(' '))
        && body.chars().all(|c| c == '\n' || matches!(c, ' '..='~'))
}

fn block(out: &mut String, words: &str, indent: usize) {
    let (mark, body) = match words.strip_suffix('\n') {
        Some(body) => ("|", body),
        None => ("|-", words),
    };
    out.push(' ');
    out.push_str(mark);
    out.push('\n');
    for line in body.split('\n') {
        if !line.is_empty() {
            pad(out, indent);
            out.push_str(line);
        }
        out.push('\n');
    }
}

#[cfg(test)]
mod tests {
    use blaze_runtime::config::yaml_documents;
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn back(text: &str) -> Vec<Value> {
        yaml_documents(text, 1_000).unwrap()
    }

    #[test]
    fn documents_read_like_written_by_hand() {
        let value = json!({
            "kind": "Node", "name": "robot-1", "labels": {}, "annotations": {"note": "a: b"},
            "spec": {
                "layer": "edge", "addresses": ["10.0.1.7"], "resources": {"cpus": 8},
                "config": {"log": {"level": "info"}, "off": "off",
                    "secret": {"$secret": {"redacted": true, "version": 3}},
                    "list": [{"a": 1, "b": [2, {"c": null}]}, [], "x y"],
                    "script": "one\n  two\n\nthree\n"},
            },
        });
        assert_eq!(
            document(&value),
            "kind: Node\n\
             name: robot-1\n\
             labels: {}\n\
             annotations:\n\
             \x20 note: \"a: b\"\n\
             spec:\n\
             \x20 layer: edge\n\
             \x20 addresses: [\"10.0.1.7\"]\n\
             \x20 resources:\n\
             \x20   cpus: 8\n\
             \x20 config:\n\
             \x20   log:\n\
             \x20     level: info\n\
             \x20   \"off\": \"off\"\n\
             \x20   secret:\n\
             \x20     $secret:\n\
             \x20       redacted: true\n\
             \x20       version: 3\n\
             \x20   list:\n\
             \x20     - a: 1\n\
             \x20       b:\n\
             \x20         - 2\n\
             \x20         - c: null\n\
             \x20     - []\n\
             \x20     - \"x y\"\n\
             \x20   script: |\n\
             \x20     one\n\
             \x20       two\n\
             \n\
             \x20     three\n"
        );
        assert_eq!(back(&document(&value)), [value]);
    }

    #[test]
    fn texts_that_look_like_something_else_are_quoted() {
        for words in [
            "",
            "1",
            "1e3",
            "0x1f",
            "0o17",
            "1_000",
            "~",
            "null",
            "No",
            "off",
            ".inf",
            "-",
            "---",
            "a b",
            "a: b",
            "#x",
            "12:30:45",
            "2026-11-21",
            "<<",
            "=",
            "é",
            "y",
            "'",
            "\"",
            "{",
            "\u{85}x",
            "\u{feff}",
            "a\r\nb",
            "\u{7f}",
        ] {
            assert_eq!(inline(&json!(words)), quoted(words), "{words:?}");
            assert_eq!(
                back(&document(&json!({ "a": words }))),
                [json!({ "a": words })],
                "{words:?}"
            );
        }
        for words in
            ["edge", "robot-1", "/camera/rate_hz", "ops@example.org", "v1.2", "_x", "$secret"]
        {
            assert_eq!(inline(&json!(words)), words);
        }
    }

    #[test]
    fn several_documents_are_apart() {
        let values = [json!({"a": 1}), json!({}), json!([1, {"b": 2}])];
        let text = documents(&values);
        assert_eq!(text, "---\na: 1\n---\n{}\n---\n- 1\n- b: 2\n");
        assert_eq!(back(&text), values);
    }

    #[test]
    fn long_keys_and_many_levels_read_back() {
        // Longer ones are not read.
        let long = "k".repeat(1_024);
        let value = json!({ "a": [{ long.clone(): [{ long: { "b": 1 } }], "c": 2 }] });
        assert_eq!(back(&document(&value)), [value]);
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let words = prop_oneof![
            "[ -~\n]{0,12}",
            "\\PC{0,6}",
            prop::sample::select(vec![
                "off", "---", "a\nb", "a\nb\n", "a\n\nb", " a\nb", "a \nb", "|", "- a", "? b",
                "...\nx"
            ])
            .prop_map(str::to_owned),
        ];
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            (-9_007_199_254_740_991_i64..=9_007_199_254_740_991).prop_map(Value::from),
            (-1e12..1e12_f64).prop_map(Value::from),
            words.clone().prop_map(Value::from),
        ];
        leaf.prop_recursive(5, 40, 5, move |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..5).prop_map(Value::from),
                prop::collection::vec((words.clone(), inner), 0..5)
                    .prop_map(|members| Value::Object(members.into_iter().collect())),
            ]
        })
    }

    proptest! {
        /// Whatever is written reads back the same: `export` piped into `apply` changes nothing.
        #[test]
        fn what_is_written_reads_back(value in any_value()) {
            let document = json!({ "kind": "Service", "spec": value });
            prop_assert_eq!(back(&super::document(&document)), vec![document]);
        }
    }
}
