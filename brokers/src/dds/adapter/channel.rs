//! Subscribed channels: their DDS readers, and the threads that empty them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};
use std::task::{Wake, Waker};
use std::thread::{self, Thread};
use std::time::{Duration, Instant};

use parking_lot::{Mutex, RwLock};
use rustdds::Timestamp;
use tokio::sync::oneshot;

use super::deliver::{Kind, Progress, deliver, note_lost};
use super::doubtful::{Doubtful, Outcome, Room};
use super::kept::History;
use super::seen::Seen;
use super::shared::{Shared, WriterFacts};
use super::{Admission, Topic};
use crate::dds::participant::RawReader;
use crate::dds::reader::{StoppableThread, take_up_to};
use crate::dds::writer::endpoint_of;
use crate::dds::{DdsError, EndpointId, Profile, Sample};
use crate::port::{BrokerError, Content, Received, SubscribeOptions, SubscriptionSender};

/// Channels that one broker reads at most.
pub(crate) const MAX_CHANNELS: usize = 4096;
/// Samples that one channel gives before the next has its turn.
const TURN: usize = 256;
/// A safety net only: RustDDS wakes the thread.
const LONGEST_SLEEP: Duration = Duration::from_millis(250);
/// Samples that wait for the reading thread. RustDDS keeps that many whether they wait or not.
const SMALL_DEPTH: u16 = 1024;
/// The same where they may be large.
const LARGE_DEPTH: u16 = 32;

/// The readers of a channel, and how far they have come.
pub(super) struct Readers {
    /// By [`Kind`]. A reader that asks for more than a writer offers does not match it.
    pub(super) by_kind: [Option<RawReader>; 3],
    /// What came before is not delivered: RustDDS keeps samples of a topic for readers to come.
    pub(super) opened: Option<Timestamp>,
    /// What came of each writer.
    pub(super) seen: HashMap<EndpointId, Seen>,
    pub(super) history: History,
    doubtful: Doubtful<(Kind, Sample)>,
}

/// A channel that is read.
pub(super) struct Channel {
    pub(super) topic: Topic,
    pub(super) large: bool,
    /// Begin with what is kept for late joiners.
    pub(super) with_kept: bool,
    pub(super) senders: Mutex<Vec<SubscriptionSender>>,
    pub(super) readers: Mutex<Readers>,
    /// Who waits until it is read.
    waiting: Mutex<Vec<oneshot::Sender<()>>>,
    /// It stands in the list of those with samples.
    is_ready: AtomicBool,
    ready: Arc<Ready>,
    /// Of its readers.
    waker: Waker,
}

/// Channels with samples, and the thread that empties them.
#[derive(Default)]
struct Ready {
    queue: Mutex<Vec<Arc<Channel>>>,
    thread: OnceLock<Thread>,
}

impl Channel {
    pub(super) fn profile(&self, kind: Kind) -> Profile {
        let depth = if self.large { LARGE_DEPTH } else { SMALL_DEPTH };
        Profile {
            reliable: kind != Kind::BestEffort,
            transient_local: kind == Kind::Durable,
            timing: self.topic.timing,
            ..Profile::best_effort(depth)
        }
    }

    /// Which readers it needs, where writers of these kinds are known; one stands in any case.
    ///
    /// All readers of a topic share one cache in RustDDS. Where a reliable writer that keeps nothing
    /// joins one that does, both are read, but a reader that begins at the same moment may then miss
    /// what is kept.
    pub(super) fn wanted(&self, [_, reliable, best_effort]: [bool; 3]) -> [bool; 3] {
        [self.with_kept, reliable || !self.with_kept, best_effort]
    }

    /// Whether its reader of a kind is the one that reads a writer, as far as that is known.
    pub(super) fn reads(&self, kind: Kind, writer: Option<WriterFacts>) -> bool {
        writer.is_none_or(|facts| Kind::of(facts, self.with_kept) == kind)
    }

    /// It is read now: whoever waits for that is told, and what came meanwhile is looked for.
    pub(super) fn opened(self: &Arc<Self>) {
        for waiting in self.waiting.lock().drain(..) {
            // Nobody waits any more when the subscription was given up.
            let _ = waiting.send(());
        }
        self.note_samples();
    }

    fn is_used(&self) -> bool {
        let mut senders = self.senders.lock();
        senders.retain(|sender| !sender.is_closed());
        !senders.is_empty()
    }

    /// Its thread is to look for samples.
    fn note_samples(self: &Arc<Self>) {
        if !self.is_ready.swap(true, Ordering::AcqRel) {
            self.ready.queue.lock().push(Arc::clone(self));
        }
        if let Some(thread) = self.ready.thread.get() {
            thread.unpark();
        }
    }

    /// Takes samples until there is none, or its turn is over.
    fn drain(self: &Arc<Self>, shared: &Shared) {
        self.is_ready.store(false, Ordering::Release);
        let mut readers = self.readers.lock();
        let Readers { by_kind, opened, seen, history, doubtful } = &mut *readers;
        // The last of them gets all samples of the topic.
        let last =
            Kind::ALL.into_iter().zip(&*by_kind).filter(|(_, reader)| reader.is_some()).last();
        let counts = last.map(|(kind, _)| kind).filter(|_| shared.channels.is_first(self));
        let opened = opened.unwrap_or(Timestamp::ZERO);
        let mut progress = Progress { opened, counts, seen, history };
        self.resolve(shared, doubtful, &mut progress);
        let mut again = false;
        for (reader, kind) in by_kind.iter().zip(Kind::ALL) {
            let Some(reader) = reader else { continue };
            // Before it is emptied: what comes before a waker is set wakes nobody.
            reader.set_waker(Some(self.waker.clone()));
            again |= self.drain_one(shared, reader, kind, &mut progress, doubtful);
        }
        let clock = |writer: EndpointId| {
            let facts = shared.facts_of(&writer);
            shared.clock_of(writer, facts)
        };
        let quiet = progress.history.quiet(Instant::now(), clock);
        drop(readers);
        self.send_kept(&quiet);
        // Not under the lock: what takes the messages may publish, and this participant's messages
        // go to its own readers.
        let senders = self.senders.lock().clone();
        senders.iter().for_each(SubscriptionSender::flush);
        if again {
            self.note_samples();
        }
    }

    /// Hands a message to all who subscribed, at the end of [`drain`](Self::drain).
    pub(super) fn put(&self, received: Received) {
        self.send_by(received, SubscriptionSender::put);
    }

    fn send_by(&self, received: Received, send: fn(&SubscriptionSender, Received) -> bool) {
        let mut senders = self.senders.lock();
        if let [sender] = &senders[..] {
            // Mostly there is one; one that has ended is swept later.
            send(sender, received);
        } else {
            senders.retain(|sender| send(sender, received.clone()));
        }
    }

    /// Hands messages that were kept to all who subscribed.
    pub(super) fn send_kept(&self, kept: &[Received]) {
        if kept.is_empty() {
            return;
        }
        for sender in self.senders.lock().iter() {
            sender.send_kept(kept.iter().cloned());
        }
    }

    /// Messages that were acknowledged are lost to all who subscribed.
    pub(super) fn note_lost(&self, messages: u64) {
        for sender in self.senders.lock().iter() {
            sender.note_lost(messages);
        }
    }

    /// Whether it holds messages: those that were kept until their writers are quiet, and those of
    /// which it is not known yet whether they are read. Not to be waited for while a reader is made.
    fn holds_messages(&self) -> bool {
        let holds =
            |readers: &Readers| !(readers.history.is_empty() && readers.doubtful.is_empty());
        self.readers.try_lock().is_some_and(|readers| holds(&readers))
    }

    /// Delivers what waited until it is known whether it is read.
    fn resolve(
        &self,
        shared: &Shared,
        doubtful: &mut Doubtful<(Kind, Sample)>,
        progress: &mut Progress<'_>,
    ) {
        let admission = |writer: &EndpointId| shared.dialect.admission(&self.topic, writer);
        doubtful.resolve(Instant::now(), admission, |(kind, sample), outcome| match outcome {
            Outcome::Read => deliver(shared, self, kind, progress, &sample),
            Outcome::Lost => note_lost(shared, self, kind, progress, &sample),
        });
    }

    /// Delivers a sample, or lets it wait until it is known whether it is read.
    fn take(
        &self,
        shared: &Shared,
        kind: Kind,
        sample: Sample,
        progress: &mut Progress<'_>,
        doubtful: &mut Doubtful<(Kind, Sample)>,
    ) {
        let writer = endpoint_of(sample.writer_guid);
        match shared.dialect.admission(&self.topic, &writer) {
            Admission::Yes if !doubtful.has(&writer) => {
                deliver(shared, self, kind, progress, &sample);
            }
            Admission::Yes | Admission::Later if self.reads(kind, shared.facts_of(&writer)) => {
                let bytes = sample.sample.payload().len();
                for (kind, lost) in doubtful.push(Instant::now(), writer, (kind, sample), bytes) {
                    note_lost(shared, self, kind, progress, &lost);
                }
            }
            Admission::Yes | Admission::Later => {}
            // What another flow takes meanwhile is not lost.
            Admission::No => _ = progress.seen.remove(&writer),
        }
    }

    /// Returns whether there may be more.
    fn drain_one(
        &self,
        shared: &Shared,
        reader: &RawReader,
        kind: Kind,
        progress: &mut Progress<'_>,
        doubtful: &mut Doubtful<(Kind, Sample)>,
    ) -> bool {
        take_up_to(reader, TURN, |taken| match taken {
            Ok(sample) => self.take(shared, kind, sample, progress, doubtful),
            Err(error) => {
                // All readers of a topic get it.
                if progress.counts == Some(kind) {
                    shared.counts.lock().malformed += 1;
                    tracing::debug!(topic = &*self.topic.name, %error, "a sample cannot be read");
                }
            }
        })
    }
}

/// Wakes the reading thread for one channel.
struct Bell(Weak<Channel>);

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        if let Some(channel) = self.0.upgrade() {
            channel.note_samples();
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct ChannelKey {
    topic: Topic,
    large: bool,
    /// One that begins with what is kept shares its reader with nobody.
    alone: Option<u64>,
}

/// All channels that one broker reads.
#[derive(Default)]
pub(super) struct Channels {
    all: Mutex<HashMap<ChannelKey, Arc<Channel>>>,
    /// The same by their topics, for what this participant publishes itself.
    by_topic: RwLock<HashMap<Arc<str>, Vec<Arc<Channel>>>>,
    ready: [Arc<Ready>; 2],
    closed: AtomicBool,
    next: AtomicU64,
    doubtful: Room,
}

impl Channels {
    /// Adds a reader; it hears of it when the channel is read.
    pub(super) fn add(
        &self,
        topic: Topic,
        sender: SubscriptionSender,
        options: SubscribeOptions,
    ) -> Result<oneshot::Receiver<()>, BrokerError> {
        let (confirm, confirmed) = oneshot::channel();
        let key = ChannelKey {
            topic,
            large: options.large,
            alone: options.with_kept.then(|| self.next.fetch_add(1, Ordering::Relaxed)),
        };
        let mut all = self.all.lock();
        if self.closed.load(Ordering::Acquire) {
            return Err(BrokerError::Closed);
        }
        if all.len() >= MAX_CHANNELS && !all.contains_key(&key) {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        let found = all.entry(key).or_insert_with_key(|key| {
            let ready = Arc::clone(&self.ready[usize::from(options.large)]);
            let made = Arc::new_cyclic(|weak| Channel {
                topic: key.topic.clone(),
                large: options.large,
                with_kept: options.with_kept,
                senders: Mutex::default(),
                readers: Mutex::new(Readers {
                    by_kind: [None, None, None],
                    opened: None,
                    seen: HashMap::new(),
                    history: History::default(),
                    doubtful: Doubtful::new(Arc::clone(&self.doubtful)),
                }),
                waiting: Mutex::default(),
                is_ready: AtomicBool::new(false),
                ready,
                waker: Waker::from(Arc::new(Bell(weak.clone()))),
            });
            let mut by_topic = self.by_topic.write();
            by_topic.entry(Arc::clone(&key.topic.name)).or_default().push(Arc::clone(&made));
            made
        });
        // In this order, as the thread that opens it locks them.
        let readers = found.readers.lock();
        found.senders.lock().push(sender);
        if readers.opened.is_some() {
            let _ = confirm.send(());
        } else {
            found.waiting.lock().push(confirm);
        }
        drop(readers);
        Ok(confirmed)
    }

    pub(super) fn list(&self) -> Vec<Arc<Channel>> {
        self.all.lock().values().map(Arc::clone).collect()
    }

    pub(super) fn undecided_bytes(&self) -> usize {
        self.doubtful.load(Ordering::Acquire)
    }

    /// All channels are looked at, though nothing came.
    pub(super) fn look_again(&self) {
        for channel in self.list() {
            channel.note_samples();
        }
    }

    /// A subscription does not read a topic any more.
    pub(super) fn remove(&self, topic: &Topic, sender: &SubscriptionSender) {
        let by_topic = self.by_topic.read();
        for channel in by_topic.get(&topic.name).into_iter().flatten() {
            if channel.topic == *topic {
                channel.senders.lock().retain(|other| !other.is_same(sender));
                // It may have been given something just now.
                sender.wake();
            }
        }
    }

    /// Whether a channel of a topic begins with what is kept.
    pub(super) fn ask_for_kept(&self, topic: &str) -> bool {
        let by_topic = self.by_topic.read();
        by_topic.get(topic).into_iter().flatten().any(|channel| channel.with_kept)
    }

    /// Whether a channel is the first one of its topic.
    fn is_first(&self, channel: &Channel) -> bool {
        let by_topic = self.by_topic.read();
        let first = by_topic.get(&channel.topic.name).and_then(|channels| channels.first());
        first.is_some_and(|first| std::ptr::eq(&raw const **first, channel))
    }

    /// Takes out the channels that nobody reads any more.
    pub(super) fn take_unused(&self) -> Vec<Arc<Channel>> {
        let mut unused = Vec::new();
        self.all.lock().retain(|_, channel| {
            let used = channel.is_used();
            if !used {
                unused.push(Arc::clone(channel));
            }
            used
        });
        let mut by_topic = self.by_topic.write();
        for gone in &unused {
            if let Some(channels) = by_topic.get_mut(&gone.topic.name) {
                channels.retain(|channel| !Arc::ptr_eq(channel, gone));
                if channels.is_empty() {
                    by_topic.remove(&gone.topic.name);
                }
            }
        }
        drop(by_topic);
        unused
    }

    /// Hands an own message to the own readers of its topic. `content` is asked for once for each.
    pub(super) fn deliver_own(&self, topic: &str, content: impl Fn() -> Option<Content>) {
        let by_topic = self.by_topic.read();
        for channel in by_topic.get(topic).into_iter().flatten() {
            let Some(content) = content() else { return };
            let received = Received::live(content, Instant::now());
            channel.send_by(received, SubscriptionSender::send);
        }
    }

    /// Takes out all readers, whose participant has died.
    pub(super) fn take_readers(&self) -> Vec<RawReader> {
        let take = |channel: Arc<Channel>| {
            let mut readers = channel.readers.lock();
            readers.opened = None;
            std::mem::take(&mut readers.by_kind)
        };
        self.list().into_iter().flat_map(take).flatten().collect()
    }

    /// Ends all subscriptions; what waits in them is still read.
    pub(super) fn close(&self) {
        let all = self.all.lock();
        self.closed.store(true, Ordering::Release);
        for channel in all.values() {
            for sender in channel.senders.lock().iter() {
                sender.close();
            }
            channel.waiting.lock().clear();
        }
        drop(all);
        for ready in &self.ready {
            if let Some(thread) = ready.thread.get() {
                thread.unpark();
            }
        }
    }
}

/// Starts the thread that reads the channels with small or large messages.
pub(super) fn start(shared: &Arc<Shared>, large: bool) -> Result<StoppableThread, DdsError> {
    let shared = Arc::clone(shared);
    let name = if large { "dds-read-large" } else { "dds-read" };
    StoppableThread::start(name, Arc::default(), move |stop| {
        let ready = Arc::clone(&shared.channels.ready[usize::from(large)]);
        let _ = ready.thread.set(thread::current());
        let mut next_look = Instant::now() + LONGEST_SLEEP;
        while !stop.load(Ordering::Relaxed) && !shared.stop.load(Ordering::Acquire) {
            let channels = std::mem::take(&mut *ready.queue.lock());
            let idle = channels.is_empty();
            for channel in channels {
                channel.drain(&shared);
            }
            let of_this = |all: bool| {
                let mut channels = shared.channels.list();
                channels
                    .retain(|channel| channel.large == large && (all || channel.holds_messages()));
                channels
            };
            if idle {
                thread::park_timeout(LONGEST_SLEEP);
                if ready.queue.lock().is_empty() {
                    for channel in of_this(true) {
                        channel.drain(&shared);
                    }
                }
            }
            // Where others are never idle, nobody else looks for writers that have become quiet.
            let now = Instant::now();
            if now >= next_look {
                next_look = now + LONGEST_SLEEP;
                for channel in of_this(false) {
                    channel.drain(&shared);
                }
            }
        }
        ready.queue.lock().clear();
    })
}
