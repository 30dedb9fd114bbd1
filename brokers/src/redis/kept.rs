//! What is kept for late joiners: the list that a field of a hash holds, and the own copy that it
//! is written from.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Weak};

use blaze_domain::WriterId;
use blaze_proto::Frame;
use blaze_proto::frame::MAX_FRAME_BYTES;
use bytes::{Buf, Bytes};
use redis::{RedisWrite, ToRedisArgs};

use super::publisher::Target;
use super::state::Line;
use crate::retained::{Retained, RetainedBounds, RetainedCache};

/// What one client keeps. Each message writes the whole field.
const BOUNDS: RetainedBounds =
    RetainedBounds { writers: 65_536, bytes: 64 * 1024 * 1024, bytes_of_writer: 32 * 1024 * 1024 };
/// Length and time before each frame.
const ENTRY_HEAD_BYTES: usize = 12;
/// Allowance for what a frame takes beside its bytes.
const OVERHEAD_BYTES: usize = 128;

/// One frame as it was published.
#[derive(Debug, Clone)]
pub(super) struct KeptFrame {
    /// When it was published, nanoseconds since 1970.
    pub(super) written_ns: u64,
    pub(super) head: Bytes,
    pub(super) payload: Bytes,
    /// Which connection wrote it.
    pub(super) line: Line,
    /// Gone with the publisher, once all that waited in its queue is written.
    pub(super) publisher: Weak<Target>,
}

impl KeptFrame {
    fn length(&self) -> usize {
        self.head.len() + self.payload.len()
    }
}

/// The value of a field: the frames of one writer, oldest first.
///
/// Each is a length (u32, little-endian), the time of publishing (u64, little-endian, nanoseconds
/// since 1970, the clock of the host of the publisher) and the frame.
pub(super) struct Field<'a>(&'a Retained<KeptFrame>);

impl Field<'_> {
    /// Bytes of the value at most.
    pub(super) fn size(&self) -> usize {
        self.0.bytes()
    }
}

impl ToRedisArgs for Field<'_> {
    fn write_redis_args<W: ?Sized + RedisWrite>(&self, out: &mut W) {
        use std::io::Write as _;
        let mut value = out.writer_for_next_arg();
        for frame in self.0.iter() {
            // Writing to memory cannot fail; a frame has less than 2^32 bytes.
            let length = u32::try_from(frame.length()).unwrap_or(u32::MAX);
            let _ = value.write_all(&length.to_le_bytes());
            let _ = value.write_all(&frame.written_ns.to_le_bytes());
            let _ = value.write_all(&frame.head);
            let _ = value.write_all(&frame.payload);
        }
    }
}

/// Reads the value of a field. What follows a damaged part is left out, and counts as damaged.
pub(super) fn read_field(mut value: Bytes, writer: WriterId) -> (Vec<(u64, Frame)>, bool) {
    let mut frames: Vec<(u64, Frame)> = Vec::new();
    while value.len() >= ENTRY_HEAD_BYTES {
        let length = value.get_u32_le() as usize;
        let written_ns = value.get_u64_le();
        if length > MAX_FRAME_BYTES || length > value.len() {
            return (frames, true);
        }
        match Frame::parse(value.split_to(length)) {
            Ok(frame) if frame.writer() == writer => frames.push((written_ns, frame)),
            _ => return (frames, true),
        }
    }
    let damaged = !value.is_empty();
    frames.sort_by_key(|(_, frame)| frame.sequence());
    // A clock may have been set back between two messages; their order is that of their numbers.
    let mut latest = 0;
    for (written_ns, _) in &mut frames {
        latest = latest.max(*written_ns);
        *written_ns = latest;
    }
    (frames, damaged)
}

/// Hash and field.
pub(super) type FieldKey = (Arc<str>, WriterId);

/// The last frames of each writer that this client publishes, as the server has them.
pub(super) struct Mirror {
    fields: RetainedCache<FieldKey, KeptFrame>,
    /// Fields that the server has lost, by the connection that wrote them.
    rewrite: HashMap<Line, VecDeque<FieldKey>>,
}

impl Default for Mirror {
    fn default() -> Self {
        Self { fields: RetainedCache::new(BOUNDS), rewrite: HashMap::new() }
    }
}

impl Mirror {
    /// Takes a frame in as the newest of its writer, and gives the field that is to be written
    /// before it is published.
    pub(super) fn keep(
        &mut self,
        key: &FieldKey,
        frame: KeptFrame,
        depth: usize,
    ) -> Option<Field<'_>> {
        let size = frame.length() + ENTRY_HEAD_BYTES + OVERHEAD_BYTES;
        self.fields.keep(key.clone(), frame, size, depth);
        self.fields.get(key).map(Field)
    }

    /// Forgets a writer.
    pub(super) fn forget(&mut self, key: &FieldKey) {
        self.fields.forget(key);
    }

    /// Forgets what publishers wrote that are no more.
    pub(super) fn forget_orphans(&mut self) {
        self.fields.forget_if(|_, newest| newest.publisher.strong_count() == 0);
    }

    /// The hashes that the server is to have.
    pub(super) fn hashes(&self) -> Vec<Arc<str>> {
        let hashes: HashSet<&Arc<str>> = self.fields.iter().map(|((hash, _), ..)| hash).collect();
        hashes.into_iter().cloned().collect()
    }

    /// The server has lost these hashes.
    pub(super) fn rewrite(&mut self, is_lost: impl Fn(&Arc<str>) -> bool) {
        let queued: HashSet<FieldKey> = self.rewrite.values().flatten().cloned().collect();
        for (key, newest, _) in self.fields.iter().filter(|((hash, _), ..)| is_lost(hash)) {
            if !queued.contains(key) {
                self.rewrite.entry(newest.line).or_default().push_back(key.clone());
            }
        }
    }

    /// The server has lost everything.
    pub(super) fn rewrite_all(&mut self) {
        self.rewrite.clear();
        self.rewrite(|_| true);
    }

    /// The next field that a connection has to write again.
    pub(super) fn next_to_rewrite(&mut self, line: Line) -> Option<(FieldKey, Field<'_>)> {
        let queue = self.rewrite.get_mut(&line)?;
        while let Some(key) = queue.pop_front() {
            if let Some(field) = self.fields.get(&key) {
                return Some((key, Field(field)));
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::Origin;
    use blaze_proto::Header;

    fn frame(writer: u8, sequence: u64, bytes: usize) -> Frame {
        let header = Header::new("t", Origin::default(), WriterId([writer; 16]), sequence, 0);
        Frame::new(&header, Bytes::from(vec![writer; bytes])).unwrap()
    }

    fn kept(frame: &Frame, written_ns: u64) -> KeptFrame {
        KeptFrame {
            written_ns,
            head: frame.head_to_write(),
            payload: frame.payload().clone(),
            line: Line::PublishSmall,
            publisher: Weak::new(),
        }
    }

    fn key(writer: u8) -> FieldKey {
        (Arc::from("blaze:last:t"), WriterId([writer; 16]))
    }

    fn keep(mirror: &mut Mirror, writer: u8, sequence: u64, bytes: usize, depth: usize) {
        let frame = kept(&frame(writer, sequence, bytes), sequence);
        mirror.keep(&key(writer), frame, depth);
    }

    fn value(mirror: &Mirror, writer: u8) -> Option<Bytes> {
        let field = mirror.fields.get(&key(writer)).map(Field)?;
        field.to_redis_args().pop().map(Bytes::from)
    }

    #[test]
    fn a_field_survives_its_bytes() {
        let mut mirror = Mirror::default();
        for sequence in 1..=5 {
            keep(&mut mirror, 1, sequence, 100, 3);
        }
        let (frames, damaged) = read_field(value(&mirror, 1).unwrap(), WriterId([1; 16]));
        assert!(!damaged);
        assert_eq!(frames.len(), 3);
        for ((written_ns, found), sequence) in frames.iter().zip(3..) {
            assert_eq!((*written_ns, found), (sequence, &frame(1, sequence, 100)));
        }
    }

    #[test]
    fn damaged_fields_give_what_is_whole() {
        let mut mirror = Mirror::default();
        keep(&mut mirror, 1, 1, 10, 2);
        let one = value(&mirror, 1).unwrap();
        keep(&mut mirror, 1, 2, 10, 2);
        let two = value(&mirror, 1).unwrap();
        for end in 0..two.len() {
            let (frames, damaged) = read_field(two.slice(..end), WriterId([1; 16]));
            assert_eq!(frames.len(), usize::from(end >= one.len()), "cut at {end}");
            assert_eq!(damaged, end != 0 && end != one.len(), "cut at {end}");
        }
        let (frames, damaged) = read_field(two.clone(), WriterId([2; 16]));
        assert!(frames.is_empty() && damaged, "another's frames");
        let mut long = two.to_vec();
        long[..4].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(read_field(Bytes::from(long), WriterId([1; 16])).1);
    }

    #[test]
    fn order_is_that_of_the_numbers_though_the_clock_was_set_back() {
        let mut mirror = Mirror::default();
        for (sequence, written_ns) in [(1, 50), (2, 20), (3, 60)] {
            let frame = kept(&frame(1, sequence, 1), written_ns);
            mirror.keep(&key(1), frame, 3);
        }
        let (frames, _) = read_field(value(&mirror, 1).unwrap(), WriterId([1; 16]));
        let found: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.sequence())).collect();
        assert_eq!(found, [(50, 1), (50, 2), (60, 3)]);
    }

    #[test]
    fn after_a_loss_all_that_lives_is_written_again() {
        let mut mirror = Mirror::default();
        for writer in 1..=3 {
            keep(&mut mirror, writer, 7, 10, 1);
        }
        mirror.rewrite_all();
        mirror.forget(&key(2));
        assert!(mirror.next_to_rewrite(Line::PublishLarge).is_none());
        let mut found = Vec::new();
        while let Some(((_, writer), _)) = mirror.next_to_rewrite(Line::PublishSmall) {
            found.push(writer.0[0]);
        }
        found.sort_unstable();
        assert_eq!(found, [1, 3]);
        mirror.forget_orphans();
        assert!(mirror.fields.iter().next().is_none());
    }
}
