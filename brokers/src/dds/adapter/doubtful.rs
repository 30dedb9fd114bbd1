//! Samples that came before it is known whether they are read.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::Admission;
use crate::dds::EndpointId;

/// How long a sample waits.
pub(crate) const LONGEST_DOUBT: Duration = Duration::from_secs(3);
/// Samples of one writer that wait in a channel; then the oldest are lost.
const MAX_SAMPLES: usize = 1024;
/// Bytes of all that wait in one adapter; then the oldest of the same writer are lost.
const MAX_BYTES: usize = 32 * 1024 * 1024;
/// Bookkeeping of a sample, so that empty ones are bounded, too.
const OVERHEAD_BYTES: usize = 128;

/// Bytes that wait in all channels of one adapter.
pub(super) type Room = Arc<AtomicUsize>;

/// A part of the room, given back on drop.
struct Reserved {
    room: Room,
    bytes: usize,
}

impl Reserved {
    fn of(room: &Room, bytes: usize) -> Option<Self> {
        let add = |used: usize| used.checked_add(bytes).filter(|sum| *sum <= MAX_BYTES);
        room.fetch_update(Ordering::AcqRel, Ordering::Acquire, add).ok()?;
        Some(Self { room: Arc::clone(room), bytes })
    }
}

impl Drop for Reserved {
    fn drop(&mut self) {
        self.room.fetch_sub(self.bytes, Ordering::AcqRel);
    }
}

struct Waiting<T> {
    since: Instant,
    sample: T,
    _bytes: Reserved,
}

/// What became of a sample that waited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    /// It is read.
    Read,
    /// It gave way, or waited for too long.
    Lost,
}

/// The samples of a channel that wait, in the order of their arrival for each writer.
pub(super) struct Doubtful<T> {
    by_writer: HashMap<EndpointId, VecDeque<Waiting<T>>>,
    room: Room,
}

impl<T> Doubtful<T> {
    pub(super) fn new(room: Room) -> Self {
        Self { by_writer: HashMap::new(), room }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.by_writer.is_empty()
    }

    pub(super) fn has(&self, writer: &EndpointId) -> bool {
        self.by_writer.contains_key(writer)
    }

    /// Takes a sample. Returns those that are lost for it: older ones of the same writer, or itself.
    pub(super) fn push(
        &mut self,
        now: Instant,
        writer: EndpointId,
        sample: T,
        bytes: usize,
    ) -> Vec<T> {
        let mut lost = Vec::new();
        let waiting = self.by_writer.entry(writer).or_default();
        if waiting.len() >= MAX_SAMPLES {
            lost.extend(waiting.pop_front().map(|oldest| oldest.sample));
        }
        loop {
            if let Some(bytes) = Reserved::of(&self.room, bytes + OVERHEAD_BYTES) {
                waiting.push_back(Waiting { since: now, sample, _bytes: bytes });
                break;
            }
            let Some(oldest) = waiting.pop_front() else {
                self.by_writer.remove(&writer);
                lost.push(sample);
                break;
            };
            lost.push(oldest.sample);
        }
        lost
    }

    /// Takes out what is decided, and what has waited for too long.
    pub(super) fn resolve(
        &mut self,
        now: Instant,
        admission: impl Fn(&EndpointId) -> Admission,
        mut each: impl FnMut(T, Outcome),
    ) {
        let is_over =
            |one: &mut Waiting<T>| now.saturating_duration_since(one.since) >= LONGEST_DOUBT;
        self.by_writer.retain(|writer, waiting| {
            match admission(writer) {
                Admission::Yes => {
                    waiting.drain(..).for_each(|one| each(one.sample, Outcome::Read));
                }
                Admission::No => waiting.clear(),
                Admission::Later => {
                    while let Some(one) = waiting.pop_front_if(is_over) {
                        each(one.sample, Outcome::Lost);
                    }
                }
            }
            !waiting.is_empty()
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: EndpointId = [1; 16];
    const OTHER: EndpointId = [2; 16];

    fn resolved(
        doubtful: &mut Doubtful<usize>,
        now: Instant,
        admission: impl Fn(&EndpointId) -> Admission,
    ) -> Vec<(usize, Outcome)> {
        let mut found = Vec::new();
        doubtful.resolve(now, admission, |sample, outcome| found.push((sample, outcome)));
        found
    }

    #[test]
    fn samples_wait_for_a_decision_in_order_and_not_for_ever() {
        let now = Instant::now();
        let room = Room::default();
        let mut doubtful = Doubtful::new(Arc::clone(&room));
        for number in 0..3 {
            assert!(doubtful.push(now, ONE, number, 10).is_empty());
            let at = now + Duration::from_secs(number as u64);
            assert!(doubtful.push(at, OTHER, 10 + number, 10).is_empty());
        }
        assert!(resolved(&mut doubtful, now, |_| Admission::Later).is_empty());
        let yes = |writer: &EndpointId| match *writer {
            ONE => Admission::Yes,
            _ => Admission::Later,
        };
        assert_eq!(
            resolved(&mut doubtful, now, yes),
            [(0, Outcome::Read), (1, Outcome::Read), (2, Outcome::Read)]
        );
        assert!(!doubtful.has(&ONE) && doubtful.has(&OTHER));
        let later = now + LONGEST_DOUBT + Duration::from_secs(1);
        assert_eq!(
            resolved(&mut doubtful, later, |_| Admission::Later),
            [(10, Outcome::Lost), (11, Outcome::Lost)]
        );
        assert!(resolved(&mut doubtful, now, |_| Admission::No).is_empty());
        assert!(doubtful.is_empty());
        assert_eq!(room.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn what_waits_is_bounded_for_each_writer_and_in_all_channels_together() {
        let now = Instant::now();
        let room = Room::default();
        let [mut doubtful, mut other] = [(); 2].map(|()| Doubtful::new(Arc::clone(&room)));
        for number in 0..MAX_SAMPLES {
            assert!(doubtful.push(now, ONE, number, 0).is_empty());
        }
        assert_eq!(doubtful.push(now, ONE, MAX_SAMPLES, 0), [0]);
        assert!(doubtful.push(now, OTHER, 7, MAX_BYTES / 2).is_empty());
        assert_eq!(other.push(now, OTHER, 8, MAX_BYTES / 2), [8], "others have the room");
        assert!(!other.has(&OTHER));
        assert_eq!(doubtful.push(now, OTHER, 9, MAX_BYTES / 2), [7]);
        drop(doubtful);
        assert_eq!(room.load(Ordering::Relaxed), 0);
    }
}
