//! A message as it lies on a broker and on the link.
//!
//! ```text
//! "BLZ1" | u32 little-endian header length (at most 4096) | header (protobuf) | payload (at most 16 MiB)
//! ```
//!
//! [`Frame::parse`] looks at the header once, without an allocation: texts stay where they are and
//! are found by their place. Hops and age change on the way; [`Frame::with_hops_and_age`] notes
//! them beside the bytes, and only a writer that puts the frame on a broker encodes them
//! ([`Frame::head_to_write`]). Only [`Frame::to_bytes`] copies the payload.

mod addressed;
mod compressed;
mod header;
mod index;

#[cfg(test)]
mod tests;

use std::ops::Range;

use blaze_domain::{MAX_HEADER_BYTES, MAX_PAYLOAD_BYTES, Origin, Priority, WriterId};
use bytes::{BufMut, Bytes, BytesMut};
use prost::Message as _;
use prost::encoding::{WireType, encode_key, encode_varint};

pub use compressed::Compression;
pub use header::Header;
use index::{Index, usize_range};

use crate::priority_from_wire;

/// The first four bytes of a frame.
pub const MAGIC: [u8; 4] = *b"BLZ1";
/// Magic and header length.
pub const PREFIX_BYTES: usize = 8;
/// Largest frame.
pub const MAX_FRAME_BYTES: usize = PREFIX_BYTES + LONGEST_HEADER_BYTES + MAX_PAYLOAD_BYTES;

const HOPS_TAG: u32 = 12;
const AGE_TAG: u32 = 13;
/// Hops and age need at most 17 bytes: two keys of one byte, numbers of up to 5 and 10 bytes.
const HOPS_AND_AGE_BYTES: usize = 17;
/// Hops and age grow on the way, so they do not count.
const LONGEST_HEADER_BYTES: usize = MAX_HEADER_BYTES + HOPS_AND_AGE_BYTES;

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
    /// The header, with the longest hops and age, is longer than allowed.
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

/// One message: header and payload, cheap to clone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    head: Bytes,
    payload: Bytes,
    index: Index,
    hops: u32,
    age_us: u64,
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
    /// [`FrameError::HeaderTooLarge`], [`FrameError::PayloadTooLarge`], or [`FrameError::Field`]
    /// for a sequence of 0.
    pub fn new(header: &Header, payload: Bytes) -> Result<Self, FrameError> {
        let wire = header.to_wire();
        let length = wire.encoded_len();
        if length > MAX_HEADER_BYTES {
            return Err(FrameError::HeaderTooLarge(length));
        }
        let mut head = BytesMut::with_capacity(PREFIX_BYTES + length);
        head.put_slice(&MAGIC);
        head.put_u32_le(u32::try_from(length).map_err(|_| FrameError::HeaderTooLarge(length))?);
        wire.encode(&mut head).map_err(|error| FrameError::Header(error.to_string()))?;
        Self::from_parts(head.freeze(), payload)
    }

    /// Reads a frame. The parts share the given memory.
    ///
    /// # Errors
    /// What is wrong with it, see [`FrameError`].
    pub fn parse(mut whole: Bytes) -> Result<Self, FrameError> {
        let head_bytes = Self::head_length(&whole)?;
        if whole.len() < head_bytes {
            return Err(FrameError::Truncated { found: whole.len(), needed: head_bytes });
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
            return Err(FrameError::Truncated { found: bytes.len(), needed: PREFIX_BYTES });
        };
        let length = u32::from_le_bytes([length[0], length[1], length[2], length[3]]) as usize;
        if length > LONGEST_HEADER_BYTES {
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
            return Err(FrameError::Truncated { found: head.len(), needed });
        }
        if payload.len() > MAX_PAYLOAD_BYTES {
            return Err(FrameError::PayloadTooLarge(payload.len()));
        }
        let index = Index::read(&head[PREFIX_BYTES..])?;
        let lasting = needed - PREFIX_BYTES - index.hops_at.len() - index.age_at.len();
        if lasting > MAX_HEADER_BYTES {
            return Err(FrameError::HeaderTooLarge(lasting));
        }
        let (hops, age_us) = (index.encoded_hops, index.encoded_age_us);
        Ok(Self { head, payload, index, hops, age_us })
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

    /// Prefix and header with the current hops and age: what a writer to a broker sends before the
    /// payload.
    #[must_use]
    pub fn head_to_write(&self) -> Bytes {
        let index = &self.index;
        if self.hops == index.encoded_hops && self.age_us == index.encoded_age_us {
            return self.head.clone();
        }
        let header = &self.head[PREFIX_BYTES..];
        let mut out = BytesMut::with_capacity(self.head.len() + HOPS_AND_AGE_BYTES);
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
        // At most `LONGEST_HEADER_BYTES`, as `from_parts` has checked: this never fails.
        let length = u32::try_from(out.len() - PREFIX_BYTES).unwrap_or(u32::MAX);
        out[4..PREFIX_BYTES].copy_from_slice(&length.to_le_bytes());
        out.freeze()
    }

    /// The whole frame in one piece, with the current hops and age. Copies the payload.
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
    pub fn received_len(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    fn text(&self, place: &Range<u16>) -> &str {
        let place = usize_range(place);
        // `Index::read` has checked that these bytes are UTF-8.
        std::str::from_utf8(&self.head[PREFIX_BYTES + place.start..PREFIX_BYTES + place.end])
            .unwrap_or_default()
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

    /// W3C trace context, or empty.
    #[must_use]
    pub fn traceparent(&self) -> &str {
        self.text(&self.index.traceparent)
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

    /// Of a reply: writer and sequence of the request that it answers.
    #[must_use]
    pub fn related(&self) -> Option<(WriterId, u64)> {
        self.index.related_writer.map(|writer| (writer, self.index.related_sequence))
    }

    /// The flow, `layer/node`, that alone writes it to ROS 2; empty: any.
    #[must_use]
    pub fn to(&self) -> &str {
        self.text(&self.index.to)
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
