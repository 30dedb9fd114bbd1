//! LZ4 blocks: payloads are compressed for the inter scope, and what comes from there is taken
//! apart with distrust.
//!
//! A block does not say how long it was; the message header does (`uncompressed_bytes`). The
//! sender may have written any number there and any bytes after it, so nothing is believed: the
//! size is checked before memory is taken for it, and the result must have that size exactly.

use ::lz4::block::{CompressionMode, compress_to_buffer, decompress_to_buffer};
use blaze_domain::MAX_PAYLOAD_BYTES;
use bytes::Bytes;

#[cfg(test)]
pub(super) mod image;
#[cfg(test)]
mod tests;

/// Highest level; the lowest one is 1.
pub const HIGHEST_LEVEL: u8 = 12;
/// The first level of LZ4's high compression.
const FIRST_HIGH_LEVEL: u8 = 3;
/// What one byte of a block can expand to at most: one that lengthens a match by 255 bytes.
const MOST_OF_ONE_BYTE: u64 = 255;
/// LZ4 finds nothing in fewer bytes. Its levels above 9 must not even be given nothing: they read
/// from the address of an empty slice, and there is no memory.
const SMALLEST: usize = 13;
/// A payload that stays larger than this part of it, in percent, goes as it is: to take it apart
/// would cost more than it saves.
const WORTHWHILE_PERCENT: usize = 97;

/// Why a payload from the inter scope is not taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The announced size is that of no payload.
    #[error("announces {announced} bytes, at most {MAX_PAYLOAD_BYTES} are allowed")]
    TooLarge {
        /// What the header says.
        announced: u64,
    },
    /// The announced size cannot come from so few bytes.
    #[error("announces {announced} bytes, {found} compressed ones cannot be so many")]
    Impossible {
        /// What the header says.
        announced: u64,
        /// Bytes of the block.
        found: usize,
    },
    /// The block itself is larger than any payload.
    #[error("a block of {found} bytes, at most {MAX_PAYLOAD_BYTES} are allowed")]
    BlockTooLarge {
        /// Bytes of the block.
        found: usize,
    },
    /// The bytes are no LZ4 block, or one that holds more than was announced.
    #[error("no LZ4 block of {announced} bytes")]
    Damaged {
        /// What the header says.
        announced: u64,
    },
    /// The block holds fewer bytes than were announced.
    #[error("announces {announced} bytes and holds {found}")]
    OtherSize {
        /// What the header says.
        announced: u64,
        /// Bytes that were in it.
        found: usize,
    },
}

/// Compresses a payload at a level of the node file: 1 and 2 are LZ4's fast mode (LZ4 has no step
/// between them), 3 to 12 its high compression; others count as the nearest one.
///
/// `None`: it goes as it is, because it would not become at least 3 % smaller (less a few bytes
/// that LZ4 keeps free at its end), or is larger than a payload may be. Takes no more memory than
/// the payload has, besides 256 KiB that LZ4 works with.
#[must_use]
pub fn compress(payload: &[u8], level: u8) -> Option<Bytes> {
    if !(SMALLEST..=MAX_PAYLOAD_BYTES).contains(&payload.len()) {
        return None;
    }
    let mode = if level < FIRST_HIGH_LEVEL {
        CompressionMode::FAST(1)
    } else {
        CompressionMode::HIGHCOMPRESSION(level.min(HIGHEST_LEVEL).into())
    };
    // LZ4 gives up as soon as the result has no room here: what is not worth it takes no more time
    // than it must.
    let mut block = vec![0; payload.len() * WORTHWHILE_PERCENT / 100];
    let length = compress_to_buffer(payload, Some(mode), false, &mut block).ok()?;
    block.truncate(length);
    // Queues count the bytes of a message; it must not hold more than these.
    block.shrink_to_fit();
    Some(block.into())
}

/// Takes a block apart that announces its size. No memory is taken before that size is
/// [checked](announced_size); then exactly the announced size, whatever the block holds. The time
/// is linear in both sizes.
///
/// # Errors
/// [`Refused`]; nothing of the block is given then.
pub fn decompress(block: &[u8], announced: u64) -> Result<Bytes, Refused> {
    let (size, narrow) = check(block.len(), announced)?;
    let mut payload = vec![0; size];
    let found = decompress_to_buffer(block, Some(narrow), &mut payload)
        .map_err(|_| Refused::Damaged { announced })?;
    if found == size { Ok(payload.into()) } else { Err(Refused::OtherSize { announced, found }) }
}

/// The size that a block of so many bytes announces, if it may have it: that of a payload, and no
/// more than so many bytes can hold at all.
///
/// # Errors
/// [`Refused`].
pub fn announced_size(block: usize, announced: u64) -> Result<usize, Refused> {
    check(block, announced).map(|(size, _)| size)
}

/// The announced size, the second time as LZ4 wants it.
fn check(block: usize, announced: u64) -> Result<(usize, i32), Refused> {
    if block > MAX_PAYLOAD_BYTES {
        return Err(Refused::BlockTooLarge { found: block });
    }
    let too_large = Refused::TooLarge { announced };
    let size = usize::try_from(announced).map_err(|_| too_large)?;
    if size > MAX_PAYLOAD_BYTES {
        return Err(too_large);
    }
    if announced > block as u64 * MOST_OF_ONE_BYTE {
        return Err(Refused::Impossible { announced, found: block });
    }
    Ok((size, i32::try_from(size).map_err(|_| too_large)?))
}
