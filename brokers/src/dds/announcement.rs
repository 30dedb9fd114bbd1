//! What the relay reads of participants' announcements (SPDP).

use super::GuidPrefix;
use super::rtps::{Data, Message};

/// What the relay must know of an announcement (SPDP).
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Announcement {
    /// Who announces itself.
    pub(super) prefix: GuidPrefix,
    /// Whether it names a multicast address.
    pub(super) multicast: bool,
}

const PID_METATRAFFIC_MULTICAST: u16 = 0x0033;
const PID_DEFAULT_MULTICAST: u16 = 0x0048;

impl Announcement {
    /// Finds the participant's data in an RTPS message; `None` for all else, such as a good-bye.
    pub(super) fn parse(datagram: &[u8]) -> Option<Self> {
        let message = Message::parse(datagram)?;
        let mut data = message.submessages().map_while(|it| it).filter_map(|it| it.data());
        let announcement = data.find(Data::is_announcement)?;
        let mut multicast = false;
        let whole = announcement.visit_payload(|id, value| {
            if matches!(id, PID_METATRAFFIC_MULTICAST | PID_DEFAULT_MULTICAST) {
                multicast |= value.get(20).is_some_and(|byte| (224..240).contains(byte));
            }
        });
        Some(Self { prefix: message.prefix(), multicast: multicast && whole.is_some() })
    }
}

#[cfg(test)]
mod tests {
    use super::super::rtps::{DATA, FLAG_DATA, FLAG_LITTLE_ENDIAN, SPDP_WRITER};
    use super::*;

    const PID_SENTINEL: u16 = 0x0001;

    /// An SPDP message with one parameter.
    fn announcement(id: u16, value: &[u8]) -> Vec<u8> {
        let mut payload = vec![0, 3, 0, 0];
        for (id, value) in [(id, value), (PID_SENTINEL, &[][..])] {
            payload.extend(id.to_le_bytes());
            payload.extend(u16::try_from(value.len()).unwrap().to_le_bytes());
            payload.extend(value);
        }
        let mut message = b"RTPS\x02\x04\x01\x12abcdefghijkl".to_vec();
        message.extend([0x09, 0x01, 8, 0, 1, 2, 3, 4, 5, 6, 7, 8]);
        message.extend([DATA, FLAG_LITTLE_ENDIAN | FLAG_DATA]);
        message.extend(u16::try_from(20 + payload.len()).unwrap().to_le_bytes());
        message.extend([0, 0, 16, 0, 0, 1, 0, 0xc7]);
        message.extend(SPDP_WRITER);
        message.extend([0; 8]);
        message.extend(payload);
        message
    }

    #[test]
    fn an_announcement_tells_its_participant_and_multicast() {
        let prefix = GuidPrefix(*b"abcdefghijkl");
        let mut locator = [0; 24];
        locator[20..].copy_from_slice(&[239, 255, 0, 1]);
        for (id, multicast) in
            [(PID_METATRAFFIC_MULTICAST, true), (PID_DEFAULT_MULTICAST, true), (0x0031, false)]
        {
            let message = announcement(id, &locator);
            assert_eq!(Announcement::parse(&message), Some(Announcement { prefix, multicast }));
        }
        let mut good_bye = announcement(0x0031, &locator);
        good_bye[33] &= !FLAG_DATA;
        assert_eq!(Announcement::parse(&good_bye), None);
    }

    #[test]
    fn no_bytes_make_the_parser_panic() {
        let whole = announcement(PID_DEFAULT_MULTICAST, &[0; 24]);
        for length in 0..whole.len() {
            let _ = Announcement::parse(&whole[..length]);
        }
        for at in 0..whole.len() {
            for byte in [0, 1, 0x7f, 0x80, 0xff] {
                let mut changed = whole.clone();
                changed[at] = byte;
                let _ = Announcement::parse(&changed);
            }
        }
    }
}
