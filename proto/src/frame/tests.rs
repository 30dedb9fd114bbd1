//! Frames survive their bytes; what is none is refused.

use super::*;
use crate::v1;
use proptest::prelude::*;

fn header() -> Header {
    Header {
        encoding: "application/json".into(),
        lifespan_ms: 500,
        priority: Some(Priority::State),
        type_hash: "RIHS01_00".into(),
        traceparent: "00-1-2-03".into(),
        reliable: true,
        depth: 3,
        hops: 1,
        age_us: 77,
        related: Some((WriterId([7; 16]), 5)),
        to: "edge/robot-2".into(),
        ..Header::new(
            "imu/data",
            Origin {
                layer: "edge".into(),
                node: "robot-1".into(),
                service: "imu".into(),
                instance: "0".into(),
                epoch: 9,
            },
            WriterId(*b"0123456789abcdef"),
            42,
            1_700_000_000_000_000_000,
        )
    }
}

#[test]
fn every_field_survives() {
    let header = header();
    let frame = Frame::new(&header, Bytes::from_static(b"payload")).unwrap();
    let frame = Frame::parse(frame.to_bytes()).unwrap();
    assert_eq!(frame.topic(), "imu/data");
    assert_eq!(frame.origin(), header.origin);
    assert_eq!(frame.writer(), header.writer);
    assert_eq!((frame.sequence(), frame.publish_time_ns()), (42, 1_700_000_000_000_000_000));
    assert_eq!((frame.encoding(), frame.type_hash()), ("application/json", "RIHS01_00"));
    assert_eq!(frame.traceparent(), "00-1-2-03");
    assert_eq!((frame.lifespan_ms(), frame.priority()), (500, Some(Priority::State)));
    assert_eq!((frame.reliable(), frame.depth()), (true, 3));
    assert_eq!((frame.hops(), frame.age_us()), (1, 77));
    assert_eq!((frame.related(), frame.to()), (header.related, "edge/robot-2"));
    assert_eq!(&frame.payload()[..], b"payload");
}

#[test]
fn a_message_of_an_earlier_version_answers_nothing_and_is_for_any_flow() {
    let frame = Frame::new(&Header { related: None, to: String::new(), ..header() }, Bytes::new());
    let frame = frame.unwrap();
    assert_eq!((frame.related(), frame.to()), (None, ""));
    let short =
        v1::MessageHeader { related_writer: Bytes::from_static(b"short"), ..header().to_wire() };
    let mut head = BytesMut::from(&MAGIC[..]);
    head.put_u32_le(u32::try_from(short.encoded_len()).unwrap());
    short.encode(&mut head).unwrap();
    let error = Frame::from_parts(head.freeze(), Bytes::new()).unwrap_err();
    let reason = "must have 16 bytes";
    assert_eq!(error, FrameError::Field { field: "related_writer", reason });
}

#[test]
fn a_message_for_any_flow_is_addressed_and_stays_the_same_otherwise() {
    let frame = Frame::new(&Header { to: String::new(), ..header() }, Bytes::from_static(b"x"));
    let addressed = frame.unwrap().with_hops_and_age(2, 80).with_to("edge/robot-2").unwrap();
    let expected =
        Frame::new(&Header { hops: 2, age_us: 80, ..header() }, Bytes::from_static(b"x"));
    let expected = expected.unwrap();
    assert_eq!((addressed.to(), addressed.topic()), ("edge/robot-2", "imu/data"));
    assert_eq!((addressed.hops(), addressed.age_us()), (2, 80));
    assert_eq!(
        (addressed.related(), addressed.payload()),
        (expected.related(), expected.payload())
    );
    assert!(addressed.with_to(&"x".repeat(MAX_HEADER_BYTES)).is_err());
}

#[test]
fn hops_and_age_are_written_anew_and_the_rest_stays() {
    let frame = Frame::new(&header(), Bytes::from_static(b"p")).unwrap();
    let written = frame.clone().with_hops_and_age(2, 1_000_000).to_bytes();
    let again = Frame::parse(written.clone()).unwrap();
    assert_eq!((again.hops(), again.age_us()), (2, 1_000_000));
    let decoded = v1::MessageHeader::decode(&again.head()[PREFIX_BYTES..]).unwrap();
    assert_eq!(decoded, v1::MessageHeader { hops: 2, age_us: 1_000_000, ..header().to_wire() });
    let back = again.with_hops_and_age(0, 0).to_bytes();
    assert_eq!(Frame::parse(back).unwrap().hops(), 0);
}

#[test]
fn hops_and_age_grow_beyond_the_longest_header() {
    let of =
        |length: usize| Header { traceparent: "t".repeat(length), hops: 0, age_us: 0, ..header() };
    let short = Frame::new(&of(3_000), Bytes::new()).unwrap().head().len() - PREFIX_BYTES;
    let longest = 3_000 + MAX_HEADER_BYTES - short;
    let frame = Frame::new(&of(longest), Bytes::new()).unwrap();
    let written = frame.with_hops_and_age(u32::MAX, u64::MAX).to_bytes();
    assert_eq!(written.len(), PREFIX_BYTES + MAX_HEADER_BYTES + HOPS_AND_AGE_BYTES);
    let again = Frame::parse(written).unwrap();
    assert_eq!((again.hops(), again.age_us()), (u32::MAX, u64::MAX));
    assert_eq!(
        Frame::new(&of(longest + 1), Bytes::new()).unwrap_err(),
        FrameError::HeaderTooLarge(MAX_HEADER_BYTES + 1)
    );
}

#[test]
fn what_is_no_frame_is_refused_with_a_reason() {
    let good = Frame::new(&header(), Bytes::from_static(b"payload")).unwrap().to_bytes();
    assert_eq!(Frame::parse(Bytes::from_static(b"{\"a\":1}")).unwrap_err(), FrameError::Magic);
    for length in 4..good.len() - 7 {
        assert!(Frame::parse(good.slice(..length)).is_err(), "{length}");
    }
    let mut huge = BytesMut::from(&b"BLZ1"[..]);
    huge.put_u32_le(5000);
    assert_eq!(Frame::parse(huge.freeze()).unwrap_err(), FrameError::HeaderTooLarge(5000));
    assert_eq!(
        Frame::new(&Header { sequence: 0, ..header() }, Bytes::new()).unwrap_err(),
        FrameError::Field { field: "sequence", reason: "must be 1 or more" }
    );
    let large = Bytes::from(vec![0; MAX_PAYLOAD_BYTES + 1]);
    assert_eq!(
        Frame::new(&header(), large).unwrap_err(),
        FrameError::PayloadTooLarge(MAX_PAYLOAD_BYTES + 1)
    );
}

proptest! {
    #[test]
    fn random_bytes_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..300),
        framed: bool) {
        if framed && bytes.len() >= 8 {
            bytes[..4].copy_from_slice(&MAGIC);
            let length = u32::try_from(bytes.len() - 8).unwrap();
            bytes[4..8].copy_from_slice(&length.to_le_bytes());
        }
        if let Ok(frame) = Frame::parse(Bytes::from(bytes)) {
            prop_assert!(Frame::parse(frame.with_hops_and_age(3, 4).to_bytes()).is_ok());
        }
    }

    #[test]
    fn a_flipped_byte_never_panics(at in 0usize..200, value: u8) {
        let mut bytes =
            BytesMut::from(&Frame::new(&header(), Bytes::from_static(b"x")).unwrap()
            .to_bytes()[..]);
        let at = at % bytes.len();
        bytes[at] = value;
        let _ = Frame::parse(bytes.freeze());
    }
}
