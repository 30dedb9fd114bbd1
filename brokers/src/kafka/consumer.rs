//! Reading: one client reads the partitions of all its topics, and one thread hands the records to
//! the readers.
//!
//! ```text
//! server ─► librdkafka (bounded queue) ─► thread: position, identity, header ─► rings of the topic's readers
//! ```
//!
//! The position of each partition is ours: librdkafka gets it with the assignment and never decides
//! by itself. A reader gets records at or behind the end that it saw when it subscribed. A topic
//! that was made anew has another identity, which this client learns before it gets a record of it:
//! it is then read from its beginning, for all its readers.
//!
//! Records are polled and handed out under the lock under which assignments change, so no record of
//! an earlier position comes after a change.

#[cfg(test)]
mod tests;
mod topic;

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use blaze_domain::names::ChannelName;
use blaze_runtime::supervisor::TaskPolicy;
use futures::Stream as _;
use parking_lot::Mutex;
use rdkafka::consumer::{Consumer as _, MessageStream, StreamConsumer};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};
use rdkafka::message::{BorrowedMessage, Message as _};
use rdkafka::util::AsyncRuntime;
use tokio::sync::Notify;

use super::context::ReadContext;
use super::directory::{Marks, TopicInfo};
use super::identity::Identities;
use super::inner::Shared;
use super::receive::receive;
use super::waker::block_on;
use crate::port::{Received, SubscriptionSender};
use topic::{Reader, TopicState};

/// Records that are handed out before others may use the state.
const BATCH: usize = 256;
/// How long a replaced client is waited for until nobody uses it, and the pause between two looks.
const LEAVE: Duration = Duration::from_secs(2);
const LEAVE_TURN: Duration = Duration::from_millis(5);
/// How long a reader waits to learn of its topic.
const LEARN: Duration = Duration::from_secs(1);

type Client = StreamConsumer<ReadContext, NoTimers>;

/// A stream consumer wakes itself up for the sake of its group; these are in none.
struct NoTimers;

impl AsyncRuntime for NoTimers {
    type Delay = futures::future::Pending<()>;

    fn spawn<T: Future<Output = ()> + Send + 'static>(_: T) {}

    fn delay_for(_: Duration) -> Self::Delay {
        futures::future::pending()
    }
}

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
    /// The topic's other readers are beyond where this one would begin: it must first read up to
    /// here by itself.
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
    /// It gets what is kept first, and is refused if records between that and what is read next
    /// have been read already.
    AfterKept(&'a mut dyn FnMut() -> Vec<Received>),
}

/// A topic that has readers, and whether it is to be looked at soon.
pub(super) struct Known {
    pub(super) topic: Arc<str>,
    /// The server does not have it yet.
    pub(super) is_awaited: bool,
    /// It is not read now, and may be.
    pub(super) is_idle: bool,
    /// It was behind the server's end when it was last looked at.
    pub(super) is_behind: bool,
}

#[derive(Default)]
struct State {
    /// `None` after the end.
    client: Option<Arc<Client>>,
    topics: HashMap<Arc<str>, TopicState>,
    /// Number of identity changes that were looked at.
    identities_seen: u64,
}

/// One client that reads.
pub(super) struct Consumer {
    large: bool,
    layer: String,
    shared: Arc<Shared>,
    identities: Arc<Identities>,
    state: Mutex<State>,
    /// The client is another one.
    replaced: Notify,
    /// A position was not on the server, so all positions are to be compared.
    lost_position: AtomicBool,
}

impl Consumer {
    /// Makes the client and its thread.
    pub(super) fn start(
        large: bool,
        layer: &str,
        shared: &Arc<Shared>,
    ) -> Result<Arc<Self>, String> {
        let consumer = Arc::new(Self::new(large, layer, shared)?);
        let name = if large { "kafka-read-l" } else { "kafka-read" };
        let reading = Arc::clone(&consumer);
        let run = move || {
            block_on(reading.shared.stop.run_until_cancelled(reading.run()));
            // The client ends here, on the thread that may wait for it.
            reading.close();
        };
        let started = shared.supervisor.spawn_thread(name, TaskPolicy::MayEnd, run);
        started.map_err(|error| error.to_string())?;
        Ok(consumer)
    }

    /// Makes the client alone.
    fn new(large: bool, layer: &str, shared: &Arc<Shared>) -> Result<Self, String> {
        let consumer = Self {
            large,
            layer: layer.to_owned(),
            shared: Arc::clone(shared),
            identities: Arc::default(),
            state: Mutex::default(),
            replaced: Notify::new(),
            lost_position: AtomicBool::new(false),
        };
        consumer.state.lock().client = Some(consumer.connect()?);
        Ok(consumer)
    }

    fn connect(&self) -> Result<Arc<Client>, String> {
        let context = ReadContext::new(&self.identities, &self.shared.last_error);
        let made = self.shared.settings.consumer(self.large).create_with_context(context);
        made.map(Arc::new).map_err(|error| error.to_string())
    }

    fn client(&self) -> Option<Arc<Client>> {
        self.state.lock().client.clone()
    }

    /// Hands out records until there is no client any more.
    async fn run(&self) {
        while let Some(client) = self.client() {
            let mut stream = client.stream();
            let read =
                std::future::poll_fn(|context| self.hand_out(&client, &mut stream, context, BATCH));
            tokio::select! {
                () = read => {}
                () = self.replaced.notified() => {}
            }
        }
    }

    /// Hands out what a client has, up to a limit; then others have a turn. Ready when it is not
    /// the client any more.
    fn hand_out(
        &self,
        client: &Arc<Client>,
        stream: &mut MessageStream<'_, ReadContext>,
        context: &mut Context<'_>,
        limit: usize,
    ) -> Poll<()> {
        let mut state = self.state.lock();
        if !state.client.as_ref().is_some_and(|now| Arc::ptr_eq(now, client)) {
            return Poll::Ready(());
        }
        for _ in 0..limit {
            let next = Pin::new(&mut *stream).poll_next(context);
            // Also without a record: at the position of before there may be none of the topic that
            // was made anew.
            let anew = self.follow_identities(&mut state, client);
            let Poll::Ready(next) = next else {
                return Poll::Pending;
            };
            match next {
                // It was read at a position of the topic that was before, and comes again.
                Some(Ok(message)) if anew.iter().any(|topic| **topic == *message.topic()) => {}
                Some(Ok(message)) => self.deliver(&mut state, client, &message),
                Some(Err(error)) => self.note_error(&error),
                None => return Poll::Ready(()),
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }

    fn note_error(&self, error: &KafkaError) {
        if matches!(
            error.rdkafka_error_code(),
            Some(RDKafkaErrorCode::AutoOffsetReset | RDKafkaErrorCode::OffsetOutOfRange)
        ) {
            self.look_again();
        }
        self.shared.last_error.note(error.to_string());
        tracing::debug!(%error, "reading");
    }

    /// Topics that were made anew are read from their beginning. Returns which.
    fn follow_identities(&self, state: &mut State, client: &Client) -> Vec<Arc<str>> {
        let changes = self.identities.changes();
        if changes == state.identities_seen {
            return Vec::new();
        }
        state.identities_seen = changes;
        let mut anew = Vec::new();
        for (name, topic) in &mut state.topics {
            let Some(uuid) = self.identities.of(name) else { continue };
            match &topic.uuid {
                Some(before) if *before == uuid => {}
                None => topic.identify(Some(uuid), &self.layer),
                Some(before) => {
                    tracing::info!(topic = %name, ?before, now = ?uuid, "the topic was made anew");
                    topic.made_anew(uuid, &self.layer);
                    if topic.assigned {
                        topic.reassign(client);
                    }
                    anew.push(Arc::clone(name));
                }
            }
        }
        anew
    }

    fn deliver(&self, state: &mut State, client: &Client, message: &BorrowedMessage<'_>) {
        let Some(topic) = state.topics.get_mut(message.topic()) else {
            return;
        };
        let Ok(number) = usize::try_from(message.partition()) else {
            return;
        };
        let Some(partition) = topic.partitions.get_mut(number) else {
            return;
        };
        let offset = message.offset();
        if offset < partition.next {
            return;
        }
        partition.next = offset + 1;
        let identity = partition.bare_writer.zip(u64::try_from(offset + 1).ok());
        let payload = match message.payload() {
            Some(payload) => payload,
            // It takes a key away; there is nothing to deliver.
            None if topic.source.channel.is_reserved() || message.key().is_some() => return,
            // A message may be empty, and some clients write that so.
            None => &[],
        };
        let wanted =
            |reader: &Reader| reader.starts.get(number).is_none_or(|start| offset >= *start);
        if topic.readers.iter().any(wanted) {
            let received =
                receive(&topic.source.channel, message, payload, identity, &self.shared.clock);
            topic.readers.retain(|reader| !wanted(reader) || reader.sender.send(received.clone()));
        }
        if topic.readers.is_empty() {
            topic.unassign(client);
            state.topics.remove(message.topic());
        }
    }

    /// Whether the client gets an answer of the server. Waits for it.
    pub(super) fn is_answered(&self, topic: &str, timeout: Duration) -> bool {
        self.client().is_none_or(|client| client.fetch_metadata(Some(topic), timeout).is_ok())
    }

    /// Begins anew with a client that knows nothing; it reads on where the old one stood. Blocks
    /// while that one ends.
    pub(super) fn remake(&self) -> Result<(), String> {
        let made = self.connect()?;
        let old = {
            let mut state = self.state.lock();
            let State { client, topics, .. } = &mut *state;
            // Once closed it stays closed.
            let Some(client) = client else { return Ok(()) };
            for topic in topics.values_mut().filter(|topic| topic.assigned) {
                topic.assign(&made);
            }
            std::mem::replace(client, made)
        };
        self.replaced.notify_one();
        // The thread that reads has the old one for a moment yet. If it were the last, it would
        // read nothing while that one ends.
        let until = Instant::now() + LEAVE;
        while Arc::strong_count(&old) > 1 && Instant::now() < until {
            std::thread::sleep(LEAVE_TURN);
        }
        drop(old);
        Ok(())
    }

    /// Takes a reader in that begins at the given offsets. `info` is what the server said of the
    /// topic just before.
    pub(super) fn add(
        &self,
        source: &Source,
        info: &TopicInfo,
        starts: Vec<i64>,
        sender: SubscriptionSender,
        join: Join<'_>,
    ) -> Result<(), Refused> {
        self.learn(&source.topic);
        let mut state = self.state.lock();
        let State { client: Some(client), topics, .. } = &mut *state else {
            return Err(Refused::Closed);
        };
        let known = topics.contains_key(&source.topic);
        let topic =
            topics.entry(Arc::clone(&source.topic)).or_insert_with(|| TopicState::new(source));
        if !known {
            topic.begin_at(&starts, info, &self.layer);
            if !topic.assign(client) {
                topics.remove(&source.topic);
                return Err(Refused::Failed("the client does not take the topic".to_owned()));
            }
        } else if topic.is_awaited() {
            topic.begin_at(&[], info, &self.layer);
            topic.assign(client);
        } else if let (Some(known), Some(found)) = (&topic.uuid, &info.uuid)
            && known != found
        {
            topic.made_anew(found.clone(), &self.layer);
            topic.grow(info.partitions, &self.layer);
            topic.reassign(client);
        } else if matches!(join, Join::AfterKept(_)) && topic.is_beyond(&starts) {
            return Err(Refused::Behind(topic.positions()));
        }
        match join {
            Join::Following => {}
            Join::Rewinding => topic.rewind(&starts, client),
            Join::AfterKept(kept) => {
                sender.send_kept(kept());
            }
        }
        topic.readers.push(Reader { sender, starts });
        Ok(())
    }

    /// Takes a reader in of a topic that is not there yet.
    pub(super) fn add_awaiting(
        &self,
        source: &Source,
        sender: SubscriptionSender,
    ) -> Result<(), Refused> {
        let mut state = self.state.lock();
        if state.client.is_none() {
            return Err(Refused::Closed);
        }
        tracing::debug!(
            topic = %source.topic,
            "the topic is not there yet; it is read as soon as it is",
        );
        let topic = state.topics.entry(Arc::clone(&source.topic));
        let topic = topic.or_insert_with(|| TopicState::new(source));
        let starts = Vec::new();
        topic.readers.push(Reader { sender, starts });
        Ok(())
    }

    /// Lets the client ask for a topic that is new to it: by itself it does so once a second.
    fn learn(&self, topic: &str) {
        let client = {
            let state = self.state.lock();
            let new = !state.topics.contains_key(topic);
            state.client.clone().filter(|_| new)
        };
        // Without an answer it asks again by itself.
        if let Some(Err(error)) = client.map(|client| client.fetch_metadata(Some(topic), LEARN)) {
            tracing::debug!(topic, %error, "the reader has not learnt of its topic");
        }
    }

    /// How many topics are read or are to be read.
    pub(super) fn count(&self) -> usize {
        self.state.lock().topics.len()
    }

    /// The topics that are read or are to be read, without those whose readers have gone.
    pub(super) fn topics(&self) -> Vec<Known> {
        let mut state = self.state.lock();
        let State { client, topics, .. } = &mut *state;
        topics.retain(|_, topic| {
            topic.readers.retain(|reader| !reader.sender.is_closed());
            if let (Some(client), true) = (&client, topic.readers.is_empty()) {
                topic.unassign(client);
            }
            !topic.readers.is_empty()
        });
        topics
            .iter()
            .map(|(name, topic)| Known {
                topic: Arc::clone(name),
                is_awaited: topic.is_awaited(),
                is_behind: topic.is_behind(),
                is_idle: !topic.assigned && self.shared.gate.lets(topic.source.stays_open),
            })
            .collect()
    }

    /// Whether any topic is waited for.
    pub(super) fn awaits_any(&self) -> bool {
        self.state.lock().topics.values().any(TopicState::is_awaited)
    }

    /// Whether a position was not on the server, since the last call.
    pub(super) fn take_lost_position(&self) -> bool {
        self.lost_position.swap(false, Ordering::AcqRel)
    }

    /// All positions are to be compared with those of the server.
    pub(super) fn look_again(&self) {
        self.lost_position.store(true, Ordering::Release);
    }

    /// Stops reading, but for what stays open.
    pub(super) fn stand_back(&self) {
        let mut state = self.state.lock();
        let State { client, topics, .. } = &mut *state;
        let Some(client) = client else { return };
        for topic in topics.values_mut().filter(|topic| !topic.source.stays_open) {
            topic.unassign(client);
            topic.stood_back = true;
        }
    }

    /// Brings the reading of a topic into line with what the server says of it: begins, reads new
    /// partitions, asks again for what stands still. `lost_position`: looks whether the server has
    /// what is to be read next.
    pub(super) fn follow(
        &self,
        now: Instant,
        name: &str,
        (info, marks): (&TopicInfo, &[Marks]),
        lost_position: bool,
    ) {
        let mut state = self.state.lock();
        let State { client, topics, .. } = &mut *state;
        let (Some(client), Some(topic)) = (client, topics.get_mut(name)) else {
            return;
        };
        if !topic.assigned {
            // Asked under the lock that standing back takes: nothing is read after it.
            if self.shared.gate.lets(topic.source.stays_open) {
                topic.begin(info, marks, &self.layer);
                topic.assign(client);
            }
            return;
        }
        if topic.uuid != info.uuid {
            return;
        }
        if info.partitions > topic.partitions.len() {
            topic.grow(info.partitions, &self.layer);
            topic.reassign(client);
        }
        if !lost_position {
            topic.watch(marks, now, client);
        } else if topic.compare(marks, now, client) {
            self.look_again();
        }
    }

    /// Ends all readers, then the client.
    fn close(&self) {
        let state = std::mem::take(&mut *self.state.lock());
        for reader in state.topics.values().flat_map(|topic| &topic.readers) {
            reader.sender.close();
        }
    }
}
