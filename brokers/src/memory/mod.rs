//! Messages within one process.
//!
//! ```text
//! MemoryBroker (client) ─ publisher ─┐                       ┌─ ring ─ Subscription
//! MemoryBroker (client) ─ publisher ─┴─► MemoryHub: channel ─┼─ ring ─ Subscription
//!                                           │                └─ ring ─ Subscription
//!                                           └─► kept: last `depth` frames per (channel, writer)
//! ```
//!
//! A [`MemoryHub`] is the server, a [`MemoryBroker`] one client of it; a client also sees what it publishes itself, as on
//! Redis. Messages are shared, never copied. [`MemoryHub::cut`] and [`MemoryHub::restore`] take the server away and bring
//! it back, so that what follows an outage can be tried without a server.

mod broker;
mod kept;

use std::collections::HashMap;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use parking_lot::Mutex;

pub use broker::MemoryBroker;
pub use kept::{MAX_KEPT_BYTES, MAX_KEPT_WRITERS};

use crate::port::{BrokerError, Content, Health, Received, SubscribeOptions, Subscription, SubscriptionSender};
use broker::Client;
use kept::Kept;

/// Channels that one hub holds at most.
pub const MAX_CHANNELS: usize = 65_536;

/// A named space of channels: the server of the memory broker. Cheap to clone; all clones are the same hub.
#[derive(Clone)]
pub struct MemoryHub {
    shared: Arc<Shared>,
}

/// What a hub holds now, and what it had to give up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MemoryHubStats {
    /// Channels that are known.
    pub channels: usize,
    /// Subscriptions that live.
    pub subscriptions: usize,
    /// Pairs of channel and writer of which messages are kept for late joiners.
    pub kept_writers: usize,
    /// Messages kept for late joiners.
    pub kept_messages: usize,
    /// Bytes kept for late joiners, with an allowance for each message's own administration.
    pub kept_bytes: usize,
    /// Messages that were kept and gave way to newer ones because the hub was at its bounds, not because of `depth`.
    pub kept_dropped: u64,
}

struct Shared {
    name: String,
    up: AtomicBool,
    channels: Mutex<Channels>,
    kept: Mutex<Kept>,
    clients: Mutex<Vec<Weak<Client>>>,
}

struct Channels {
    by_name: HashMap<ChannelName, Arc<Channel>>,
    /// The next sweep for unused channels comes when there are this many.
    sweep_at: usize,
}

const FIRST_SWEEP: usize = 64;

/// Who reads a channel. Its lock is held while a message is handed out and kept, so that a late joiner gets each message
/// either from what is kept or as it is published, and never both.
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
                channels: Mutex::new(Channels {
                    by_name: HashMap::new(),
                    sweep_at: FIRST_SWEEP,
                }),
                kept: Mutex::default(),
                clients: Mutex::default(),
            }),
        }
    }

    /// The hub's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.shared.name
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

    /// Simulates an outage: clients are [`Health::Down`], publishes are dropped, subscriptions stay and are silent.
    pub fn cut(&self) {
        self.set_up(false);
    }

    /// Ends the outage that [`MemoryHub::cut`] began: clients are [`Health::Up`], subscriptions go on.
    pub fn restore(&self) {
        self.set_up(true);
    }

    /// Forgets what is kept of a writer of a channel, as when its lease lapsed.
    pub fn forget_writer(&self, channel: &ChannelName, writer: WriterId) {
        self.shared.kept.lock().forget(channel, writer);
    }

    /// What the hub holds now.
    #[must_use]
    pub fn stats(&self) -> MemoryHubStats {
        let channels: Vec<Arc<Channel>> = self.shared.channels.lock().by_name.values().cloned().collect();
        let subscriptions = channels.iter().map(|channel| channel.count_readers()).sum();
        let kept = self.shared.kept.lock();
        MemoryHubStats {
            channels: channels.len(),
            subscriptions,
            kept_writers: kept.writers(),
            kept_messages: kept.messages(),
            kept_bytes: kept.bytes(),
            kept_dropped: kept.dropped(),
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
        let channel = Arc::new(Channel {
            name: name.clone(),
            readers: Mutex::default(),
        });
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
            let kept = self.shared.kept.lock().of_channel(&channel.name);
            let now = Instant::now();
            let received = |(frame, since)| Received {
                content: Content::Frame(frame),
                at: now,
                broker_age_us: u64::try_from(now.saturating_duration_since(since).as_micros()).unwrap_or(u64::MAX),
                kept: true,
                place: None,
            };
            sender.send_kept(kept.into_iter().map(received));
        }
        readers.push(sender.clone());
        Ok((sender, subscription))
    }

    /// Hands a message to all readers of a channel, and keeps the last `depth` frames of its writer.
    fn deliver(&self, channel: &Channel, content: Content, depth: u32) {
        let message = Received {
            content,
            at: Instant::now(),
            broker_age_us: 0,
            kept: false,
            place: None,
        };
        let mut readers = channel.readers.lock();
        if depth > 0
            && let Content::Frame(frame) = &message.content
        {
            let mut kept = self.shared.kept.lock();
            kept.keep(&channel.name, frame.clone(), depth, message.at);
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
    /// Forgets channels that nobody reads and no publisher holds. Kept messages are found by name, not through the
    /// channel. The bound doubles, so that sweeping costs a constant per channel made.
    fn sweep(&mut self) {
        self.by_name
            .retain(|_, channel| Arc::strong_count(channel) > 1 || channel.count_readers() > 0);
        self.sweep_at = FIRST_SWEEP.max(self.by_name.len() * 2).min(MAX_CHANNELS);
    }
}
