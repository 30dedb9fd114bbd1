//! The payload of a frame, compressed for the inter scope, and as it was.
//!
//! ```text
//! fields of the publisher ──compressed──► fields of the publisher, 7: compression, 8: uncompressed_bytes
//!                         ◄─decompressed─
//! ```
//!
//! The two fields are put behind the others and cut out again, so that the header that comes back
//! is, byte for byte, the one that went in: with fields that this version does not know, and in the
//! order that another implementation chose.

use std::ops::Range;

use blaze_domain::MAX_PAYLOAD_BYTES;
use bytes::{BufMut, Bytes, BytesMut};
use prost::encoding::{
    DecodeContext, WireType, decode_key, encode_key, encode_varint, encoded_len_varint, key_len,
    skip_field,
};

use super::{Frame, FrameError, LONGEST_HEADER_BYTES, MAGIC, PREFIX_BYTES};

#[cfg(test)]
mod tests;

const COMPRESSION_TAG: u32 = 7;
const UNCOMPRESSED_BYTES_TAG: u32 = 8;
/// `COMPRESSION_LZ4_BLOCK`.
const LZ4_BLOCK: i32 = 1;

/// How the payload of a frame is compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// Not at all.
    None,
    /// One LZ4 block without a size of its own; [`Frame::uncompressed_bytes`] has it.
    Lz4Block,
    /// In a way that this version does not know: the number in the header, or the largest one if
    /// that has no 32 bits.
    Unknown(i32),
}

impl Frame {
    /// How the payload is compressed.
    #[must_use]
    pub fn compression(&self) -> Compression {
        match self.index.compression {
            0 => Compression::None,
            LZ4_BLOCK => Compression::Lz4Block,
            other => Compression::Unknown(other),
        }
    }

    /// Bytes of the payload before it was compressed, as the sender says; 0 where it is not
    /// compressed. Any number may stand there: it is to be checked before memory is taken for it.
    #[must_use]
    pub fn uncompressed_bytes(&self) -> u64 {
        self.index.uncompressed_bytes
    }

    /// The same message with its payload as an LZ4 block that was `uncompressed_bytes` long. Hops
    /// and age stay beside it.
    ///
    /// # Errors
    /// [`FrameError::HeaderTooLarge`] if the header has no room for the two fields (at most 7
    /// bytes): then the message goes as it is. [`FrameError::Field`] if it is compressed already,
    /// [`FrameError::PayloadTooLarge`] if one of the sizes is not allowed.
    pub fn compressed(&self, payload: Bytes, uncompressed_bytes: u64) -> Result<Self, FrameError> {
        if self.is_compressed() {
            return Err(FrameError::Field { field: "compression", reason: "is set already" });
        }
        let uncompressed = usize::try_from(uncompressed_bytes).unwrap_or(usize::MAX);
        if uncompressed > MAX_PAYLOAD_BYTES {
            return Err(FrameError::PayloadTooLarge(uncompressed));
        }
        let header = &self.head[PREFIX_BYTES..];
        let added = key_len(COMPRESSION_TAG)
            + 1
            + key_len(UNCOMPRESSED_BYTES_TAG)
            + encoded_len_varint(uncompressed_bytes);
        let mut head = begin(header.len() + added)?;
        head.put_slice(header);
        // Written even if it is 0, so that what is cut out again is what was added.
        encode_key(COMPRESSION_TAG, WireType::Varint, &mut head);
        encode_varint(LZ4_BLOCK.unsigned_abs().into(), &mut head);
        encode_key(UNCOMPRESSED_BYTES_TAG, WireType::Varint, &mut head);
        encode_varint(uncompressed_bytes, &mut head);
        self.with_head(head, payload)
    }

    /// The same message with its payload as it was before [`Frame::compressed`]. Hops and age stay
    /// beside it.
    ///
    /// # Errors
    /// [`FrameError::Field`] if it is not an LZ4 block, says so twice, or announced another size
    /// than that of `payload`; [`FrameError::PayloadTooLarge`].
    pub fn decompressed(&self, payload: Bytes) -> Result<Self, FrameError> {
        if self.compression() != Compression::Lz4Block {
            return Err(FrameError::Field { field: "compression", reason: "is not LZ4_BLOCK" });
        }
        if payload.len() as u64 != self.uncompressed_bytes() {
            return Err(FrameError::Field {
                field: "uncompressed_bytes",
                reason: "is not the size of the payload",
            });
        }
        let head = self.head_without([COMPRESSION_TAG, UNCOMPRESSED_BYTES_TAG], 0)?;
        let frame = self.with_head(head, payload)?;
        if frame.is_compressed() {
            // Each new reading of it would be compressed once more.
            return Err(FrameError::Field { field: "compression", reason: "is given twice" });
        }
        Ok(frame)
    }

    /// Prefix and header without the last of each of these fields, with room for more bytes. Of
    /// several of one kind the last one counts.
    pub(super) fn head_without<const N: usize>(
        &self,
        tags: [u32; N],
        room: usize,
    ) -> Result<BytesMut, FrameError> {
        let header = &self.head[PREFIX_BYTES..];
        let mut cuts = places(header, tags)?;
        cuts.sort_by_key(|cut| cut.start);
        let cut_bytes = cuts.iter().map(ExactSizeIterator::len).sum::<usize>();
        let mut head = begin(header.len() - cut_bytes + room)?;
        let mut from = 0;
        for cut in cuts.iter().filter(|cut| !cut.is_empty()) {
            head.put_slice(&header[from..cut.start]);
            from = cut.end;
        }
        head.put_slice(&header[from..]);
        Ok(head)
    }

    pub(super) fn with_head(&self, head: BytesMut, payload: Bytes) -> Result<Self, FrameError> {
        Ok(Self::from_parts(head.freeze(), payload)?.with_hops_and_age(self.hops, self.age_us))
    }
}

/// A prefix for a header of so many bytes, with room for it.
fn begin(header_bytes: usize) -> Result<BytesMut, FrameError> {
    let length =
        u32::try_from(header_bytes).map_err(|_| FrameError::HeaderTooLarge(header_bytes))?;
    if header_bytes > LONGEST_HEADER_BYTES {
        return Err(FrameError::HeaderTooLarge(header_bytes));
    }
    let mut head = BytesMut::with_capacity(PREFIX_BYTES + header_bytes);
    head.put_slice(&MAGIC);
    head.put_u32_le(length);
    Ok(head)
}

/// Where the last field of each tag stands. Empty where there is none.
fn places<const N: usize>(header: &[u8], tags: [u32; N]) -> Result<[Range<usize>; N], FrameError> {
    let mut places = std::array::from_fn(|_| 0..0);
    let mut rest = header;
    while !rest.is_empty() {
        let start = header.len() - rest.len();
        let (tag, wire_type) =
            decode_key(&mut rest).map_err(|error| FrameError::Header(error.to_string()))?;
        skip_field(wire_type, tag, &mut rest, DecodeContext::default())
            .map_err(|error| FrameError::Header(error.to_string()))?;
        if let Some(at) = tags.iter().position(|wanted| *wanted == tag) {
            places[at] = start..header.len() - rest.len();
        }
    }
    Ok(places)
}
