//! Who reads which channel over one connection: what is to be subscribed at the server, and where
//! messages go.
//!
//! ```text
//! subscribe ─► add ─► Asked ─ take_work ─► Asking ─ confirm ─► Subscribed ─┐ deliver ─► readers
//!                       ▲                                                  │
//!                       └──────────── forget_server (connection lost) ─────┘ last reader gone ─► unsubscribe
//! ```
//!
//! One SUBSCRIBE serves all readers of a channel. SUBSCRIBE and UNSUBSCRIBE are sent by one task,
//! one after the other, so a channel that is left and wanted again ends up subscribed.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use futures::FutureExt as _;
use parking_lot::Mutex;
use tokio::sync::{Notify, oneshot};

use crate::port::{
    BrokerError, Content, Received, SubscribeOptions, Subscription, SubscriptionSender,
    subscription,
};

/// Channels that one broker reads at most, over all its connections.
const MAX_CHANNELS: usize = 10_000;
/// Channels of one SUBSCRIBE or UNSUBSCRIBE.
const PER_COMMAND: usize = 500;

/// Name on the server, with the prefix.
pub(super) type Name = Arc<str>;
/// Told when a channel is subscribed, or cannot be.
pub(super) type Confirmation = oneshot::Receiver<Result<(), BrokerError>>;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// To be subscribed.
    Asked,
    /// SUBSCRIBE is under way.
    Asking,
    Subscribed,
}

/// What a reader gets.
enum Phase {
    /// All that comes.
    Live,
    /// Nothing yet: what is kept for late joiners is being read. What comes meanwhile waits in a
    /// subscription of its own.
    Joining(SubscriptionSender, Subscription),
    /// All but what it got from what is kept: per writer, the highest sequence.
    Filtered(HashMap<WriterId, u64>),
}

struct Reader {
    id: u64,
    sender: SubscriptionSender,
    phase: Phase,
}

impl Reader {
    /// Returns whether the reader still lives.
    fn offer(&mut self, message: Received) -> bool {
        match &mut self.phase {
            Phase::Live => self.sender.send(message),
            Phase::Joining(held, _) => {
                held.send(message);
                !self.sender.is_closed()
            }
            Phase::Filtered(highest) => {
                if is_repeat(highest, &message.content) {
                    return !self.sender.is_closed();
                }
                if highest.is_empty() {
                    self.phase = Phase::Live;
                }
                self.sender.send(message)
            }
        }
    }

    fn join(&mut self, kept: Vec<Received>) {
        let mut highest = HashMap::new();
        for message in &kept {
            if let Content::Frame(frame) = &message.content {
                let highest = highest.entry(frame.writer()).or_insert(0);
                *highest = frame.sequence().max(*highest);
            }
        }
        self.sender.send_kept(kept);
        if let Phase::Joining(_, mut held) =
            std::mem::replace(&mut self.phase, Phase::Filtered(highest))
        {
            let mut messages = Vec::new();
            let _ = held.receive(&mut messages, usize::MAX).now_or_never();
            self.sender.note_lost(held.take_dropped());
            for message in messages {
                self.offer(message);
            }
        }
    }
}

/// Whether a message was among what is kept. The first that was not is the last of its writer to be
/// compared.
fn is_repeat(highest: &mut HashMap<WriterId, u64>, content: &Content) -> bool {
    let Content::Frame(frame) = content else { return false };
    match highest.get(&frame.writer()) {
        Some(highest) if frame.sequence() <= *highest => true,
        Some(_) => {
            highest.remove(&frame.writer());
            false
        }
        None => false,
    }
}

struct Channel {
    /// Its payloads are JSON, never frames.
    reserved: bool,
    stage: Stage,
    readers: Vec<Reader>,
    waiting: Vec<oneshot::Sender<Result<(), BrokerError>>>,
}

#[derive(Default)]
struct Channels {
    by_name: HashMap<Name, Channel>,
    /// Names that may have to be subscribed, or may have no reader any more.
    changed: Vec<Name>,
    next_id: u64,
    closed: bool,
}

/// What the connection's task has to do next.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Work {
    pub(super) subscribe: Vec<Name>,
    pub(super) unsubscribe: Vec<Name>,
}

/// A reader that was added.
pub(super) struct Added {
    pub(super) id: u64,
    pub(super) confirmation: Confirmation,
}

/// The readers of one connection.
pub(super) struct Subscriptions {
    channels: Mutex<Channels>,
    /// Something is to be subscribed or unsubscribed.
    pub(super) changed: Notify,
    /// Channels of all connections of the broker.
    count: Arc<AtomicUsize>,
}

impl Subscriptions {
    pub(super) fn new(count: Arc<AtomicUsize>) -> Arc<Self> {
        Arc::new(Self { channels: Mutex::default(), changed: Notify::new(), count })
    }

    /// Adds a reader. What comes is his once the confirmation says so.
    pub(super) fn add(
        &self,
        name: &Name,
        channel: &ChannelName,
        sender: SubscriptionSender,
        options: SubscribeOptions,
    ) -> Result<Added, BrokerError> {
        let (tell, confirmation) = oneshot::channel();
        let mut channels = self.channels.lock();
        let channels = &mut *channels;
        if channels.closed {
            return Err(BrokerError::Closed);
        }
        if !channels.by_name.contains_key(name) {
            self.count_one()?;
            channels.changed.push(Arc::clone(name));
        }
        let entry = channels.by_name.entry(Arc::clone(name)).or_insert_with(|| Channel {
            reserved: channel.is_reserved(),
            stage: Stage::Asked,
            readers: Vec::new(),
            waiting: Vec::new(),
        });
        let id = channels.next_id;
        channels.next_id += 1;
        let phase = if options.with_kept {
            let (held, waiting) = subscription(options);
            Phase::Joining(held, waiting)
        } else {
            Phase::Live
        };
        entry.readers.push(Reader { id, sender, phase });
        if entry.stage == Stage::Subscribed {
            let _ = tell.send(Ok(()));
        } else {
            entry.waiting.push(tell);
            self.changed.notify_one();
        }
        Ok(Added { id, confirmation })
    }

    fn count_one(&self) -> Result<(), BrokerError> {
        let more = |count: usize| (count < MAX_CHANNELS).then_some(count + 1);
        self.count
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, more)
            .map(|_| ())
            .map_err(|_| BrokerError::TooManyChannels(MAX_CHANNELS))
    }

    fn remove(&self, channels: &mut Channels, name: &Name) -> Option<Channel> {
        let channel = channels.by_name.remove(name)?;
        self.count.fetch_sub(1, Ordering::Relaxed);
        Some(channel)
    }

    /// Hands a reader what is kept, and from now on what comes.
    pub(super) fn join(&self, name: &Name, id: u64, kept: Vec<Received>) {
        let mut channels = self.channels.lock();
        let readers = channels.by_name.get_mut(name).map(|channel| &mut channel.readers);
        if let Some(reader) =
            readers.and_then(|readers| readers.iter_mut().find(|reader| reader.id == id))
        {
            reader.join(kept);
        }
    }

    /// Hands a message to all readers of its channel.
    pub(super) fn deliver(&self, name: &[u8], payload: Vec<u8>, at: Instant) {
        let Ok(name) = std::str::from_utf8(name) else { return };
        let payload = Bytes::from(payload);
        let mut channels = self.channels.lock();
        let Some(channel) = channels.by_name.get_mut(name) else {
            return;
        };
        // One that is to be subscribed anew was left before: what still comes is of the time
        // before.
        if channel.stage == Stage::Asked || channel.readers.is_empty() {
            return;
        }
        let message = Received::live(Content::of(channel.reserved, payload), at);
        channel.readers.retain_mut(|reader| reader.offer(message.clone()));
        if channel.readers.is_empty() {
            channels.changed.push(Arc::from(name));
            self.changed.notify_one();
        }
    }

    /// Forgets readers that have gone, also where no message comes.
    pub(super) fn sweep(&self) {
        let mut channels = self.channels.lock();
        let channels = &mut *channels;
        for (name, channel) in &mut channels.by_name {
            channel.readers.retain(|reader| !reader.sender.is_closed());
            if channel.readers.is_empty() {
                channels.changed.push(Arc::clone(name));
            }
        }
    }

    /// What is to be asked of the server next; it is the caller's to report how it ended.
    pub(super) fn take_work(&self) -> Work {
        let mut channels = self.channels.lock();
        let channels = &mut *channels;
        let mut work = Work::default();
        while work.subscribe.len().max(work.unsubscribe.len()) < PER_COMMAND
            && let Some(name) = channels.changed.pop()
        {
            let Some(channel) = channels.by_name.get_mut(&name) else {
                continue;
            };
            match (channel.stage, channel.readers.is_empty()) {
                (Stage::Asked, false) => {
                    channel.stage = Stage::Asking;
                    work.subscribe.push(name);
                }
                (Stage::Asked, true) => drop(self.remove(channels, &name)),
                (Stage::Subscribed, true) => {
                    self.remove(channels, &name);
                    work.unsubscribe.push(name);
                }
                (Stage::Asking, _) | (Stage::Subscribed, false) => {}
            }
        }
        work
    }

    /// The server has confirmed SUBSCRIBE.
    pub(super) fn confirm(&self, names: &[Name]) {
        let mut channels = self.channels.lock();
        for name in names {
            if let Some(channel) = channels.by_name.get_mut(name) {
                channel.stage = Stage::Subscribed;
                for waiting in channel.waiting.drain(..) {
                    let _ = waiting.send(Ok(()));
                }
            }
        }
    }

    /// The server does not let us read a channel: its readers end.
    pub(super) fn refuse(&self, name: &Name, why: &str) {
        let mut channels = self.channels.lock();
        let Some(channel) = self.remove(&mut channels, name) else {
            return;
        };
        for waiting in channel.waiting {
            let _ = waiting
                .send(Err(BrokerError::Name { channel: name.to_string(), reason: why.to_owned() }));
        }
        for reader in channel.readers {
            reader.sender.close();
        }
    }

    /// The server knows nothing of us any more: all is to be subscribed again.
    pub(super) fn forget_server(&self) {
        let mut channels = self.channels.lock();
        let channels = &mut *channels;
        for channel in channels.by_name.values_mut() {
            channel.stage = Stage::Asked;
        }
        channels.changed = channels.by_name.keys().cloned().collect();
    }

    /// Those who wait for a confirmation wait no longer.
    pub(super) fn fail_waiting(&self, why: &str) {
        let mut channels = self.channels.lock();
        for channel in channels.by_name.values_mut() {
            for waiting in channel.waiting.drain(..) {
                let _ = waiting.send(Err(BrokerError::Away(why.to_owned())));
            }
        }
    }

    /// Ends all readers; they still get what waits for them.
    pub(super) fn close(&self) {
        let taken = {
            let mut channels = self.channels.lock();
            channels.closed = true;
            std::mem::take(&mut channels.by_name)
        };
        for channel in taken.into_values() {
            self.count.fetch_sub(1, Ordering::Relaxed);
            for waiting in channel.waiting {
                let _ = waiting.send(Err(BrokerError::Closed));
            }
            for reader in channel.readers {
                reader.sender.close();
            }
        }
    }
}

#[cfg(test)]
#[path = "subscriptions_tests.rs"]
mod tests;
