//! Samples as they are on the wire: CDR without its encapsulation, which RustDDS adds and strips.
//!
//! Those of BlazeAIoT's own topics are IDL `sequence<octet>`: a length of four bytes and the octets.

use std::io;

use bytes::{BufMut, Bytes, BytesMut};
use rustdds::{RepresentationIdentifier, no_key};

/// Bytes of the length before the octets.
const LENGTH_BYTES: usize = 4;

/// One sample.
#[derive(Debug, Clone)]
pub struct Cdr {
    /// How its bytes are to be read.
    pub encoding: RepresentationIdentifier,
    /// The serialized data, with up to three bytes of padding at the end.
    pub bytes: Bytes,
}

impl Cdr {
    /// A sample in little-endian CDR.
    pub(super) fn little(bytes: Bytes) -> Self {
        Self { encoding: RepresentationIdentifier::CDR_LE, bytes }
    }

    /// The octets of a `sequence<octet>`; `None` where it is none.
    pub(super) fn octets(&self) -> Option<Bytes> {
        let length = *self.bytes.first_chunk::<LENGTH_BYTES>()?;
        let length = match self.encoding {
            RepresentationIdentifier::CDR_LE => u32::from_le_bytes(length),
            RepresentationIdentifier::CDR_BE => u32::from_be_bytes(length),
            _ => return None,
        };
        let end = LENGTH_BYTES.checked_add(usize::try_from(length).ok()?)?;
        (end <= self.bytes.len()).then(|| self.bytes.slice(LENGTH_BYTES..end))
    }
}

/// Little-endian CDR of a `sequence<octet>` that is made of these parts.
///
/// # Errors
/// Where they have 4 GiB or more together.
pub fn octet_sequence(parts: &[&[u8]]) -> io::Result<Bytes> {
    let length = parts.iter().map(|part| part.len()).sum::<usize>();
    let mut bytes = BytesMut::with_capacity(LENGTH_BYTES + length);
    bytes.put_u32_le(u32::try_from(length).map_err(io::Error::other)?);
    parts.iter().for_each(|part| bytes.put_slice(part));
    Ok(bytes.freeze())
}

/// Takes samples of any encoding from RustDDS, and gives it those in little-endian CDR.
pub(super) struct CdrAdapter;

/// The decoder of [`CdrAdapter`].
#[derive(Clone)]
pub(super) struct CdrDecoder;

static ENCODINGS: [RepresentationIdentifier; 8] = [
    RepresentationIdentifier::CDR_LE,
    RepresentationIdentifier::CDR_BE,
    RepresentationIdentifier::XCDR2_LE,
    RepresentationIdentifier::XCDR2_BE,
    RepresentationIdentifier::D_CDR2_LE,
    RepresentationIdentifier::D_CDR2_BE,
    RepresentationIdentifier::PL_XCDR2_LE,
    RepresentationIdentifier::PL_XCDR2_BE,
];

impl no_key::Decode<'_, Cdr> for CdrDecoder {
    type Error = io::Error;
    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> io::Result<Cdr> {
        // A copy of its own: the slice lies in a receive buffer of 256 KiB, which a small message
        // would hold.
        Ok(Cdr { encoding, bytes: Bytes::copy_from_slice(bytes) })
    }
}

impl no_key::DeserializerAdapter<Cdr> for CdrAdapter {
    type Error = io::Error;
    type Decoded = Cdr;
    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCODINGS
    }
    fn transform_decoded(decoded: Cdr) -> Cdr {
        decoded
    }
}

impl no_key::DefaultDecoder<Cdr> for CdrAdapter {
    type Decoder = CdrDecoder;
    const DECODER: CdrDecoder = CdrDecoder;
}

impl no_key::SerializerAdapter<Cdr> for CdrAdapter {
    type Error = io::Error;
    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }
    fn to_bytes(sample: &Cdr) -> io::Result<Bytes> {
        Ok(sample.bytes.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn octets_survive_and_padding_is_ignored() {
        let sample = octet_sequence(&[b"abc", b"de"]).unwrap();
        assert_eq!(&sample[..], b"\x05\0\0\0abcde");
        let mut padded = sample.to_vec();
        padded.extend_from_slice(&[0; 3]);
        assert_eq!(&Cdr::little(padded.into()).octets().unwrap()[..], b"abcde");
        let big = Bytes::from_static(b"\0\0\0\x01z");
        let encoding = RepresentationIdentifier::CDR_BE;
        assert_eq!(&Cdr { encoding, bytes: big.clone() }.octets().unwrap()[..], b"z");
        let encoding = RepresentationIdentifier::XCDR2_BE;
        assert!(Cdr { encoding, bytes: big }.octets().is_none());
    }

    #[test]
    fn a_length_beyond_the_sample_is_refused() {
        for bad in [&b""[..], b"\x01\0\0", b"\x02\0\0\0x", b"\xff\xff\xff\xffx"] {
            assert!(Cdr::little(Bytes::from_static(bad)).octets().is_none());
        }
    }
}
