use proptest::prelude::*;
use serde_json::{Value, json};

use super::{located_documents, yaml_documents};

fn read(text: &str) -> Vec<Value> {
    yaml_documents(text, 100).unwrap_or_else(|faults| panic!("{text:?}: {faults:?}"))
}

fn faults(text: &str) -> Vec<String> {
    yaml_documents(text, 100).unwrap_err().iter().map(ToString::to_string).collect()
}

#[test]
fn documents_are_split_by_three_dashes() {
    let two = [json!({ "a": 1 }), json!({ "b": [true, "off"] })];
    for text in [
        "a: 1\n---\nb: [true, off]\n",
        "---\na: 1\n---\nb: [true, off]\n",
        "--- {a: 1}\n--- {b: [true, off]}\n",
        "a: 1\n...\n---\nb: [true, off]\n...\n",
        "\u{feff}%YAML 1.2\n---\na: 1\n---\nb: [true, off]",
        "{\"a\": 1}\n---\n{\"b\": [true, \"off\"]}",
        "a: 1\r\n---\r\nb: [true, off]\r\n",
    ] {
        assert_eq!(read(text), two, "{text:?}");
    }
}

#[test]
fn empty_documents_are_left_out() {
    for text in ["", "---\n", "# nothing\n", "---\n---\n...\n", "--- null\n--- ~\n"] {
        assert_eq!(read(text), [Value::Null; 0], "{text:?}");
    }
    assert_eq!(read("---\n# first\n---\na: 1\n---\n"), [json!({ "a": 1 })]);
    assert_eq!(read("a: |\n  ---x\n  b\n"), [json!({ "a": "---x\nb\n" })]);
}

#[test]
fn documents_have_the_line_of_their_content() {
    for (text, lines) in [
        ("# nothing\n", &[][..]),
        ("a: 1\n", &[1]),
        ("---\na: 1\n--- # x\n# y\nb: 2\n", &[2, 5]),
        ("--- {a: 1}\n---\n---\nb: 1\n---\n", &[1, 4]),
        ("--- null\n---\n- a\n", &[3]),
        ("a: 1\n...\n# c\nb: 2\n...\n", &[1, 4]),
        ("%YAML 1.2\n---\na: 1\n", &[3]),
        ("a: |\n  ---\n  x\n---x: 2\n", &[1]),
    ] {
        let located = located_documents(text, 10).unwrap();
        assert_eq!(
            located.into_iter().map(|(line, _)| line).collect::<Vec<_>>(),
            lines,
            "{text:?}"
        );
    }
}

#[test]
fn faults_have_the_line_of_the_text() {
    assert_eq!(
        faults("a: 1\n---\nspec:\n  b: 1\n  b: 2\n---\nc: &x 1\nd: *x\ne: !t 2\nf: .nan\n"),
        [
            "line 5: spec.b: is given twice",
            "line 7: c: anchors (&name) are not allowed: write the value out",
            "line 8: d: aliases (*name) are not allowed: write the value out",
            "line 9: e: tags are not allowed",
            "line 10: f: is not a number",
        ]
    );
    assert!(faults("a: 1\n---\nb: [1\nc: 2\n")[0].starts_with("line 4: is not YAML: "));
    assert_eq!(faults("a: 100000000000000000000\n"), ["line 1: a: is a number too large to hold"]);
    assert_eq!(faults("list:\n- a: {b: .inf}\n"), ["line 2: list[0].a.b: is not a finite number"]);
}

#[test]
fn no_tag_is_taken() {
    for tag in ["!!str", "!!int", "!", "!own", "!<tag:yaml.org,2002:str>"] {
        for text in [format!("a: {tag} 1\n"), format!("{tag} a: 1\n"), format!("{tag} 1\n")] {
            assert!(
                faults(&text).iter().any(|fault| fault.ends_with("tags are not allowed")),
                "{text}: {:?}",
                faults(&text)
            );
        }
    }
    for text in ["a: !!seq [1]\n", "!!map {a: 1}\n", "- !!map {a: 1}\n"] {
        assert!(faults(text)[0].ends_with("tags are not allowed"), "{text}");
    }
}

#[test]
fn directives_say_nothing_but_the_version() {
    let refused = "directives other than %YAML 1.2 are not allowed";
    for (text, line) in [
        ("%YAML 1.1\n---\na: on\n", 1),
        ("%TAG !e! tag:example.org,2026:\n---\na: 1\n", 1),
        ("%TAG ! tag:yaml.org,2002:\r\n---\r\na: !str 1\r\n", 1),
        ("# first\n%TAG !e! tag:example.org,2026:\n---\na: 1\n", 2),
        ("a: 1\n...\n%YAML 1.1\n---\nb: 1\n", 3),
        ("a: 1\r...\r%YAML 1.1\r---\rb: 1\r", 3),
        ("%OTHER x\n---\na: 1\n", 1),
    ] {
        assert_eq!(faults(text)[0], format!("line {line}: {refused}"), "{text:?}");
    }
    for text in [
        "%YAML 1.2\n---\na: \"%YAML 1.1\"\n",
        "%YAML 1.2 # of 2009\n---\na: \"%YAML 1.1\"\n",
        "a: |-\n  %YAML 1.1\n",
    ] {
        assert_eq!(read(text), [json!({ "a": "%YAML 1.1" })], "{text:?}");
    }
    assert_eq!(read("--- |\n%TAG x y\n"), [json!("%TAG x y\n")]);
}

#[test]
fn documents_are_counted() {
    let many = "a: 1\n---\n".repeat(3);
    assert_eq!(yaml_documents(&many, 3).unwrap().len(), 3);
    let faults = yaml_documents(&many, 2).unwrap_err();
    assert!(faults.len() == 1 && faults[0].is_too_many_documents(), "{faults:?}");
    assert_eq!(yaml_documents("---\n---\n---\n", 0), Ok(Vec::new()));
    assert!(!yaml_documents("a: .inf", 2).unwrap_err()[0].is_too_many_documents());
}

#[test]
fn large_texts_take_time_in_proportion() {
    // Each of many values below a long key: the path must not be put together for each.
    let rows = "  - {v: 1}\n".repeat(50_000);
    let text =
        format!("{}:\n  {}:\n{}", "k".repeat(1000), "m".repeat(1000), rows.replace("  -", "   -"));
    assert_eq!(read(&text).len(), 1);
}

proptest! {
    #[test]
    fn no_text_panics(text in "[-?:,\\[\\]{}#&*!|>'\"%@. \n\ta-c0-9~]{0,60}") {
        let _ = yaml_documents(&text, 3);
    }

    #[test]
    fn every_document_reads_as_it_does_alone(numbers in prop::collection::vec(any::<i64>(), 0..6),
        text in "[a-z \"\\\\\n\u{e4}]{0,20}") {
        let trees: Vec<Value> =
            numbers.iter().map(|number| json!({ "n": number, "t": text, "l": [[], {}] })).collect();
        let joined: String = trees.iter().map(|tree| format!("---\n{tree}\n")).collect();
        prop_assert_eq!(yaml_documents(&joined, 6).unwrap(), trees);
    }
}
