use super::*;
use crate::description::Field;

fn fields(text: &str) -> Vec<Field> {
    parse_message("a_msgs/msg/Test", text).expect("a definition").fields
}

fn fault(text: &str) -> String {
    parse_message("a_msgs/msg/Test", text).expect_err("no definition").to_string()
}

#[test]
fn types_of_all_forms_are_read() {
    let list = [
        ("bool x", FieldType::plain(Base::Bool, Shape::Single, 0)),
        ("byte x", FieldType::plain(Base::Byte, Shape::Single, 0)),
        ("char x", FieldType::plain(Base::UInt8, Shape::Single, 0)),
        ("float32[3] x", FieldType::plain(Base::Float32, Shape::Array(3), 0)),
        ("int64[] x", FieldType::plain(Base::Int64, Shape::Unbounded, 0)),
        ("uint16[<=5]\tx", FieldType::plain(Base::UInt16, Shape::Bounded(5), 0)),
        ("string<=10 x", FieldType::plain(Base::BoundedString, Shape::Single, 10)),
        ("wstring<=10[<=2] x", FieldType::plain(Base::BoundedWString, Shape::Bounded(2), 10)),
        ("Point x", FieldType::nested("a_msgs/msg/Point", Shape::Single)),
        ("Header x", FieldType::nested("a_msgs/msg/Header", Shape::Single)),
        ("geometry_msgs/Point[] x", FieldType::nested("geometry_msgs/msg/Point", Shape::Unbounded)),
        ("b/action/Do_Goal x", FieldType::nested("b/action/Do_Goal", Shape::Single)),
    ];
    for (line, expected) in list {
        assert_eq!(fields(line)[0].ty, expected, "{line}");
    }
}

#[test]
fn defaults_and_comments_are_told_apart() {
    let list = [
        ("float64 w 1 # unit", "1"),
        ("string s \"a # b\" # c", "a # b"),
        ("string s 'it\\'s'", "it's"),
        ("string s don't # say 'it'", "don't"),
        ("string s a=b", "a=b"),
        ("uint8[<=3] u [0, 1] # two", "[0, 1]"),
    ];
    for (line, default) in list {
        assert_eq!(fields(line)[0].default_value, default, "{line}");
    }
}

#[test]
fn constants_are_no_fields() {
    let text =
        "# of a sensor\r\nuint8 OK = 0  # good\r\nstring NAME=\"a=b\"\r\n\r\nint8 status -2\r\n";
    let read = parse_message("a_msgs/msg/Test", text).expect("a definition");
    let constants: Vec<(&str, &str, &str)> =
        read.constants.iter().map(|c| (c.ty.as_str(), c.name.as_str(), c.value.as_str())).collect();
    assert_eq!(constants, [("uint8", "OK", "0"), ("string", "NAME", "\"a=b\"")]);
    assert_eq!(read.fields.len(), 1);
    assert_eq!(read.fields[0].default_value, "-2");
}

#[test]
fn a_message_without_fields_has_one_byte() {
    assert_eq!(fields("uint8 A=1\n")[0].name, EMPTY_FIELD);
}

#[test]
fn faults_say_line_and_reason() {
    for (text, expected) in [
        ("bool", "a_msgs/msg/Test line 1: expected a type and a name, found \"bool\""),
        ("\nbool 1x", "a_msgs/msg/Test line 2: expected a name, found \"1x\""),
        ("time x", "a_msgs/msg/Test line 1: \"time\" is not a type"),
        ("int8[0] x", "a_msgs/msg/Test line 1: expected a size from 1 to 4294967295, found \"0\""),
        ("int8<=3 x", "a_msgs/msg/Test line 1: only strings have a bound, found \"int8<=3\""),
        ("int8[][] x", "a_msgs/msg/Test line 1: \"int8[]\" is not a type"),
    ] {
        assert_eq!(fault(text), expected, "{text}");
    }
    let large = " ".repeat(MAX_DEFINITION_BYTES + 1);
    assert_eq!(fault(&large), "has 1048577 bytes, at most 1048576 are allowed");
    assert!(parse_message("Test", "bool x").is_err());
}

#[test]
fn services_and_actions_have_their_parts() {
    let service = parse_service("a/srv/Add", "int64 a\n---\nint64 sum\n").expect("a service");
    let names: Vec<&str> = service.iter().map(|ty| ty.type_name.as_str()).collect();
    assert_eq!(names, ["a/srv/Add", "a/srv/Add_Request", "a/srv/Add_Response", "a/srv/Add_Event"]);
    let action = parse_action("a/action/Go", "---\nint8 x\n---\n").expect("an action");
    assert_eq!(action.len(), 13);
    let error = parse_service("a/srv/Add", "int64 a").expect_err("one part");
    assert_eq!(error.to_string(), "a/srv/Add has 1 parts, expected 2");
    let error = parse_service("a/srv/Add", "\n---\nint64 sum\n!").expect_err("a bad line");
    assert_eq!(
        error.to_string(),
        "a/srv/Add_Response line 4: expected a type and a name, found \"!\""
    );
}

#[test]
fn joined_definitions_are_read() {
    let text = "Point p\nstd_msgs/Header h\n\
        ================\nMSG: a/Point\nfloat64 x\n\
        ================\nMSG: std_msgs/msg/Header\nstring frame_id\n";
    let read = parse_joined("a/msg/Top", text, None).expect("a definition");
    let names: Vec<&str> = read.types().map(|ty| ty.type_name.as_str()).collect();
    assert_eq!(names, ["a/msg/Top", "a/msg/Point", "std_msgs/msg/Header"]);
    let error = parse_joined("a/msg/Top", "Point p", None).expect_err("a type is missing");
    assert_eq!(error.to_string(), "a/msg/Point is not known, a/msg/Top needs it");
}

#[test]
fn missing_parts_come_from_known_types() {
    let known = crate::built_in(crate::Distro::Jazzy);
    let read =
        parse_joined("a/msg/Top", "geometry_msgs/Pose p", Some(&known)).expect("it is known");
    assert_eq!(read.referenced_type_descriptions.len(), 3);
}
