use proptest::prelude::*;

use super::*;

fn channel() -> ChannelName {
    "imu/data".parse().unwrap()
}

fn full_header() -> Header {
    let origin = Origin {
        layer: "edge".to_owned(),
        node: "robot-1".to_owned(),
        service: String::new(),
        instance: "0".to_owned(),
        epoch: u64::MAX,
    };
    Header {
        encoding: "application/cdr; type=sensor_msgs/msg/Imu".to_owned(),
        lifespan_ms: 500,
        priority: Some(Priority::Control),
        type_hash: "RIHS01_0".to_owned(),
        traceparent: "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01".to_owned(),
        reliable: true,
        depth: 3,
        related: Some((WriterId([0xCD; 16]), 9)),
        to: "edge/robot-2".to_owned(),
        ..Header::new("imu/data", origin, WriterId([0xAB; 16]), 7, 1_700_000_000_000_000_001)
    }
}

fn written(frame: &Frame) -> Vec<(String, Vec<u8>)> {
    let mut out = Vec::new();
    write(frame, &mut String::new(), |key, value| {
        out.push((key.to_owned(), value.as_bytes().to_vec()));
    });
    out
}

fn read_pairs(pairs: &[(String, Vec<u8>)], payload: &[u8]) -> Content {
    let headers = pairs.iter().map(|(key, value)| (key.as_str(), Some(value.as_slice())));
    read(&channel(), headers, Bytes::copy_from_slice(payload), Some((WriterId([9; 16]), 5)))
}

#[test]
fn headers_are_as_the_contract_says() {
    let frame = Frame::new(&full_header(), Bytes::new()).unwrap().with_hops_and_age(1, 2);
    let shown: Vec<String> = written(&frame)
        .into_iter()
        .map(|(key, value)| format!("{key}={}", String::from_utf8(value).unwrap()))
        .collect();
    assert_eq!(
        shown,
        [
            "blaze-version=1",
            "blaze-origin=edge/robot-1//0",
            "blaze-epoch=18446744073709551615",
            "blaze-writer=abababababababababababababababab",
            "blaze-sequence=7",
            "blaze-time=1700000000000000001",
            "blaze-encoding=application/cdr; type=sensor_msgs/msg/Imu",
            "blaze-age-us=2",
            "blaze-hops=1",
            "blaze-lifespan-ms=500",
            "blaze-priority=control",
            "blaze-reliable=true",
            "blaze-depth=3",
            "blaze-type-hash=RIHS01_0",
            "blaze-related-writer=cdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcd",
            "blaze-related-sequence=9",
            "blaze-to=edge/robot-2",
            "traceparent=00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
        ]
    );
}

#[test]
fn a_record_without_a_writer_is_bare_whatever_else_it_says() {
    for pairs in [
        vec![],
        vec![("content-type".to_owned(), b"\xff\xff".to_vec())],
        vec![("blaze-sequence".to_owned(), b"\xff".to_vec())],
    ] {
        let Content::Bare { payload, identity } = read_pairs(&pairs, b"BLZ1 or not") else {
            panic!("not bare: {pairs:?}");
        };
        assert_eq!(&payload[..], b"BLZ1 or not");
        assert_eq!(identity, Some((WriterId([9; 16]), 5)));
    }
}

#[test]
fn broken_headers_are_malformed() {
    let good = written(&Frame::new(&full_header(), Bytes::new()).unwrap());
    let replaced = |name: &str, value: &[u8]| {
        let mut pairs = good.clone();
        pairs.retain(|(key, _)| key != name);
        pairs.push((name.to_owned(), value.to_vec()));
        pairs
    };
    for (name, value) in [
        ("blaze-version", &b"2"[..]),
        ("blaze-writer", b"abab"),
        ("blaze-writer", b"\xff"),
        ("blaze-sequence", b"0"),
        ("blaze-sequence", b"-1"),
        ("blaze-sequence", b"18446744073709551616"),
        ("blaze-origin", b"edge/robot-1"),
        ("blaze-origin", b"a/b/c/d/e"),
        ("blaze-origin", &[b'/'; 2000]),
        ("blaze-encoding", &[b'x'; 5000]),
        ("blaze-priority", b"urgent"),
        ("blaze-reliable", b"yes"),
        ("blaze-hops", b"4294967296"),
        ("blaze-related-writer", b"cdcd"),
        ("blaze-related-sequence", b"-1"),
    ] {
        let found = read_pairs(&replaced(name, value), b"12345");
        assert!(
            matches!(found, Content::Malformed { bytes: 5, .. }),
            "{name} {}: {found:?}",
            value.escape_ascii()
        );
    }
    let mut without = good.clone();
    without.retain(|(key, _)| key != "blaze-sequence");
    assert!(matches!(read_pairs(&without, b""), Content::Malformed { .. }));
    let null = [("blaze-writer", None)].into_iter();
    assert!(matches!(read(&channel(), null, Bytes::new(), None), Content::Malformed { .. }));
}

#[test]
fn keys_keep_a_writer_together() {
    let writer = WriterId([0xAB; 16]);
    assert_eq!(key(writer, 7, 0), "ab".repeat(16));
    assert_eq!(key(writer, 7, 3), format!("{}/1", "ab".repeat(16)));
    assert!(!is_kept(key(writer, 7, 0).as_bytes()));
    assert!(is_kept(key(writer, 7, 1).as_bytes()));
    assert!(is_kept(b"robot-1"));
    for partitions in [-1, 0, 1, 2, 7] {
        assert!((0..partitions.max(1)).contains(&partition_of(writer, partitions)));
    }
}

fn names() -> impl Strategy<Value = String> {
    prop_oneof![
        8 => prop::sample::select(vec![
            "blaze-version", "blaze-origin", "blaze-epoch", "blaze-writer", "blaze-sequence",
            "blaze-time",
            "blaze-encoding", "blaze-age-us", "blaze-hops", "blaze-lifespan-ms", "blaze-priority",
            "blaze-reliable",
            "blaze-depth", "blaze-type-hash", "blaze-related-writer", "blaze-related-sequence",
            "blaze-to", "traceparent", "blaze-unknown",
        ]).prop_map(str::to_owned),
        1 => ".*",
    ]
}

fn values() -> impl Strategy<Value = Vec<u8>> {
    prop_oneof![
        prop::collection::vec(any::<u8>(), 0..64),
        prop::collection::vec(any::<u8>(), 1000..1100),
        "[0-9a-f]{32}".prop_map(String::into_bytes),
        any::<u64>().prop_map(|number| number.to_string().into_bytes()),
        "[a-z0-9/-]{0,300}".prop_map(String::into_bytes),
    ]
}

proptest! {
    #[test]
    fn hostile_headers_never_panic(pairs in prop::collection::vec((names(), values()), 0..24),
        payload: Vec<u8>) {
        let names_writer = pairs.iter().any(|(key, _)| key == "blaze-writer");
        match read_pairs(&pairs, &payload) {
            Content::Frame(frame) => {
                prop_assert!(names_writer && frame.sequence() > 0);
                prop_assert_eq!(&frame.payload()[..], &payload[..]);
                // What was read can be written and read again.
                let again = read_pairs(&written(&frame), &payload);
                let Content::Frame(again) = again else { panic!("not read again: {again:?}") };
                prop_assert_eq!(again.writer(), frame.writer());
                prop_assert_eq!(again.origin(), frame.origin());
            }
            Content::Bare { .. } => prop_assert!(!names_writer),
            Content::Malformed { bytes, .. } => prop_assert!(
                names_writer && bytes == payload.len(),
            ),
        }
    }

    #[test]
    fn any_frame_survives(
        texts in prop::collection::vec("[a-zA-Z0-9 ;=_-]{0,60}", 7),
        numbers: (u64, u64, u64, u32, u32, u64),
        writer: [u8; 16],
        reliable: bool,
        urgent: bool,
        depth in 0u32..100,
    ) {
        let origin = Origin {
            layer: texts[0].clone(),
            node: texts[1].clone(),
            service: texts[2].clone(),
            instance: texts[3].clone(),
            epoch: numbers.0,
        };
        let header = Header {
            encoding: texts[4].clone(),
            type_hash: texts[5].clone(),
            traceparent: texts[6].clone(),
            priority: urgent.then_some(Priority::Control),
            lifespan_ms: numbers.3,
            hops: numbers.4,
            age_us: numbers.5,
            reliable,
            depth,
            ..Header::new("imu/data", origin, WriterId(writer), numbers.1.max(1), numbers.2)
        };
        let frame = Frame::new(&header, Bytes::from_static(b"x")).unwrap();
        let Content::Frame(found) = read_pairs(&written(&frame), b"x") else { panic!("no frame") };
        prop_assert_eq!(found, frame);
    }
}
