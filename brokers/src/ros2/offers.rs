//! What a flow writes to the network: a DDS writer for each topic and type, which offers what the
//! readers there ask for.
//!
//! One that offers something else takes over in steps: it is made, its writers meet the readers,
//! and from then on it gets all messages, which wait until those of the one before are written. So
//! a reader gets each message once. Of a transient_local topic the new writers begin with what the
//! old ones kept, for those who join from now on: readers of both get that again.

use std::collections::BTreeMap;
use std::sync::Weak;
use std::time::{Duration, Instant};

use blaze_domain::media::Media;
use blaze_domain::{TopicName, WriterId};
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;

use super::Inner;
use super::endpoint::RosEndpoint;
use super::names::RosName;
use crate::dds::TimingQos;
use crate::dds::adapter::{MAX_ORIGINS, TopicPublisher};
use crate::port::{Later, PublishOutcome, Publisher, PublisherOptions};
use crate::retained::{RetainedBounds, RetainedCache};

/// Types of one topic that are written, or read, at most.
pub(super) const MAX_TYPES: usize = 16;
/// How long a new writer has to meet the readers before it takes over.
const MEET: Duration = Duration::from_secs(2);
/// What is kept of a transient_local topic for a new writer.
const RETAINED: RetainedBounds = RetainedBounds {
    writers: MAX_ORIGINS,
    bytes: 32 * 1024 * 1024,
    bytes_of_writer: 32 * 1024 * 1024,
};

/// What a writer offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Offered {
    pub(super) reliable: bool,
    /// Samples for late joiners; 0 = volatile.
    pub(super) depth: u32,
    pub(super) timing: TimingQos,
}

impl Offered {
    /// What serves all readers of a topic and type, as it is published.
    pub(super) fn to<'a>(
        published: PublisherOptions,
        readers: impl IntoIterator<Item = &'a RosEndpoint>,
    ) -> Self {
        let PublisherOptions { reliable, depth, .. } = published;
        let mut offered = Self { reliable, depth, timing: TimingQos::MARKED };
        for reader in readers {
            offered.reliable |= reader.reliable;
            offered.depth = offered.depth.max(reader.durable.into());
            let strictest = |one: Option<_>, other| one.into_iter().chain(other).min();
            offered.timing.deadline = strictest(offered.timing.deadline, reader.deadline);
            offered.timing.lease = strictest(offered.timing.lease, reader.lease);
            offered.timing.manual |= reader.manual;
        }
        offered.reliable |= offered.depth > 0;
        offered
    }
}

/// The DDS writers of a topic and type, as they were made.
struct Writers {
    offered: Offered,
    publisher: TopicPublisher,
    /// Of a transient_local topic: it shows the topic until a message was published, or holds what
    /// was kept before these writers were made.
    beside: Option<TopicPublisher>,
}

/// A type of a topic that is written.
struct Written {
    current: Writers,
    /// They take over when they have met the readers.
    next: Option<Writers>,
    /// The last frames of each origin, and until when they are of use.
    retained: RetainedCache<WriterId, (Frame, Option<Instant>)>,
}

impl Written {
    fn publish(&mut self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        let outcome = self.current.publisher.publish(frame, deadline);
        let depth = usize::try_from(self.current.offered.depth).unwrap_or(usize::MAX);
        if depth > 0 {
            if self.is_new() {
                self.current.beside = None;
            }
            let size = frame.received_len();
            self.retained.keep(frame.writer(), (frame.clone(), deadline), size, depth);
        }
        outcome
    }

    fn is_new(&self) -> bool {
        self.retained.iter().next().is_none()
    }

    /// Lets the next writers take over if they are ready. Returns those before.
    fn switch(&mut self, now: Instant, readers: usize) -> Option<TopicPublisher> {
        let has_met = |writers: &TopicPublisher| writers.has_met(readers, now, MEET);
        let is_ready =
            |next: &mut Writers| has_met(&next.publisher) && next.beside.iter().all(has_met);
        let next = self.next.take_if(is_ready)?;
        if let Some(kept) = &next.beside {
            for (.., retained) in self.retained.iter() {
                for (frame, deadline) in retained.iter() {
                    if deadline.is_none_or(|deadline| deadline > now) {
                        kept.publish(frame, *deadline);
                    }
                }
            }
        }
        if next.offered.depth == 0 {
            self.retained = RetainedCache::new(RETAINED);
        }
        Some(std::mem::replace(&mut self.current, next).publisher)
    }
}

#[derive(Default)]
struct State {
    by_type: BTreeMap<String, Written>,
    /// Writers that others have replaced, until nothing waits for them.
    replaced: Vec<TopicPublisher>,
    /// What became of messages of those that have gone, and of those that none could take.
    before: Later,
}

impl State {
    fn refuse(&mut self) -> PublishOutcome {
        self.before.broker_error += 1;
        PublishOutcome::Taken
    }
}

/// A topic that the flow writes.
pub(super) struct Offer {
    topic: TopicName,
    pub(super) name: RosName,
    options: PublisherOptions,
    state: Mutex<State>,
    inner: Weak<Inner>,
}

impl Offer {
    pub(super) fn new(
        topic: TopicName,
        name: RosName,
        options: PublisherOptions,
        inner: Weak<Inner>,
    ) -> Self {
        Self { topic, name, options, state: Mutex::default(), inner }
    }

    /// Whether it writes a type.
    pub(super) fn writes(&self, type_name: &str) -> bool {
        self.state.lock().by_type.contains_key(type_name)
    }

    /// Makes writers for each type that readers ask for, and others where those that stand do not
    /// offer what readers ask for.
    pub(super) fn follow(&self, inner: &Inner) {
        let mut state = self.state.lock();
        let by_type = &mut state.by_type;
        for reader in inner.knowledge.endpoints(&self.name, false) {
            let Some(type_name) = reader.type_name.as_ref().filter(|_| !reader.is_keyed) else {
                continue;
            };
            if by_type.len() < MAX_TYPES && !by_type.contains_key(type_name) {
                let written = self.write(inner, type_name);
                by_type.extend(written.map(|written| (type_name.clone(), written)));
            }
        }
        for (type_name, written) in by_type.iter_mut() {
            let offered = inner.offered(&self.name, type_name, self.options);
            let wanted = (offered != written.current.offered).then_some(offered);
            if wanted != written.next.as_ref().map(|next| next.offered) {
                written.next = wanted.and_then(|_| self.make(inner, type_name, Some(written)));
            }
        }
        drop(state);
        self.tick(inner, Instant::now());
    }

    /// Lets writers take over that are ready, and forgets those that are no longer needed.
    pub(super) fn tick(&self, inner: &Inner, now: Instant) {
        let state = &mut *self.state.lock();
        for (type_name, written) in &mut state.by_type {
            if written.next.is_some() {
                let readers = inner.readers(&self.name, type_name).len();
                state.replaced.extend(written.switch(now, readers));
            }
        }
        let before = &mut state.before;
        state.replaced.retain(|publisher| {
            let later = publisher.later();
            if later.queued == 0 {
                add(before, later);
            }
            later.queued > 0
        });
    }

    /// The first writers of a type.
    fn write(&self, inner: &Inner, type_name: &str) -> Option<Written> {
        let current = self.make(inner, type_name, None)?;
        Some(Written { current, next: None, retained: RetainedCache::new(RETAINED) })
    }

    /// Writers that offer what readers ask for now, after those that stand.
    fn make(&self, inner: &Inner, type_name: &str, before: Option<&Written>) -> Option<Writers> {
        let (name, topic, large) = (&self.name, &self.topic, self.options.large);
        let offered = inner.offered(name, type_name, self.options);
        let publisher = inner.writer(name, topic, type_name, offered, large)?;
        let beside = match before {
            _ if offered.depth == 0 => None,
            Some(before) if !before.is_new() => {
                let kept = inner.writer(name, topic, type_name, offered, large)?;
                before.retained.iter().for_each(|(origin, ..)| kept.prepare(*origin));
                publisher.wait_for(&kept);
                Some(kept)
            }
            _ => inner.idle_writer(name, topic, type_name, offered),
        };
        if let Some(before) = before {
            let after = &before.current.publisher;
            publisher.wait_for(after);
            beside.iter().for_each(|beside| beside.wait_for(after));
        }
        Some(Writers { offered, publisher, beside })
    }
}

impl Drop for Offer {
    fn drop(&mut self) {
        if let Some(inner) = self.inner.upgrade() {
            inner.forget_offer(&self.name);
        }
    }
}

impl Publisher for Offer {
    /// Writes a message of ROS 2 in its own type; another one is dropped.
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        let state = &mut *self.state.lock();
        let Media::Cdr { type_name: Some(type_name) } = Media::of(frame.encoding()) else {
            return state.refuse();
        };
        if let Some(written) = state.by_type.get_mut(type_name) {
            return written.publish(frame, deadline);
        }
        let Some(inner) = self.inner.upgrade() else { return PublishOutcome::Dropped };
        let has_room = state.by_type.len() < MAX_TYPES;
        let Some(mut written) = has_room.then(|| self.write(&inner, type_name)).flatten() else {
            return state.refuse();
        };
        let outcome = written.publish(frame, deadline);
        state.by_type.insert(type_name.to_owned(), written);
        outcome
    }

    /// Without a header there is no type.
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.state.lock().refuse()
    }

    fn later(&self) -> Later {
        let state = self.state.lock();
        let mut sum = state.before;
        state.replaced.iter().for_each(|publisher| add(&mut sum, publisher.later()));
        let current = state.by_type.values().map(|written| &written.current.publisher);
        current.for_each(|publisher| add(&mut sum, publisher.later()));
        sum
    }
}

fn add(sum: &mut Later, one: Later) {
    sum.queued += one.queued;
    sum.queue_full += one.queue_full;
    sum.lifespan += one.lifespan;
    sum.too_large += one.too_large;
    sum.broker_error += one.broker_error;
}

#[cfg(test)]
mod tests {
    use super::super::endpoint::tests::found;
    use super::*;

    fn reader(reliable: bool, deadline: Option<u64>, lease: Option<u64>) -> RosEndpoint {
        let endpoint = RosEndpoint::of(&found(1, "rt/a", "std_msgs::msg::dds_::String_"), false);
        RosEndpoint {
            reliable,
            deadline: deadline.map(Duration::from_millis),
            lease: lease.map(Duration::from_millis),
            ..endpoint.unwrap()
        }
    }

    fn published(reliable: bool, depth: u32) -> PublisherOptions {
        PublisherOptions { reliable, depth, large: false }
    }

    #[test]
    fn a_writer_offers_what_the_strictest_reader_asks_for() {
        let offered = |reliable, readers: &[RosEndpoint]| {
            let offered = Offered::to(published(reliable, 0), readers);
            assert!(offered.timing.marked);
            let ms = |time: Option<Duration>| time.map(|time| time.as_millis());
            (offered.reliable, ms(offered.timing.deadline), ms(offered.timing.lease))
        };
        let (loose, strict) = (reader(false, None, Some(500)), reader(true, Some(20), None));
        assert_eq!(offered(false, &[]), (false, None, None));
        assert_eq!(offered(true, &[]), (true, None, None));
        assert_eq!(offered(false, std::slice::from_ref(&loose)), (false, None, Some(500)));
        let other = reader(false, Some(50), Some(100));
        assert_eq!(offered(false, &[loose, strict, other]), (true, Some(20), Some(100)));
    }

    #[test]
    fn readers_that_ask_for_more_than_is_published_are_served() {
        let offered = |depth, reader: RosEndpoint| {
            let Offered { reliable, depth, timing } =
                Offered::to(published(false, depth), [&reader]);
            (reliable, depth, timing.manual)
        };
        let plain = reader(false, None, None);
        assert_eq!(offered(0, plain.clone()), (false, 0, false));
        assert_eq!(offered(3, plain.clone()), (true, 3, false), "what is kept is repaired");
        let durable = RosEndpoint { durable: true, ..plain.clone() };
        assert_eq!(offered(0, durable.clone()), (true, 1, false));
        assert_eq!(offered(3, durable), (true, 3, false));
        assert_eq!(offered(0, RosEndpoint { manual: true, ..plain }), (false, 0, true));
    }
}
