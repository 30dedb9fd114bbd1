//! Messages within one process.
//!
//! ```text
//! MemoryBroker (client) ─ publisher ─┐                       ┌─ ring ─ Subscription
//! MemoryBroker (client) ─ publisher ─┴─► MemoryHub: channel ─┼─ ring ─ Subscription
//!                                           │                └─ ring ─ Subscription
//!                                           └─► retained: last `depth` frames per (channel, writer)
//! ```
//!
//! A [`MemoryHub`] is the server, a [`MemoryBroker`] one client of it; a client also sees what it
//! publishes itself, as on Redis. Messages are shared, never copied. [`MemoryHub::cut`] and
//! [`MemoryHub::restore`] take the server away and bring it back, so that what follows an outage
//! can be tried without a server.

mod broker;

use std::collections::HashMap;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;
use parking_lot::Mutex;

pub use broker::MemoryBroker;

use crate::port::{
    BrokerError, Content, Health, Received, SubscribeOptions, Subscription, SubscriptionSender,
};
use crate::retained::{RetainedBounds, RetainedCache};
use broker::Client;

/// Channels that one hub holds at most.
pub const MAX_CHANNELS: usize = 65_536;
/// What one hub retains: 65,536 pairs of channel and writer, 64 MiB.
const RETAINED: RetainedBounds =
    RetainedBounds { writers: 65_536, bytes: 64 * 1024 * 1024, bytes_of_writer: 64 * 1024 * 1024 };
/// Allowance for what a retained message takes beside its bytes: index entries and the parsed
/// header.
const OVERHEAD_BYTES: usize = 512;

/// A named space of channels: the server of the memory broker. Cheap to clone; all clones are the
/// same hub.
#[derive(Clone)]
pub struct MemoryHub {
    shared: Arc<Shared>,
}

/// What a hub holds now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MemoryHubStats {
    /// Channels that are known.
    pub channels: usize,
    /// Subscriptions that live.
    pub subscriptions: usize,
    /// Retained messages that gave way to others.
    pub kept_dropped: u64,
}

struct Shared {
    name: String,
    up: AtomicBool,
    channels: Mutex<Channels>,
    /// Frames and when they came.
    retained: Mutex<RetainedCache<(ChannelName, WriterId), (Frame, Instant)>>,
    clients: Mutex<Vec<Weak<Client>>>,
}

struct Channels {
    by_name: HashMap<ChannelName, Arc<Channel>>,
    /// The next sweep for unused channels comes when there are this many.
    sweep_at: usize,
}

const FIRST_SWEEP: usize = 64;

/// Who reads a channel. Its lock is held while a message is handed out and kept, so that a late
/// joiner gets each message either from what is kept or as it is published, and never both.
struct Channel {
    name: ChannelName,
    readers: Mutex<Vec<SubscriptionSender>>,
}

impl MemoryHub {
    /// A hub with no channels. The name is for people; two hubs of one name are not connected.
    #[must_use]
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            shared: Arc::new(Shared {
                name: name.into(),
                up: AtomicBool::new(true),
                channels: Mutex::new(Channels { by_name: HashMap::new(), sweep_at: FIRST_SWEEP }),
                retained: Mutex::new(RetainedCache::new(RETAINED)),
                clients: Mutex::default(),
            }),
        }
    }

    /// A new client of this hub.
    #[must_use]
    pub fn broker(&self) -> MemoryBroker {
        let mut clients = self.shared.clients.lock();
        let (health, detail) = self.health();
        let client = Arc::new(Client::new(health, detail));
        clients.retain(|client| client.strong_count() > 0);
        clients.push(Arc::downgrade(&client));
        drop(clients);
        MemoryBroker::new(self.clone(), client)
    }

    /// Simulates an outage: clients are [`Health::Down`], publishes are dropped, subscriptions stay
    /// and are silent.
    pub fn cut(&self) {
        self.set_up(false);
    }

    /// Ends the outage that [`MemoryHub::cut`] began: clients are [`Health::Up`], subscriptions go
    /// on.
    pub fn restore(&self) {
        self.set_up(true);
    }

    /// Forgets what is retained of a writer of a channel, as when its lease lapsed.
    pub fn forget_writer(&self, channel: &ChannelName, writer: WriterId) {
        self.shared.retained.lock().forget(&(channel.clone(), writer));
    }

    /// What the hub holds now.
    #[must_use]
    pub fn stats(&self) -> MemoryHubStats {
        let channels: Vec<Arc<Channel>> =
            self.shared.channels.lock().by_name.values().cloned().collect();
        let subscriptions = channels.iter().map(|channel| channel.count_readers()).sum();
        MemoryHubStats {
            channels: channels.len(),
            subscriptions,
            kept_dropped: self.shared.retained.lock().evicted(),
        }
    }

    /// Subscriptions of a channel that live.
    #[must_use]
    pub fn subscriptions_of(&self, channel: &ChannelName) -> usize {
        let found = self.shared.channels.lock().by_name.get(channel).cloned();
        found.map_or(0, |channel| channel.count_readers())
    }

    fn health(&self) -> (Health, String) {
        if self.is_up() {
            (Health::Up, format!("memory hub {}", self.shared.name))
        } else {
            (Health::Down, format!("memory hub {} is cut", self.shared.name))
        }
    }

    fn is_up(&self) -> bool {
        self.shared.up.load(Ordering::Acquire)
    }

    fn set_up(&self, up: bool) {
        // Under this lock, so that a client made meanwhile does not miss the change.
        let clients = self.shared.clients.lock();
        self.shared.up.store(up, Ordering::Release);
        let (health, detail) = self.health();
        for client in clients.iter().filter_map(Weak::upgrade) {
            client.set_health(health, &detail);
        }
    }

    fn channel(&self, name: &ChannelName) -> Result<Arc<Channel>, BrokerError> {
        let mut channels = self.shared.channels.lock();
        if let Some(channel) = channels.by_name.get(name) {
            return Ok(Arc::clone(channel));
        }
        if channels.by_name.len() >= channels.sweep_at {
            channels.sweep();
        }
        if channels.by_name.len() >= MAX_CHANNELS {
            return Err(BrokerError::TooManyChannels(MAX_CHANNELS));
        }
        let channel = Arc::new(Channel { name: name.clone(), readers: Mutex::default() });
        channels.by_name.insert(name.clone(), Arc::clone(&channel));
        Ok(channel)
    }

    fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<(SubscriptionSender, Subscription), BrokerError> {
        let channel = self.channel(channel)?;
        let (sender, subscription) = crate::port::subscription(options);
        let mut readers = channel.readers.lock();
        readers.retain(|reader| !reader.is_closed());
        if options.with_kept {
            let now = Instant::now();
            let received = |(frame, since)| {
                let age = now.saturating_duration_since(since).as_micros();
                Received::kept(Content::Frame(frame), now, u64::try_from(age).unwrap_or(u64::MAX))
            };
            sender.send_kept(self.retained_of(&channel.name).into_iter().map(received));
        }
        readers.push(sender.clone());
        Ok((sender, subscription))
    }

    /// All that is retained of a channel, in the order of arrival. It walks all writers of the hub,
    /// 65,536 at most: the cost of one subscription, under the mutex that publishers with `depth`
    /// take.
    fn retained_of(&self, channel: &ChannelName) -> Vec<(Frame, Instant)> {
        let retained = self.shared.retained.lock();
        let of_channel = retained.iter().filter(|((name, _), ..)| name == channel);
        let mut found: Vec<_> =
            of_channel.flat_map(|(.., of_writer)| of_writer.iter().cloned()).collect();
        // Stable, and the times of one writer ascend.
        found.sort_by_key(|(_, since)| *since);
        found
    }

    /// Hands a message to all readers of a channel, and keeps the last `depth` frames of its
    /// writer.
    fn deliver(&self, channel: &Channel, content: Content, depth: u32) {
        let mut readers = channel.readers.lock();
        // Under the lock, so that the times of one writer ascend.
        let message = Received::live(content, Instant::now());
        if depth > 0
            && let Content::Frame(frame) = &message.content
        {
            let writer = (channel.name.clone(), frame.writer());
            let (size, depth) = (
                frame.received_len() + OVERHEAD_BYTES,
                usize::try_from(depth).unwrap_or(usize::MAX),
            );
            let mut retained = self.shared.retained.lock();
            retained.keep(writer, (frame.clone(), message.at), size, depth);
        }
        readers.retain(|reader| reader.send(message.clone()));
    }
}

impl fmt::Debug for MemoryHub {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MemoryHub")
            .field("name", &self.shared.name)
            .field("up", &self.is_up())
            .finish_non_exhaustive()
    }
}

impl Channel {
    /// Reads of a channel that live; forgets the others.
    fn count_readers(&self) -> usize {
        let mut readers = self.readers.lock();
        readers.retain(|reader| !reader.is_closed());
        readers.len()
    }
}

impl Channels {
    /// Forgets channels that nobody reads and no publisher holds. Retained messages are found by
    /// name, not through the channel. The bound doubles, so that sweeping costs a constant per
    /// channel made.
    fn sweep(&mut self) {
        self.by_name
            .retain(|_, channel| Arc::strong_count(channel) > 1 || channel.count_readers() > 0);
        self.sweep_at = FIRST_SWEEP.max(self.by_name.len() * 2).min(MAX_CHANNELS);
    }
}
