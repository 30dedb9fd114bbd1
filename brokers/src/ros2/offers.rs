//! What a flow writes to the network: a DDS writer for each topic and type, which offers what the
//! readers there ask for.

use std::collections::BTreeMap;
use std::sync::Weak;
use std::time::Instant;

use blaze_domain::TopicName;
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;

use super::Inner;
use super::endpoint::RosEndpoint;
use super::names::RosName;
use crate::dds::Terms;
use crate::dds::adapter::TopicPublisher;
use crate::port::{Later, PublishOutcome, Publisher, PublisherOptions};

/// Types of one topic that are written at most.
const MAX_TYPES: usize = 16;

/// What a writer offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Offered {
    pub(super) reliable: bool,
    pub(super) terms: Terms,
}

impl Offered {
    /// What serves all readers of a topic and type, where it is published reliably or not.
    pub(super) fn to<'a>(
        published_reliable: bool,
        readers: impl Iterator<Item = &'a RosEndpoint>,
    ) -> Self {
        let terms = Terms { marked: true, ..Terms::default() };
        let mut offered = Self { reliable: published_reliable, terms };
        for reader in readers {
            offered.reliable |= reader.reliable;
            let strictest = |one: Option<_>, other| one.into_iter().chain(other).min();
            offered.terms.deadline = strictest(offered.terms.deadline, reader.deadline);
            offered.terms.lease = strictest(offered.terms.lease, reader.lease);
        }
        offered
    }
}

struct Written {
    offered: Offered,
    publisher: TopicPublisher,
    /// Stands for the writers of single origins until one of them has published.
    idle: Option<TopicPublisher>,
}

/// A topic that the flow writes.
pub(super) struct Offer {
    topic: TopicName,
    pub(super) name: RosName,
    options: PublisherOptions,
    by_type: Mutex<BTreeMap<String, Written>>,
    /// Writers that others have replaced, until nothing waits for them.
    replaced: Mutex<Vec<TopicPublisher>>,
    /// What became of messages of those that have gone, and of those that none could take.
    before: Mutex<Later>,
    inner: Weak<Inner>,
}

impl Offer {
    pub(super) fn new(
        topic: TopicName,
        name: RosName,
        options: PublisherOptions,
        inner: Weak<Inner>,
    ) -> Self {
        Self {
            topic,
            name,
            options,
            by_type: Mutex::default(),
            replaced: Mutex::default(),
            before: Mutex::default(),
            inner,
        }
    }

    /// Whether it writes a type.
    pub(super) fn writes(&self, type_name: &str) -> bool {
        self.by_type.lock().contains_key(type_name)
    }

    /// Makes a writer for each type that readers ask for, and replaces those that do not offer what
    /// readers ask for. The new one stands before the old one goes, which delivers what it has
    /// taken.
    pub(super) fn follow(&self, inner: &Inner) {
        let mut replaced = Vec::new();
        let mut by_type = self.by_type.lock();
        for reader in inner.knowledge.endpoints(&self.name, false) {
            let Some(type_name) = &reader.type_name else { continue };
            let is_new = !by_type.contains_key(type_name) && !reader.is_keyed;
            if is_new && by_type.len() < MAX_TYPES {
                let offered = inner.offered(&self.name, type_name, self.options.reliable);
                let made = self.make(inner, type_name, offered);
                by_type.extend(made.map(|made| (type_name.clone(), made)));
            }
        }
        for (type_name, written) in by_type.iter_mut() {
            let offered = inner.offered(&self.name, type_name, self.options.reliable);
            if offered == written.offered {
                continue;
            }
            if let Some(next) = self.make(inner, type_name, offered) {
                replaced.push(std::mem::replace(written, next).publisher);
            }
        }
        drop(by_type);
        let mut all = self.replaced.lock();
        all.append(&mut replaced);
        let mut before = self.before.lock();
        all.retain(|publisher| {
            let later = publisher.later();
            if later.queued == 0 {
                add(&mut before, later);
            }
            later.queued > 0
        });
    }

    fn make(&self, inner: &Inner, type_name: &str, offered: Offered) -> Option<Written> {
        let options = PublisherOptions { reliable: offered.reliable, ..self.options };
        let (name, topic, terms) = (&self.name, &self.topic, offered.terms);
        let publisher = inner.writer(name, topic, type_name, terms, options)?;
        let idle = (options.depth > 0)
            .then(|| inner.idle_writer(name, topic, type_name, terms, options))
            .flatten();
        Some(Written { offered, publisher, idle })
    }

    fn refuse(&self) -> PublishOutcome {
        self.before.lock().broker_error += 1;
        PublishOutcome::Taken
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
        let Some(type_name) = type_of(frame.encoding()) else { return self.refuse() };
        let mut by_type = self.by_type.lock();
        if let Some(written) = by_type.get_mut(type_name) {
            let outcome = written.publisher.publish(frame, deadline);
            written.idle = None;
            return outcome;
        }
        let Some(inner) = self.inner.upgrade() else { return PublishOutcome::Dropped };
        let offered = inner.offered(&self.name, type_name, self.options.reliable);
        let made = self.make(&inner, type_name, offered).filter(|_| by_type.len() < MAX_TYPES);
        let Some(mut made) = made else {
            drop(by_type);
            return self.refuse();
        };
        let outcome = made.publisher.publish(frame, deadline);
        made.idle = None;
        by_type.insert(type_name.to_owned(), made);
        outcome
    }

    /// Without a header there is no type.
    fn publish_bare(&self, _: &Bytes, _: Option<Instant>) -> PublishOutcome {
        self.refuse()
    }

    fn later(&self) -> Later {
        let mut sum = *self.before.lock();
        self.replaced.lock().iter().for_each(|publisher| add(&mut sum, publisher.later()));
        self.by_type.lock().values().for_each(|written| add(&mut sum, written.publisher.later()));
        sum
    }
}

/// The type in `application/cdr; type=sensor_msgs/msg/Imu`.
pub(super) fn type_of(encoding: &str) -> Option<&str> {
    let (kind, parameters) = encoding.split_once(';')?;
    let type_name = parameters.trim().strip_prefix("type=")?;
    (kind.trim() == "application/cdr").then_some(type_name.trim())
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
    use std::time::Duration;

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

    #[test]
    fn a_writer_offers_what_the_strictest_reader_asks_for() {
        let offered = |published, readers: &[RosEndpoint]| {
            let offered = Offered::to(published, readers.iter());
            assert!(offered.terms.marked);
            let ms = |time: Option<Duration>| time.map(|time| time.as_millis());
            (offered.reliable, ms(offered.terms.deadline), ms(offered.terms.lease))
        };
        let (loose, strict) = (reader(false, None, Some(500)), reader(true, Some(20), None));
        assert_eq!(offered(false, &[]), (false, None, None));
        assert_eq!(offered(true, &[]), (true, None, None));
        assert_eq!(offered(false, std::slice::from_ref(&loose)), (false, None, Some(500)));
        let other = reader(false, Some(50), Some(100));
        assert_eq!(offered(false, &[loose, strict, other]), (true, Some(20), Some(100)));
    }

    #[test]
    fn the_type_of_a_message_is_in_its_encoding() {
        assert_eq!(type_of("application/cdr; type=a/msg/B"), Some("a/msg/B"));
        assert_eq!(type_of("application/cdr;type= a/msg/B "), Some("a/msg/B"));
        for other in
            ["", "application/cdr", "application/json; type=a/msg/B", "application/cdr; x=1"]
        {
            assert_eq!(type_of(other), None, "{other}");
        }
    }
}
