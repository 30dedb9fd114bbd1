//! A message whose parts come one by one.

use std::time::{Duration, Instant};

use blaze_proto::Frame;
use bytes::BytesMut;

use super::receiver::MESSAGE_OVERHEAD;
use super::wire::{MIN_PART_BYTES, Record};

#[derive(Debug)]
pub(crate) struct Assembly {
    buffer: BytesMut,
    /// What has come: disjoint, ascending, end excluded.
    ranges: Vec<(u32, u32)>,
    received: usize,
    pub behind: u16,
    pub hops: u8,
    /// Of the first part that came.
    pub age_us: u32,
    pub first_part: Instant,
    pub last_part: Instant,
    /// The class's active time at the last part.
    pub active: Duration,
    /// Half the round trip when its first part came.
    pub half_round_trip: Duration,
    /// End of its lifespan, once its header has come.
    pub expires: Option<Instant>,
    topic: String,
}

impl Assembly {
    pub(crate) fn new(
        first: &Record,
        now: Instant,
        half_round_trip: Duration,
        active: Duration,
    ) -> Self {
        Self {
            buffer: BytesMut::zeroed(first.total as usize),
            ranges: Vec::new(),
            received: 0,
            behind: first.behind,
            hops: first.hops,
            age_us: first.age_us,
            first_part: now,
            last_part: now,
            active,
            half_round_trip,
            expires: None,
            topic: String::new(),
        }
    }

    /// Memory that a message of that size takes while it is unfinished, at most.
    pub(crate) fn memory(total: usize) -> usize {
        total + total / MIN_PART_BYTES * size_of::<(u32, u32)>() + MESSAGE_OVERHEAD
    }

    pub(crate) fn total(&self) -> usize {
        self.buffer.len()
    }

    pub(crate) fn missing_bytes(&self) -> usize {
        self.total() - self.received
    }

    pub(crate) fn is_complete(&self) -> bool {
        self.received == self.total()
    }

    /// Topic, if its header has come; else empty.
    pub(crate) fn topic(&self) -> &str {
        &self.topic
    }

    /// Takes a part. Returns whether it is one of this message.
    pub(crate) fn take(
        &mut self,
        record: &Record,
        bytes: &[u8],
        now: Instant,
        active: Duration,
    ) -> bool {
        let (start, end) = (record.offset as usize, record.offset as usize + bytes.len());
        if record.total as usize != self.total() || end > self.total() {
            return false;
        }
        if !self.note(record.offset, record.offset + record.length) {
            return true;
        }
        self.buffer[start..end].copy_from_slice(bytes);
        self.last_part = now;
        self.active = active;
        if start == 0 {
            self.read_header(record, bytes);
        }
        true
    }

    /// Topic and lifespan, where the first part holds the whole header, which it does unless that
    /// is very long.
    fn read_header(&mut self, record: &Record, bytes: &[u8]) {
        let Ok(length) = Frame::head_length(bytes) else { return };
        let Some(head) = bytes.get(..length) else { return };
        let Ok(frame) = Frame::parse(BytesMut::from(head).freeze()) else {
            return;
        };
        self.topic = frame.topic().chars().take(200).collect();
        if frame.lifespan_ms() > 0 {
            let age = Duration::from_micros(u64::from(record.age_us)) + self.half_round_trip;
            let left = Duration::from_millis(u64::from(frame.lifespan_ms())).saturating_sub(age);
            self.expires = self.last_part.checked_add(left);
        }
    }

    /// Notes a range. Returns whether any of it is new.
    fn note(&mut self, start: u32, end: u32) -> bool {
        let from = self.ranges.partition_point(|range| range.1 < start);
        let to = self.ranges.partition_point(|range| range.0 <= end);
        let (mut joined, mut known) = ((start, end), 0);
        for range in &self.ranges[from..to] {
            known += range.1.min(end).saturating_sub(range.0.max(start));
            joined = (joined.0.min(range.0), joined.1.max(range.1));
        }
        if known == end - start {
            return false;
        }
        self.ranges.splice(from..to, [joined]);
        self.received += (end - start - known) as usize;
        true
    }

    /// The complete message, unless its bytes are no frame.
    pub(crate) fn into_frame(self) -> Option<Frame> {
        Frame::parse(self.buffer.freeze()).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn record(total: u32, offset: u32, length: u32) -> Record {
        Record { message: 1, total, offset, length, hops: 1, flags: 0, behind: 0, age_us: 0 }
    }

    proptest! {
        #[test]
        fn parts_in_any_order_make_the_whole(
            parts in proptest::collection::vec((0u32..2000, 1u32..700), 1..40),
        ) {
            let total = 2_000;
            let now = Instant::now();
            let whole: Vec<u8> = (0..total).map(|at| u8::try_from(at % 253).unwrap()).collect();
            let mut assembly =
                Assembly::new(&record(total, 0, 1), now, Duration::ZERO, Duration::ZERO);
            let mut truth = vec![false; total as usize];
            for (offset, length) in parts {
                let length = length.min(total - offset);
                let place = offset as usize..(offset + length) as usize;
                prop_assert!(
                    assembly.take(
                        &record(total, offset, length),
                        &whole[place.clone()],
                        now,
                        Duration::ZERO,
                    ),
                );
                truth[place].fill(true);
                let known = truth.iter().filter(|known| **known).count();
                prop_assert_eq!(assembly.missing_bytes(), total as usize - known);
            }
            for (at, known) in truth.iter().enumerate().filter(|(_, known)| **known) {
                prop_assert!(*known && assembly.buffer[at] == whole[at]);
            }
            prop_assert!(
                !assembly.take(&record(total + 1, 0, 300), &whole[..300], now, Duration::ZERO),
            );
        }
    }
}
