//! The datagrams of the link, little-endian. Only flows see them.
//!
//! ```text
//! datagram = header (40 B), then records
//! header   = u8 version | u8 class | u16 records | u32 link_epoch | u64 sender | u64 link_sequence | u64 send_ns
//!            | u32 unsettled | u32 message_floor
//! record   = u32 message | u32 total | u32 offset | u32 length | u8 hops | u8 flags | u16 behind | u32 age_us, then bytes
//! ```
//!
//! `link_sequence` 0 marks a datagram of LinkControl records; it counts nowhere. A datagram without
//! records is a probe. Two floors let a receiver forget exactly what its sender no longer cares
//! for: samples up to `link_sequence - unsettled` are known to be received or lost, and messages
//! below `message_floor` are delivered or given up and will never be sent again.

use blaze_domain::{FlowId, LayerKind, Priority};
use blaze_proto::frame::MAX_FRAME_BYTES;
use blaze_proto::link::link_control::Kind;
use blaze_proto::{Frame, priority_to_wire};
use bytes::{Buf, BufMut, Bytes, BytesMut};
use sha2::{Digest, Sha256};

/// Version of the format.
pub(crate) const VERSION: u8 = 1;
/// Bytes of the link header.
pub const HEADER_BYTES: usize = 40;
/// Bytes before the content of each record.
pub const RECORD_BYTES: usize = 24;
/// Smallest part of a message, except for its last one: bounds what a receiver has to note of an
/// unfinished message.
pub(crate) const MIN_PART_BYTES: usize = 256;

/// The record is an encoded `LinkControl`.
pub(crate) const FLAG_CONTROL: u8 = 1;
/// The part was sent before.
pub(crate) const FLAG_REPAIR: u8 = 2;

/// One life of one flow, in eight bytes: a hash of layer, node and epoch. A Hello binds it to the
/// names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct SenderId(pub u64);

impl SenderId {
    pub(crate) fn of(flow: &FlowId, epoch: u64) -> Self {
        let mut hash = Sha256::new();
        hash.update(flow.layer.as_str());
        hash.update(b"/");
        hash.update(flow.node.as_str());
        hash.update(b"/");
        hash.update(epoch.to_le_bytes());
        let mut first = [0; 8];
        first.copy_from_slice(&hash.finalize()[..8]);
        Self(u64::from_le_bytes(first))
    }
}

/// Why a datagram is none of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum WireError {
    #[error("{0} bytes are no link header")]
    Short(usize),
    #[error("version {0} is not known")]
    Version(u8),
    #[error("class {0} is not the one that it came on")]
    Class(u8),
    #[error("a field of the header contradicts another")]
    Header,
    #[error("record {0} does not fit")]
    Record(u16),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LinkHeader {
    pub class: Priority,
    pub records: u16,
    pub link_epoch: u32,
    pub sender: SenderId,
    /// 0 for LinkControl, else 1, 2, 3 … per link epoch.
    pub link_sequence: u64,
    /// The sender's monotonic clock.
    pub send_ns: u64,
    /// How many of the newest samples, this one included, the sender does not yet know to be
    /// received or lost.
    pub unsettled: u32,
    /// Lowest message that may still be sent.
    pub message_floor: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Record {
    pub message: u32,
    pub total: u32,
    pub offset: u32,
    pub length: u32,
    pub hops: u8,
    pub flags: u8,
    /// How many messages before this one the frame lies that it must follow; 0 = none.
    pub behind: u16,
    pub age_us: u32,
}

impl Record {
    pub(crate) fn is_whole(&self) -> bool {
        self.offset == 0 && self.length == self.total
    }

    fn is_valid(&self) -> bool {
        if self.flags & FLAG_CONTROL != 0 {
            return true;
        }
        let (offset, length, total) =
            (self.offset as usize, self.length as usize, self.total as usize);
        let Some(end) = offset.checked_add(length) else {
            return false;
        };
        self.message > 0
            && u32::from(self.behind) < self.message
            && (1..=MAX_FRAME_BYTES).contains(&total)
            && length > 0
            && end <= total
            && (length >= MIN_PART_BYTES || end == total)
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        if bytes.remaining() < RECORD_BYTES {
            return None;
        }
        Some(Self {
            message: bytes.get_u32_le(),
            total: bytes.get_u32_le(),
            offset: bytes.get_u32_le(),
            length: bytes.get_u32_le(),
            hops: bytes.get_u8(),
            flags: bytes.get_u8(),
            behind: bytes.get_u16_le(),
            age_us: bytes.get_u32_le(),
        })
    }
}

/// A datagram that was checked as a whole: every record lies inside it.
pub(crate) struct Datagram {
    pub header: LinkHeader,
    bytes: Bytes,
}

impl Datagram {
    /// Checks a datagram that came on the topic of a class.
    pub(crate) fn parse(bytes: Bytes, class: Priority) -> Result<Self, WireError> {
        let mut rest = &bytes[..];
        if rest.len() < HEADER_BYTES {
            return Err(WireError::Short(rest.len()));
        }
        let version = rest.get_u8();
        if version != VERSION {
            return Err(WireError::Version(version));
        }
        let code = rest.get_u8();
        if code != class_code(class) {
            return Err(WireError::Class(code));
        }
        let header = LinkHeader {
            class,
            records: rest.get_u16_le(),
            link_epoch: rest.get_u32_le(),
            sender: SenderId(rest.get_u64_le()),
            link_sequence: rest.get_u64_le(),
            send_ns: rest.get_u64_le(),
            unsettled: rest.get_u32_le(),
            message_floor: rest.get_u32_le(),
        };
        let control = header.link_sequence == 0;
        if u64::from(header.unsettled) > header.link_sequence
            || (!control && (header.link_epoch == 0 || header.unsettled == 0))
        {
            return Err(WireError::Header);
        }
        for at in 0..header.records {
            let record = Record::read(&mut rest).ok_or(WireError::Record(at))?;
            let is_control = record.flags & FLAG_CONTROL != 0;
            if record.length as usize > rest.len() || is_control != control || !record.is_valid() {
                return Err(WireError::Record(at));
            }
            rest.advance(record.length as usize);
        }
        Ok(Self { header, bytes })
    }

    /// Bytes of the whole datagram.
    pub(crate) fn len(&self) -> usize {
        self.bytes.len()
    }

    /// Calls `each` with every record and its content, which shares the datagram's memory.
    pub(crate) fn for_each(&self, mut each: impl FnMut(&Record, Bytes)) {
        let mut at = HEADER_BYTES;
        for _ in 0..self.header.records {
            let Some(record) = self.bytes.get(at..).and_then(|mut rest| Record::read(&mut rest))
            else {
                return;
            };
            let start = at + RECORD_BYTES;
            let end = start + record.length as usize;
            each(&record, self.bytes.slice(start..end));
            at = end;
        }
    }
}

/// Puts records into one datagram.
pub(crate) struct DatagramBuilder {
    bytes: BytesMut,
    records: u16,
    limit: usize,
}

impl DatagramBuilder {
    pub(crate) fn new(limit: usize) -> Self {
        let mut bytes = BytesMut::with_capacity(limit);
        bytes.put_bytes(0, HEADER_BYTES);
        Self { bytes, records: 0, limit }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.records == 0
    }

    /// Bytes that one more record may have.
    pub(crate) fn room(&self) -> usize {
        self.limit.saturating_sub(self.bytes.len() + RECORD_BYTES)
    }

    pub(crate) fn fits(&self, length: usize) -> bool {
        self.records < u16::MAX && self.bytes.len() + RECORD_BYTES + length <= self.limit
    }

    fn put_record(&mut self, record: &Record) {
        self.bytes.put_u32_le(record.message);
        self.bytes.put_u32_le(record.total);
        self.bytes.put_u32_le(record.offset);
        self.bytes.put_u32_le(record.length);
        self.bytes.put_u8(record.hops);
        self.bytes.put_u8(record.flags);
        self.bytes.put_u16_le(record.behind);
        self.bytes.put_u32_le(record.age_us);
        self.records += 1;
    }

    /// Copies the part of a frame that the record names.
    pub(crate) fn put_part(&mut self, record: &Record, frame: &Frame) {
        self.put_record(record);
        let (start, end) = (record.offset as usize, (record.offset + record.length) as usize);
        let (head, payload) = (frame.head(), frame.payload());
        let split = head.len();
        if start < split {
            self.bytes.put_slice(&head[start..end.min(split)]);
        }
        if end > split {
            self.bytes.put_slice(&payload[start.saturating_sub(split)..end - split]);
        }
    }

    /// Adds an encoded `LinkControl`.
    pub(crate) fn put_control(&mut self, body: &[u8]) {
        let length = u32::try_from(body.len()).unwrap_or(u32::MAX);
        self.put_record(&Record {
            message: 0,
            total: length,
            offset: 0,
            length,
            hops: 0,
            flags: FLAG_CONTROL,
            behind: 0,
            age_us: 0,
        });
        self.bytes.put_slice(body);
    }

    /// Writes the header, its `records` apart, which are counted here.
    pub(crate) fn finish(mut self, header: &LinkHeader) -> Bytes {
        let mut head = &mut self.bytes[..HEADER_BYTES];
        head.put_u8(VERSION);
        head.put_u8(class_code(header.class));
        head.put_u16_le(self.records);
        head.put_u32_le(header.link_epoch);
        head.put_u64_le(header.sender.0);
        head.put_u64_le(header.link_sequence);
        head.put_u64_le(header.send_ns);
        head.put_u32_le(header.unsettled);
        head.put_u32_le(header.message_floor);
        self.bytes.freeze()
    }
}

/// Number of a class on the wire.
pub(crate) fn class_code(class: Priority) -> u8 {
    u8::try_from(priority_to_wire(class)).unwrap_or(0)
}

/// The class of a number on the wire.
pub(crate) fn class_of(code: u32) -> Option<Priority> {
    let mut classes = Priority::ALL.iter().copied();
    classes.find(|class| u32::from(class_code(*class)) == code)
}

/// The kind of a layer that a Hello names.
pub(crate) fn kind_from_wire(kind: Kind) -> Option<LayerKind> {
    match kind {
        Kind::Edge => Some(LayerKind::Edge),
        Kind::Fog => Some(LayerKind::Fog),
        Kind::Cloud => Some(LayerKind::Cloud),
        Kind::Unspecified => None,
    }
}

/// The kind of a layer for a Hello.
pub(crate) fn kind_to_wire(kind: LayerKind) -> Kind {
    match kind {
        LayerKind::Edge => Kind::Edge,
        LayerKind::Fog => Kind::Fog,
        LayerKind::Cloud => Kind::Cloud,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::{Origin, WriterId};
    use blaze_proto::Header;
    use proptest::prelude::*;

    fn header(link_sequence: u64) -> LinkHeader {
        LinkHeader {
            class: Priority::State,
            records: 0,
            link_epoch: 3,
            sender: SenderId(77),
            link_sequence,
            send_ns: 123_456,
            unsettled: 2,
            message_floor: 9,
        }
    }

    fn frame(payload: usize) -> Frame {
        let bytes: Vec<u8> = (0..payload).map(|at| u8::try_from(at % 251).unwrap()).collect();
        Frame::new(&Header::new("a/b", Origin::default(), WriterId([7; 16]), 1, 1), bytes.into())
            .unwrap()
    }

    fn part(frame: &Frame, offset: usize, length: usize) -> Record {
        Record {
            message: 5,
            total: u32::try_from(frame.received_len()).unwrap(),
            offset: u32::try_from(offset).unwrap(),
            length: u32::try_from(length).unwrap(),
            hops: 2,
            flags: FLAG_REPAIR,
            behind: 4,
            age_us: 1_000,
        }
    }

    #[test]
    fn parts_of_a_frame_come_back_as_they_were() {
        let frame = frame(2_000);
        let whole = [&frame.head()[..], &frame.payload()[..]].concat();
        for (offset, length) in
            [(0, 300), (0, whole.len()), (20, 500), (1_000, whole.len() - 1_000)]
        {
            let record = part(&frame, offset, length);
            let mut builder = DatagramBuilder::new(4_000);
            builder.put_part(&record, &frame);
            builder.put_part(&record, &frame);
            let datagram = Datagram::parse(builder.finish(&header(8)), Priority::State).unwrap();
            assert_eq!(datagram.header, LinkHeader { records: 2, ..header(8) });
            let mut seen = 0;
            datagram.for_each(|found, bytes| {
                assert_eq!(*found, record);
                assert_eq!(bytes, whole[offset..offset + length]);
                seen += 1;
            });
            assert_eq!(seen, 2);
        }
    }

    #[test]
    fn contradictions_are_refused() {
        let frame = frame(2_000);
        let parse = |record: Record, header: LinkHeader| {
            let mut builder = DatagramBuilder::new(4_000);
            builder.put_part(&record, &frame);
            Datagram::parse(builder.finish(&header), Priority::State).err()
        };
        assert_eq!(parse(part(&frame, 0, 300), header(8)), None);
        assert_eq!(
            parse(part(&frame, 0, 100), header(8)),
            Some(WireError::Record(0)),
            "a tiny part"
        );
        let huge = Record { total: u32::MAX, ..part(&frame, 0, 300) };
        assert_eq!(parse(huge, header(8)), Some(WireError::Record(0)));
        let before_the_first = Record { behind: 5, ..part(&frame, 0, 300) };
        assert_eq!(parse(before_the_first, header(8)), Some(WireError::Record(0)));
        assert_eq!(
            parse(part(&frame, 0, 300), header(1)),
            Some(WireError::Header),
            "2 of 1 unsettled"
        );
        assert_eq!(parse(part(&frame, 0, 300), header(0)), Some(WireError::Header));
        let probe = DatagramBuilder::new(100).finish(&header(8));
        assert_eq!(Datagram::parse(probe.clone(), Priority::Bulk).err(), Some(WireError::Class(2)));
        assert_eq!(
            Datagram::parse(probe.slice(..39), Priority::State).err(),
            Some(WireError::Short(39))
        );
    }

    #[test]
    fn lives_have_different_senders() {
        let flow: FlowId = "edge/robot-1".parse().unwrap();
        assert_eq!(SenderId::of(&flow, 1), SenderId::of(&flow, 1));
        assert_ne!(SenderId::of(&flow, 1), SenderId::of(&flow, 2));
    }

    proptest! {
        #[test]
        fn random_datagrams_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..400),
            ours: bool) {
            if ours && bytes.len() > 4 {
                let records = bytes[2] % 4;
                bytes[..4].copy_from_slice(&[VERSION, 2, records, 0]);
            }
            if let Ok(datagram) = Datagram::parse(Bytes::from(bytes), Priority::State) {
                let mut content = 0;
                datagram.for_each(|record, bytes| {
                    assert_eq!(record.length as usize, bytes.len());
                    content += bytes.len();
                });
                prop_assert!(content <= datagram.len());
            }
        }
    }
}
