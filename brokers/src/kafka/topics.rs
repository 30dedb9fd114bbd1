//! The topics that are written, and whether the server has them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::settings::Lot;

/// Bytes of a batch that no batch of ours reaches: twice `batch.size`, for what a record has beside
/// its payload.
const ROOMY: usize = 1_000_000;
/// Of several partitions one may have no leader: what is not acknowledged for longer holds up
/// nothing any more.
pub(super) const LONG: Duration = Duration::from_millis(100);
/// So many messages of a topic go at once: no more than librdkafka has of a partition under way
/// before it waits for answers.
const FEW: usize = 4;
/// Not known to exist.
const ABSENT: i32 = 0;

/// A topic that is written. It lives as long as its publishers.
#[derive(Debug)]
pub(super) struct Topic {
    /// Its name on the server.
    pub(super) name: Arc<str>,
    partitions: AtomicI32,
    /// Largest batch that the server takes, in bytes; 0 = not known.
    largest_batch: AtomicUsize,
    /// The server is to be asked for it, also where it was before.
    asks_limit: AtomicBool,
    in_flight: Mutex<[InFlight; Lot::COUNT]>,
    /// Written also while the scope belongs to another flow.
    pub(super) stays_open: bool,
}

/// Messages of a topic that are with the clients of one producer and not acknowledged.
#[derive(Debug, Default)]
struct InFlight {
    count: usize,
    /// When the last of them was handed over.
    last: Option<Instant>,
    /// The client that has them.
    with: Which,
    /// Those that are to be handed over together next.
    coming: usize,
}

/// One of the two librdkafka clients that a producer has.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) enum Which {
    /// It sends at once what it gets.
    #[default]
    Prompt,
    /// It gathers what it gets together.
    Gathering,
}

impl Topic {
    /// How many partitions the server has of it; `None` = it is not known to be there, so that
    /// nothing is handed over.
    pub(super) fn partitions(&self) -> Option<i32> {
        let partitions = self.partitions.load(Ordering::Acquire);
        (partitions != ABSENT).then_some(partitions)
    }

    /// Bytes that may be handed over now, by the sizes that an outbox counts; `None` = nothing.
    ///
    /// What comes while messages are in flight waits, and goes together: few large requests carry
    /// many messages where many come, and none waits where few do.
    ///
    /// The server's limit counts the whole batch that the client library makes of what it has.
    /// Where that could be too large, only what fits is handed over, and more when it is
    /// acknowledged: a message is refused for its own size alone.
    pub(super) fn allowance(&self, lot: Lot, now: Instant) -> Option<usize> {
        let limit = self.largest_batch.load(Ordering::Acquire);
        let in_flight = &self.in_flight.lock()[lot.index()];
        let is_long =
            || in_flight.last.is_some_and(|last| now.saturating_duration_since(last) >= LONG);
        let has_several = || self.partitions().is_some_and(|partitions| partitions > 1);
        match (in_flight.count, self.is_limited()) {
            // On the wire a small message with its headers has up to twice what the outbox counts.
            (0, true) => Some(limit / 2),
            (0, false) => Some(usize::MAX),
            (_, false) if has_several() && is_long() => Some(usize::MAX),
            _ => None,
        }
    }

    /// Whether the server takes less than what batches may become.
    pub(super) fn is_limited(&self) -> bool {
        let limit = self.largest_batch.load(Ordering::Acquire);
        limit != 0 && limit < ROOMY
    }

    /// A message is about to be handed over, with others.
    pub(super) fn announce(&self, lot: Lot) {
        self.in_flight.lock()[lot.index()].coming += 1;
    }

    /// All that was announced is in flight from now on. Returns the client for it: as long as one
    /// has messages, all go there, as the other might be faster.
    pub(super) fn depart(&self, lot: Lot, now: Instant) -> Which {
        let in_flight = &mut self.in_flight.lock()[lot.index()];
        if in_flight.count == 0 {
            let few = in_flight.coming <= FEW;
            in_flight.with = if few { Which::Prompt } else { Which::Gathering };
        }
        in_flight.count += std::mem::take(&mut in_flight.coming);
        in_flight.last = Some(now);
        in_flight.with
    }

    /// A message is no longer with the client library. Whether it was the last.
    pub(super) fn end(&self, lot: Lot) -> bool {
        let in_flight = &mut self.in_flight.lock()[lot.index()];
        in_flight.count = in_flight.count.saturating_sub(1);
        in_flight.count == 0
    }

    /// The server refused a message for its size. Where that was thought to be impossible, messages
    /// go one by one until the server has told its limit.
    pub(super) fn doubt_limit(&self) {
        if !self.is_limited() {
            self.largest_batch.store(1, Ordering::Release);
        }
        self.asks_limit.store(true, Ordering::Release);
    }

    fn forget_limit(&self) {
        self.largest_batch.store(0, Ordering::Release);
        self.asks_limit.store(true, Ordering::Release);
    }

    /// The server says that there is no such topic.
    pub(super) fn vanished(&self) {
        self.forget_limit();
        self.partitions.store(ABSENT, Ordering::Release);
    }
}

/// All topics that are written.
#[derive(Debug, Default)]
pub(super) struct Topics {
    by_name: Mutex<HashMap<Arc<str>, Weak<Topic>>>,
    /// Where the next search for absent ones begins.
    next: AtomicUsize,
}

impl Topics {
    /// The topic of a name; also whether it is new here.
    pub(super) fn of(&self, name: &Arc<str>, stays_open: bool) -> (Arc<Topic>, bool) {
        let mut by_name = self.by_name.lock();
        if let Some(topic) = by_name.get(name).and_then(Weak::upgrade) {
            return (topic, false);
        }
        if by_name.len() == by_name.capacity() {
            by_name.retain(|_, topic| topic.strong_count() > 0);
        }
        let topic = Arc::new(Topic {
            name: Arc::clone(name),
            partitions: AtomicI32::new(ABSENT),
            largest_batch: AtomicUsize::new(0),
            asks_limit: AtomicBool::new(true),
            in_flight: Mutex::default(),
            stays_open,
        });
        by_name.insert(Arc::clone(name), Arc::downgrade(&topic));
        (topic, true)
    }

    /// Up to `limit` topics that are not known to be there, in turns.
    pub(super) fn absent(&self, limit: usize) -> Vec<Arc<str>> {
        let by_name = self.by_name.lock();
        let absent =
            |topic: &Weak<Topic>| topic.upgrade().filter(|topic| topic.partitions().is_none());
        let mut names: Vec<Arc<str>> =
            by_name.values().filter_map(absent).map(|topic| Arc::clone(&topic.name)).collect();
        if names.len() > limit {
            names.sort_unstable();
            let from = self.next.fetch_add(limit, Ordering::Relaxed) % names.len();
            names.rotate_left(from);
            names.truncate(limit);
        }
        names
    }

    /// Up to `limit` topics whose largest batch the server is to be asked for, of those that it
    /// has.
    pub(super) fn without_limit(
        &self,
        found: &HashMap<String, usize>,
        limit: usize,
    ) -> Vec<Arc<str>> {
        let unknown = |topic: &Arc<Topic>| {
            let is_there = topic.partitions().is_some() || found.contains_key(&*topic.name);
            topic.asks_limit.load(Ordering::Acquire) && is_there
        };
        let by_name = self.by_name.lock();
        let topics = by_name.values().filter_map(Weak::upgrade).filter(unknown);
        topics.map(|topic| Arc::clone(&topic.name)).take(limit).collect()
    }

    /// The server takes batches of so many bytes; `None` = it does not say.
    pub(super) fn note_limit(&self, name: &str, bytes: Option<usize>) {
        if let Some(topic) = self.by_name.lock().get(name).and_then(Weak::upgrade) {
            topic.asks_limit.store(false, Ordering::Release);
            if let Some(bytes) = bytes {
                topic.largest_batch.store(bytes, Ordering::Release);
            }
        }
    }

    /// The server has these topics, with so many partitions; and no others, if these are `all`.
    /// Returns whether one came.
    pub(super) fn note(&self, found: &HashMap<String, usize>, all: bool) -> bool {
        let mut came = false;
        for (name, topic) in &*self.by_name.lock() {
            let Some(topic) = topic.upgrade() else { continue };
            match found.get(&**name) {
                Some(partitions) => {
                    let partitions = i32::try_from(*partitions).unwrap_or(i32::MAX);
                    came |= topic.partitions.swap(partitions, Ordering::AcqRel) == ABSENT;
                }
                None if all => topic.vanished(),
                None => {}
            }
        }
        came
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(topics: &[(&str, usize)]) -> HashMap<String, usize> {
        topics.iter().map(|(name, partitions)| ((*name).to_owned(), *partitions)).collect()
    }

    #[test]
    fn topics_come_and_go() {
        let topics = Topics::default();
        let name: Arc<str> = Arc::from("a");
        let (topic, new) = topics.of(&name, false);
        assert!(new && topic.partitions().is_none());
        assert!(!topics.of(&name, false).1);
        assert_eq!(topics.absent(16), [Arc::clone(&name)]);
        assert!(topics.note(&found(&[("a", 2)]), false));
        assert!(!topics.note(&found(&[("a", 3)]), false), "it was there already");
        assert_eq!(topic.partitions(), Some(3));
        assert!(topics.absent(16).is_empty());
        assert!(!topics.note(&found(&[]), false) && topic.partitions().is_some());
        assert!(!topics.note(&found(&[]), true));
        assert_eq!(topic.partitions(), None);
        assert!(topics.note(&found(&[("a", 1)]), true));
        drop(topic);
        assert!(topics.of(&name, false).1, "it was forgotten with its last publisher");
    }

    const LOT: Lot = Lot { reliable: true, large: false };

    fn hand_over(topic: &Topic, count: usize, now: Instant) -> Which {
        (0..count).for_each(|_| topic.announce(LOT));
        let client = topic.depart(LOT, now);
        assert_eq!(topic.depart(LOT, now), client, "each message of them asks");
        client
    }

    #[test]
    fn a_topic_with_small_batches_gets_what_fits_when_nothing_is_on_its_way() {
        let topics = Topics::default();
        let (topic, _) = topics.of(&Arc::from("a"), false);
        let now = Instant::now();
        let allowance = || topic.allowance(LOT, now);
        assert_eq!(allowance(), Some(usize::MAX), "not known");
        assert_eq!(topics.without_limit(&found(&[("a", 1)]), 8).len(), 1);
        topics.note_limit("a", Some(10_000));
        assert!(topics.without_limit(&found(&[("a", 1)]), 8).is_empty());
        assert_eq!(allowance(), Some(5_000));
        hand_over(&topic, 1, now);
        assert_eq!(topic.allowance(LOT, now + LONG), None);
        assert!(topic.end(LOT));
        assert_eq!(allowance(), Some(5_000));
        topic.doubt_limit();
        assert_eq!(allowance(), Some(5_000), "a message was too large by itself");
        assert_eq!(topics.without_limit(&found(&[("a", 1)]), 8).len(), 1);
        topics.note_limit("a", Some(17_825_792));
        assert_eq!(allowance(), Some(usize::MAX));
        topic.doubt_limit();
        assert_eq!(allowance(), Some(0), "one by one");
        topics.note(&found(&[]), true);
        assert_eq!(allowance(), Some(usize::MAX), "made anew it has another");
        topics.note_limit("a", None);
        assert!(
            topics.without_limit(&found(&[("a", 1)]), 8).is_empty(),
            "not asked again and again"
        );
    }

    #[test]
    fn what_is_in_flight_holds_up_the_next_unless_it_takes_long() {
        let topics = Topics::default();
        let (topic, _) = topics.of(&Arc::from("a"), false);
        let now = Instant::now();
        assert_eq!(topic.allowance(LOT, now), Some(usize::MAX));
        hand_over(&topic, 1, now);
        hand_over(&topic, 1, now);
        assert!(!topic.end(LOT));
        assert_eq!(topic.allowance(LOT, now), None, "one is not acknowledged");
        assert_eq!(topic.allowance(Lot::default(), now), Some(usize::MAX), "another producer's");
        topics.note(&found(&[("a", 1)]), false);
        assert_eq!(topic.allowance(LOT, now + LONG), None, "it waits for the only partition");
        topics.note(&found(&[("a", 2)]), false);
        assert_eq!(topic.allowance(LOT, now + LONG), Some(usize::MAX));
        hand_over(&topic, 1, now + LONG);
        assert_eq!(topic.allowance(LOT, now + LONG), None);
        assert!(!topic.end(LOT));
        assert!(topic.end(LOT));
        assert_eq!(topic.allowance(LOT, now + LONG), Some(usize::MAX));
    }

    #[test]
    fn many_go_to_the_client_that_gathers_but_past_none_that_is_on_its_way() {
        let topics = Topics::default();
        let (topic, _) = topics.of(&Arc::from("a"), false);
        let now = Instant::now();
        let hand_over = |count| hand_over(&topic, count, now);
        assert_eq!(hand_over(FEW), Which::Prompt);
        assert_eq!(hand_over(FEW + 1), Which::Prompt, "the first are on their way");
        (0..2 * FEW).for_each(|_| assert!(!topic.end(LOT)));
        assert!(topic.end(LOT));
        assert_eq!(hand_over(FEW + 1), Which::Gathering);
        assert_eq!(hand_over(1), Which::Gathering);
        (0..=FEW).for_each(|_| assert!(!topic.end(LOT)));
        assert!(topic.end(LOT));
        assert_eq!(hand_over(1), Which::Prompt);
    }

    #[test]
    fn absent_topics_have_their_turns() {
        let topics = Topics::default();
        let names: Vec<Arc<str>> =
            (0..40).map(|number| Arc::from(format!("t{number:02}"))).collect();
        let kept: Vec<_> = names.iter().map(|name| topics.of(name, false).0).collect();
        let mut seen: Vec<_> = (0..3).flat_map(|_| topics.absent(16)).collect();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), kept.len());
    }
}
