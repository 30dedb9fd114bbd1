use proptest::prelude::*;
use serde_json::json;

use super::*;

fn read(text: &str) -> Parsed {
    parse(text, &Origin::File(Arc::from("f")), "")
}

fn value(text: &str) -> Value {
    let parsed = read(text);
    assert_eq!(parsed.faults, [], "{text}");
    parsed.value.unwrap()
}

fn faults(text: &str) -> Vec<String> {
    read(text).faults.iter().map(ToString::to_string).collect()
}

#[test]
fn quotes_and_tags_make_text() {
    let text = "a: 150\nb: \"150\"\nc: 'true'\nd: !!str 150\ne:\nf: off\n";
    let expected = json!({ "a": 150, "b": "150", "c": "true", "d": "150", "e": null, "f": "off" });
    assert_eq!(value(text), expected);
    assert_eq!(value(""), Value::Null);
    assert_eq!(value("# only a comment\n"), Value::Null);
}

#[test]
fn every_value_has_its_line() {
    let parsed = read("a: 1\nb:\n  c: [x,\n    y]\n  d:\n    - e: 5\n      f:\n    - 7\n");
    let line = |path: &str| parsed.places.locate(path).to_string();
    for (path, expected) in [
        ("", "f:1"),
        ("a", "f:1"),
        ("b", "f:2"),
        ("b.c", "f:3"),
        ("b.c[0]", "f:3"),
        ("b.c[1]", "f:4"),
        ("b.d", "f:5"),
        ("b.d[0]", "f:6"),
        ("b.d[0].e", "f:6"),
        ("b.d[0].f", "f:7"),
        ("b.d[1]", "f:8"),
        ("b.d[9]", "f:5"),
    ] {
        assert_eq!(line(path), expected, "{path}");
    }
}

#[test]
fn what_misleads_is_refused_with_its_line() {
    assert_eq!(faults("a: 1\nb: 2\na: 3\n"), ["f:3: a: is given twice"]);
    assert_eq!(
        faults("a: &x 1\nb: *x\nc: !thing 4\nd: .inf\n"),
        [
            "f:1: a: anchors (&name) are not allowed: write the value out",
            "f:2: b: aliases (*name) are not allowed: write the value out",
            "f:3: c: tags other than !!str are not allowed",
            "f:4: d: is not a finite number",
        ]
    );
    assert_eq!(faults("!!int 1: a\n!!str b: 1\n"), ["f:1: tags other than !!str are not allowed"]);
    assert_eq!(
        faults("%YAML 1.1\n---\na: off\n"),
        ["f:1: directives other than %YAML 1.2 are not allowed"]
    );
    assert_eq!(faults("a: 1\n---\nb: 2\n"), ["f:2: holds a second document; one is allowed"]);
    assert_eq!(faults("a:\n  ? [x]\n  : 1\n"), ["f:2: a: a key must be text"]);
    assert!(
        faults("a: 1\nb: [1, 2\nc: 3\n")[0].starts_with("f:3: is not YAML: "),
        "{:?}",
        faults("b: [1")
    );
    assert_eq!(value("a: 1\nb: {}\n"), json!({ "a": 1, "b": {} }));
}

#[test]
fn a_repeated_key_does_not_replace_the_first() {
    let parsed = read("a: { x: 1 }\na: { x: 2 }\n");
    assert_eq!(parsed.value, Some(json!({ "a": { "x": 1 } })));
    assert_eq!(parsed.places.locate("a.x").to_string(), "f:1");
}

#[test]
fn keys_are_bounded() {
    let key = |length: usize| format!("{}: 1\n", "k".repeat(length));
    assert_eq!(faults(&key(MAX_KEY_BYTES - 2)), [""; 0]);
    let long = format!("? {}\n: 1\n", "k".repeat(MAX_KEY_BYTES + 1));
    assert_eq!(faults(&long), ["f:1: has a key of 1025 bytes, at most 1024 are allowed"]);
}

#[test]
fn depth_is_bounded() {
    let deep = |n: usize| format!("{}1{}", "[".repeat(n), "]".repeat(n));
    assert!(read(&deep(MAX_DEPTH)).faults.is_empty());
    assert_eq!(read(&deep(MAX_DEPTH + 1)).faults.len(), 1);
    assert_eq!(read(&"[".repeat(1 << 20)).faults.len(), 1);
    assert!(!read(&"? ".repeat(1 << 19)).faults.is_empty());
    assert!(!read(&"- ".repeat(1 << 19)).faults.is_empty());
    assert!(!read(&"&a ".repeat(1 << 18)).faults.is_empty());
}

proptest! {
    #[test]
    fn no_text_panics(text in "[-?:,\\[\\]{}#&*!|>'\"%@` \n\ta-c0-9.~]{0,60}") {
        let _ = read(&text);
    }

    #[test]
    fn no_characters_panic(text in any::<String>()) {
        let _ = read(&text);
    }

    #[test]
    fn json_is_yaml(numbers in prop::collection::vec(any::<i64>(), 0..5),
        text in "[a-z \"\\\\\n\u{e4}]{0,20}") {
        let tree = json!({
            "numbers": numbers,
            "text": text,
            "inner": { "list": [[], {}, null, true] },
        });
        prop_assert_eq!(value(&serde_json::to_string_pretty(&tree).unwrap()), tree);
    }
}
