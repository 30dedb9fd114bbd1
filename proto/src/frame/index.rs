//! Where the parts of an encoded header stand: one pass, no allocation.

use std::ops::Range;

use blaze_domain::WriterId;
use bytes::Buf;
use prost::encoding::{WireType, decode_key, decode_varint};

use super::{AGE_TAG, FrameError, HOPS_TAG};

/// Places of the texts inside the encoded header, and the numbers that every hop needs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Index {
    pub(super) topic: Range<u16>,
    pub(super) layer: Range<u16>,
    pub(super) node: Range<u16>,
    pub(super) service: Range<u16>,
    pub(super) instance: Range<u16>,
    pub(super) encoding: Range<u16>,
    pub(super) type_hash: Range<u16>,
    pub(super) traceparent: Range<u16>,
    pub(super) origin_epoch: u64,
    pub(super) writer: WriterId,
    pub(super) sequence: u64,
    pub(super) publish_time_ns: u64,
    pub(super) compression: i32,
    pub(super) uncompressed_bytes: u64,
    pub(super) lifespan_ms: u32,
    pub(super) priority: i32,
    pub(super) reliable: bool,
    pub(super) depth: u32,
    pub(super) related_writer: Option<WriterId>,
    pub(super) related_sequence: u64,
    pub(super) to: Range<u16>,
    /// Where hops and age stand in the header, to be left out when they are written anew.
    pub(super) hops_at: Range<u16>,
    pub(super) age_at: Range<u16>,
    /// Hops and age as the header has them.
    pub(super) encoded_hops: u32,
    pub(super) encoded_age_us: u64,
}

pub(super) fn usize_range(range: &Range<u16>) -> Range<usize> {
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
        let value =
            decode_varint(&mut rest).map_err(|error| FrameError::Header(error.to_string()))?;
        self.at += before - rest.len();
        Ok(value)
    }

    fn take(&mut self, count: usize) -> Result<Range<u16>, FrameError> {
        let needed = self.at.saturating_add(count);
        if needed > self.end {
            return Err(FrameError::Truncated { found: self.end, needed });
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
        let (tag, wire_type) =
            decode_key(&mut rest).map_err(|error| FrameError::Header(error.to_string()))?;
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
                let length =
                    usize::try_from(length).map_err(|_| FrameError::HeaderTooLarge(usize::MAX))?;
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
    pub(super) fn read(header: &[u8]) -> Result<Self, FrameError> {
        let mut index = Self::default();
        let mut has_writer = false;
        let mut fields = Fields { whole: header, at: 0, end: header.len() };
        loop {
            let start = fields.at;
            let Some((tag, value)) = fields.next()? else { break };
            match (tag, value) {
                (1, Value::Bytes(place)) => index.topic = utf8(header, place, "topic")?,
                (2, Value::Bytes(place)) => index.read_origin(header, &place)?,
                (3, Value::Bytes(place)) => {
                    index.writer = writer(header, &place, "writer")?;
                    has_writer = true;
                }
                (4, Value::Varint(value)) => index.sequence = value,
                (5, Value::Fixed64(value)) => index.publish_time_ns = value,
                (6, Value::Bytes(place)) => index.encoding = utf8(header, place, "encoding")?,
                (7, Value::Varint(value)) => {
                    index.compression = i32::try_from(value).unwrap_or(i32::MAX);
                }
                (8, Value::Varint(value)) => index.uncompressed_bytes = value,
                (9, Value::Varint(value)) => {
                    index.lifespan_ms = u32::try_from(value).unwrap_or(u32::MAX);
                }
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
                    index.traceparent = utf8(header, place, "traceparent")?;
                }
                (15, Value::Varint(value)) => index.reliable = value != 0,
                (16, Value::Varint(value)) => {
                    index.depth = u32::try_from(value).unwrap_or(u32::MAX);
                }
                // Empty is as good as absent.
                (17, Value::Bytes(place)) if place.is_empty() => {}
                (17, Value::Bytes(place)) => {
                    index.related_writer = Some(writer(header, &place, "related_writer")?);
                }
                (18, Value::Varint(value)) => index.related_sequence = value,
                (19, Value::Bytes(place)) => index.to = utf8(header, place, "to")?,
                (1..=19, _) => {
                    return Err(FrameError::Header(format!("field {tag} has the wrong wire type")));
                }
                _ => {} // a newer version may have more fields
            }
        }
        if !has_writer {
            return Err(FrameError::Field { field: "writer", reason: "is missing" });
        }
        if index.sequence == 0 {
            return Err(FrameError::Field { field: "sequence", reason: "must be 1 or more" });
        }
        if index.topic.is_empty() {
            return Err(FrameError::Field { field: "topic", reason: "is missing" });
        }
        Ok(index)
    }

    fn read_origin(&mut self, header: &[u8], place: &Range<u16>) -> Result<(), FrameError> {
        let place = usize_range(place);
        let mut fields = Fields { whole: header, at: place.start, end: place.end };
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

fn writer(header: &[u8], place: &Range<u16>, field: &'static str) -> Result<WriterId, FrameError> {
    let bytes = header[usize_range(place)].try_into();
    bytes.map(WriterId).map_err(|_| FrameError::Field { field, reason: "must have 16 bytes" })
}

fn utf8(header: &[u8], place: Range<u16>, field: &'static str) -> Result<Range<u16>, FrameError> {
    std::str::from_utf8(&header[usize_range(&place)])
        .map_err(|_| FrameError::Field { field, reason: "is not UTF-8" })?;
    Ok(place)
}

fn refuse_repeat(place: &Range<u16>, field: &'static str) -> Result<(), FrameError> {
    // A second one would survive when the first is cut out and written anew.
    if place.is_empty() {
        Ok(())
    } else {
        Err(FrameError::Field { field, reason: "is given twice" })
    }
}

fn place_of(start: usize, end: usize) -> Result<Range<u16>, FrameError> {
    let narrow = |at: usize| u16::try_from(at).map_err(|_| FrameError::HeaderTooLarge(at));
    Ok(narrow(start)?..narrow(end)?)
}
