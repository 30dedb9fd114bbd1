//! What is read of RTPS messages. They come from the network, so every length is checked.

use super::GuidPrefix;

const HEADER_LENGTH: usize = 20;
/// How own messages begin: RTPS 2.4, and RustDDS' vendor id. The prefix of the participant follows.
pub(super) const OWN_HEADER: [u8; 8] = *b"RTPS\x02\x04\x01\x12";
const PAD: u8 = 0x01;
const INFO_TS: u8 = 0x09;
pub(super) const INFO_SRC: u8 = 0x0c;
pub(super) const INFO_DST: u8 = 0x0e;
pub(super) const DATA: u8 = 0x15;
pub(super) const FLAG_LITTLE_ENDIAN: u8 = 0x01;
pub(super) const FLAG_INLINE_QOS: u8 = 0x02;
pub(super) const FLAG_DATA: u8 = 0x04;
pub(super) const FLAG_KEY: u8 = 0x08;
/// Writer of participants' announcements.
pub(super) const SPDP_WRITER: [u8; 4] = [0x00, 0x01, 0x00, 0xc2];
const PID_SENTINEL: u16 = 0x0001;

/// An RTPS message: its header, and the rest of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Message<'a> {
    pub(super) header: &'a [u8; HEADER_LENGTH],
    rest: &'a [u8],
}

/// One submessage.
#[derive(Debug, Clone, Copy)]
pub(super) struct Submessage<'a> {
    pub(super) kind: u8,
    pub(super) flags: u8,
    /// All of it.
    pub(super) whole: &'a [u8],
    /// Without kind, flags and length.
    pub(super) body: &'a [u8],
}

/// A DATA submessage.
#[derive(Debug, Clone, Copy)]
pub(super) struct Data<'a> {
    pub(super) writer: [u8; 4],
    pub(super) flags: u8,
    /// What stands before the inline parameters.
    pub(super) head: &'a [u8],
    /// With their end; empty where there are none.
    pub(super) inline: &'a [u8],
    pub(super) payload: &'a [u8],
}

impl<'a> Message<'a> {
    pub(super) fn parse(datagram: &'a [u8]) -> Option<Self> {
        let (header, rest) = datagram.split_first_chunk()?;
        header.starts_with(b"RTPS").then_some(Self { header, rest })
    }

    /// Who sends it.
    pub(super) fn prefix(&self) -> GuidPrefix {
        let mut prefix = [0; 12];
        prefix.copy_from_slice(&self.header[8..]);
        GuidPrefix(prefix)
    }

    /// Its submessages; the last is `None` where the message is cut off.
    pub(super) fn submessages(self) -> impl Iterator<Item = Option<Submessage<'a>>> {
        let mut rest = self.rest;
        std::iter::from_fn(move || {
            if rest.is_empty() {
                return None;
            }
            let parsed = Submessage::parse(rest);
            rest = parsed.map_or(&[], |(_, next)| next);
            Some(parsed.map(|(submessage, _)| submessage))
        })
    }
}

impl<'a> Submessage<'a> {
    fn parse(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (head, body) = bytes.split_first_chunk::<4>()?;
        let [kind, flags, ..] = *head;
        let length = match usize::from(read_u16(&head[2..], flags & FLAG_LITTLE_ENDIAN != 0)?) {
            0 if kind != PAD && kind != INFO_TS => body.len(),
            length => length,
        };
        let (body, next) = body.split_at_checked(length)?;
        Some((Self { kind, flags, whole: &bytes[..4 + length], body }, next))
    }

    pub(super) fn is_little(&self) -> bool {
        self.flags & FLAG_LITTLE_ENDIAN != 0
    }

    /// What a DATA submessage has; `None` for all else.
    pub(super) fn data(&self) -> Option<Data<'a>> {
        if self.kind != DATA {
            return None;
        }
        let to_parameters = usize::from(read_u16(self.body.get(2..)?, self.is_little())?);
        let (head, rest) = self.body.split_at_checked(4 + to_parameters)?;
        let payload = if self.flags & FLAG_INLINE_QOS == 0 {
            rest
        } else {
            after_parameters(rest, self.is_little(), |_, _| {})?
        };
        Some(Data {
            writer: *head.get(8..)?.first_chunk()?,
            flags: self.flags,
            head,
            inline: &rest[..rest.len() - payload.len()],
            payload,
        })
    }
}

impl<'a> Data<'a> {
    pub(super) fn is_announcement(&self) -> bool {
        self.writer == SPDP_WRITER && self.flags & FLAG_DATA != 0
    }

    /// Whether it tells that something ceases, by its key.
    pub(super) fn is_end(&self) -> bool {
        self.flags & (FLAG_KEY | FLAG_DATA) == FLAG_KEY && !self.inline.is_empty()
    }

    /// Visits the parameters that the payload consists of; returns their byte order.
    pub(super) fn visit_payload(&self, visit: impl FnMut(u16, &'a [u8])) -> Option<bool> {
        // Representation 0x0002 is big-endian, 0x0003 little-endian.
        let is_little = self.payload.get(1)? & 1 != 0;
        after_parameters(self.payload.get(4..)?, is_little, visit)?;
        Some(is_little)
    }
}

/// Visits a list of parameters; returns what follows it, `None` where its end is missing.
pub(super) fn after_parameters<'a>(
    mut list: &'a [u8],
    is_little: bool,
    mut visit: impl FnMut(u16, &'a [u8]),
) -> Option<&'a [u8]> {
    loop {
        let (head, rest) = list.split_at_checked(4)?;
        let id = read_u16(head, is_little)?;
        if id == PID_SENTINEL {
            return Some(rest);
        }
        let (value, next) = rest.split_at_checked(read_u16(&head[2..], is_little)?.into())?;
        visit(id, value);
        list = next;
    }
}

fn read_u16(bytes: &[u8], is_little: bool) -> Option<u16> {
    let bytes = *bytes.first_chunk::<2>()?;
    Some(if is_little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
}

pub(super) fn read_u32(bytes: &[u8], is_little: bool) -> Option<u32> {
    let bytes = *bytes.first_chunk::<4>()?;
    Some(if is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
}
