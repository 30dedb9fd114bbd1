//! A message that is for one flow.

use bytes::{BufMut, BytesMut};
use prost::encoding::{WireType, encode_key, encode_varint};

use super::{Frame, FrameError, MAX_HEADER_BYTES, PREFIX_BYTES};

/// The field `to` of the header.
const TO_TAG: u32 = 19;

impl Frame {
    /// The same, for a flow `layer/node` alone; it had none before.
    ///
    /// # Errors
    /// [`FrameError::HeaderTooLarge`].
    pub fn with_to(self, to: &str) -> Result<Self, FrameError> {
        let mut header = BytesMut::from(&self.head_to_write()[PREFIX_BYTES..]);
        encode_key(TO_TAG, WireType::LengthDelimited, &mut header);
        encode_varint(to.len() as u64, &mut header);
        header.put_slice(to.as_bytes());
        if header.len() > MAX_HEADER_BYTES {
            return Err(FrameError::HeaderTooLarge(header.len()));
        }
        let mut head = BytesMut::with_capacity(PREFIX_BYTES + header.len());
        head.put_slice(&super::MAGIC);
        let length = u32::try_from(header.len());
        head.put_u32_le(length.map_err(|_| FrameError::HeaderTooLarge(header.len()))?);
        head.put_slice(&header);
        Self::from_parts(head.freeze(), self.payload().clone())
    }
}
