//! What the flow of a layer does on its Kafka, beside messages: topics, leases, what is kept of writers.

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
use super::maker::{Made, Maker, Prepared};
use super::names::RESERVED;
use super::read_to_end::ReaderToEnd;
use super::record;
use super::topics::Topic;
use crate::port::{BrokerError, FlowSide};

/// How long reading all leases may take.
const LOAD: Duration = Duration::from_secs(10);
/// Leases that are remembered at most, to write them again.
const MAX_LEASES: usize = 65_536;
/// Places of a writer that are taken away at most.
const MAX_DEPTH: u32 = 10_000;

/// The flow's part of a broker.
pub(super) struct FlowState {
    maker: Maker,
    leases: Arc<Topic>,
    leases_identity: Mutex<Option<TopicUuid>>,
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
            maker: Maker::new(needed.collect()),
            leases,
            leases_identity: Mutex::default(),
            mirror: Mutex::default(),
            keyed: KeyedWriter::default(),
            stood_back: Mutex::default(),
        }
    }

    /// Makes what is missing, as [`Maker::make`].
    pub(super) fn keep_topics(&self, inner: &Inner, listing: &Listing) -> Result<Made, String> {
        let (made, asked) = self.maker.make(inner, listing)?;
        if asked.contains(&self.leases.name) {
            self.write_all_leases();
        }
        if made != Made::Needed {
            self.follow_leases_topic(inner);
        }
        Ok(made)
    }

    /// If someone else made the topic of leases anew, it is empty.
    fn follow_leases_topic(&self, inner: &Inner) {
        let name = &self.leases.name;
        let found = inner.directory.known_identity(name);
        let Some(found) = found.or_else(|| inner.directory.topic(name, Duration::from_secs(1)).ok()?.uuid) else {
            return;
        };
        let before = self.leases_identity.lock().replace(found.clone());
        if before.is_some_and(|before| before != found) {
            self.write_all_leases();
        }
    }

    fn write_all_leases(&self) {
        // Locked until all are handed over: a lease that is removed meanwhile must not be overtaken by its old value.
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
        let mut reader = ReaderToEnd::open(&inner.settings, &inner.last_error, name, &marks)?;
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
        let purpose = if depth > 0 {
            Purpose::LastValues
        } else {
            Purpose::Messages
        };
        self.state.maker.prepare(&self.inner, channel, purpose, depth)
    }

    fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        self.state.maker.take_collisions()
    }

    fn release(&self, channel: &ChannelName) {
        if let Ok(name) = self.inner.names.topic(channel) {
            self.state.maker.release(&name);
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
        self.state
            .keyed
            .put(&self.state.leases, None, key.to_owned(), Some(value));
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
        let known = |prepared: &Prepared| (Arc::clone(&prepared.topic), prepared.depth);
        let Some((topic, depth)) = self.state.maker.with(&name, known) else {
            return;
        };
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
        if std::mem::replace(&mut *self.state.stood_back.lock(), for_whom).is_some() == back && !back {
            return;
        }
        self.inner.stand_back(back);
    }
}
