//! Messages that came over the link before their bridge stood.
//!
//! Both flows learn of a pair by the same announcement, but not at the same moment: the sender may
//! be quicker by some hundred milliseconds. What it sends then is meant for us and waits here,
//! bounded, until the bridge stands.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use blaze_proto::Frame;

use super::measure::micros;

/// How long a message waits for its bridge: twice what a change of the registry takes to reach the
/// plan.
pub(super) const WAIT: Duration = Duration::from_millis(500);
/// Messages that wait at most, of all topics; the oldest give way.
const MAX_MESSAGES: usize = 4_096;
/// Bytes that wait at most (8 MiB); one message always fits.
const MAX_BYTES: usize = 8 * 1024 * 1024;

/// Messages without a bridge, in the order in which they came.
#[derive(Default)]
pub(super) struct Early {
    waiting: VecDeque<(Instant, Frame)>,
    /// How many of each topic.
    topics: HashMap<String, usize>,
    bytes: usize,
}

impl Early {
    /// Holds a message. Returns those that gave way.
    pub(super) fn hold(&mut self, now: Instant, frame: Frame) -> Vec<Frame> {
        self.bytes += frame.received_len();
        match self.topics.get_mut(frame.topic()) {
            Some(count) => *count += 1,
            None => {
                self.topics.insert(frame.topic().to_owned(), 1);
            }
        }
        self.waiting.push_back((now, frame));
        let mut gone = Vec::new();
        while self.waiting.len() > MAX_MESSAGES
            || (self.bytes > MAX_BYTES && self.waiting.len() > 1)
        {
            gone.extend(self.pop());
        }
        gone
    }

    /// Those whose bridge did not come in time.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<Frame> {
        let mut gone = Vec::new();
        while self.next_expiry().is_some_and(|at| at <= now) {
            gone.extend(self.pop());
        }
        gone
    }

    /// Whether a message of the topic waits.
    pub(super) fn holds(&self, topic: &str) -> bool {
        self.topics.contains_key(topic)
    }

    /// When the next one has waited long enough.
    pub(super) fn next_expiry(&self) -> Option<Instant> {
        self.waiting.front().map(|(since, _)| *since + WAIT)
    }

    /// The messages of a topic, older by what they waited.
    pub(super) fn take(&mut self, now: Instant, topic: &str) -> Vec<Frame> {
        if self.topics.remove(topic).is_none() {
            return Vec::new();
        }
        let (taken, left): (VecDeque<_>, VecDeque<_>) = std::mem::take(&mut self.waiting)
            .into_iter()
            .partition(|(_, frame)| frame.topic() == topic);
        self.waiting = left;
        let aged = taken.into_iter().map(|(since, frame)| {
            self.bytes -= frame.received_len();
            let waited = micros(now.saturating_duration_since(since));
            let (hops, age_us) = (frame.hops(), frame.age_us().saturating_add(waited));
            frame.with_hops_and_age(hops, age_us)
        });
        aged.collect()
    }

    fn pop(&mut self) -> Option<Frame> {
        let (_, frame) = self.waiting.pop_front()?;
        self.bytes -= frame.received_len();
        if let Some(count) = self.topics.get_mut(frame.topic()) {
            *count -= 1;
            if *count == 0 {
                self.topics.remove(frame.topic());
            }
        }
        Some(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::{Origin, WriterId};
    use blaze_proto::Header;
    use bytes::Bytes;

    fn frame(topic: &str, sequence: u64, bytes: usize) -> Frame {
        let header = Header::new(topic, Origin::default(), WriterId([1; 16]), sequence, 0);
        Frame::new(&header, Bytes::from(vec![0; bytes])).unwrap()
    }

    #[test]
    fn a_topic_gets_its_messages_in_order_and_older() {
        let (mut early, now) = (Early::default(), Instant::now());
        for sequence in 1..=3 {
            assert!(early.hold(now, frame("a", sequence, 10)).is_empty());
            assert!(early.hold(now, frame("b", sequence, 10)).is_empty());
        }
        let taken = early.take(now + Duration::from_millis(20), "a");
        assert_eq!(taken.iter().map(Frame::sequence).collect::<Vec<_>>(), [1, 2, 3]);
        assert!(taken.iter().all(|frame| frame.age_us() == 20_000));
        assert!(early.take(now, "a").is_empty());
        assert!(early.holds("b") && !early.holds("a"));
        assert_eq!(early.expire(now + WAIT).len(), 3);
        assert_eq!((early.bytes, early.next_expiry()), (0, None));
        assert!(!early.holds("b"));
    }

    #[test]
    fn what_waits_is_bounded() {
        let (mut early, now) = (Early::default(), Instant::now());
        let mut gone = 0;
        for sequence in 1..=20 {
            gone += early.hold(now, frame("a", sequence, 1_000_000)).len();
        }
        assert_eq!((gone, early.waiting.len()), (12, 8));
        for sequence in 1..=5_000 {
            early.hold(now, frame("b", sequence, 0));
        }
        assert_eq!(early.waiting.len(), MAX_MESSAGES);
    }
}
