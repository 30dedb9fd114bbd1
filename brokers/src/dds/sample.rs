//! Samples as IDL `sequence<octet>`: a length of four bytes and the octets. RustDDS adds and strips
//! the encapsulation.

use std::io;

use bytes::{BufMut, Bytes, BytesMut};
use rustdds::{RepresentationIdentifier, no_key};

/// Bytes of the length before the octets.
pub(super) const LENGTH_BYTES: usize = 4;

/// The octets of one sample, without the length.
#[derive(Debug, Clone)]
pub(super) struct Octets(pub(super) Bytes);

/// Serializes [`Octets`] for RustDDS.
pub(super) struct OctetsAdapter;

/// The decoder of [`OctetsAdapter`].
#[derive(Clone)]
pub(super) struct OctetsDecoder;

static ENCODINGS: [RepresentationIdentifier; 2] =
    [RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE];

fn decode(bytes: &[u8], encoding: RepresentationIdentifier) -> io::Result<Octets> {
    let malformed = || io::Error::new(io::ErrorKind::InvalidData, "not a sequence of octets");
    let (length, rest) = bytes.split_first_chunk::<LENGTH_BYTES>().ok_or_else(malformed)?;
    let length = if encoding == RepresentationIdentifier::CDR_BE {
        u32::from_be_bytes(*length)
    } else {
        u32::from_le_bytes(*length)
    };
    let length = usize::try_from(length).map_err(|_| malformed())?;
    // A copy of its own: the slice lies in a receive buffer of 256 KiB, which a small message would
    // hold.
    let octets = rest.get(..length).ok_or_else(malformed)?;
    Ok(Octets(Bytes::copy_from_slice(octets)))
}

impl no_key::Decode<'_, Octets> for OctetsDecoder {
    type Error = io::Error;
    fn decode_bytes(
        self,
        bytes: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Octets, io::Error> {
        decode(bytes, encoding)
    }
}

impl no_key::DeserializerAdapter<Octets> for OctetsAdapter {
    type Error = io::Error;
    type Decoded = Octets;
    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCODINGS
    }
    fn transform_decoded(decoded: Octets) -> Octets {
        decoded
    }
}

impl no_key::DefaultDecoder<Octets> for OctetsAdapter {
    type Decoder = OctetsDecoder;
    const DECODER: OctetsDecoder = OctetsDecoder;
}

impl no_key::SerializerAdapter<Octets> for OctetsAdapter {
    type Error = io::Error;
    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }
    fn to_bytes(sample: &Octets) -> Result<Bytes, io::Error> {
        let length = u32::try_from(sample.0.len()).map_err(io::Error::other)?;
        let mut bytes = BytesMut::with_capacity(LENGTH_BYTES + sample.0.len());
        bytes.put_u32_le(length);
        bytes.put_slice(&sample.0);
        Ok(bytes.freeze())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::no_key::SerializerAdapter;

    #[test]
    fn octets_survive_and_padding_is_ignored() {
        let sample = OctetsAdapter::to_bytes(&Octets(Bytes::from_static(b"abcde"))).unwrap();
        assert_eq!(&sample[..], b"\x05\0\0\0abcde");
        let mut padded = sample.to_vec();
        padded.extend_from_slice(&[0; 3]);
        assert_eq!(&decode(&padded, RepresentationIdentifier::CDR_LE).unwrap().0[..], b"abcde");
        assert_eq!(&decode(b"\0\0\0\x01z", RepresentationIdentifier::CDR_BE).unwrap().0[..], b"z");
    }

    #[test]
    fn a_length_beyond_the_sample_is_refused() {
        for bad in [&b""[..], b"\x01\0\0", b"\x02\0\0\0x", b"\xff\xff\xff\xffx"] {
            assert!(decode(bad, RepresentationIdentifier::CDR_LE).is_err());
        }
    }
}
