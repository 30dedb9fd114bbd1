//! Reading: one client reads the partitions of all its topics, and one thread hands the records to the readers.
//!
//! ```text
//! server ─► librdkafka (bounded queue) ─► thread: position, identity, header ─► rings of the topic's readers
//! ```
//!
//! The position of each partition is ours: librdkafka is told where to begin and never decides by itself. A reader gets
//! what lies at or behind the end that it saw when it subscribed. A topic that was made anew has another identity, which
//! this client learns before it gets a record of it: it is then read from its beginning, for all its readers.

mod positions;
#[cfg(test)]
mod tests;
mod thread;
mod topic;

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use parking_lot::{Mutex, MutexGuard};
use rdkafka::consumer::{BaseConsumer, Consumer as _};
use tokio_util::sync::CancellationToken;

use super::clock::BrokerClock;
use super::context::{LastError, ReadContext};
use super::directory::{Marks, TopicInfo};
use super::identity::Identities;
use super::settings::Settings;
use crate::port::{Received, SubscriptionSender};
use topic::{Partition, TopicState};

/// How long the thread may sleep: closing waits for that.
const POLL: Duration = Duration::from_millis(100);

/// How long a client that was replaced is waited for until nobody uses it any more, and how often that is looked at.
const LEAVE: Duration = Duration::from_secs(2);
const LEAVE_TURN: Duration = Duration::from_millis(5);

/// How long a reader waits to learn of its topic.
const LEARN: Duration = Duration::from_secs(1);

type Client = BaseConsumer<ReadContext>;

/// A topic that is to be read.
#[derive(Debug, Clone)]
pub(super) struct Source {
    pub(super) channel: ChannelName,
    pub(super) topic: Arc<str>,
    /// Read also while the scope belongs to another flow.
    pub(super) stays_open: bool,
}

/// A reader could not be taken in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Refused {
    /// The topic's other readers are beyond where this one would begin: it must first read up to here by itself.
    Behind(Vec<i64>),
    /// The client did not take it.
    Failed(String),
    /// The broker was closed.
    Closed,
}

/// How a reader joins those that a topic has.
pub(super) enum Join<'a> {
    /// With what is read next.
    Following,
    /// What lies before that is read once more, for it alone.
    Rewinding,
    /// It gets what is kept first, and is refused if records between that and what is read next have been read already.
    AfterKept(&'a mut dyn FnMut() -> Vec<Received>),
}

#[derive(Default)]
struct State {
    topics: HashMap<Arc<str>, TopicState>,
    /// Topics that were made to be read from elsewhere since the thread last looked: what it polled meanwhile may be a record
    /// of before.
    moved: HashSet<Arc<str>>,
    /// Number of identity changes that were looked at.
    identities_seen: u64,
    closed: bool,
}

/// One client that reads.
pub(super) struct Consumer {
    large: bool,
    layer: String,
    client: Mutex<Option<Arc<Client>>>,
    identities: Arc<Identities>,
    state: Mutex<State>,
    clock: Arc<Mutex<BrokerClock>>,
    last_error: Arc<LastError>,
    /// A position was not on the server: someone has to look.
    lost_position: AtomicBool,
}

impl Consumer {
    /// Makes the client and its thread.
    pub(super) fn start(
        large: bool,
        layer: &str,
        settings: &Settings,
        clock: &Arc<Mutex<BrokerClock>>,
        last_error: &Arc<LastError>,
        supervisor: &Supervisor,
        stop: &CancellationToken,
    ) -> Result<Arc<Self>, String> {
        let consumer = Arc::new(Self::new(large, layer, settings, clock, last_error)?);
        let name = if large { "kafka-read-l" } else { "kafka-read" };
        let run = {
            let (consumer, stop) = (Arc::clone(&consumer), stop.clone());
            move || consumer.run(&stop)
        };
        supervisor
            .spawn_thread(name, TaskPolicy::MayEnd, run)
            .map_err(|error| error.to_string())?;
        Ok(consumer)
    }

    /// Makes the client alone.
    fn new(
        large: bool,
        layer: &str,
        settings: &Settings,
        clock: &Arc<Mutex<BrokerClock>>,
        last_error: &Arc<LastError>,
    ) -> Result<Self, String> {
        let identities = Arc::default();
        let client = Self::connect(large, settings, &identities, last_error)?;
        Ok(Self {
            large,
            layer: layer.to_owned(),
            client: Mutex::new(Some(client)),
            identities,
            state: Mutex::default(),
            clock: Arc::clone(clock),
            last_error: Arc::clone(last_error),
            lost_position: AtomicBool::new(false),
        })
    }

    fn connect(
        large: bool,
        settings: &Settings,
        identities: &Arc<Identities>,
        last_error: &Arc<LastError>,
    ) -> Result<Arc<Client>, String> {
        let context = ReadContext::new(identities, last_error);
        let made = settings.consumer(large).create_with_context(context);
        made.map(Arc::new).map_err(|error| error.to_string())
    }

    /// What is read, and the client that reads it: both at once, because another client may come at any moment, and what is asked of
    /// the one before it is never read. `None` when it was closed.
    fn reading(&self) -> Option<(MutexGuard<'_, State>, Arc<Client>)> {
        let state = self.state.lock();
        let client = self.client.lock().clone()?;
        Some((state, client))
    }

    /// Whether the client gets an answer of the server. Waits for it.
    pub(super) fn is_answered(&self, topic: &str, timeout: Duration) -> bool {
        let client = self.client.lock().clone();
        client.is_none_or(|client| client.fetch_metadata(Some(topic), timeout).is_ok())
    }

    /// Begins anew with a client that knows nothing; it reads on where the old one stood. Blocks while that one ends.
    pub(super) fn remake(&self, settings: &Settings) -> Result<(), String> {
        let made = Self::connect(self.large, settings, &self.identities, &self.last_error)?;
        let mut state = self.state.lock();
        let State { topics, moved, .. } = &mut *state;
        let old = {
            let mut client = self.client.lock();
            // Who was closed stays closed.
            let Some(client) = client.as_mut() else { return Ok(()) };
            std::mem::replace(client, Arc::clone(&made))
        };
        for (name, topic) in topics.iter_mut().filter(|(_, topic)| topic.assigned) {
            if let Err(error) = topic.assign(&made) {
                // It is asked for again when it is seen to stand still.
                tracing::warn!(topic = %name, %error, "the topic cannot be read");
            }
            moved.insert(Arc::clone(name));
        }
        drop(state);
        // The thread that reads is with the old one for a moment yet. If it were the last to leave it, it would read nothing while that
        // one ends.
        let until = Instant::now() + LEAVE;
        while Arc::strong_count(&old) > 1 && Instant::now() < until {
            std::thread::sleep(LEAVE_TURN);
        }
        drop(old);
        Ok(())
    }

    /// Takes a reader in that begins at the given offsets. `info` is what the server said of the topic just before.
    pub(super) fn add(
        &self,
        source: &Source,
        info: &TopicInfo,
        starts: Vec<i64>,
        sender: SubscriptionSender,
        join: Join<'_>,
    ) -> Result<(), Refused> {
        self.learn(&source.topic);
        let Some((mut state, client)) = self.reading() else {
            return Err(Refused::Closed);
        };
        let State {
            topics, moved, closed, ..
        } = &mut *state;
        if *closed {
            return Err(Refused::Closed);
        }
        let mut note_move = || moved.insert(Arc::clone(&source.topic));
        if let Some(topic) = topics.get_mut(&source.topic) {
            if topic.awaited {
                topic.came(info, &self.layer, &client);
                note_move();
            } else if let (Some(known), Some(found)) = (&topic.uuid, &info.uuid)
                && known != found
            {
                topic.made_anew(found.clone(), &self.layer);
                topic.grow(info.partitions, &self.layer);
                topic.reassign(&client);
                note_move();
            } else if matches!(join, Join::AfterKept(_))
                && topic.partitions.iter().zip(&starts).any(|(at, start)| at.next > *start)
            {
                return Err(Refused::Behind(topic.partitions.iter().map(|at| at.next).collect()));
            }
            if matches!(join, Join::Rewinding) && topic.rewind(&starts, &client) {
                note_move();
            }
            topic.take_in(sender, starts, join);
            return Ok(());
        }
        let mut topic = TopicState {
            source: source.clone(),
            uuid: None,
            partitions: starts
                .iter()
                .map(|start| Partition {
                    next: *start,
                    bare_writer: None,
                    doubted_since: None,
                })
                .collect(),
            readers: Vec::new(),
            assigned: false,
            stood_back: false,
            awaited: false,
            behind: None,
        };
        topic.identify(info.uuid.clone(), &self.layer);
        topic
            .assign(&client)
            .map_err(|error| Refused::Failed(error.to_string()))?;
        topic.take_in(sender, starts, join);
        // It may have been read until a moment ago.
        note_move();
        topics.insert(Arc::clone(&source.topic), topic);
        Ok(())
    }

    /// Takes a reader in of a topic that is not there yet.
    pub(super) fn add_awaiting(&self, source: &Source, sender: SubscriptionSender) -> Result<(), Refused> {
        let mut state = self.state.lock();
        if state.closed {
            return Err(Refused::Closed);
        }
        tracing::debug!(topic = %source.topic, "the topic is not there yet; it is read as soon as it is");
        let topic = state
            .topics
            .entry(Arc::clone(&source.topic))
            .or_insert_with(|| TopicState {
                source: source.clone(),
                uuid: None,
                partitions: Vec::new(),
                readers: Vec::new(),
                assigned: false,
                stood_back: false,
                awaited: true,
                behind: None,
            });
        topic.take_in(sender, Vec::new(), Join::Following);
        Ok(())
    }

    /// Whether a topic is waited for.
    pub(super) fn is_awaited(&self, topic: &str) -> bool {
        self.state.lock().topics.get(topic).is_some_and(|topic| topic.awaited)
    }

    /// Whether any topic is waited for.
    pub(super) fn awaits_any(&self) -> bool {
        self.state.lock().topics.values().any(|topic| topic.awaited)
    }

    /// Lets the client ask for a topic that is new to it: by itself it does so once a second.
    fn learn(&self, topic: &str) {
        if self.state.lock().topics.contains_key(topic) {
            return;
        }
        let Some(client) = self.client.lock().clone() else {
            return;
        };
        // Without an answer it asks again by itself.
        if let Err(error) = client.fetch_metadata(Some(topic), LEARN) {
            tracing::debug!(topic, %error, "the reader has not learnt of its topic");
        }
    }

    /// The topics that are read or are to be read.
    pub(super) fn topics(&self) -> Vec<Arc<str>> {
        self.state.lock().topics.keys().cloned().collect()
    }

    /// Whether a topic is to be read and is not.
    pub(super) fn is_idle(&self, topic: &str) -> bool {
        self.state.lock().topics.get(topic).is_some_and(|topic| !topic.assigned)
    }

    /// Whether a position was not on the server, since the last call.
    pub(super) fn take_lost_position(&self) -> bool {
        self.lost_position.swap(false, Ordering::AcqRel)
    }

    /// What could not be looked into is to be looked into again.
    pub(super) fn look_again(&self) {
        self.lost_position.store(true, Ordering::Release);
    }

    /// Forgets readers that have gone, and topics without any.
    pub(super) fn sweep(&self) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        let mut empty = Vec::new();
        for (name, topic) in &mut state.topics {
            topic.readers.retain(|reader| !reader.sender.is_closed());
            if topic.readers.is_empty() {
                empty.push(Arc::clone(name));
            }
        }
        for name in empty {
            forget(&mut state, &client, &name);
        }
    }

    /// Stops reading, but for what stays open.
    pub(super) fn stand_back(&self) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        for topic in state.topics.values_mut().filter(|topic| !topic.source.stays_open) {
            topic.unassign(&client);
            topic.stood_back = true;
        }
    }

    /// Reads a topic again. One that this flow stood back from is read from its end, because what was written meanwhile was another's;
    /// one that the client did not take when it was to be read on, from where it stood.
    /// `lets` is asked under the lock that [`Consumer::stand_back`] takes: who stands back meanwhile reads nothing.
    pub(super) fn resume(&self, topic: &str, info: &TopicInfo, marks: &[Marks], lets: impl FnOnce() -> bool) {
        let Some((mut state, client)) = self.reading() else {
            return;
        };
        if !lets() {
            return;
        }
        let State { topics, moved, .. } = &mut *state;
        let Some(topic) = topics.get_mut(topic) else {
            return;
        };
        if topic.assigned {
            return;
        }
        moved.insert(Arc::clone(&topic.source.topic));
        if topic.awaited {
            topic.came(info, &self.layer, &client);
            return;
        }
        topic.identify(info.uuid.clone(), &self.layer);
        topic.grow(info.partitions, &self.layer);
        if std::mem::take(&mut topic.stood_back) {
            for (partition, mark) in topic.partitions.iter_mut().zip(marks) {
                partition.next = mark.high;
            }
            for reader in &mut topic.readers {
                reader.starts = marks.iter().map(|mark| mark.high).collect();
            }
        }
        if let Err(error) = topic.assign(&client) {
            tracing::debug!(topic = %topic.source.topic, %error, "could not be read again yet");
        }
    }

    /// Ends all readers.
    pub(super) fn close(&self) {
        let topics = {
            let mut state = self.state.lock();
            state.closed = true;
            std::mem::take(&mut state.topics)
        };
        for reader in topics.values().flat_map(|topic| &topic.readers) {
            reader.sender.close();
        }
    }
}

fn forget(state: &mut State, client: &Client, topic: &str) {
    if let Some(mut topic) = state.topics.remove(topic) {
        topic.unassign(client);
    }
}
