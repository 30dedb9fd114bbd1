//! Samples as they are on the wire, with their encapsulation: four bytes, of which the first two
//! tell how the CDR behind them is to be read. It is also what rosbag2 and MCAP store.
//!
//! Those of BlazeAIoT's own topics are IDL `sequence<octet>`: a length of four bytes and the octets.

use std::io;

use bytes::{BufMut, Bytes, BytesMut};
use rustdds::{RepresentationIdentifier, no_key};

/// Bytes of the encapsulation.
const ENCAPSULATION: usize = 4;
/// Encapsulation of little-endian CDR.
const LITTLE: [u8; ENCAPSULATION] = [0x00, 0x01, 0x00, 0x00];
/// Bytes of the length before octets.
const LENGTH: usize = 4;

/// One sample.
#[derive(Debug, Clone)]
pub struct Cdr(Bytes);

impl Cdr {
    /// A sample in little-endian CDR, as [`octet_sequence`] makes it; `None` where it is none.
    #[must_use]
    pub fn little(payload: Bytes) -> Option<Self> {
        (payload.get(..2)? == &LITTLE[..2] && payload.len() >= ENCAPSULATION)
            .then_some(Self(payload))
    }

    /// The sample with its encapsulation.
    #[must_use]
    pub fn payload(&self) -> &Bytes {
        &self.0
    }

    /// How its body is to be read.
    #[must_use]
    pub fn encoding(&self) -> [u8; 2] {
        self.0.first_chunk::<2>().copied().unwrap_or_default()
    }

    /// The data, with up to three bytes of padding at the end.
    #[must_use]
    pub fn body(&self) -> &[u8] {
        self.0.get(ENCAPSULATION..).unwrap_or_default()
    }

    /// Whether the body is plain CDR, and if so, whether it is big-endian.
    pub(crate) fn is_big_endian(&self) -> Option<bool> {
        match self.encoding() {
            [0x00, 0x00] => Some(true),
            [0x00, 0x01] => Some(false),
            _ => None,
        }
    }

    /// The octets of a `sequence<octet>`; `None` where it is none.
    pub(super) fn octets(&self) -> Option<Bytes> {
        let length = *self.body().first_chunk::<LENGTH>()?;
        let length = if self.is_big_endian()? {
            u32::from_be_bytes(length)
        } else {
            u32::from_le_bytes(length)
        };
        let begin = ENCAPSULATION + LENGTH;
        let end = begin.checked_add(usize::try_from(length).ok()?)?;
        (end <= self.0.len()).then(|| self.0.slice(begin..end))
    }
}

/// A sample of a `sequence<octet>` that is made of these parts.
///
/// # Errors
/// Where they have 4 GiB or more together.
pub fn octet_sequence(parts: &[&[u8]]) -> io::Result<Cdr> {
    let length = parts.iter().map(|part| part.len()).sum::<usize>();
    let mut bytes = BytesMut::with_capacity(ENCAPSULATION + LENGTH + length);
    bytes.put_slice(&LITTLE);
    bytes.put_u32_le(u32::try_from(length).map_err(io::Error::other)?);
    parts.iter().for_each(|part| bytes.put_slice(part));
    Ok(Cdr(bytes.freeze()))
}

/// Takes samples of any encoding from RustDDS, and gives it those in little-endian CDR.
pub(crate) struct CdrAdapter;

/// The decoder of [`CdrAdapter`].
#[derive(Clone)]
pub(crate) struct CdrDecoder;

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
    fn decode_bytes(self, body: &[u8], encoding: RepresentationIdentifier) -> io::Result<Cdr> {
        // A copy of its own: the slice lies in a receive buffer of 256 KiB, which a small message
        // would hold. RustDDS has dropped the options, which hold the length of the padding.
        let mut bytes = BytesMut::with_capacity(ENCAPSULATION + body.len());
        bytes.put_slice(&encoding.to_bytes());
        bytes.put_slice(&LITTLE[2..]);
        bytes.put_slice(body);
        Ok(Cdr(bytes.freeze()))
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
        if sample.encoding() != LITTLE[..2] {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "not little-endian CDR"));
        }
        Ok(sample.0.slice_ref(sample.body()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::no_key::SerializerAdapter as _;

    fn of(payload: &[u8]) -> Cdr {
        Cdr(Bytes::copy_from_slice(payload))
    }

    #[test]
    fn octets_survive_and_padding_is_ignored() {
        let sample = octet_sequence(&[b"abc", b"de"]).unwrap();
        assert_eq!(&sample.payload()[..], b"\0\x01\0\0\x05\0\0\0abcde");
        let padded = of(&[sample.payload(), &[0; 3][..]].concat());
        assert_eq!(&padded.octets().unwrap()[..], b"abcde");
        assert_eq!(&of(b"\0\0\0\0\0\0\0\x01z").octets().unwrap()[..], b"z");
        assert!(of(b"\0\x07\0\0\x01\0\0\0z").octets().is_none(), "no plain CDR");
    }

    #[test]
    fn a_length_beyond_the_sample_is_refused() {
        for bad in [&b""[..], b"\x01\0\0", b"\x02\0\0\0x", b"\xff\xff\xff\xffx"] {
            assert!(of(&[&LITTLE, bad].concat()).octets().is_none());
        }
        assert!(of(b"").octets().is_none());
    }

    #[test]
    fn only_little_endian_cdr_is_written() {
        let little = |payload: &'static [u8]| Cdr::little(Bytes::from_static(payload)).is_some();
        assert!(little(b"\0\x01\0\0") && little(b"\0\x01\0\x03abc\0"));
        for other in [&b""[..], b"\0\x01\0", b"\0\0\0\0", b"\0\x07\0\0abcd"] {
            assert!(!little(other), "{other:?}");
            let written = CdrAdapter::to_bytes(&of(other));
            assert!(written.is_err() || other.starts_with(b"\0\x01"), "{other:?}");
        }
    }
}
