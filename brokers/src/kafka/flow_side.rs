//! What the flow of a layer does on its Kafka, beside messages: topics, leases, what is kept of
//! writers.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use parking_lot::Mutex;

use super::admin::Purpose;
use super::directory::Listing;
use super::identity::TopicUuid;
use super::inner::Inner;
use super::keyed::KeyedWriter;
use super::names::RESERVED;
use super::read_to_end::ReaderToEnd;
use super::record;
use super::topic_creator::TopicCreator;
use super::topics::Topic;
use crate::port::{BrokerError, FlowSide};

/// How long reading all leases may take.
const LOAD: Duration = Duration::from_secs(10);
/// Leases that are remembered at most, to write them again.
const MAX_LEASES: usize = 65_536;
/// Places of a writer that are taken away at most.
const MAX_DEPTH: u32 = 10_000;

/// The topic of leases as the server had it when it was last listed.
#[derive(Default)]
struct Seen {
    is_there: bool,
    uuid: Option<TopicUuid>,
}

impl Seen {
    /// Takes what was seen now; `uuid` is absent if it could not be asked for. Whether the topic
    /// was made since the last time, and is empty.
    fn is_new_at(&mut self, is_there: bool, uuid: Option<TopicUuid>) -> bool {
        let before = std::mem::take(self);
        let is_another =
            matches!((&before.uuid, &uuid), (Some(before), Some(now)) if before != now);
        *self = Self { is_there, uuid: uuid.or(before.uuid).filter(|_| is_there) };
        is_there && (!before.is_there || is_another)
    }
}

/// The flow's part of a broker.
pub(super) struct FlowState {
    pub(super) creator: TopicCreator,
    leases: Arc<Topic>,
    leases_seen: Mutex<Seen>,
    mirror: Mutex<HashMap<String, Bytes>>,
    pub(super) keyed: KeyedWriter,
    pub(super) stood_back: Mutex<Option<String>>,
}

impl FlowState {
    pub(super) fn new(names: &super::names::Names, topics: &super::topics::Topics) -> Self {
        let leases = topics.of(&names.leases(), false).0;
        let reserved = RESERVED.iter().map(|channel| names.reserved(channel));
        let needed = std::iter::once((Arc::clone(&leases.name), Purpose::LastValues))
            .chain(reserved.map(|name| (name, Purpose::Messages)));
        Self {
            creator: TopicCreator::new(needed),
            leases,
            leases_seen: Mutex::default(),
            mirror: Mutex::default(),
            keyed: KeyedWriter::default(),
            stood_back: Mutex::default(),
        }
    }

    /// Writes all leases again if their topic was made anew, for then it is empty.
    pub(super) fn follow_leases_topic(&self, inner: &Inner, listing: &Listing) {
        let name = &self.leases.name;
        let is_there = listing.topics.contains_key(&**name);
        let known = || inner.directory.known_identity(name);
        let ask = || inner.directory.topic(name, Duration::from_secs(1)).ok()?.uuid;
        let uuid = if is_there { known().or_else(ask) } else { None };
        if self.leases_seen.lock().is_new_at(is_there, uuid) {
            self.write_all_leases();
        }
    }

    fn write_all_leases(&self) {
        // Locked until all are handed over: a lease that is removed meanwhile must not be overtaken
        // by its old value.
        let mirror = self.mirror.lock();
        if !mirror.is_empty() {
            tracing::info!(
                leases = mirror.len(),
                "the topic of leases was made anew: all are written again"
            );
        }
        for (key, value) in mirror.iter() {
            self.keyed.put(&self.leases, None, key.clone(), Some(value.clone()));
        }
    }

    fn load(&self, inner: &Inner) -> Result<Vec<(String, Bytes)>, BrokerError> {
        let deadline = Instant::now() + LOAD;
        let name = &self.leases.name;
        let info = inner.directory.topic(name, LOAD)?;
        let marks = inner.directory.marks(name, info.partitions, deadline)?;
        let mut reader = ReaderToEnd::open(&inner.shared, name, &marks)?;
        let ends: Vec<i64> = marks.iter().map(|mark| mark.high).collect();
        reader.read(&ends, deadline, &|| inner.is_closed(), |_, payload| {
            Some(Bytes::copy_from_slice(payload))
        })?;
        let leases: Vec<(String, Bytes)> = reader
            .take_latest()
            .into_iter()
            .filter_map(|(key, value)| Some((String::from_utf8(key).ok()?, value)))
            .collect();
        let mut mirror = self.mirror.lock();
        for (key, value) in &leases {
            if mirror.len() < MAX_LEASES && !mirror.contains_key(key) {
                mirror.insert(key.clone(), value.clone());
            }
        }
        Ok(leases)
    }
}

/// What the flow is given.
pub(super) struct KafkaFlowSide {
    pub(super) inner: Arc<Inner>,
    pub(super) state: Arc<FlowState>,
}

#[async_trait]
impl FlowSide for KafkaFlowSide {
    fn prepare(&self, channel: &ChannelName, depth: u32) -> Result<(), BrokerError> {
        let purpose = if depth > 0 { Purpose::LastValues } else { Purpose::Messages };
        self.state.creator.prepare(&self.inner, channel, purpose, depth)
    }

    fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        self.state.creator.take_collisions()
    }

    fn release(&self, channel: &ChannelName) {
        if let Ok(name) = self.inner.names.topic(channel) {
            self.state.creator.release(&name);
        }
    }

    async fn load_leases(&self) -> Result<Vec<(String, Bytes)>, BrokerError> {
        let (inner, state) = (Arc::clone(&self.inner), Arc::clone(&self.state));
        let load = tokio::task::spawn_blocking(move || state.load(&inner));
        load.await.unwrap_or_else(|_| Err(BrokerError::Closed))
    }

    fn put_lease(&self, key: &str, value: Bytes) {
        let mut mirror = self.state.mirror.lock();
        if mirror.len() < MAX_LEASES || mirror.contains_key(key) {
            mirror.insert(key.to_owned(), value.clone());
        }
        self.state.keyed.put(&self.state.leases, None, key.to_owned(), Some(value));
    }

    fn remove_lease(&self, key: &str) {
        let mut mirror = self.state.mirror.lock();
        mirror.remove(key);
        self.state.keyed.put(&self.state.leases, None, key.to_owned(), None);
    }

    fn forget_writer(&self, channel: &ChannelName, writer: WriterId) {
        let Ok(name) = self.inner.names.topic(channel) else {
            return;
        };
        let known =
            self.state.creator.with(&name, |prepared| (prepared.topic.clone(), prepared.depth));
        let Some((Some(topic), depth)) = known else { return };
        // A topic that is not there keeps nothing.
        let Some(partitions) = topic.partitions() else { return };
        let partition = Some(record::partition_of(writer, partitions));
        for slot in 0..depth.min(MAX_DEPTH) {
            let key = record::kept_key(writer, u64::from(slot));
            self.state.keyed.put(&topic, partition, key, None);
        }
    }

    fn stand_back(&self, for_whom: Option<String>) {
        let back = for_whom.is_some();
        if std::mem::replace(&mut *self.state.stood_back.lock(), for_whom).is_some() == back
            && !back
        {
            return;
        }
        self.inner.stand_back(back);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_is_new_when_it_comes_and_when_it_is_another_one() {
        let of = |octet: &str| TopicUuid::from_base64(&octet.repeat(22));
        let (one, other) = (|| of("B"), || of("C"));
        let mut seen = Seen::default();
        assert!(!seen.is_new_at(false, None));
        assert!(seen.is_new_at(true, one()));
        assert!(!seen.is_new_at(true, one()));
        // It was deleted and made again between two looks, of which one could not ask.
        assert!(!seen.is_new_at(true, None));
        assert!(seen.is_new_at(true, other()));
        assert!(!seen.is_new_at(true, other()));
        assert!(!seen.is_new_at(false, None));
        assert!(seen.is_new_at(true, None), "whatever it is");
        assert!(!seen.is_new_at(true, one()), "known for the first time");
    }
}
