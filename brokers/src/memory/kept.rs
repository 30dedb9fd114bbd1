//! Messages that are kept for late joiners.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::time::Instant;

use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;

/// Pairs of channel and writer of which one hub keeps messages at most.
pub const MAX_KEPT_WRITERS: usize = 65_536;
/// Bytes that one hub keeps at most (64 MiB).
pub const MAX_KEPT_BYTES: usize = 64 * 1024 * 1024;

/// Allowance for what a kept message takes beside its bytes: index entries and the parsed header.
const OVERHEAD_BYTES: usize = 512;

struct Entry {
    /// Order of arrival in the whole hub.
    stamp: u64,
    frame: Frame,
    since: Instant,
}

/// The last `depth` frames of each writer of each channel, bounded over all; the oldest give way.
pub(super) struct Kept {
    by_channel: HashMap<ChannelName, HashMap<WriterId, VecDeque<Entry>>>,
    /// Whose message has which stamp: the first is the oldest of all.
    by_age: BTreeMap<u64, (ChannelName, WriterId)>,
    next_stamp: u64,
    writers: usize,
    bytes: usize,
    dropped: u64,
    max_writers: usize,
    max_bytes: usize,
}

impl Default for Kept {
    fn default() -> Self {
        Self::with_bounds(MAX_KEPT_WRITERS, MAX_KEPT_BYTES)
    }
}

fn cost(frame: &Frame) -> usize {
    frame.wire_len() + OVERHEAD_BYTES
}

impl Kept {
    fn with_bounds(max_writers: usize, max_bytes: usize) -> Self {
        Self {
            by_channel: HashMap::new(),
            by_age: BTreeMap::new(),
            next_stamp: 0,
            writers: 0,
            bytes: 0,
            dropped: 0,
            max_writers,
            max_bytes,
        }
    }

    pub(super) fn writers(&self) -> usize {
        self.writers
    }

    pub(super) fn messages(&self) -> usize {
        self.by_age.len()
    }

    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Keeps a frame as the newest of its writer.
    pub(super) fn keep(&mut self, channel: &ChannelName, frame: Frame, depth: u32, now: Instant) {
        let writer = frame.writer();
        let stamp = self.next_stamp;
        self.next_stamp += 1;
        self.bytes += cost(&frame);
        self.by_age.insert(stamp, (channel.clone(), writer));
        let entries = self
            .by_channel
            .entry(channel.clone())
            .or_default()
            .entry(writer)
            .or_default();
        if entries.is_empty() {
            self.writers += 1;
        }
        entries.push_back(Entry {
            stamp,
            frame,
            since: now,
        });
        let depth = usize::try_from(depth).unwrap_or(usize::MAX);
        while entries.len() > depth {
            if let Some(old) = entries.pop_front() {
                self.by_age.remove(&old.stamp);
                self.bytes -= cost(&old.frame);
            }
        }
        self.enforce_bounds();
    }

    /// All that is kept of a channel and since when, in the order of arrival.
    pub(super) fn of_channel(&self, channel: &ChannelName) -> Vec<(Frame, Instant)> {
        let Some(writers) = self.by_channel.get(channel) else {
            return Vec::new();
        };
        let mut entries: Vec<&Entry> = writers.values().flatten().collect();
        entries.sort_unstable_by_key(|entry| entry.stamp);
        entries
            .into_iter()
            .map(|entry| (entry.frame.clone(), entry.since))
            .collect()
    }

    /// Forgets a writer of a channel. Returns how many of its messages were kept.
    pub(super) fn forget(&mut self, channel: &ChannelName, writer: WriterId) -> usize {
        let Some(writers) = self.by_channel.get_mut(channel) else {
            return 0;
        };
        let Some(entries) = writers.remove(&writer) else {
            return 0;
        };
        if writers.is_empty() {
            self.by_channel.remove(channel);
        }
        for entry in &entries {
            self.by_age.remove(&entry.stamp);
            self.bytes -= cost(&entry.frame);
        }
        self.writers -= 1;
        entries.len()
    }

    fn enforce_bounds(&mut self) {
        while self.writers > self.max_writers {
            let Some((_, (channel, writer))) = self.by_age.first_key_value() else {
                return;
            };
            // The whole writer: shortening many others for one newcomer would leave all of them incomplete.
            let (channel, writer) = (channel.clone(), *writer);
            self.dropped += self.forget(&channel, writer) as u64;
        }
        while self.bytes > self.max_bytes {
            let Some((_, (channel, writer))) = self.by_age.pop_first() else {
                return;
            };
            self.drop_oldest_of(&channel, writer);
        }
    }

    fn drop_oldest_of(&mut self, channel: &ChannelName, writer: WriterId) {
        let Some(writers) = self.by_channel.get_mut(channel) else {
            return;
        };
        let Some(entries) = writers.get_mut(&writer) else {
            return;
        };
        if let Some(old) = entries.pop_front() {
            self.bytes -= cost(&old.frame);
            self.dropped += 1;
        }
        if entries.is_empty() {
            writers.remove(&writer);
            self.writers -= 1;
            if writers.is_empty() {
                self.by_channel.remove(channel);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::Origin;
    use blaze_proto::Header;
    use bytes::Bytes;

    fn channel(name: &str) -> ChannelName {
        name.parse().unwrap()
    }

    fn frame(writer: u8, sequence: u64, bytes: usize) -> Frame {
        let header = Header::new("t", Origin::default(), WriterId([writer; 16]), sequence, 0);
        Frame::new(&header, Bytes::from(vec![0; bytes])).unwrap()
    }

    fn sequences(kept: &Kept, name: &str) -> Vec<(u8, u64)> {
        kept.of_channel(&channel(name))
            .iter()
            .map(|(frame, _)| (frame.writer().0[0], frame.sequence()))
            .collect()
    }

    #[test]
    fn keeps_the_last_of_each_writer_in_the_order_of_arrival() {
        let mut kept = Kept::default();
        let now = Instant::now();
        for sequence in 1..=4 {
            kept.keep(&channel("a"), frame(1, sequence, 10), 2, now);
            kept.keep(&channel("a"), frame(2, sequence, 10), 1, now);
            kept.keep(&channel("b"), frame(1, sequence, 10), 1, now);
        }
        assert_eq!(sequences(&kept, "a"), [(1, 3), (1, 4), (2, 4)]);
        assert_eq!(sequences(&kept, "b"), [(1, 4)]);
        assert_eq!((kept.writers(), kept.messages(), kept.dropped()), (3, 4, 0));
    }

    #[test]
    fn too_many_writers_cost_the_oldest_writer_all_its_messages() {
        let mut kept = Kept::with_bounds(2, usize::MAX);
        let now = Instant::now();
        for (writer, sequence) in [(1, 1), (2, 1), (1, 2), (3, 1)] {
            kept.keep(&channel("a"), frame(writer, sequence, 10), 5, now);
        }
        assert_eq!(sequences(&kept, "a"), [(2, 1), (3, 1)]);
        assert_eq!((kept.writers(), kept.dropped()), (2, 2));
    }

    #[test]
    fn too_many_bytes_cost_the_oldest_messages() {
        let one = cost(&frame(1, 1, 1000));
        let mut kept = Kept::with_bounds(100, 3 * one);
        let now = Instant::now();
        for sequence in 1..=3 {
            kept.keep(&channel("a"), frame(1, sequence, 1000), 10, now);
        }
        kept.keep(&channel("b"), frame(2, 1, 1000), 10, now);
        assert_eq!(sequences(&kept, "a"), [(1, 2), (1, 3)]);
        assert_eq!(sequences(&kept, "b"), [(2, 1)]);
        assert_eq!((kept.bytes(), kept.dropped()), (3 * one, 1));
    }

    #[test]
    fn forgetting_leaves_nothing_behind() {
        let mut kept = Kept::default();
        for sequence in 1..=3 {
            kept.keep(&channel("a"), frame(1, sequence, 1000), 10, Instant::now());
        }
        assert_eq!(kept.forget(&channel("a"), WriterId([1; 16])), 3);
        assert_eq!(kept.forget(&channel("a"), WriterId([1; 16])), 0);
        assert_eq!((kept.writers(), kept.messages(), kept.bytes()), (0, 0, 0));
        assert!(kept.by_channel.is_empty());
    }
}
