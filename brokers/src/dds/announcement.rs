//! What is read of participants' announcements (SPDP). They come from the network, so every length
//! is checked.

use super::GuidPrefix;

/// What the relay must know of an announcement (SPDP).
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Announcement {
    /// Who announces itself.
    pub(super) prefix: GuidPrefix,
    /// Whether it names a multicast address.
    pub(super) multicast: bool,
}

const SUBMESSAGE_DATA: u8 = 0x15;
const FLAG_LITTLE_ENDIAN: u8 = 0x01;
const FLAG_INLINE_QOS: u8 = 0x02;
const FLAG_DATA: u8 = 0x04;
const SPDP_WRITER: [u8; 4] = [0x00, 0x01, 0x00, 0xc2];
const PID_SENTINEL: u16 = 0x0001;
const PID_METATRAFFIC_MULTICAST: u16 = 0x0033;
const PID_DEFAULT_MULTICAST: u16 = 0x0048;

impl Announcement {
    /// Finds the participant's data in an RTPS message; `None` for all else, such as a good-bye.
    pub(super) fn parse(message: &[u8]) -> Option<Self> {
        let (header, mut rest) = message.split_at_checked(20)?;
        if !header.starts_with(b"RTPS") {
            return None;
        }
        let prefix = GuidPrefix(header[8..20].try_into().ok()?);
        while let Some((head, body)) = rest.split_first_chunk::<4>() {
            let little = head[1] & FLAG_LITTLE_ENDIAN != 0;
            let length = match usize::from(read_u16(&head[2..], little)?) {
                0 => body.len(),
                length => length,
            };
            let (body, next) = body.split_at_checked(length)?;
            if head[0] == SUBMESSAGE_DATA
                && head[1] & FLAG_DATA != 0
                && body.get(8..12) == Some(&SPDP_WRITER)
            {
                return Some(Self {
                    prefix,
                    multicast: announces_multicast(head[1], body, little).unwrap_or(false),
                });
            }
            rest = next;
        }
        None
    }
}

fn announces_multicast(flags: u8, body: &[u8], little: bool) -> Option<bool> {
    let mut rest = body.get(4 + usize::from(read_u16(&body[2..], little)?)..)?;
    if flags & FLAG_INLINE_QOS != 0 {
        rest = after_parameters(rest, little, |_, _| {})?;
    }
    // Representation 0x0002 is big-endian, 0x0003 little-endian.
    let little = rest.get(1)? & 1 != 0;
    let mut found = false;
    after_parameters(rest.get(4..)?, little, |id, value| {
        if matches!(id, PID_METATRAFFIC_MULTICAST | PID_DEFAULT_MULTICAST) {
            found |= value.get(20).is_some_and(|byte| (224..240).contains(byte));
        }
    })?;
    Some(found)
}

fn after_parameters(
    mut list: &[u8],
    little: bool,
    mut visit: impl FnMut(u16, &[u8]),
) -> Option<&[u8]> {
    loop {
        let (head, rest) = list.split_at_checked(4)?;
        let (id, length) = (read_u16(head, little)?, usize::from(read_u16(&head[2..], little)?));
        if id == PID_SENTINEL {
            return Some(rest);
        }
        let (value, next) = rest.split_at_checked(length)?;
        visit(id, value);
        list = next;
    }
}

fn read_u16(bytes: &[u8], little: bool) -> Option<u16> {
    let bytes = *bytes.first_chunk::<2>()?;
    Some(if little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
}

#[cfg(test)]
mod tests {
    use super::*;

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
        message.extend([SUBMESSAGE_DATA, FLAG_LITTLE_ENDIAN | FLAG_DATA]);
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
