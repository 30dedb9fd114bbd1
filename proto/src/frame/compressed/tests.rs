//! What is compressed comes back as it was, byte for byte.

use super::*;
use crate::Header;
use blaze_domain::{MAX_HEADER_BYTES, Origin, Priority, WriterId};
use proptest::prelude::*;

fn header() -> Header {
    let origin = Origin {
        layer: "edge".into(),
        node: "robot-1".into(),
        service: "camera".into(),
        instance: "0".into(),
        epoch: 9,
    };
    Header {
        encoding: "application/x-cdr".into(),
        hops: 1,
        age_us: 77,
        ..Header::new("camera/image_raw", origin, WriterId(*b"0123456789abcdef"), 42, 1)
    }
}

fn frame() -> Frame {
    Frame::new(&header(), Bytes::from_static(b"original")).unwrap()
}

fn from_header_bytes(header: &[u8], payload: &'static [u8]) -> Result<Frame, FrameError> {
    let mut head = begin(header.len())?;
    head.put_slice(header);
    Frame::from_parts(head.freeze(), Bytes::from_static(payload))
}

fn field(error: &FrameError) -> &'static str {
    match error {
        FrameError::Field { reason, .. } => reason,
        _ => "",
    }
}

#[test]
fn compressed_and_back_is_the_same_frame() {
    let original = frame();
    assert_eq!((original.compression(), original.uncompressed_bytes()), (Compression::None, 0));
    let packed = original.compressed(Bytes::from_static(b"packed"), 8).unwrap();
    assert_eq!((packed.compression(), packed.uncompressed_bytes()), (Compression::Lz4Block, 8));
    assert_eq!(packed.head().len(), original.head().len() + 4);
    assert_eq!(
        (packed.topic(), packed.writer(), packed.sequence()),
        ("camera/image_raw", original.writer(), 42)
    );
    let received = Frame::parse(packed.to_bytes()).unwrap();
    assert_eq!(received, packed);
    let back = received.decompressed(original.payload().clone()).unwrap();
    assert_eq!(back, original);
    assert_eq!(back.to_bytes(), original.to_bytes());
}

#[test]
fn hops_and_age_stay_beside_the_header() {
    let original = frame().with_hops_and_age(3, 5_000);
    let packed = original.compressed(Bytes::from_static(b"packed"), 8).unwrap();
    assert_eq!((packed.hops(), packed.age_us()), (3, 5_000));
    assert!(
        packed
            .head()
            .starts_with(&[MAGIC.as_slice(), &packed.head()[4..8], &original.head()[8..]].concat())
    );
    let packed = packed.with_hops_and_age(4, 6_000);
    let back = packed.decompressed(original.payload().clone()).unwrap();
    assert_eq!(back, original.clone().with_hops_and_age(4, 6_000));
    // Over the wire they are in the header.
    let received = Frame::parse(packed.to_bytes()).unwrap();
    let back = received.decompressed(original.payload().clone()).unwrap();
    assert_eq!(back.to_bytes(), original.with_hops_and_age(4, 6_000).to_bytes());
}

#[test]
fn a_header_without_room_is_an_error() {
    let with_header_bytes = |bytes: usize| {
        let of = |length: usize| Header {
            traceparent: "t".repeat(length),
            hops: 0,
            age_us: 0,
            ..header()
        };
        let short = Frame::new(&of(3_000), Bytes::new()).unwrap().head().len() - PREFIX_BYTES;
        Frame::new(&of(3_000 + bytes - short), Bytes::new()).unwrap()
    };
    for (free, size, fits) in
        [(4, 127, true), (4, 128, false), (7, MAX_PAYLOAD_BYTES as u64, true), (0, 0, false)]
    {
        let original = with_header_bytes(MAX_HEADER_BYTES - free);
        let packed = original.compressed(Bytes::from_static(b"p"), size);
        assert_eq!(packed.is_ok(), fits, "{free} bytes free, size {size}: {packed:?}");
        match packed {
            Ok(packed) => assert!(Frame::parse(packed.to_bytes()).is_ok()),
            Err(error) => assert!(matches!(error, FrameError::HeaderTooLarge(4097..)), "{error}"),
        }
    }
}

#[test]
fn what_is_not_as_announced_is_refused() {
    let original = frame();
    let packed = original.compressed(Bytes::from_static(b"packed"), 8).unwrap();
    assert_eq!(field(&packed.compressed(Bytes::new(), 6).unwrap_err()), "is set already");
    assert_eq!(field(&original.decompressed(Bytes::new()).unwrap_err()), "is not LZ4_BLOCK");
    let other_size = packed.decompressed(Bytes::from_static(b"seven b")).unwrap_err();
    assert_eq!(field(&other_size), "is not the size of the payload");
    let too_large = original.compressed(Bytes::new(), MAX_PAYLOAD_BYTES as u64 + 1).unwrap_err();
    assert_eq!(too_large, FrameError::PayloadTooLarge(MAX_PAYLOAD_BYTES + 1));
    assert!(original.compressed(Bytes::new(), u64::MAX).is_err());
    let header = |more: &[u8]| [&original.head()[PREFIX_BYTES..], more].concat();
    // 7: 1, 7: 1, 8: 0
    let twice = from_header_bytes(&header(&[0x38, 1, 0x38, 1, 0x40, 0]), b"p").unwrap();
    assert_eq!(field(&twice.decompressed(Bytes::new()).unwrap_err()), "is given twice");
    let unknown = from_header_bytes(&header(&[0x38, 9]), b"p").unwrap();
    assert_eq!(unknown.compression(), Compression::Unknown(9));
    assert_eq!(field(&unknown.decompressed(Bytes::new()).unwrap_err()), "is not LZ4_BLOCK");
    assert_eq!(field(&unknown.compressed(Bytes::new(), 1).unwrap_err()), "is set already");
    let negative = [&[0x38][..], &[0xff; 9], &[1]].concat();
    let negative = from_header_bytes(&header(&negative), b"p").unwrap();
    assert_eq!(negative.compression(), Compression::Unknown(i32::MAX));
}

/// The fields of a header, one by one.
fn split(header: &[u8]) -> Vec<Vec<u8>> {
    let mut fields = Vec::new();
    let mut rest = header;
    while !rest.is_empty() {
        let before = rest;
        let (tag, wire_type) = decode_key(&mut rest).unwrap();
        skip_field(wire_type, tag, &mut rest, DecodeContext::default()).unwrap();
        fields.push(before[..before.len() - rest.len()].to_vec());
    }
    fields
}

/// A field that no version knows, or that says in many bytes what is said anyway.
fn strange_field() -> impl Strategy<Value = Vec<u8>> {
    let bytes = |tag: u32, wire_type: WireType, value: &[u8]| {
        let mut out = Vec::new();
        encode_key(tag, wire_type, &mut out);
        if wire_type == WireType::LengthDelimited {
            encode_varint(value.len() as u64, &mut out);
        }
        out.extend_from_slice(value);
        out
    };
    prop_oneof![
        (17u32..20_000, proptest::collection::vec(any::<u8>(), 0..40))
            .prop_map(move |(tag, value)| bytes(tag, WireType::LengthDelimited, &value)),
        (17u32..20_000, any::<u64>()).prop_map(|(tag, value)| {
            let mut out = Vec::new();
            encode_key(tag, WireType::Varint, &mut out);
            encode_varint(value, &mut out);
            out
        }),
        (17u32..20_000, any::<[u8; 4]>()).prop_map(move |(tag, value)| bytes(
            tag,
            WireType::ThirtyTwoBit,
            &value
        )),
        (17u32..20_000, any::<[u8; 8]>()).prop_map(move |(tag, value)| bytes(
            tag,
            WireType::SixtyFourBit,
            &value
        )),
        Just(vec![0x38, 0]),
        Just(vec![0x38, 0x80, 0]),
        (0u8..128).prop_map(|size| vec![0x40, size]),
    ]
}

prop_compose! {
    fn any_header()(
        topic in "[a-z/]{1,200}",
        texts in proptest::collection::vec("[ -~äé]{0,60}", 6),
        epoch: u64,
        writer: [u8; 16],
        sequence in 1u64..,
        publish_time_ns: u64,
        numbers: (u32, u32, u64, u32),
        priority in prop_oneof![
            Just(None),
            Just(Some(Priority::Control)),
            Just(Some(Priority::Bulk)),
        ],
        reliable: bool,
    ) -> Header {
        let text = |at: usize| texts[at].clone();
        let origin =
            Origin { layer: text(0), node: text(1), service: text(2), instance: text(3), epoch };
        Header {
            encoding: text(4),
            traceparent: text(5),
            type_hash: text(4),
            lifespan_ms: numbers.0,
            hops: numbers.1,
            age_us: numbers.2,
            depth: numbers.3,
            priority,
            reliable,
            ..Header::new(&topic, origin, WriterId(writer), sequence, publish_time_ns)
        }
    }
}

proptest! {
    #[test]
    fn any_header_comes_back_byte_for_byte(
        header in any_header(),
        strange in proptest::collection::vec(strange_field(), 0..6),
        order in any::<u64>(),
        size in 0usize..3_000,
        beside in proptest::option::of((any::<u32>(), any::<u64>())),
    ) {
        let mut fields = split(&Frame::new(&header, Bytes::new()).unwrap().head()[PREFIX_BYTES..]);
        fields.extend(strange);
        let count = fields.len() as u64;
        let mut mixed = order;
        for at in 0..fields.len() {
            mixed =
                mixed.wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            fields.swap(at, usize::try_from((mixed >> 33) % count).unwrap());
        }
        let mut original = from_header_bytes(&fields.concat(), &[7; 3_000][..size]).unwrap();
        if let Some((hops, age_us)) = beside {
            original = original.with_hops_and_age(hops, age_us);
        }
        let packed = original.compressed(Bytes::from_static(b"packed"), size as u64).unwrap();
        prop_assert_eq!(packed.uncompressed_bytes(), size as u64);
        let back = packed.decompressed(original.payload().clone()).unwrap();
        prop_assert_eq!(&back, &original);
        let received =
            Frame::parse(packed.to_bytes()).unwrap().decompressed(original.payload().clone())
            .unwrap();
        prop_assert_eq!(received.to_bytes(), original.to_bytes());
    }

    #[test]
    fn random_headers_never_panic(header in proptest::collection::vec(any::<u8>(), 0..60),
        more: bool) {
        let mut bytes = header;
        if more {
            bytes.extend_from_slice(&frame().head()[PREFIX_BYTES..]);
        }
        if let Ok(frame) = from_header_bytes(&bytes, b"p") {
            let announced = usize::try_from(frame.uncompressed_bytes().min(100)).unwrap();
            let _ = frame.decompressed(Bytes::from(vec![0; announced]));
            if let Ok(packed) = frame.compressed(Bytes::new(), 1) {
                prop_assert_eq!(packed.decompressed(frame.payload().clone()).unwrap(), frame);
            }
        }
    }
}
