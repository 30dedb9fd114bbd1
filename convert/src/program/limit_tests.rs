//! Limits: lengths that lie, nesting without end, messages and types that are too large.

use super::tests::{again, cdr, compile, fault_of_bytes, le};
use super::*;
use crate::limits::{MAX_MESSAGE_BYTES, MAX_NESTING};
use crate::{FieldType, parse_joined};

#[test]
fn lengths_that_lie_are_found_at_once() {
    for ty in ["string", "wstring", "uint8[]", "float64[]", "string[]", "std_msgs/Empty[]"] {
        let found = fault_of_bytes(&format!("{ty} a\n"), &[255, 255, 255, 255, 0, 0, 0, 0]);
        assert_eq!(found, "/a: the CDR ends: 4294967295 elements, 4 bytes left", "{ty}");
    }
}

#[test]
fn both_sides_have_a_limit() {
    let program = compile("uint8[] a\n");
    let mut out = Vec::new();
    let too_large = Err(ConvertError::TooLarge);
    assert_eq!(program.to_json(&vec![0; MAX_MESSAGE_BYTES + 1], &mut out), too_large);
    assert_eq!(program.to_cdr(&vec![b' '; MAX_MESSAGE_BYTES + 1], &mut out), too_large);
    let size = 13 * 1024 * 1024;
    let bytes = [&le(&[&u32::to_le_bytes(size)])[..], &vec![0; size as usize]].concat();
    assert_eq!(program.to_json(&bytes, &mut out), too_large);
    assert!(out.is_empty());
    // Each element has a default of 1 MiB.
    let program = compile("Big[] a\n===\nMSG: a/Big\nuint8[1048576] x\n");
    let elements = vec!["{}"; 17].join(",");
    assert_eq!(program.to_cdr(format!("{{\"a\":[{elements}]}}").as_bytes(), &mut out), too_large);
    let wide = format!("{{\"a\":\"{}\"}}", "x".repeat(5 * 1024 * 1024));
    assert_eq!(compile("wstring a\n").to_cdr(wide.as_bytes(), &mut out), too_large);
    assert_eq!(ConvertError::TooLarge.to_string(), "larger than 16777216 bytes");
}

/// Types `T0` to `T<count>`, each with the fields that `line` gives for the name of the next.
fn chain(count: usize, line: impl Fn(&str) -> String) -> String {
    let mut text = line("T0");
    for at in 0..count {
        text += &format!("===\nMSG: a/T{at}\n{}", line(&format!("T{}", at + 1)));
    }
    text + &format!("===\nMSG: a/T{count}\nint8 x\n")
}

fn compile_error(text: &str) -> String {
    let description = parse_joined("a/msg/Test", text, None).expect("a definition");
    Program::compile(&description).expect_err("it cannot be converted").to_string()
}

#[test]
fn nesting_has_a_limit() {
    let deepest = chain(MAX_NESTING - 2, |next| format!("{next} n\n"));
    let program = compile(&deepest);
    assert!(again(&program, "{}").expect("a message").ends_with(&"}".repeat(MAX_NESTING)));
    let deeper = chain(MAX_NESTING - 1, |next| format!("{next} n\n"));
    assert_eq!(compile_error(&deeper), "a/msg/Test is nested deeper than 64");
    let lists = chain(MAX_NESTING / 2, |next| format!("{next}[] n\n"));
    assert_eq!(compile_error(&lists), "a/msg/Test is nested deeper than 64");
    let much = chain(900, |next| format!("{next} n\n"));
    assert!(compile_error(&much).ends_with("is nested deeper than 64"));
}

#[test]
fn types_that_have_no_end_are_refused() {
    assert_eq!(
        compile_error("A a\n===\nMSG: a/A\nB[] b\n===\nMSG: a/B\nA a\n"),
        "a/msg/A contains itself"
    );
    assert_eq!(compile_error("Test t\n"), "a/msg/Test contains itself");
    let doubled = chain(40, |next| format!("{next} a\n{next} b\n"));
    assert!(compile_error(&doubled).ends_with("has no value of at most 16777216 bytes"));
    let squared = chain(2, |next| format!("{next}[100000] a\n"));
    assert!(compile_error(&squared).ends_with("has no value of at most 16777216 bytes"));
    assert!(compile_error("int8[4294967295] a\n").ends_with("at most 16777216 bytes"));
}

/// A type of 2^20 values that are all defaults is made and read within the limits.
#[test]
fn many_defaults_end_at_the_limit() {
    let doubled = compile(&chain(20, |next| format!("{next} a\n{next} b\n")));
    assert!(cdr(&doubled, "{}").is_ok());
    let lists = compile(&chain(20, |next| format!("{next}[] a\n{next} b\n")));
    let deep = "{\"a\":[".repeat(10) + "{}" + &"]}".repeat(10);
    assert!(cdr(&lists, &deep).is_ok());
}

#[test]
fn members_that_come_early_end_in_time() {
    let program = compile(&chain(60, |next| format!("int8 z\n{next} a\n")));
    let deep =
        (0..61).fold("{\"x\":1}".to_owned(), |inner, _| format!("{{\"a\":{inner},\"z\":1}}"));
    let deep = deep.replace("\"x\":1", &format!("\"x\":{}1", " ".repeat(1024 * 1024)));
    assert!(cdr(&program, &deep).is_ok());
}

#[test]
fn faulty_descriptions_are_refused() {
    let bad = |change: fn(&mut FieldType)| {
        let mut description = parse_joined("a/msg/Test", "int8 a 1\n", None).expect("a definition");
        change(&mut description.type_description.fields[0].ty);
        Program::compile(&description).expect_err("it cannot be converted").to_string()
    };
    assert_eq!(bad(|ty| ty.type_id = 12), "a/msg/Test/a: type 12 is not supported");
    assert_eq!(bad(|ty| ty.type_id = 255), "a/msg/Test/a: type 255 is not supported");
    assert_eq!(bad(|ty| ty.type_id = 50), "a/msg/Test/a: expected a size above 0");
    assert_eq!(bad(|ty| ty.type_id = 21), "a/msg/Test/a: expected a size above 0");
    assert_eq!(bad(|ty| ty.type_id = 1), "a/msg/Test/a:  is not in the description");
    assert_eq!(compile_error("int8 a 300\n"), "a/msg/Test/a: default \"300\": 300 is out of range");
    assert_eq!(
        compile_error("int8[2] a [1]\n"),
        "a/msg/Test/a: default \"[1]\": expected 2 elements, found 1"
    );
}
