//! Good-bye in the name of a participant that cannot say it any more.
//!
//! A participant that ends tells so, and RustDDS then forgets its readers at once, else only after
//! the lease that it announced: 50 s for RustDDS, during which reliable writers wait for its
//! acknowledgements. The datagram here is what RustDDS itself sends when it ends; it goes to the
//! own participant alone, and others are not told.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};

use bytes::BufMut;

use super::GuidPrefix;
use super::rtps::OWN_HEADER;

const SUBMESSAGE_DATA: u8 = 0x15;
/// Little endian, with inline parameters, with a key instead of data.
const FLAGS: u8 = 0x01 | 0x02 | 0x08;
/// Bytes from behind this field to the inline parameters.
const TO_PARAMETERS: u16 = 16;
const SPDP_READER: [u8; 4] = [0x00, 0x01, 0x00, 0xc7];
const SPDP_WRITER: [u8; 4] = [0x00, 0x01, 0x00, 0xc2];
const PARTICIPANT: [u8; 4] = [0x00, 0x00, 0x01, 0xc1];
/// `PID_STATUS_INFO`: disposed and unregistered.
const STATUS_INFO: [u8; 8] = [0x71, 0x00, 0x04, 0x00, 0x00, 0x00, 0x00, 0x03];
const SENTINEL: [u8; 4] = [0x01, 0x00, 0x00, 0x00];
/// `PL_CDR_LE`, no options.
const ENCAPSULATION: [u8; 4] = [0x00, 0x03, 0x00, 0x00];
/// `PID_PARTICIPANT_GUID` of 16 bytes.
const PARTICIPANT_GUID: [u8; 4] = [0x50, 0x00, 0x10, 0x00];
/// No participant has announced itself that often.
const FIRST_NUMBER: u32 = 0x4000_0000;

/// Says good-bye for others to one participant of this host.
pub(super) struct Farewell {
    socket: UdpSocket,
    /// Where the own participant takes announcements.
    to: SocketAddrV4,
    number: u32,
}

impl Farewell {
    pub(super) fn new(address: Ipv4Addr, port: u16) -> io::Result<Self> {
        Ok(Self {
            socket: UdpSocket::bind((address, 0))?,
            to: SocketAddrV4::new(address, port),
            number: FIRST_NUMBER,
        })
    }

    pub(super) fn say(&mut self, whose: GuidPrefix) -> io::Result<()> {
        // A number that was seen is passed over.
        self.number = self.number.wrapping_add(1);
        self.socket.send_to(&datagram(whose, self.number), self.to).map(|_| ())
    }
}

pub(super) fn datagram(whose: GuidPrefix, number: u32) -> Vec<u8> {
    let mut body = Vec::with_capacity(64);
    body.put_u16_le(0);
    body.put_u16_le(TO_PARAMETERS);
    body.put_slice(&SPDP_READER);
    body.put_slice(&SPDP_WRITER);
    body.put_i32_le(0);
    body.put_u32_le(number);
    body.put_slice(&STATUS_INFO);
    body.put_slice(&SENTINEL);
    body.put_slice(&ENCAPSULATION);
    body.put_slice(&PARTICIPANT_GUID);
    body.put_slice(&whose.0);
    body.put_slice(&PARTICIPANT);
    body.put_slice(&SENTINEL);
    let mut message = Vec::with_capacity(24 + body.len());
    message.put_slice(&OWN_HEADER);
    message.put_slice(&whose.0);
    message.put_u8(SUBMESSAGE_DATA);
    message.put_u8(FLAGS);
    message.put_u16_le(u16::try_from(body.len()).unwrap_or(0));
    message.put_slice(&body);
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_names_the_participant_twice_and_holds_together() {
        let message = datagram(GuidPrefix(*b"abcdefghijkl"), 7);
        assert_eq!(&message[..8], b"RTPS\x02\x04\x01\x12");
        assert_eq!(&message[8..20], b"abcdefghijkl");
        assert_eq!(usize::from(u16::from_le_bytes([message[22], message[23]])), message.len() - 24);
        let place = message.windows(12).rposition(|part| part == b"abcdefghijkl").unwrap();
        assert_eq!(&message[place - 4..place], &PARTICIPANT_GUID);
        assert_eq!(&message[place + 12..place + 16], &PARTICIPANT);
    }
}
