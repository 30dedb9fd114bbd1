use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::config::arbitrary::any_json;

fn fault(text: &str) -> String {
    parse(text.as_bytes()).unwrap_err().to_string()
}

#[test]
fn what_is_json_is_read() {
    for (text, expected) in [
        ("null", json!(null)),
        (" [1, -2, 0.5, true, \"\u{e4}\\u0000\"] ", json!([1, -2, 0.5, true, "\u{e4}\u{0}"])),
        ("{\"b\":{},\"a\":[]}", json!({ "b": {}, "a": [] })),
        ("9007199254740991", json!(9_007_199_254_740_991_i64)),
        ("-9007199254740991", json!(-9_007_199_254_740_991_i64)),
        ("9007199254740991.0", json!(9_007_199_254_740_991.0)),
        ("[1e15, \"100000000000000000000\"]", json!([1e15, "100000000000000000000"])),
        (
            "{\"$serde_json::private::RawValue\":\"1\"}",
            json!({ "$serde_json::private::RawValue": "1" }),
        ),
    ] {
        assert_eq!(parse(text.as_bytes()), Ok(expected), "{text}");
    }
}

#[test]
fn the_order_of_members_stays() {
    let value = parse(b"{\"z\":1,\"a\":2,\"m\":3}").unwrap();
    assert_eq!(value.to_string(), "{\"z\":1,\"a\":2,\"m\":3}");
}

#[test]
fn faults_have_line_column_and_pointer() {
    assert_eq!(
        fault("{\n \"a\": {\"b\": 1,\n  \"b\": 2}}"),
        "line 3 column 5: /a/b: is given twice"
    );
    let deep = parse(b"{\"a\":[{\"b/c\":9007199254740992}]}").unwrap_err();
    assert_eq!(deep.pointer, "/a/0/b~1c");
    assert_eq!(deep.line, 1);
    assert!(deep.detail.starts_with("is an integer outside ±9007199254740991"), "{deep}");
    assert_eq!(parse(b"[1,2]]").unwrap_err().detail, "trailing characters");
    assert_eq!(parse(b"{\"a\":[1,}").unwrap_err().pointer, "/a/1");
    assert_eq!(parse(b"").unwrap_err().detail, "EOF while parsing a value");
}

#[test]
fn integers_that_some_readers_round_are_refused() {
    for number in [
        "9007199254740992",
        "-9007199254740992",
        "18446744073709551615",
        "18446744073709551616",
        "-9223372036854775809",
        "100000000000000000000",
        "-100000000000000000000000000",
        "9007199254740992.0",
        "-1e16",
        "1E300",
    ] {
        let fault = parse(format!("{{\"x\":[0,{number}]}}").as_bytes()).unwrap_err();
        assert_eq!(fault.pointer, "/x/1", "{number}");
        assert!(fault.detail.contains("integer outside"), "{number}: {fault}");
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused() {
    for number in ["1e400", "-1e400", "1e999999999999", &"9".repeat(400)] {
        assert!(parse(number.as_bytes()).is_err(), "{number}");
    }
    assert_eq!(parse(b"1e-400"), Ok(json!(0.0)));
    assert!(parse(b"1234567890123.5").unwrap().is_f64());
}

#[test]
fn what_is_no_json_is_refused() {
    for text in [
        &b"\xff"[..],
        b"\"\xc3\x28\"",
        b"\"\\ud800\"",
        b"{\"a\":1,}",
        b"[1 2]",
        b"{a:1}",
        b"'a'",
        b"NaN",
        b"Infinity",
        b"01",
        b"+1",
        b".5",
        b"\xef\xbb\xbf1",
        b"\"\n\"",
        b"// x\n1",
    ] {
        assert!(parse(text).is_err(), "{:?}", String::from_utf8_lossy(text));
    }
}

#[test]
fn depth_is_bounded() {
    let nested = |depth: usize| format!("{}{}", "[".repeat(depth), "]".repeat(depth));
    let objects = |depth: usize| format!("{}1{}", "{\"a\":".repeat(depth), "}".repeat(depth));
    for text in [nested(MAX_DEPTH), objects(MAX_DEPTH)] {
        let value = parse(text.as_bytes()).unwrap();
        assert_eq!(check(&value), Ok(()));
        assert_eq!(depth(&value), MAX_DEPTH);
    }
    for text in [
        nested(MAX_DEPTH + 1),
        objects(MAX_DEPTH + 1),
        "[".repeat(1 << 20),
        "{\"a\":".repeat(1 << 18),
    ] {
        assert_eq!(parse(text.as_bytes()).unwrap_err().detail, "is nested deeper than 32");
    }
    let value = parse_within(nested(MAX_DEPTH + 1).as_bytes(), MAX_DEPTH + 1).unwrap();
    assert_eq!(check(&value).unwrap_err().detail, "is nested deeper than 32");
    assert_eq!(check(&value).unwrap_err().pointer, "/0".repeat(MAX_DEPTH));
}

#[test]
fn a_secret_is_as_deep_as_it_will_be_shown() {
    assert_eq!(depth(&json!({ "a": { "$secret": "x" } })), 3);
    assert_eq!(depth(&json!({ "a": { "$secret": { "redacted": true, "version": 3 } } })), 3);
    assert_eq!(depth(&json!(5)), 0);
}

#[test]
fn values_from_elsewhere_have_the_same_limits() {
    for (value, pointer) in [
        (json!({ "a": [u64::MAX] }), "/a/0"),
        (json!({ "a": { "b": i64::MIN } }), "/a/b"),
        (json!(9_007_199_254_740_992_i64), ""),
        (json!([1e300]), "/0"),
    ] {
        let fault = check(&value).unwrap_err();
        assert_eq!((fault.pointer.as_str(), fault.line), (pointer, 0));
        assert!(fault.detail.contains("integer outside"));
    }
    assert_eq!(check(&json!({ "a": [1e-300, -0.5, 1e15, 9_007_199_254_740_991_i64] })), Ok(()));
}

#[test]
fn pointers_are_escaped() {
    assert_eq!(push("", "a"), "/a");
    assert_eq!(push("/a", "m~n/o"), "/a/m~0n~1o");
    assert_eq!(push("/a", ""), "/a/");
    let value = json!({ "a~1": { "/": 7 } });
    assert_eq!(value.pointer(&push(&push("", "a~1"), "/")), Some(&json!(7)));
}

#[test]
fn long_pointers_are_cut_in_faults() {
    let text = format!("{{\"{}\": 9007199254740993}}", "\u{e4}".repeat(100_000));
    let fault = parse(text.as_bytes()).unwrap_err();
    assert!(fault.pointer.len() <= MAX_SHOWN_BYTES + 3 && fault.pointer.ends_with('…'));
}

proptest! {
    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = parse(&bytes);
    }

    #[test]
    fn no_text_panics(text in "[\\[\\]{}:,\"\\\\ue0-9.+\\- a]{0,60}") {
        let own = parse(text.as_bytes());
        let other = serde_json::from_str::<Value>(&text);
        // What is taken here is what everybody reads; the other way round there are the limits.
        match (own, other) {
            (Ok(own), Ok(other)) => prop_assert_eq!(own, other),
            (Err(_), _) => {}
            (Ok(own), Err(error)) => prop_assert!(false, "{} is read, but {}", own, error),
        }
    }

    #[test]
    fn what_is_written_reads_the_same(value in any_json()) {
        prop_assert_eq!(check(&value), Ok(()));
        let text = value.to_string();
        prop_assert_eq!(parse(text.as_bytes()).unwrap(), value);
    }
}
