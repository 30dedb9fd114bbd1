//! A message as it lies on a broker and on the link.
//!
//! ```text
//! "BLZ1" | u32 little-endian header length (at most 4096) | header (protobuf) | payload (at most 16 MiB)
//! ```
//!
//! [`Frame::parse`] looks at the header once, without an allocation: texts stay where they are and are found by their
//! place. Hops and age change on the way; [`Frame::with_hops_and_age`] notes them beside the bytes, and only a writer
//! that puts the frame on a broker encodes them ([`Frame::head_to_write`]). The payload is never copied here.

use std::ops::Range;

use blaze_domain::{MAX_HEADER_BYTES, MAX_PAYLOAD_BYTES, Origin, Priority, WriterId};
use bytes::{Buf, BufMut, Bytes, BytesMut};
use prost::Message as _;
use prost::encoding::{WireType, decode_key, decode_varint, encode_key, encode_varint};

use crate::{priority_from_wire, priority_to_wire, v1};

/// The first four bytes of a frame.
pub const MAGIC: [u8; 4] = *b"BLZ1";
/// Magic and header length.
pub const PREFIX_BYTES: usize = 8;
/// Largest frame.
pub const MAX_FRAME_BYTES: usize = PREFIX_BYTES + MAX_HEADER_BYTES + MAX_PAYLOAD_BYTES;

const HOPS_TAG: u32 = 12;
const AGE_TAG: u32 = 13;

/// Why bytes that claim to be a frame are none.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The bytes do not begin with `BLZ1`.
    #[error("does not begin with BLZ1")]
    Magic,
    /// Fewer bytes than the header length promises.
    #[error("ends after {found} bytes, the header needs {needed}")]
    Truncated {
        /// Bytes that there are.
        found: usize,
        /// Bytes that the prefix promises.
        needed: usize,
    },
    /// The header is longer than allowed.
    #[error("header of {0} bytes, at most {MAX_HEADER_BYTES} are allowed")]
    HeaderTooLarge(usize),
    /// The payload is longer than allowed.
    #[error("payload of {0} bytes, at most {MAX_PAYLOAD_BYTES} are allowed")]
    PayloadTooLarge(usize),
    /// The header is not valid protobuf.
    #[error("header: {0}")]
    Header(String),
    /// A field holds a value that no message may have.
    #[error("header field {field}: {reason}")]
    Field {
        /// The field's name.
        field: &'static str,
        /// What is wrong with it.
        reason: &'static str,
    },
}

/// Places of the texts inside the encoded header, and the numbers that every hop needs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
struct Index {
    topic: Range<u16>,
    layer: Range<u16>,
    node: Range<u16>,
    service: Range<u16>,
    instance: Range<u16>,
    encoding: Range<u16>,
    type_hash: Range<u16>,
    origin_epoch: u64,
    writer: WriterId,
    sequence: u64,
    publish_time_ns: u64,
    compression: i32,
    uncompressed_bytes: u64,
    lifespan_ms: u32,
    priority: i32,
    reliable: bool,
    depth: u32,
    /// Where hops and age stand in the header, to be left out when they are written anew.
    hops_at: Range<u16>,
    age_at: Range<u16>,
    /// Hops and age as the header has them.
    encoded_hops: u32,
    encoded_age_us: u64,
}

/// One message: header and payload, cheap to clone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    head: Bytes,
    payload: Bytes,
    index: Index,
    hops: u32,
    age_us: u64,
}

/// What a publisher says of a message; [`Frame::new`] encodes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// User topic.
    pub topic: String,
    /// Where it was born.
    pub origin: Origin,
    /// Publisher.
    pub writer: WriterId,
    /// 1, 2, 3 … per writer.
    pub sequence: u64,
    /// The origin's clock, nanoseconds since 1970.
    pub publish_time_ns: u64,
    /// Media type of the payload.
    pub encoding: String,
    /// Milliseconds after which it is of no use; 0 = none.
    pub lifespan_ms: u32,
    /// Class on the inter scope; absent = not said.
    pub priority: Option<Priority>,
    /// RIHS01 hash of the ROS type, or empty.
    pub type_hash: String,
    /// Flows that wrote it so far.
    pub hops: u32,
    /// Microseconds since it was published, as far as the flows could tell.
    pub age_us: u64,
    /// W3C trace context, or empty.
    pub traceparent: String,
    /// The publisher advertised it as reliable.
    pub reliable: bool,
    /// Samples kept per writer; 0 = volatile.
    pub depth: u32,
}

impl Header {
    /// A header with the parts that every message has; the rest is empty, absent or zero.
    #[must_use]
    pub fn new(topic: &str, origin: Origin, writer: WriterId, sequence: u64, publish_time_ns: u64) -> Self {
        Self {
            topic: topic.to_owned(),
            origin,
            writer,
            sequence,
            publish_time_ns,
            encoding: String::new(),
            lifespan_ms: 0,
            priority: None,
            type_hash: String::new(),
            hops: 0,
            age_us: 0,
            traceparent: String::new(),
            reliable: false,
            depth: 0,
        }
    }

    fn to_wire(&self) -> v1::MessageHeader {
        v1::MessageHeader {
            topic: self.topic.clone(),
            origin: Some(v1::Origin {
                layer: self.origin.layer.clone(),
                node: self.origin.node.clone(),
                service: self.origin.service.clone(),
                instance: self.origin.instance.clone(),
                epoch: self.origin.epoch,
            }),
            writer: Bytes::copy_from_slice(&self.writer.0),
            sequence: self.sequence,
            publish_time_ns: self.publish_time_ns,
            encoding: self.encoding.clone(),
            compression: 0,
            uncompressed_bytes: 0,
            lifespan_ms: self.lifespan_ms,
            priority: self.priority.map_or(0, priority_to_wire),
            type_hash: self.type_hash.clone(),
            hops: self.hops,
            age_us: self.age_us,
            traceparent: self.traceparent.clone(),
            reliable: self.reliable,
            depth: self.depth,
        }
    }
}

/// Whether bytes claim to be a frame; anything else is a bare payload.
#[must_use]
pub fn claims_to_be_a_frame(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC)
}

impl Frame {
    /// Encodes a header for a payload.
    ///
    /// # Errors
    /// [`FrameError::HeaderTooLarge`], [`FrameError::PayloadTooLarge`], or [`FrameError::Field`] for a sequence of 0.
    pub fn new(header: &Header, payload: Bytes) -> Result<Self, FrameError> {
        let wire = header.to_wire();
        let length = wire.encoded_len();
        if length > MAX_HEADER_BYTES {
            return Err(FrameError::HeaderTooLarge(length));
        }
        let mut head = BytesMut::with_capacity(PREFIX_BYTES + length);
        head.put_slice(&MAGIC);
        head.put_u32_le(u32::try_from(length).map_err(|_| FrameError::HeaderTooLarge(length))?);
        wire.encode(&mut head)
            .map_err(|error| FrameError::Header(error.to_string()))?;
        Self::from_parts(head.freeze(), payload)
    }

    /// Reads a frame. The parts share the given memory.
    ///
    /// # Errors
    /// What is wrong with it, see [`FrameError`].
    pub fn parse(mut whole: Bytes) -> Result<Self, FrameError> {
        let head_bytes = Self::head_length(&whole)?;
        if whole.len() < head_bytes {
            return Err(FrameError::Truncated {
                found: whole.len(),
                needed: head_bytes,
            });
        }
        let head = whole.split_to(head_bytes);
        Self::from_parts(head, whole)
    }

    /// Bytes of prefix and header, as the prefix says.
    ///
    /// # Errors
    /// [`FrameError::Magic`], [`FrameError::Truncated`] or [`FrameError::HeaderTooLarge`].
    pub fn head_length(bytes: &[u8]) -> Result<usize, FrameError> {
        if !claims_to_be_a_frame(bytes) {
            return Err(FrameError::Magic);
        }
        let Some(length) = bytes.get(4..PREFIX_BYTES) else {
            return Err(FrameError::Truncated {
                found: bytes.len(),
                needed: PREFIX_BYTES,
            });
        };
        let length = u32::from_le_bytes([length[0], length[1], length[2], length[3]]) as usize;
        if length > MAX_HEADER_BYTES {
            return Err(FrameError::HeaderTooLarge(length));
        }
        Ok(PREFIX_BYTES + length)
    }

    /// A frame from its encoded prefix and header, and its payload, which may lie elsewhere.
    ///
    /// # Errors
    /// What is wrong with it, see [`FrameError`].
    pub fn from_parts(head: Bytes, payload: Bytes) -> Result<Self, FrameError> {
        let needed = Self::head_length(&head)?;
        if head.len() != needed {
            return Err(FrameError::Truncated {
                found: head.len(),
                needed,
            });
        }
        if payload.len() > MAX_PAYLOAD_BYTES {
            return Err(FrameError::PayloadTooLarge(payload.len()));
        }
        let index = Index::read(&head[PREFIX_BYTES..])?;
        let (hops, age_us) = (index.encoded_hops, index.encoded_age_us);
        Ok(Self {
            head,
            payload,
            index,
            hops,
            age_us,
        })
    }

    /// The same message with other hops and age.
    #[must_use]
    pub fn with_hops_and_age(mut self, hops: u32, age_us: u64) -> Self {
        self.hops = hops;
        self.age_us = age_us;
        self
    }

    /// Prefix and header as they came; hops and age in them may be old.
    #[must_use]
    pub fn head(&self) -> &Bytes {
        &self.head
    }

    /// Prefix and header with today's hops and age: what a writer to a broker sends before the payload.
    #[must_use]
    pub fn head_to_write(&self) -> Bytes {
        let index = &self.index;
        if self.hops == index.encoded_hops && self.age_us == index.encoded_age_us {
            return self.head.clone();
        }
        let header = &self.head[PREFIX_BYTES..];
        let mut out = BytesMut::with_capacity(self.head.len() + 20);
        out.put_slice(&MAGIC);
        out.put_u32_le(0);
        let mut cuts = [usize_range(&index.hops_at), usize_range(&index.age_at)];
        cuts.sort_by_key(|cut| cut.start);
        let mut from = 0;
        for cut in cuts.iter().filter(|cut| !cut.is_empty()) {
            out.put_slice(&header[from..cut.start]);
            from = cut.end;
        }
        out.put_slice(&header[from..]);
        if self.hops != 0 {
            encode_key(HOPS_TAG, WireType::Varint, &mut out);
            encode_varint(u64::from(self.hops), &mut out);
        }
        if self.age_us != 0 {
            encode_key(AGE_TAG, WireType::Varint, &mut out);
            encode_varint(self.age_us, &mut out);
        }
        let length = u32::try_from(out.len() - PREFIX_BYTES).unwrap_or(u32::MAX);
        out[4..PREFIX_BYTES].copy_from_slice(&length.to_le_bytes());
        out.freeze()
    }

    /// The whole frame in one piece, with today's hops and age. Copies the payload.
    #[must_use]
    pub fn to_bytes(&self) -> Bytes {
        let head = self.head_to_write();
        let mut out = BytesMut::with_capacity(head.len() + self.payload.len());
        out.put_slice(&head);
        out.put_slice(&self.payload);
        out.freeze()
    }

    /// The payload.
    #[must_use]
    pub fn payload(&self) -> &Bytes {
        &self.payload
    }

    /// Bytes of the frame as it came: head and payload.
    #[must_use]
    pub fn wire_len(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    fn text(&self, place: &Range<u16>) -> &str {
        let place = usize_range(place);
        // `Index::read` has checked that these bytes are UTF-8.
        std::str::from_utf8(&self.head[PREFIX_BYTES + place.start..PREFIX_BYTES + place.end]).unwrap_or_default()
    }

    /// Topic.
    #[must_use]
    pub fn topic(&self) -> &str {
        self.text(&self.index.topic)
    }

    /// Layer where it was born.
    #[must_use]
    pub fn origin_layer(&self) -> &str {
        self.text(&self.index.layer)
    }

    /// Node where it was born; empty = not said.
    #[must_use]
    pub fn origin_node(&self) -> &str {
        self.text(&self.index.node)
    }

    /// Service that published it; empty = not said.
    #[must_use]
    pub fn origin_service(&self) -> &str {
        self.text(&self.index.service)
    }

    /// Instance of that service.
    #[must_use]
    pub fn origin_instance(&self) -> &str {
        self.text(&self.index.instance)
    }

    /// The whole origin, in texts of its own.
    #[must_use]
    pub fn origin(&self) -> Origin {
        Origin {
            layer: self.origin_layer().to_owned(),
            node: self.origin_node().to_owned(),
            service: self.origin_service().to_owned(),
            instance: self.origin_instance().to_owned(),
            epoch: self.index.origin_epoch,
        }
    }

    /// Media type of the payload.
    #[must_use]
    pub fn encoding(&self) -> &str {
        self.text(&self.index.encoding)
    }

    /// RIHS01 hash of the ROS type, or empty.
    #[must_use]
    pub fn type_hash(&self) -> &str {
        self.text(&self.index.type_hash)
    }

    /// Publisher.
    #[must_use]
    pub fn writer(&self) -> WriterId {
        self.index.writer
    }

    /// Number of the message, per writer.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.index.sequence
    }

    /// The origin's clock at publication, nanoseconds since 1970.
    #[must_use]
    pub fn publish_time_ns(&self) -> u64 {
        self.index.publish_time_ns
    }

    /// Milliseconds after which it is of no use; 0 = none.
    #[must_use]
    pub fn lifespan_ms(&self) -> u32 {
        self.index.lifespan_ms
    }

    /// Class that the publisher gave, if it gave one.
    #[must_use]
    pub fn priority(&self) -> Option<Priority> {
        matches!(self.index.priority, 1..=3).then(|| priority_from_wire(self.index.priority))
    }

    /// Whether the publisher advertised it as reliable.
    #[must_use]
    pub fn reliable(&self) -> bool {
        self.index.reliable
    }

    /// Samples kept per writer for late joiners; 0 = volatile.
    #[must_use]
    pub fn depth(&self) -> u32 {
        self.index.depth
    }

    /// Whether the payload is compressed (inter scope only).
    #[must_use]
    pub fn is_compressed(&self) -> bool {
        self.index.compression != 0
    }

    /// Flows that wrote it so far.
    #[must_use]
    pub fn hops(&self) -> u32 {
        self.hops
    }

    /// Microseconds since it was published.
    #[must_use]
    pub fn age_us(&self) -> u64 {
        self.age_us
    }
}

fn usize_range(range: &Range<u16>) -> Range<usize> {
    usize::from(range.start)..usize::from(range.end)
}

/// Walks over the fields of one protobuf message inside `whole`.
struct Fields<'a> {
    whole: &'a [u8],
    at: usize,
    end: usize,
}

enum Value {
    Varint(u64),
    Fixed64(u64),
    Bytes(Range<u16>),
    Other,
}

impl Fields<'_> {
    fn varint(&mut self) -> Result<u64, FrameError> {
        let mut rest = &self.whole[self.at..self.end];
        let before = rest.len();
        let value = decode_varint(&mut rest).map_err(|error| FrameError::Header(error.to_string()))?;
        self.at += before - rest.len();
        Ok(value)
    }

    fn take(&mut self, count: usize) -> Result<Range<u16>, FrameError> {
        let needed = self.at.saturating_add(count);
        if needed > self.end {
            return Err(FrameError::Truncated {
                found: self.end,
                needed,
            });
        }
        // The header has at most 4096 bytes.
        let narrow = |at: usize| u16::try_from(at).map_err(|_| FrameError::HeaderTooLarge(at));
        let place = narrow(self.at)?..narrow(needed)?;
        self.at = needed;
        Ok(place)
    }

    fn next(&mut self) -> Result<Option<(u32, Value)>, FrameError> {
        if self.at >= self.end {
            return Ok(None);
        }
        let mut rest = &self.whole[self.at..self.end];
        let before = rest.len();
        let (tag, wire_type) = decode_key(&mut rest).map_err(|error| FrameError::Header(error.to_string()))?;
        self.at += before - rest.len();
        let value = match wire_type {
            WireType::Varint => Value::Varint(self.varint()?),
            WireType::SixtyFourBit => {
                let place = usize_range(&self.take(8)?);
                Value::Fixed64((&self.whole[place]).get_u64_le())
            }
            WireType::ThirtyTwoBit => {
                self.take(4)?;
                Value::Other
            }
            WireType::LengthDelimited => {
                let length = self.varint()?;
                let length = usize::try_from(length).map_err(|_| FrameError::HeaderTooLarge(usize::MAX))?;
                Value::Bytes(self.take(length)?)
            }
            WireType::StartGroup | WireType::EndGroup => {
                return Err(FrameError::Header("groups are not part of the header".to_owned()));
            }
        };
        Ok(Some((tag, value)))
    }
}

impl Index {
    fn read(header: &[u8]) -> Result<Self, FrameError> {
        let mut index = Self::default();
        let mut has_writer = false;
        let mut fields = Fields {
            whole: header,
            at: 0,
            end: header.len(),
        };
        loop {
            let start = fields.at;
            let Some((tag, value)) = fields.next()? else { break };
            match (tag, value) {
                (1, Value::Bytes(place)) => index.topic = utf8(header, place, "topic")?,
                (2, Value::Bytes(place)) => index.read_origin(header, &place)?,
                (3, Value::Bytes(place)) => {
                    let bytes = &header[usize_range(&place)];
                    index.writer = WriterId(bytes.try_into().map_err(|_| FrameError::Field {
                        field: "writer",
                        reason: "must have 16 bytes",
                    })?);
                    has_writer = true;
                }
                (4, Value::Varint(value)) => index.sequence = value,
                (5, Value::Fixed64(value)) => index.publish_time_ns = value,
                (6, Value::Bytes(place)) => index.encoding = utf8(header, place, "encoding")?,
                (7, Value::Varint(value)) => index.compression = i32::try_from(value).unwrap_or(i32::MAX),
                (8, Value::Varint(value)) => index.uncompressed_bytes = value,
                (9, Value::Varint(value)) => index.lifespan_ms = u32::try_from(value).unwrap_or(u32::MAX),
                (10, Value::Varint(value)) => index.priority = i32::try_from(value).unwrap_or(0),
                (11, Value::Bytes(place)) => index.type_hash = utf8(header, place, "type_hash")?,
                (HOPS_TAG, Value::Varint(value)) => {
                    refuse_repeat(&index.hops_at, "hops")?;
                    index.encoded_hops = u32::try_from(value).unwrap_or(u32::MAX);
                    index.hops_at = place_of(start, fields.at)?;
                }
                (AGE_TAG, Value::Varint(value)) => {
                    refuse_repeat(&index.age_at, "age_us")?;
                    index.encoded_age_us = value;
                    index.age_at = place_of(start, fields.at)?;
                }
                (14, Value::Bytes(place)) => {
                    utf8(header, place, "traceparent")?;
                }
                (15, Value::Varint(value)) => index.reliable = value != 0,
                (16, Value::Varint(value)) => index.depth = u32::try_from(value).unwrap_or(u32::MAX),
                (1..=16, _) => {
                    return Err(FrameError::Header(format!("field {tag} has the wrong wire type")));
                }
                _ => {} // a newer version may have more fields
            }
        }
        if !has_writer {
            return Err(FrameError::Field {
                field: "writer",
                reason: "is missing",
            });
        }
        if index.sequence == 0 {
            return Err(FrameError::Field {
                field: "sequence",
                reason: "must be 1 or more",
            });
        }
        if index.topic.is_empty() {
            return Err(FrameError::Field {
                field: "topic",
                reason: "is missing",
            });
        }
        Ok(index)
    }

    fn read_origin(&mut self, header: &[u8], place: &Range<u16>) -> Result<(), FrameError> {
        let place = usize_range(place);
        let mut fields = Fields {
            whole: header,
            at: place.start,
            end: place.end,
        };
        while let Some((tag, value)) = fields.next()? {
            match (tag, value) {
                (1, Value::Bytes(place)) => self.layer = utf8(header, place, "origin.layer")?,
                (2, Value::Bytes(place)) => self.node = utf8(header, place, "origin.node")?,
                (3, Value::Bytes(place)) => self.service = utf8(header, place, "origin.service")?,
                (4, Value::Bytes(place)) => self.instance = utf8(header, place, "origin.instance")?,
                (5, Value::Varint(value)) => self.origin_epoch = value,
                (1..=5, _) => {
                    return Err(FrameError::Header(format!(
                        "origin field {tag} has the wrong wire type"
                    )));
                }
                _ => {}
            }
        }
        Ok(())
    }
}

fn utf8(header: &[u8], place: Range<u16>, field: &'static str) -> Result<Range<u16>, FrameError> {
    std::str::from_utf8(&header[usize_range(&place)]).map_err(|_| FrameError::Field {
        field,
        reason: "is not UTF-8",
    })?;
    Ok(place)
}

fn refuse_repeat(place: &Range<u16>, field: &'static str) -> Result<(), FrameError> {
    // A second one would survive when the first is cut out and written anew.
    if place.is_empty() {
        Ok(())
    } else {
        Err(FrameError::Field {
            field,
            reason: "is given twice",
        })
    }
}

fn place_of(start: usize, end: usize) -> Result<Range<u16>, FrameError> {
    let narrow = |at: usize| u16::try_from(at).map_err(|_| FrameError::HeaderTooLarge(at));
    Ok(narrow(start)?..narrow(end)?)
}

#[cfg(test)]
mod tests {
    use super::*;
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
        assert_eq!(
            (frame.sequence(), frame.publish_time_ns()),
            (42, 1_700_000_000_000_000_000)
        );
        assert_eq!((frame.encoding(), frame.type_hash()), ("application/json", "RIHS01_00"));
        assert_eq!((frame.lifespan_ms(), frame.priority()), (500, Some(Priority::State)));
        assert_eq!((frame.reliable(), frame.depth()), (true, 3));
        assert_eq!((frame.hops(), frame.age_us()), (1, 77));
        assert_eq!(&frame.payload()[..], b"payload");
    }

    #[test]
    fn hops_and_age_are_written_anew_and_the_rest_stays() {
        let frame = Frame::new(&header(), Bytes::from_static(b"p")).unwrap();
        let written = frame.clone().with_hops_and_age(2, 1_000_000).to_bytes();
        let again = Frame::parse(written.clone()).unwrap();
        assert_eq!((again.hops(), again.age_us()), (2, 1_000_000));
        let decoded = v1::MessageHeader::decode(&again.head()[PREFIX_BYTES..]).unwrap();
        assert_eq!(
            decoded,
            v1::MessageHeader {
                hops: 2,
                age_us: 1_000_000,
                ..header().to_wire()
            }
        );
        let back = again.with_hops_and_age(0, 0).to_bytes();
        assert_eq!(Frame::parse(back).unwrap().hops(), 0);
    }

    #[test]
    fn what_is_no_frame_is_refused_with_a_reason() {
        let good = Frame::new(&header(), Bytes::from_static(b"payload"))
            .unwrap()
            .to_bytes();
        assert_eq!(
            Frame::parse(Bytes::from_static(b"{\"a\":1}")).unwrap_err(),
            FrameError::Magic
        );
        for length in 4..good.len() - 7 {
            assert!(Frame::parse(good.slice(..length)).is_err(), "{length}");
        }
        let mut huge = BytesMut::from(&b"BLZ1"[..]);
        huge.put_u32_le(5000);
        assert_eq!(
            Frame::parse(huge.freeze()).unwrap_err(),
            FrameError::HeaderTooLarge(5000)
        );
        assert_eq!(
            Frame::new(
                &Header {
                    sequence: 0,
                    ..header()
                },
                Bytes::new()
            )
            .unwrap_err(),
            FrameError::Field {
                field: "sequence",
                reason: "must be 1 or more"
            }
        );
        let large = Bytes::from(vec![0; MAX_PAYLOAD_BYTES + 1]);
        assert_eq!(
            Frame::new(&header(), large).unwrap_err(),
            FrameError::PayloadTooLarge(MAX_PAYLOAD_BYTES + 1)
        );
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..300), framed: bool) {
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
            let mut bytes = BytesMut::from(&Frame::new(&header(), Bytes::from_static(b"x")).unwrap().to_bytes()[..]);
            let at = at % bytes.len();
            bytes[at] = value;
            let _ = Frame::parse(bytes.freeze());
        }
    }
}
