//! The last messages of transient_local writers, for bridges that begin later.
//!
//! A broker keeps them for those who subscribe to it; a bridge that begins while the topic is being
//! read already gets them from here, and so does a flow that comes back.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use blaze_brokers::retained::{RetainedBounds, RetainedCache};
use blaze_domain::{Origin, Scope, WriterId};
use blaze_proto::Frame;
use lru::LruCache;

use super::admit::Admitted;
use super::path::TopicId;
use crate::world::OriginFilter;

/// Writers that are kept at most; the one that was silent longest gives way.
const MAX_WRITERS: usize = 16_384;
/// Bytes that are kept at most (64 MiB), of all writers; one message always fits.
const MAX_BYTES: usize = 64 * 1024 * 1024;
const BOUNDS: RetainedBounds =
    RetainedBounds { writers: MAX_WRITERS, bytes: MAX_BYTES, bytes_of_writer: MAX_BYTES };
/// Messages of one writer that are kept at most, whatever depth it names.
const MAX_DEPTH: usize = 10_000;

/// After this time what a writer sends that was forgotten is not a copy that was on its way when
/// that was.
const AGAIN: Duration = Duration::from_secs(10);
/// Superseded writers that wait to be fetched at most.
const MAX_SUPERSEDED: usize = 16_384;

/// One message as it came.
#[derive(Clone)]
struct Kept {
    from: Scope,
    frame: Frame,
    hops: u32,
    born_here: bool,
    age_us: u64,
    since: Instant,
}

impl Kept {
    /// The message now: older by what it lay here.
    fn admitted(&self, now: Instant) -> Admitted {
        let waited = now.saturating_duration_since(self.since);
        let waited_us = u64::try_from(waited.as_micros()).unwrap_or(u64::MAX);
        let age_us = self.age_us.saturating_add(waited_us);
        let frame = self.frame.clone().with_hops_and_age(self.hops, age_us);
        Admitted { kept: true, ..Admitted::new(now, frame, self.born_here, age_us, 0) }
    }
}

/// What is kept, per topic and writer.
pub(super) struct KeptMessages {
    writers: RetainedCache<(TopicId, WriterId), Kept>,
    /// Writers of earlier lives of their services, which are to be forgotten by the brokers, too.
    pub(super) superseded: Vec<(TopicId, WriterId)>,
    /// Writers that were forgotten because nobody advertised for them, and when.
    forgotten: LruCache<(TopicId, WriterId), Instant>,
}

impl Default for KeptMessages {
    fn default() -> Self {
        Self {
            writers: RetainedCache::new(BOUNDS),
            superseded: Vec::new(),
            forgotten: LruCache::new(NonZeroUsize::new(MAX_WRITERS).unwrap_or(NonZeroUsize::MIN)),
        }
    }
}

impl KeptMessages {
    /// Keeps a message, if its writer is transient_local.
    pub(super) fn keep(&mut self, now: Instant, topic: TopicId, from: Scope, message: &Admitted) {
        let depth = usize::try_from(message.frame.depth()).unwrap_or(MAX_DEPTH).min(MAX_DEPTH);
        if depth == 0 {
            return;
        }
        let key = (topic, message.frame.writer());
        if self.writers.get(&key).is_none() {
            self.supersede(topic, &message.frame);
        }
        let kept = Kept {
            from,
            frame: message.frame.clone(),
            hops: message.hops,
            born_here: message.born_here,
            age_us: message.age_us,
            since: now,
        };
        self.writers.keep(key, kept, message.frame.received_len(), depth);
    }

    /// A service has begun a new life: the writers of its earlier ones are no more.
    fn supersede(&mut self, topic: TopicId, newer: &Frame) {
        let life = newer.origin();
        // Without a service it is not known whose it is.
        if life.service.is_empty() {
            return;
        }
        let gone = self.writers.forget_if(|(at, _), newest| {
            let origin = newest.frame.origin();
            let same = Origin { epoch: life.epoch, ..origin.clone() };
            *at == topic && origin.epoch < life.epoch && same == life
        });
        let room = MAX_SUPERSEDED.saturating_sub(self.superseded.len());
        self.superseded.extend(gone.into_iter().take(room));
    }

    /// What is kept of a topic from one scope, in the order of each writer and otherwise as it
    /// came.
    pub(super) fn of(&self, now: Instant, topic: TopicId, from: Scope) -> Vec<Admitted> {
        let mut found: Vec<&Kept> = self
            .writers
            .iter()
            .filter(|((of, _), newest, _)| *of == topic && newest.from == from)
            .flat_map(|(.., of_writer)| of_writer.iter())
            .collect();
        // Stable, and the times of one writer ascend.
        found.sort_by_key(|kept| kept.since);
        found.into_iter().map(|kept| kept.admitted(now)).collect()
    }

    /// Forgets writers of a topic. Returns which.
    pub(super) fn forget(
        &mut self,
        now: Instant,
        topic: TopicId,
        of: &OriginFilter,
        but: &BTreeSet<OriginFilter>,
    ) -> Vec<WriterId> {
        let is_of = |kept: &Kept| {
            let frame = &kept.frame;
            let matches = |filter: &OriginFilter| {
                filter.matches(frame.origin_layer(), frame.origin_node(), frame.origin_service())
            };
            matches(of) && !but.iter().any(matches)
        };
        let gone = self.writers.forget_if(|(of, _), newest| *of == topic && is_of(newest));
        for key in &gone {
            self.forgotten.put(*key, now);
        }
        gone.into_iter().map(|(_, writer)| writer).collect()
    }

    /// Whether a writer was forgotten a while ago; it is asked once, when something of it comes
    /// again.
    pub(super) fn takes_again(&mut self, now: Instant, topic: TopicId, writer: WriterId) -> bool {
        let key = (topic, writer);
        let since = self.forgotten.peek(&key).map(|at| now.saturating_duration_since(*at));
        since.is_some_and(|since| since >= AGAIN) && self.forgotten.pop(&key).is_some()
    }

    /// Forgets topics.
    pub(super) fn forget_topics(&mut self, gone: impl Fn(TopicId) -> bool) {
        self.writers.forget_if(|(of, _), _| gone(*of));
        let forgotten: Vec<_> = self.forgotten.iter().map(|(key, _)| *key).collect();
        for key in forgotten.into_iter().filter(|(topic, _)| gone(*topic)) {
            self.forgotten.pop(&key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_proto::Header;
    use bytes::Bytes;

    const TOPIC: TopicId = TopicId(3);

    fn message(writer: u8, service: &str, epoch: u64, sequence: u64, bytes: usize) -> Admitted {
        let origin = Origin {
            layer: "edge".into(),
            node: "robot-1".into(),
            service: service.into(),
            instance: "0".into(),
            epoch,
        };
        let header =
            Header { depth: 2, ..Header::new("map", origin, WriterId([writer; 16]), sequence, 0) };
        let frame = Frame::new(&header, Bytes::from(vec![0; bytes])).unwrap();
        Admitted::new(Instant::now(), frame, true, 5, 0)
    }

    fn sequences(kept: &KeptMessages, now: Instant) -> Vec<(u8, u64)> {
        let found = kept.of(now, TOPIC, Scope::Node);
        found.iter().map(|m| (m.frame.writer().0[0], m.frame.sequence())).collect()
    }

    #[test]
    fn each_writer_keeps_its_last_ones_and_they_grow_older() {
        let (mut kept, now) = (KeptMessages::default(), Instant::now());
        for sequence in 1..=3 {
            kept.keep(now, TOPIC, Scope::Node, &message(1, "a", 1, sequence, 10));
            kept.keep(now, TOPIC, Scope::Node, &message(2, "b", 1, sequence, 10));
        }
        kept.keep(now, TopicId(4), Scope::Node, &message(1, "a", 1, 9, 10));
        let mut found = sequences(&kept, now);
        found.sort_unstable();
        assert_eq!(found, [(1, 2), (1, 3), (2, 2), (2, 3)]);
        assert!(kept.of(now, TOPIC, Scope::Layer).is_empty());
        let later = kept.of(now + Duration::from_millis(7), TOPIC, Scope::Node);
        assert!(later.iter().all(|m| m.kept && m.age_us == 7_005 && m.hops == 0));
    }

    #[test]
    fn a_service_that_is_gone_or_new_leaves_nothing() {
        let (mut kept, now) = (KeptMessages::default(), Instant::now());
        kept.keep(now, TOPIC, Scope::Node, &message(1, "a", 1, 1, 10));
        kept.keep(now, TOPIC, Scope::Node, &message(2, "b", 1, 1, 10));
        kept.keep(now, TOPIC, Scope::Node, &message(3, "a", 2, 1, 10));
        assert_eq!(kept.superseded, [(TOPIC, WriterId([1; 16]))]);
        let of = OriginFilter { service: Some("b".into()), ..OriginFilter::default() };
        let any = BTreeSet::from([OriginFilter::default()]);
        assert_eq!(kept.forget(now, TOPIC, &of, &any), [], "somebody says that it is there");
        assert_eq!(kept.forget(now, TOPIC, &of, &BTreeSet::new()), [WriterId([2; 16])]);
        assert!(!kept.takes_again(now, TOPIC, WriterId([2; 16])), "a copy that was on its way");
        assert!(!kept.takes_again(now + AGAIN, TOPIC, WriterId([1; 16])));
        assert!(kept.takes_again(now + AGAIN, TOPIC, WriterId([2; 16])));
        assert!(!kept.takes_again(now + AGAIN, TOPIC, WriterId([2; 16])), "once");
        assert_eq!(sequences(&kept, now), [(3, 1)]);
        kept.forget_topics(|_| true);
        assert!(kept.writers.iter().next().is_none());
    }
}
