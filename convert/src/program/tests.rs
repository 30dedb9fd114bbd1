//! Each row of the table of `docs/json-and-ros2-types.md`.

use super::*;
use crate::{Distro, built_in, parse_joined};

pub(super) fn compile(text: &str) -> Program {
    let known = built_in(Distro::Jazzy);
    let description = parse_joined("a/msg/Test", text, Some(&known)).expect("a definition");
    Program::compile(&description).expect("it can be converted")
}

fn built(name: &str) -> Program {
    let description = built_in(Distro::Jazzy).describe(name).expect("it is built in");
    Program::compile(&description).expect("it can be converted")
}

fn json(program: &Program, cdr: &[u8]) -> Result<String, String> {
    let mut out = Vec::new();
    let done = program.to_json(cdr, &mut out);
    done.map(|()| String::from_utf8(out).expect("UTF-8")).map_err(|error| error.to_string())
}

pub(super) fn cdr(program: &Program, json: &str) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    program.to_cdr(json.as_bytes(), &mut out).map(|()| out).map_err(|error| error.to_string())
}

/// Little-endian CDR of bytes that need no padding.
pub(super) fn le(parts: &[&[u8]]) -> Vec<u8> {
    [&ENCAPSULATION[..], &parts.concat()].concat()
}

/// The JSON becomes the bytes, and they become the JSON.
fn both(text: &str, json_text: &str, bytes: &[u8]) {
    let program = compile(text);
    assert_eq!(cdr(&program, json_text), Ok(le(&[bytes])), "{json_text}");
    assert_eq!(json(&program, &le(&[bytes])).as_deref(), Ok(json_text));
}

/// JSON of the CDR that is made of the JSON.
pub(super) fn again(program: &Program, json_text: &str) -> Result<String, String> {
    json(program, &cdr(program, json_text)?)
}

fn fault(text: &str, json_text: &str) -> String {
    cdr(&compile(text), json_text).expect_err("a fault")
}

pub(super) fn fault_of_bytes(text: &str, bytes: &[u8]) -> String {
    json(&compile(text), &le(&[bytes])).expect_err("a fault")
}

#[test]
fn messages_are_objects_in_the_order_of_the_definition() {
    both("int8 b\nuint8 A=1\nint8 a\n", r#"{"b":1,"a":2}"#, &[1, 2]);
    both("uint8 A=1\n", "{}", &[0]);
    // Some writers send no byte for it.
    assert_eq!(json(&compile("uint8 A=1\n"), &ENCAPSULATION).as_deref(), Ok("{}"));
    both("std_msgs/Empty e\nint8 x\n", r#"{"e":{},"x":3}"#, &[0, 3]);
    both(
        "builtin_interfaces/Time stamp\n",
        r#"{"stamp":{"sec":-1,"nanosec":5}}"#,
        &[255, 255, 255, 255, 5, 0, 0, 0],
    );
}

#[test]
fn members_may_come_in_any_order_and_may_be_missing() {
    let program = compile("int8 a\nint8 b 7\nstring s\nint8[] l\ngeometry_msgs/Quaternion q\n");
    let full = r#"{"a":1,"b":2,"s":"x","l":[3],"q":{"x":0.0,"y":0.0,"z":0.5,"w":1.0}}"#;
    let mixed = r#" { "q" : {"w":1,"z":0.5} , "l":[ 3 ], "s":"\u0078","b":2, "a":1 } "#;
    assert_eq!(again(&program, mixed).as_deref(), Ok(full));
    assert_eq!(
        again(&program, r#"{"l":[1,2]}"#).as_deref(),
        Ok(r#"{"a":0,"b":7,"s":"","l":[1,2],"q":{"x":0.0,"y":0.0,"z":0.0,"w":1.0}}"#)
    );
}

#[test]
fn defaults_of_all_kinds_stand_for_missing_members() {
    let program = compile(
        "bool b true\nchar c 100\nfloat32 f 1.125\nstring s \"it's\"\nwstring w ハロー\n\
         uint8[<=3] u [0, 1, 255]\nint16[2] i [-1, 1]\nstring[] t ['a', 'b c']\n",
    );
    assert_eq!(
        again(&program, "{}").as_deref(),
        Ok("{\"b\":true,\"c\":100,\"f\":1.125,\"s\":\"it's\",\"w\":\"ハロー\",\"u\":\"AAH/\",\
            \"i\":[-1,1],\"t\":[\"a\",\"b c\"]}")
    );
}

#[test]
fn unknown_and_repeated_members_are_faults() {
    let text = "int8 a\nint8 b\n";
    assert_eq!(fault(text, r#"{"a":1,"c":2}"#), "/c: no such member");
    assert_eq!(fault(text, r#"{"a":1,"x/~y":2}"#), "/x~1~0y: no such member");
    assert_eq!(fault(text, r#"{"a":1,"a":2}"#), "/a: the member is there twice");
    assert_eq!(fault(text, r#"{"b":1,"b":2}"#), "/b: the member is there twice");
    assert_eq!(fault(text, r#"{"b":1,"a":2,"b":2}"#), "/b: the member is there twice");
    assert_eq!(
        fault("uint8 A=1\n", r#"{"structure_needs_at_least_one_member":0}"#),
        "/structure_needs_at_least_one_member: no such member"
    );
}

#[test]
fn bools_are_bools() {
    both("bool a\nbool b\n", r#"{"a":true,"b":false}"#, &[1, 0]);
    assert_eq!(fault("bool a\n", r#"{"a":1}"#), "/a: expected a bool, found a number");
    assert_eq!(fault_of_bytes("bool a\n", &[7]), "/a: expected a bool (0 or 1), found 7");
}

#[test]
fn integers_are_numbers() {
    both("int64 a\n", r#"{"a":-9223372036854775808}"#, &i64::MIN.to_le_bytes());
    both("uint64 a\n", r#"{"a":18446744073709551615}"#, &u64::MAX.to_le_bytes());
    both(
        "byte a\nchar b\nuint8 c\nint8 d\n",
        r#"{"a":0,"b":65,"c":255,"d":-1}"#,
        &[0, 65, 255, 255],
    );
    both("int16 a\nuint16 b\n", r#"{"a":-2,"b":65535}"#, &[254, 255, 255, 255]);
    both("int32 a\nuint32 b\n", r#"{"a":-2,"b":7}"#, &[254, 255, 255, 255, 7, 0, 0, 0]);
}

#[test]
fn integers_may_be_written_otherwise() {
    let program = compile("uint8 a\n");
    for (text, value) in [("1.0", 1), ("1e2", 100), ("-0", 0), ("-0.0", 0), ("2.5E1", 25)] {
        let found = again(&program, &format!(r#"{{"a":{text}}}"#));
        assert_eq!(found, Ok(format!(r#"{{"a":{value}}}"#)), "{text}");
    }
    let program = compile("int64 a\nuint64 b\n");
    assert_eq!(
        again(&program, r#"{"a":"-9223372036854775808","b":"18446744073709551615"}"#).as_deref(),
        Ok(r#"{"a":-9223372036854775808,"b":18446744073709551615}"#)
    );
    assert_eq!(
        again(&program, r#"{"a":1e18,"b":1e19}"#).as_deref(),
        Ok(r#"{"a":1000000000000000000,"b":10000000000000000000}"#)
    );
}

#[test]
fn other_integers_are_faults() {
    for (ty, value, text) in [
        ("uint8", "256", "256 is out of range"),
        ("uint8", "-1", "-1 is out of range"),
        ("int8", "1e3", "1e3 is out of range"),
        ("uint64", "18446744073709551616", "18446744073709551616 is out of range"),
        ("uint64", "18446744073709551616.0", "18446744073709551616.0 is out of range"),
        ("int64", "1e400", "1e400 is out of range"),
        ("int32", "1.5", "expected an integer, found 1.5"),
        ("int32", "\"1\"", "expected an integer, found text"),
        ("int64", "\"1.0\"", "expected an integer, found text"),
        ("int64", "\"\"", "expected an integer, found text"),
        ("int32", "null", "expected an integer, found null"),
        ("int32", "{}", "expected an integer, found an object"),
        ("uint8", &"9".repeat(50), "99999999999999999999999999999999… is out of range"),
    ] {
        let found = fault(&format!("{ty} a\n"), &format!(r#"{{"a":{value}}}"#));
        assert_eq!(found, format!("/a: {text}"), "{ty} {value}");
    }
}

#[test]
fn floats_come_back_to_the_same_bits() {
    both("float32 a\n", r#"{"a":0.1}"#, &0.1f32.to_le_bytes());
    both("float64 a\n", r#"{"a":0.1}"#, &0.1f64.to_le_bytes());
    both("float64 a\n", r#"{"a":-0.0}"#, &(-0.0f64).to_le_bytes());
    both("float64 a\n", r#"{"a":5e-324}"#, &5e-324f64.to_le_bytes());
    both("float32 a\n", r#"{"a":"NaN"}"#, &f32::NAN.to_le_bytes());
    both("float64 a\n", r#"{"a":"Infinity"}"#, &f64::INFINITY.to_le_bytes());
    both("float64 a\n", r#"{"a":"-Infinity"}"#, &f64::NEG_INFINITY.to_le_bytes());
    let program = compile("float32 a\nfloat32 b\n");
    assert_eq!(again(&program, r#"{"a":null,"b":3}"#).as_deref(), Ok(r#"{"a":"NaN","b":3.0}"#));
    // Through float64 this would be rounded twice.
    let just_above = r#"{"a":1.00000005960464477540000000000000001}"#;
    assert_eq!(again(&program, just_above).as_deref(), Ok(r#"{"a":1.0000001,"b":0.0}"#));
    let text = "float32 a\n";
    assert_eq!(fault(text, r#"{"a":1e39}"#), "/a: 1e39 is out of range");
    assert_eq!(fault(text, r#"{"a":"nan"}"#), "/a: expected a number, found text");
    assert_eq!(fault("float64 a\n", r#"{"a":1e309}"#), "/a: 1e309 is out of range");
}

#[test]
fn strings_are_text() {
    both("string a\n", r#"{"a":"é\"\n"}"#, &[5, 0, 0, 0, 0xc3, 0xa9, b'"', b'\n', 0]);
    both("string a\n", r#"{"a":""}"#, &[1, 0, 0, 0, 0]);
    let text = "string<=3 a\n";
    assert_eq!(fault(text, r#"{"a":"éé"}"#), "/a: expected at most 3 bytes, found 4");
    assert_eq!(fault(text, r#"{"a":"\u0000"}"#), "/a: a NUL within the text");
    assert_eq!(fault(text, r#"{"a":3}"#), "/a: expected text, found a number");
    assert_eq!(fault(text, r#"{"a":"\ud800"}"#), "/a: half of a surrogate pair");
    let many = fault_of_bytes(text, &[5, 0, 0, 0, b'a', b'b', b'c', b'd', 0]);
    assert_eq!(many, "/a: expected at most 3 bytes, found 4");
    assert_eq!(fault_of_bytes(text, &[2, 0, 0, 0, 0, 0]), "/a: a NUL within the text");
    let open = fault_of_bytes(text, &[1, 0, 0, 0, b'a']);
    assert_eq!(open, "/a: expected a text that ends with NUL");
}

#[test]
fn bytes_that_are_not_utf_8_are_replaced() {
    let program = compile("string a\n");
    let bytes = le(&[&[4, 0, 0, 0, b'x', 0xff, b'y', 0]]);
    assert_eq!(json(&program, &bytes).as_deref(), Ok("{\"a\":\"x\u{fffd}y\"}"));
    // Some writers send an empty text without its NUL.
    assert_eq!(json(&program, &le(&[&[0; 4]])).as_deref(), Ok(r#"{"a":""}"#));
}

#[test]
fn wide_strings_are_utf_16_units() {
    let units =
        |units: &[u32]| units.iter().flat_map(|unit| unit.to_le_bytes()).collect::<Vec<_>>();
    both("wstring a\n", r#"{"a":"hé😀"}"#, &units(&[4, 0x68, 0xe9, 0xd83d, 0xde00]));
    both("wstring<=2 a\n", r#"{"a":"😀"}"#, &units(&[2, 0xd83d, 0xde00]));
    let text = "wstring<=2 a\n";
    assert_eq!(fault(text, r#"{"a":"a😀"}"#), "/a: expected at most 2 UTF-16 units, found 3");
    assert_eq!(fault(text, r#"{"a":"\u0000"}"#), "/a: a NUL within the text");
    let program = compile("wstring a\n");
    let half = le(&[&units(&[2, 0xd83d, 0x61])]);
    assert_eq!(json(&program, &half).as_deref(), Ok("{\"a\":\"\u{fffd}a\"}"));
    assert_eq!(fault_of_bytes(text, &units(&[1, 0x1_0000])), "/a: 0x10000 is not a UTF-16 unit");
    assert_eq!(fault_of_bytes(text, &units(&[1, 0])), "/a: a NUL within the text");
    assert_eq!(
        fault_of_bytes(text, &units(&[3, 1, 1, 1])),
        "/a: expected at most 2 UTF-16 units, found 3"
    );
}

#[test]
fn many_bytes_are_base64() {
    for ty in ["uint8", "byte", "char"] {
        both(&format!("{ty}[4] a\n"), r#"{"a":"AAECAw=="}"#, &[0, 1, 2, 3]);
        both(&format!("{ty}[] a\n"), r#"{"a":"AAE="}"#, &[2, 0, 0, 0, 0, 1]);
        both(&format!("{ty}[<=2] a\n"), r#"{"a":""}"#, &[0; 4]);
    }
    both("int8[2] a\n", r#"{"a":[-1,1]}"#, &[255, 1]);
    let program = compile("uint8[<=4] a\nuint8[2] b\n");
    let written = cdr(&program, r#"{"a":"AAECAw==","b":"AAE="}"#);
    assert_eq!(cdr(&program, r#"{"a":"AAECAw","b":[0,1.0]}"#), written);
    assert_eq!(cdr(&program, r#"{"b":"AAE","a":[0,1,2,3]}"#), written);
    assert_eq!(cdr(&program, r#"{"a":"\u0041AECAw","b":[ 0, 1 ]}"#), written);
}

#[test]
fn other_base64_is_a_fault() {
    let text = "uint8[<=4] a\nuint8[2] b\n";
    for (json_text, expected) in [
        (r#"{"a":"AAECAwQ="}"#, "/a: expected at most 4 elements, found 5"),
        (r#"{"a":[0,1,2,3,4]}"#, "/a: expected at most 4 elements, found 5"),
        (r#"{"b":"AA=="}"#, "/b: expected 2 elements, found 1"),
        (r#"{"b":"AAEC"}"#, "/b: expected at most 2 elements, found 3"),
        (r#"{"b":[1]}"#, "/b: expected 2 elements, found 1"),
        (r#"{"b":[1,256]}"#, "/b/1: 256 is out of range"),
        (r#"{"a":7}"#, "/a: expected base64 or an array, found a number"),
    ] {
        assert_eq!(fault(text, json_text), expected, "{json_text}");
    }
    let symbol = fault(text, r#"{"a":"A*=="}"#);
    assert_eq!(symbol, "/a: not base64: Invalid symbol 42, offset 1.");
}

#[test]
fn lists_are_arrays() {
    both("int16[2] a\n", r#"{"a":[1,-1]}"#, &[1, 0, 255, 255]);
    both("bool[] a\n", r#"{"a":[true,false]}"#, &[2, 0, 0, 0, 1, 0]);
    both("string[] a\n", r#"{"a":["x"]}"#, &[1, 0, 0, 0, 2, 0, 0, 0, b'x', 0]);
    both("std_msgs/Bool[] a\n", r#"{"a":[{"data":true}]}"#, &[1, 0, 0, 0, 1]);
    both("float64[] a\n", r#"{"a":[]}"#, &[0; 4]);
    let text = "int16[2] a\nint32[<=2] b\n";
    assert_eq!(fault(text, r#"{"a":[1]}"#), "/a: expected 2 elements, found 1");
    assert_eq!(fault(text, r#"{"a":[1,2,3,4]}"#), "/a: expected 2 elements, found 4");
    assert_eq!(fault(text, r#"{"b":[1,2,3]}"#), "/b: expected at most 2 elements, found 3");
    assert_eq!(fault(text, r#"{"a":[1,"x"]}"#), "/a/1: expected an integer, found text");
    let many = [&[0; 4][..], &[3, 0, 0, 0], &[0; 12]].concat();
    assert_eq!(fault_of_bytes(text, &many), "/b: expected at most 2 elements, found 3");
}

#[test]
fn faults_have_pointers() {
    let text = "geometry_msgs/Twist twist\ngeometry_msgs/Point[] points\n";
    for (json_text, expected) in [
        (r#"{"twist":{"linear":{"x":"fast"}}}"#, "/twist/linear/x: expected a number, found text"),
        (r#"{"twist":[]}"#, "/twist: expected an object, found an array"),
        (r#"{"points":{}}"#, "/points: expected an array, found an object"),
        (r#"{"points":[{"x":1},{"q":1}]}"#, "/points/1/q: no such member"),
        (r#"{"points":[{"x":1},true]}"#, "/points/1: expected an object, found a bool"),
        (r#"{"points":[{"x":true}],"twist":{}}"#, "/points/0/x: expected a number, found a bool"),
        ("[]", "expected an object, found an array"),
        ("null", "expected an object, found null"),
        ("1.5", "expected an object, found a number"),
        ("-1", "expected an object, found a number"),
        ("\"x\"", "expected an object, found text"),
    ] {
        assert_eq!(fault(text, json_text), expected, "{json_text}");
    }
}

#[test]
fn text_that_is_not_json_is_a_fault() {
    let program = built("geometry_msgs/msg/Point");
    for bad in
        ["", "{", "{\"x\":}", "{\"x\":1}}", "{\"x\":1,}", "{x:1}", "{\"x\":01}", "{\"x\":NaN}"]
    {
        assert!(cdr(&program, bad).is_err(), "{bad}");
    }
    assert_eq!(
        cdr(&program, "{\"y\":[}").expect_err("no JSON"),
        "/y: expected value at line 1 column 7"
    );
    let mut out = b"before".to_vec();
    program.to_cdr(b"\xff", &mut out).expect_err("no UTF-8");
    program.to_cdr(b"{\"x\":1,\"y\":2,\"z\":true}", &mut out).expect_err("no number");
    program.to_json(&[0, 1, 0, 0, 1], &mut out).expect_err("no point");
    assert_eq!(out, b"before");
}

#[test]
fn values_are_aligned_to_their_size() {
    let program = compile("int8 a\nint64 b\nint8 c\nint16 d\nint8 e\nint32 f\nint8 g\nstring h\n");
    let text = r#"{"a":1,"b":2,"c":3,"d":4,"e":5,"f":6,"g":7,"h":"x"}"#;
    let bytes = cdr(&program, text).expect("a message");
    let expected: &[u8] = &[
        1, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 3, 0, 4, 0, 5, 0, 0, 0, 6, 0, 0, 0, 7, 0,
        0, 0, 2, 0, 0, 0, b'x', 0,
    ];
    assert_eq!(bytes, le(&[expected]));
    assert_eq!(json(&program, &bytes).as_deref(), Ok(text));
}

#[test]
fn big_endian_is_read() {
    let program = compile("uint16 a\nfloat32 b\nstring c\nwstring d\n");
    let bytes: &[u8] = &[
        0, 0, 0, 0, 1, 2, 9, 9, 0x3f, 0x80, 0, 0, 0, 0, 0, 2, b'x', 0, 9, 9, 0, 0, 0, 1, 0, 0, 0,
        0x79,
    ];
    assert_eq!(json(&program, bytes).as_deref(), Ok(r#"{"a":258,"b":1.0,"c":"x","d":"y"}"#));
}

#[test]
fn other_representations_are_carried_only() {
    let program = compile("int8 a\n");
    let mut out = Vec::new();
    for id in [2, 3, 6, 7, 0xb] {
        let error = program.to_json(&[0, id, 0, 0, 1], &mut out);
        assert_eq!(error, Err(ConvertError::Representation(u16::from(id))));
    }
    assert_eq!(
        ConvertError::Representation(7).to_string(),
        "data representation 0x0007 is not converted, expected 0x0000 or 0x0001"
    );
    assert_eq!(json(&program, &[0, 1, 0]), Err("the CDR has 3 bytes, less than 4".into()));
}

#[test]
fn bytes_of_another_type_are_found() {
    let program = compile("int32 a\n");
    assert_eq!(json(&program, &le(&[&[1, 0, 0, 0, 9, 9, 9]])).as_deref(), Ok(r#"{"a":1}"#));
    assert_eq!(
        json(&program, &le(&[&[1, 0, 0, 0, 9, 9, 9, 9]])),
        Err("4 bytes after the message: the CDR is not of this type".into())
    );
    assert_eq!(
        json(&program, &le(&[&[1, 0]])),
        Err("/a: the CDR ends: 4 bytes wanted, 2 left".into())
    );
    let wide = compile("wstring a\n");
    assert!(json(&wide, &le(&[&[0; 4], &[9; 11]])).is_ok());
    assert!(json(&wide, &le(&[&[0; 4], &[9; 12]])).is_err());
}
