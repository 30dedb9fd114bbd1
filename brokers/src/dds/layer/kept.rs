//! What a late joiner begins with: the last `depth` frames of each writer, as their headers say.
//!
//! RustDDS forgets what is beyond a writer's depth only every six seconds, so a late joiner may be given more. What it is
//! given is held until a live sample of the same writer comes, or nothing more for a moment.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use crate::dds::EndpointId;
use crate::port::{Content, Received};

/// After such a pause a writer has given all that it keeps.
const QUIET: Duration = Duration::from_millis(150);
/// Writers that are held at once, and frames of each; beyond that they are delivered as they come.
const MAX_WRITERS: usize = 1024;
const MAX_FRAMES: usize = 1024;

struct Held {
    frames: VecDeque<Received>,
    newest: Instant,
}

/// History that a channel has received and not delivered yet.
#[derive(Default)]
pub(super) struct History {
    writers: HashMap<EndpointId, Held>,
}

impl History {
    /// Takes a frame that was written before the channel was read. Returns those that are not held.
    pub(super) fn hold(&mut self, now: Instant, writer: EndpointId, received: Received) -> Option<Received> {
        if self.writers.len() >= MAX_WRITERS && !self.writers.contains_key(&writer) {
            return Some(received);
        }
        let depth = match &received.content {
            Content::Frame(frame) if frame.depth() > 0 => usize::try_from(frame.depth()).unwrap_or(MAX_FRAMES),
            // It does not say how many: all that come.
            _ => MAX_FRAMES,
        };
        let held = self.writers.entry(writer).or_insert_with(|| Held {
            frames: VecDeque::new(),
            newest: now,
        });
        held.newest = now;
        held.frames.push_back(received);
        while held.frames.len() > depth.min(MAX_FRAMES) {
            held.frames.pop_front();
        }
        None
    }

    /// What a writer gave, before a live sample of it.
    pub(super) fn of_writer(&mut self, writer: EndpointId) -> impl Iterator<Item = Received> + use<> {
        let held = self.writers.remove(&writer);
        held.into_iter().flat_map(|held| held.frames)
    }

    /// What writers gave that give nothing more.
    pub(super) fn quiet(&mut self, now: Instant) -> Vec<Received> {
        let mut quiet = Vec::new();
        self.writers.retain(|_, held| {
            let is_quiet = now.saturating_duration_since(held.newest) >= QUIET;
            if is_quiet {
                quiet.extend(held.frames.drain(..));
            }
            !is_quiet
        });
        quiet
    }
}

#[cfg(test)]
mod tests {
    use blaze_domain::{Origin, WriterId};
    use blaze_proto::{Frame, Header};
    use bytes::Bytes;

    use super::*;

    fn received(at: Instant, sequence: u64, depth: u32) -> Received {
        let header = Header {
            depth,
            ..Header::new("t", Origin::default(), WriterId([1; 16]), sequence, 0)
        };
        Received::live(Content::Frame(Frame::new(&header, Bytes::new()).unwrap()), at)
    }

    fn sequences(received: impl IntoIterator<Item = Received>) -> Vec<u64> {
        let sequence = |received: Received| match received.content {
            Content::Frame(frame) => frame.sequence(),
            other => panic!("{other:?}"),
        };
        received.into_iter().map(sequence).collect()
    }

    #[test]
    fn the_last_of_each_writer_stay_until_it_is_quiet_or_live() {
        let now = Instant::now();
        let mut history = History::default();
        for sequence in 1..=5 {
            assert!(history.hold(now, [1; 16], received(now, sequence, 2)).is_none());
            assert!(history.hold(now, [2; 16], received(now, sequence, 0)).is_none());
        }
        assert_eq!(sequences(history.of_writer([1; 16])), [4, 5]);
        assert!(sequences(history.of_writer([1; 16])).is_empty());
        assert!(sequences(history.quiet(now)).is_empty());
        assert_eq!(sequences(history.quiet(now + QUIET)), [1, 2, 3, 4, 5]);
        assert!(history.writers.is_empty());
    }

    #[test]
    fn a_crowd_of_writers_is_not_held() {
        let now = Instant::now();
        let mut history = History::default();
        for number in 0..MAX_WRITERS {
            let mut id = [0; 16];
            id[..8].copy_from_slice(&number.to_le_bytes());
            assert!(history.hold(now, id, received(now, 1, 1)).is_none());
        }
        assert!(history.hold(now, [0xff; 16], received(now, 1, 1)).is_some());
    }
}
