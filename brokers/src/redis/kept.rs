//! What is kept for late joiners: the list that a field of a hash holds, and the own copy that it is written from.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Weak};

use blaze_domain::WriterId;
use blaze_proto::Frame;
use blaze_proto::frame::MAX_FRAME_BYTES;
use bytes::{Buf, Bytes};
use lru::LruCache;
use redis::{RedisWrite, ToRedisArgs};

use super::publisher::Target;
use super::state::Line;

/// Writers of which one client keeps frames at most; the one that was silent longest gives way.
pub const MAX_KEPT_WRITERS: usize = 65_536;
/// Bytes that one client keeps at most (64 MiB).
pub const MAX_KEPT_BYTES: usize = 64 * 1024 * 1024;
/// Bytes of one field at most; its oldest frames give way, but one frame always fits. Each message writes the whole field.
const MAX_FIELD_BYTES: usize = 32 * 1024 * 1024;
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
}

impl KeptFrame {
    fn length(&self) -> usize {
        self.head.len() + self.payload.len()
    }

    fn cost(&self) -> usize {
        self.length() + ENTRY_HEAD_BYTES + OVERHEAD_BYTES
    }
}

/// The value of a field: the frames of one writer, oldest first.
///
/// Each is a length (u32, little-endian), the time of publishing (u64, little-endian, nanoseconds since 1970, the clock of
/// the host of the publisher) and the frame.
pub(super) struct Field {
    frames: VecDeque<KeptFrame>,
    bytes: usize,
    line: Line,
    /// Gone with the publisher, once all that waited in its queue is written.
    publisher: Weak<Target>,
}

impl Field {
    fn pop(&mut self) -> usize {
        let cost = self.frames.pop_front().map_or(0, |frame| frame.cost());
        self.bytes -= cost;
        cost
    }

    /// Bytes of the value at most.
    pub(super) fn size(&self) -> usize {
        self.bytes
    }
}

impl ToRedisArgs for &Field {
    fn write_redis_args<W: ?Sized + RedisWrite>(&self, out: &mut W) {
        use std::io::Write as _;
        let mut value = out.writer_for_next_arg();
        for frame in &self.frames {
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
    fields: LruCache<FieldKey, Field>,
    bytes: usize,
    max_writers: usize,
    max_bytes: usize,
    /// Fields that the server has lost, by the connection that wrote them.
    rewrite: HashMap<Line, VecDeque<FieldKey>>,
}

impl Default for Mirror {
    fn default() -> Self {
        Self::with_bounds(MAX_KEPT_WRITERS, MAX_KEPT_BYTES)
    }
}

impl Mirror {
    fn with_bounds(max_writers: usize, max_bytes: usize) -> Self {
        Self {
            fields: LruCache::unbounded(),
            bytes: 0,
            max_writers,
            max_bytes,
            rewrite: HashMap::new(),
        }
    }

    /// Takes a frame in as the newest of its writer, and gives the field that is to be written before it is published.
    pub(super) fn keep(
        &mut self,
        key: &FieldKey,
        frame: KeptFrame,
        depth: usize,
        line: Line,
        publisher: Weak<Target>,
    ) -> Option<&Field> {
        let field = self.fields.get_or_insert_mut(key.clone(), || Field {
            frames: VecDeque::new(),
            bytes: 0,
            line,
            publisher: Weak::new(),
        });
        (field.line, field.publisher) = (line, publisher);
        let before = field.bytes;
        field.bytes += frame.cost();
        field.frames.push_back(frame);
        let most = self.max_bytes.min(MAX_FIELD_BYTES);
        while field.frames.len() > depth.max(1) || (field.bytes > most && field.frames.len() > 1) {
            field.pop();
        }
        self.bytes = self.bytes - before + field.bytes;
        // The field itself is the one used last, so it goes only when it is alone.
        while self.fields.len() > self.max_writers || (self.bytes > self.max_bytes && self.fields.len() > 1) {
            let Some((_, field)) = self.fields.pop_lru() else { break };
            self.bytes -= field.bytes;
        }
        self.fields.peek(key)
    }

    /// Forgets a writer.
    pub(super) fn forget(&mut self, key: &FieldKey) {
        if let Some(field) = self.fields.pop(key) {
            self.bytes -= field.bytes;
        }
    }

    /// Forgets what publishers wrote that are no more.
    pub(super) fn forget_orphans(&mut self) {
        let orphans: Vec<FieldKey> = self
            .fields
            .iter()
            .filter(|(_, field)| field.publisher.strong_count() == 0)
            .map(|(key, _)| key.clone())
            .collect();
        for key in &orphans {
            self.forget(key);
        }
    }

    /// The server has lost everything.
    pub(super) fn rewrite_all(&mut self) {
        self.rewrite.clear();
        for (key, field) in &self.fields {
            self.rewrite.entry(field.line).or_default().push_back(key.clone());
        }
    }

    /// The next field that a connection has to write again.
    pub(super) fn next_to_rewrite(&mut self, line: Line) -> Option<(FieldKey, &Field)> {
        let queue = self.rewrite.get_mut(&line)?;
        while let Some(key) = queue.pop_front() {
            if self.fields.contains(&key) {
                let field = self.fields.peek(&key)?;
                return Some((key, field));
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
        }
    }

    fn key(writer: u8) -> FieldKey {
        (Arc::from("blaze:last:t"), WriterId([writer; 16]))
    }

    fn keep(mirror: &mut Mirror, writer: u8, sequence: u64, bytes: usize, depth: usize) {
        let frame = kept(&frame(writer, sequence, bytes), sequence);
        mirror.keep(&key(writer), frame, depth, Line::PublishSmall, Weak::new());
    }

    fn value(mirror: &Mirror, writer: u8) -> Option<Bytes> {
        let field = mirror.fields.peek(&key(writer))?;
        field.to_redis_args().pop().map(Bytes::from)
    }

    fn sequences(mirror: &Mirror, writer: u8) -> Vec<u64> {
        let Some(value) = value(mirror, writer) else {
            return Vec::new();
        };
        let (frames, damaged) = read_field(value, WriterId([writer; 16]));
        assert!(!damaged);
        frames.iter().map(|(_, frame)| frame.sequence()).collect()
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
            mirror.keep(&key(1), frame, 3, Line::PublishSmall, Weak::new());
        }
        let (frames, _) = read_field(value(&mirror, 1).unwrap(), WriterId([1; 16]));
        let found: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.sequence())).collect();
        assert_eq!(found, [(50, 1), (50, 2), (60, 3)]);
    }

    #[test]
    fn the_mirror_is_bounded_and_the_longest_silent_give_way() {
        let mut mirror = Mirror::with_bounds(2, usize::MAX);
        for writer in 1..=3 {
            keep(&mut mirror, writer, 1, 10, 5);
        }
        assert!(sequences(&mirror, 1).is_empty());
        assert_eq!((sequences(&mirror, 2), sequences(&mirror, 3)), (vec![1], vec![1]));

        let mut mirror = Mirror::with_bounds(100, 4_000);
        for sequence in 1..=3 {
            keep(&mut mirror, 1, sequence, 1_000, 5);
        }
        keep(&mut mirror, 2, 1, 1_000, 5);
        assert!(sequences(&mirror, 1).is_empty());
        keep(&mut mirror, 2, 2, 100_000, 5);
        assert_eq!(sequences(&mirror, 2), [2], "one frame always fits");
        mirror.forget(&key(2));
        assert_eq!((mirror.bytes, mirror.fields.len()), (0, 0));
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
        assert_eq!(mirror.bytes, 0);
    }
}
