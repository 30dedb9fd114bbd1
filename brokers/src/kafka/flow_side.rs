//! What the flow of a layer does on its Kafka, beside messages: topics, leases, what is kept of writers.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::error::RDKafkaErrorCode;

use super::admin::Purpose;
use super::directory::Listing;
use super::identity::TopicUuid;
use super::inner::Inner;
use super::keyed::KeyedWriter;
use super::names::{RESERVED, collide};
use super::read_to_end::ReaderToEnd;
use super::record;
use super::topics::Topic;
use crate::port::{BrokerError, FlowSide};

/// What the server refused to make is asked for again after this.
const TRY_AGAIN: Duration = Duration::from_secs(10);

/// What a round has made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Made {
    /// Topics that the flow itself needs: until they are listed there is nothing else to do.
    Needed,
    /// Topics of services, for the first time.
    Topics,
    /// Nothing, or what was asked for in the round before.
    Nothing,
}

/// How long reading all leases may take.
const LOAD: Duration = Duration::from_secs(10);
/// Leases that are remembered at most, to write them again.
const MAX_LEASES: usize = 65_536;
/// Places of a writer that are taken away at most.
const MAX_DEPTH: u32 = 10_000;

/// A topic that is to be there.
struct Prepared {
    channel: ChannelName,
    topic: Arc<Topic>,
    depth: u32,
    /// Whether it is known to keep what it shall.
    keeps: bool,
}

/// The flow's part of a broker.
pub(super) struct FlowState {
    reserved: Vec<Arc<str>>,
    leases: Arc<Topic>,
    leases_identity: Mutex<Option<TopicUuid>>,
    prepared: Mutex<BTreeMap<Arc<str>, Prepared>>,
    mirror: Mutex<HashMap<String, Bytes>>,
    pub(super) keyed: KeyedWriter,
    pub(super) stood_back: Mutex<Option<String>>,
    /// Names of the server's topics, as they were last listed.
    listed: Mutex<HashSet<Arc<str>>>,
    /// Topics that could not be made, told once.
    refused: Mutex<HashMap<Arc<str>, (RDKafkaErrorCode, Instant)>>,
    /// Channels whose name somebody else's topic has, to be told.
    collisions: Mutex<Vec<(ChannelName, String)>>,
    /// What was asked to be made in the last round.
    asked: Mutex<HashSet<Arc<str>>>,
}

impl FlowState {
    pub(super) fn new(names: &super::names::Names, topics: &super::topics::Topics) -> Self {
        Self {
            reserved: RESERVED.iter().map(|channel| names.reserved(channel)).collect(),
            leases: topics.of(&names.leases(), false).0,
            leases_identity: Mutex::default(),
            prepared: Mutex::default(),
            mirror: Mutex::default(),
            keyed: KeyedWriter::default(),
            stood_back: Mutex::default(),
            listed: Mutex::default(),
            refused: Mutex::default(),
            collisions: Mutex::default(),
            asked: Mutex::default(),
        }
    }

    /// Makes what is missing. Fails where what the flow itself needs could not be made; a topic of a service that cannot be
    /// made holds up nobody else, and is tried again after a while.
    pub(super) fn keep_topics(&self, inner: &Inner, listing: &Listing) -> Result<Made, String> {
        let there: HashSet<Arc<str>> = listing
            .topics
            .iter()
            .map(|(name, _)| Arc::from(name.as_str()))
            .collect();
        self.refuse_collisions(&there);
        let missing = self.missing(&there);
        *self.listed.lock() = there;
        let needs = missing.iter().any(|(name, _)| self.is_needed(name));
        if !missing.is_empty() {
            match inner.admin()?.make(&missing) {
                Ok(refused) => self.note_refused(&missing, &refused)?,
                Err(error) if needs => return Err(error.to_string()),
                Err(error) => tracing::warn!(%error, topics = missing.len(), "topics could not be made, trying on"),
            }
            if missing.iter().any(|(name, _)| *name == self.leases.name) {
                self.write_all_leases();
            }
        }
        let asked: HashSet<Arc<str>> = missing.into_iter().map(|(name, _)| name).collect();
        let before = std::mem::replace(&mut *self.asked.lock(), asked.clone());
        if needs {
            return Ok(Made::Needed);
        }
        self.keep_last_values(inner);
        self.follow_leases_topic(inner);
        Ok(if asked.is_subset(&before) {
            Made::Nothing
        } else {
            Made::Topics
        })
    }

    /// What was prepared before its name was known to be taken is no longer made.
    fn refuse_collisions(&self, there: &HashSet<Arc<str>>) {
        let mut prepared = self.prepared.lock();
        let mut gone = Vec::new();
        for name in prepared.keys().filter(|name| !there.contains(*name)) {
            let other = there.iter().find(|other| collide(name, other));
            gone.extend(other.map(|other| (Arc::clone(name), other.to_string())));
        }
        for (name, other) in gone {
            if let Some(prepared) = prepared.remove(&name) {
                tracing::warn!(topic = %name, other, "their names are one to Kafka: the topic is not made");
                self.collisions.lock().push((prepared.channel, other));
            }
        }
    }

    /// Whether the flow itself cannot do without a topic.
    fn is_needed(&self, name: &Arc<str>) -> bool {
        *name == self.leases.name || self.reserved.contains(name)
    }

    fn missing(&self, there: &HashSet<Arc<str>>) -> Vec<(Arc<str>, Purpose)> {
        let refused = self.refused.lock();
        let prepared = self.prepared.lock();
        let wanted = prepared.iter().map(|(name, prepared)| {
            let purpose = if prepared.depth > 0 {
                Purpose::LastValues
            } else {
                Purpose::Messages
            };
            (name, purpose)
        });
        let reserved = self.reserved.iter().map(|name| (name, Purpose::Messages));
        let leases = (&self.leases.name, Purpose::LastValues);
        std::iter::once(leases)
            .chain(reserved)
            .chain(wanted)
            .filter(|(name, _)| !there.contains(*name))
            .filter(|(name, _)| match refused.get(*name) {
                // An impossible name stays one; what the server did not want may come to be wanted.
                Some((RDKafkaErrorCode::InvalidTopic, _)) => false,
                Some((_, at)) => self.is_needed(name) || at.elapsed() >= TRY_AGAIN,
                None => true,
            })
            .map(|(name, purpose)| (Arc::clone(name), purpose))
            .collect()
    }

    fn note_refused(
        &self,
        asked: &[(Arc<str>, Purpose)],
        refused: &[(Arc<str>, RDKafkaErrorCode)],
    ) -> Result<(), String> {
        let mut known = self.refused.lock();
        for (name, _) in asked {
            if !refused.iter().any(|(refused, _)| refused == name) {
                known.remove(name);
            }
        }
        let mut needed = Ok(());
        for (name, code) in refused {
            let before = known.insert(Arc::clone(name), (*code, Instant::now()));
            if before.is_none_or(|(before, _)| before != *code) {
                tracing::warn!(topic = %name, %code, "the topic could not be made");
            }
            if self.is_needed(name) {
                needed = Err(format!("topic {name} could not be made: {code}"));
            }
        }
        needed
    }

    /// Topics that were there before, for something else, shall keep the last messages of each writer.
    fn keep_last_values(&self, inner: &Inner) {
        let to_check: Vec<Arc<str>> = {
            let prepared = self.prepared.lock();
            let open = prepared
                .iter()
                .filter(|(_, prepared)| prepared.depth > 0 && !prepared.keeps);
            open.filter(|(_, prepared)| prepared.topic.partitions().is_some())
                .map(|(name, _)| Arc::clone(name))
                .collect()
        };
        for name in to_check {
            let done = inner
                .admin()
                .and_then(|admin| admin.keep_last_values(&name).map_err(|error| error.to_string()));
            match done {
                Ok(()) => {
                    if let Some(prepared) = self.prepared.lock().get_mut(&name) {
                        prepared.keeps = true;
                    }
                }
                Err(error) => tracing::debug!(topic = %name, error, "could not be made to keep the last messages"),
            }
        }
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
        let name = self.inner.names.topic(channel)?;
        let state = &self.state;
        let mut prepared = state.prepared.lock();
        if let Some(prepared) = prepared.get_mut(&name) {
            prepared.keeps &= prepared.depth > 0 || depth == 0;
            prepared.depth = prepared.depth.max(depth);
        } else {
            let listed = state.listed.lock();
            let other = prepared.keys().chain(listed.iter()).find(|other| collide(&name, other));
            if let Some(other) = other {
                return Err(BrokerError::Collision {
                    channel: channel.to_string(),
                    other: other.to_string(),
                });
            }
            let new = Prepared {
                channel: channel.clone(),
                topic: self.inner.topics.of(&name, false).0,
                depth,
                keeps: false,
            };
            prepared.insert(Arc::clone(&name), new);
        }
        drop(prepared);
        state.refused.lock().remove(&name);
        self.inner.bell.ring();
        Ok(())
    }

    fn take_collisions(&self) -> Vec<(ChannelName, String)> {
        std::mem::take(&mut *self.state.collisions.lock())
    }

    fn release(&self, channel: &ChannelName) {
        if let Ok(name) = self.inner.names.topic(channel) {
            self.state.prepared.lock().remove(&name);
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
        let prepared = self.state.prepared.lock();
        let Some(Prepared { topic, depth, .. }) = prepared.get(&name) else {
            return;
        };
        // A topic that is not there keeps nothing.
        let Some(partitions) = topic.partitions() else { return };
        let partition = Some(record::partition_of(writer, partitions));
        for slot in 0..(*depth).min(MAX_DEPTH) {
            let key = record::kept_key(writer, u64::from(slot));
            self.state.keyed.put(topic, partition, key, None);
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
