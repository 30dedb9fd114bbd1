//! The payload of a frame in another encoding.

use bytes::{BufMut, Bytes};
use prost::encoding::{WireType, encode_key, encode_varint, encoded_len_varint, key_len};

use super::{Frame, FrameError};

const ENCODING_TAG: u32 = 6;
const TYPE_HASH_TAG: u32 = 11;

impl Frame {
    /// The same message with its payload in another encoding. Hops and age stay beside it.
    ///
    /// # Errors
    /// [`FrameError::HeaderTooLarge`] if the header has no room for the texts, and
    /// [`FrameError::PayloadTooLarge`].
    pub fn recoded(
        &self,
        encoding: &str,
        type_hash: &str,
        payload: Bytes,
    ) -> Result<Self, FrameError> {
        let fields = [(ENCODING_TAG, encoding), (TYPE_HASH_TAG, type_hash)];
        let fields = || fields.iter().filter(|(_, text)| !text.is_empty());
        let size = |(tag, text): &(u32, &str)| {
            key_len(*tag) + encoded_len_varint(text.len() as u64) + text.len()
        };
        let added = fields().map(size).sum();
        let mut head = self.head_without([ENCODING_TAG, TYPE_HASH_TAG], added)?;
        for (tag, text) in fields() {
            encode_key(*tag, WireType::LengthDelimited, &mut head);
            encode_varint(text.len() as u64, &mut head);
            head.put_slice(text.as_bytes());
        }
        self.with_head(head, payload)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Header;
    use blaze_domain::{MAX_HEADER_BYTES, Origin, WriterId};

    fn frame(encoding: &str, type_hash: &str) -> Frame {
        let header = Header {
            encoding: encoding.into(),
            type_hash: type_hash.into(),
            traceparent: "00-1-2-03".into(),
            depth: 3,
            ..Header::new("odom", Origin::default(), WriterId([1; 16]), 7, 5)
        };
        Frame::new(&header, Bytes::from_static(b"old")).unwrap().with_hops_and_age(2, 9)
    }

    #[test]
    fn encoding_hash_and_payload_change_and_nothing_else() {
        for (encoding, hash) in [("", ""), ("application/json", ""), ("a", "RIHS01_00")] {
            let new = frame(encoding, hash)
                .recoded("application/cdr; type=a/msg/B", "RIHS01_11", Bytes::from_static(b"new"))
                .unwrap();
            let told = (new.encoding(), new.type_hash(), &new.payload()[..]);
            assert_eq!(told, ("application/cdr; type=a/msg/B", "RIHS01_11", &b"new"[..]));
            assert_eq!((new.topic(), new.sequence(), new.depth()), ("odom", 7, 3));
            assert_eq!((new.traceparent(), new.hops(), new.age_us()), ("00-1-2-03", 2, 9));
            assert_eq!(Frame::parse(new.to_bytes()).unwrap().encoding(), new.encoding());
            let back = new.recoded(encoding, hash, Bytes::from_static(b"old")).unwrap();
            assert_eq!((back.encoding(), back.type_hash()), (encoding, hash));
            assert_eq!(back.head_to_write().len(), frame(encoding, hash).head_to_write().len());
        }
    }

    #[test]
    fn a_header_without_room_is_refused() {
        let long = "e".repeat(MAX_HEADER_BYTES);
        let refused = frame("", "").recoded(&long, "", Bytes::new());
        assert!(matches!(refused, Err(FrameError::HeaderTooLarge(_))), "{refused:?}");
    }
}
