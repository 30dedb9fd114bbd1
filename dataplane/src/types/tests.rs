use std::fs;

use blaze_convert::parse_joined;

use super::*;

fn ty<'a>(name: &'a str, hash: &'a str) -> MessageType<&'a str> {
    MessageType { name, hash }
}

fn json(types: &Types, now: Instant, ty: MessageType<&str>, cdr: &[u8]) -> Result<String, String> {
    let found = types.get(now, ty).and_then(|found| found.convert(Encoding::Json, cdr));
    found
        .map(|converted| String::from_utf8(converted.payload.to_vec()).unwrap())
        .map_err(|failure| format!("{}: {}", failure.code, failure))
}

const SEVEN: &[u8] = &[0, 1, 0, 0, 7, 0, 0, 0];

#[test]
fn a_type_is_sought_once_and_then_known() {
    let (types, now) = (Types::default(), Instant::now());
    let int = ty("std_msgs/msg/Int32", "");
    assert!(types.known(now, int).is_none(), "nothing is read beforehand");
    assert_eq!(json(&types, now, int, SEVEN).unwrap(), r#"{"data":7}"#);
    let known = types.known(now + RETRY * 10, int).unwrap().unwrap();
    let hash = known.hash.to_string();
    let with_hash = ty("std_msgs/msg/Int32", &hash);
    assert_eq!(json(&types, now, with_hash, SEVEN).unwrap(), r#"{"data":7}"#);
}

#[test]
fn one_with_another_hash_is_unknown_until_somebody_sends_it() {
    let (types, now) = (Types::default(), Instant::now());
    let other = parse_joined("std_msgs/msg/Int32", "int32 value\n", None).unwrap();
    let hash = other.hash().to_string();
    let asked = ty("std_msgs/msg/Int32", &hash);
    let error = json(&types, now, asked, SEVEN).unwrap_err();
    assert!(
        error
            .starts_with("type_unknown: no definition of std_msgs/msg/Int32 with the hash RIHS01_"),
        "{error}"
    );
    assert!(types.known(now, asked).unwrap().is_err(), "it is not sought for each message");
    types.add(Source::Node, other).unwrap();
    assert_eq!(json(&types, now, asked, SEVEN).unwrap(), r#"{"value":7}"#);
    let error = json(&types, now, ty("std_msgs/msg/Int32", "RIHS02_00"), SEVEN).unwrap_err();
    assert!(error.starts_with("type_unknown"), "{error}");
}

#[test]
fn a_file_that_comes_later_is_found_and_folders_are_exchanged() {
    let home = tempfile::tempdir().unwrap();
    let (types, now) = (Types::new(Distro::Humble, vec!["/no/such".into()]), Instant::now());
    let custom = ty("my_msgs/msg/Level", "");
    assert!(json(&types, now, custom, SEVEN).is_err());
    types.set_folders(vec![home.path().to_owned()]);
    assert!(json(&types, now, custom, SEVEN).is_err(), "the folder is empty");
    fs::create_dir_all(home.path().join("my_msgs/msg")).unwrap();
    fs::write(home.path().join("my_msgs/msg/Level.msg"), "int32 level\n").unwrap();
    assert!(json(&types, now, custom, SEVEN).is_err(), "it is not looked for at once");
    assert_eq!(json(&types, now + RETRY, custom, SEVEN).unwrap(), r#"{"level":7}"#);
    types.set_folders(Vec::new());
    assert!(json(&types, now, custom, SEVEN).is_err());
    assert_eq!(
        json(&types, now, ty("std_msgs/msg/Int32", ""), SEVEN).unwrap(),
        r#"{"data":7}"#,
        "what is built in stays"
    );
}

#[test]
fn what_is_kept_is_bounded() {
    let (types, now) = (Types::default(), Instant::now());
    for n in 0..3_000 {
        assert!(types.get(now, ty(&format!("a/msg/B{n}"), "")).is_err());
        assert!(types.get(now, ty("a/msg/C", &format!("RIHS01_{n}"))).is_err());
    }
    assert!(types.known(now, ty("a/msg/B0", "")).is_none());
    assert!(types.known(now, ty("a/msg/B2999", "")).is_some());
    assert!(types.known(now, ty("a/msg/C", "RIHS01_1")).is_none());
}

#[test]
fn a_type_that_cannot_be_converted_says_why() {
    let (types, now) = (Types::default(), Instant::now());
    let endless = parse_joined("a/msg/B", "a/B next\n", None);
    if let Ok(endless) = endless {
        types.add(Source::Flow, endless).unwrap();
        let error = json(&types, now, ty("a/msg/B", ""), SEVEN).unwrap_err();
        assert!(error.starts_with("convert_error: a/msg/B is not converted: "), "{error}");
    }
}
