//! Where keys and notices go: a broker, and a Redis for the keys where there is one.
//!
//! A notice counts as told when the server has it where the broker can tell (Redis that is the
//! broker's own, Kafka), else when the broker's client has taken it.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_brokers::redis::{KeyChange, KeyError, RedisKeys, RedisLock};
use blaze_brokers::{
    Broker, BrokerError, BrokerKind, Health, KeyedMessage, PublishOutcome, Publisher,
    PublisherOptions, WorkerSide, WriteError,
};
use blaze_domain::ServiceName;
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use lru::LruCache;
use parking_lot::Mutex;

/// Publishers that are kept; the one that was used longest ago goes first.
const PUBLISHERS: NonZeroUsize = NonZeroUsize::MIN.saturating_add(1023);

/// Keys of before that are looked at.
const MAX_KEYS: usize = 20_000;

/// Why nothing was delivered, or nobody knows whether it was.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OutletError {
    /// The broker does not answer.
    #[error("the broker is away: {0}")]
    Away(String),
    /// The broker has these channels not yet; it may have others. The keys were changed, no message
    /// was published.
    #[error("{} channels are not there yet: {reason}", channels.len())]
    NotYet {
        /// Where it was to go.
        channels: BTreeSet<ChannelName>,
        /// What one of them waits for.
        reason: String,
    },
    /// Nothing was done: the server of the keys, which is another one than the broker, does not
    /// take them.
    #[error("the keys are not written: {0}")]
    KeysAlone(KeyError),
    /// It is more than the broker carries.
    #[error("{bytes} bytes are more than the broker carries")]
    TooLarge {
        /// Of the message.
        bytes: usize,
    },
    /// The broker cannot have such a channel.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// Another worker of the layer leads by now.
    #[error("another worker has the lease")]
    Led,
    /// The server of the keys does not do it.
    #[error(transparent)]
    Keys(#[from] KeyError),
}

impl OutletError {
    /// Whether the same would be refused again, for what it is.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::TooLarge { .. } | Self::Keys(KeyError::Refused { .. }) => true,
            Self::Broker(error) => match error {
                BrokerError::Name { .. } | BrokerError::Collision { .. } => true,
                BrokerError::Closed | BrokerError::Away(_) | BrokerError::TooManyChannels(_) => {
                    false
                }
            },
            Self::Away(_)
            | Self::NotYet { .. }
            | Self::KeysAlone(_)
            | Self::Led
            | Self::Keys(KeyError::Away { .. }) => false,
        }
    }
}

impl From<WriteError> for OutletError {
    fn from(error: WriteError) -> Self {
        match error {
            WriteError::Broker(error) => Self::Broker(error),
            WriteError::NotYet { channels, reason } => Self::NotYet { channels, reason },
            WriteError::TooLarge { bytes, .. } => Self::TooLarge { bytes },
        }
    }
}

/// Where keys and notices go.
#[async_trait]
pub trait Outlet: Send + Sync + 'static {
    /// Makes all changes of keys, then publishes all messages, in their order. Where a server that
    /// is not the broker's does not take the keys, nothing is published, so that whoever calls can
    /// see that it is still its turn and publish without them.
    ///
    /// # Errors
    /// [`OutletError`]: some of it may have been done; doing all of it again does no harm.
    async fn deliver(
        &self,
        changes: &[KeyChange],
        messages: &[KeyedMessage],
    ) -> Result<(), OutletError>;

    /// Whether keys are kept at all.
    fn has_keys(&self) -> bool;

    /// Keys that an earlier life of this worker may have written.
    ///
    /// # Errors
    /// [`OutletError`].
    async fn own_keys(&self) -> Result<Vec<String>, OutletError>;

    /// Waits until the server of the keys may have lost them: it was away and is back.
    async fn keys_lost(&self);

    /// Those of some keys that the server has not: it may evict them, or somebody deletes them.
    ///
    /// # Errors
    /// [`OutletError`].
    async fn missing_keys(&self, keys: &[String]) -> Result<Vec<String>, OutletError>;
}

/// Channels that are there before anybody listens, on brokers where they are to be made.
pub trait Channels: Send + Sync + 'static {
    /// These services, and no others, are told of changes from now on. Does not wait.
    fn serve(&self, services: BTreeSet<ServiceName>);
}

/// The channel on which a service is told; `None` never happens, as a name of a service is part of
/// a good one.
#[must_use]
pub fn changed(service: &ServiceName) -> Option<ChannelName> {
    format!("blaze/config/changed/{service}").parse().ok()
}

/// Whether a value of a key is one's own.
type IsOwn = Box<dyn Fn(&[u8]) -> bool + Send + Sync>;

/// A broker, and a Redis for the keys.
pub struct BrokerOutlet {
    broker: Arc<dyn Broker>,
    keys: Option<Keys>,
    publishers: Mutex<LruCache<ChannelName, Arc<dyn Publisher>>>,
    /// What the broker does for workers alone, and the services whose channels it was asked for.
    side: Option<Arc<dyn WorkerSide>>,
    served: Mutex<BTreeSet<ServiceName>>,
    /// Whether a value is one that a worker of this place writes.
    is_own: IsOwn,
}

struct Keys {
    client: Arc<RedisKeys>,
    /// It is the broker's own server: keys and notices go in one transaction.
    is_broker: bool,
    /// The lease, where it lies on the same server: the server changes nothing for whoever has not
    /// got it.
    lock: Option<RedisLock>,
}

impl Keys {
    async fn apply(
        &self,
        changes: &[KeyChange],
        messages: &[(ChannelName, Bytes)],
    ) -> Result<(), OutletError> {
        match &self.lock {
            None => Ok(self.client.apply(changes, messages).await?),
            Some(lock) => match self.client.apply_if_held(lock, changes, messages).await? {
                true => Ok(()),
                false => Err(OutletError::Led),
            },
        }
    }
}

impl BrokerOutlet {
    /// A broker without keys.
    #[must_use]
    pub fn new(broker: Arc<dyn Broker>) -> Self {
        Self {
            side: broker.worker_side(),
            served: Mutex::default(),
            broker,
            keys: None,
            publishers: Mutex::new(LruCache::new(PUBLISHERS)),
            is_own: Box::new(|_| false),
        }
    }

    /// The same with keys on a Redis; `is_broker`: it is the broker's own server; `lock`: the lease
    /// of one of several workers, where it lies there as well; `is_own`: whether a value is one
    /// that a worker of this place writes, which others on the same server are not to lose.
    #[must_use]
    pub fn with_keys(
        mut self,
        client: Arc<RedisKeys>,
        is_broker: bool,
        lock: Option<RedisLock>,
        is_own: impl Fn(&[u8]) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.keys = Some(Keys { client, is_broker, lock });
        self.is_own = Box::new(is_own);
        self
    }

    /// Which broker it is.
    #[must_use]
    pub fn kind(&self) -> BrokerKind {
        self.broker.kind()
    }

    /// Whether channels are to be made, and keep what was said last on them.
    #[must_use]
    pub fn makes_channels(&self) -> bool {
        self.side.is_some()
    }

    /// Publishes one message, now. What a broker that is away does not take is dropped: whoever
    /// asked asks again.
    ///
    /// # Errors
    /// [`OutletError`].
    pub fn publish(&self, channel: &ChannelName, payload: &Bytes) -> Result<(), OutletError> {
        let publisher = self.publisher(channel)?;
        match publisher.publish_bare(payload, None) {
            PublishOutcome::Taken => Ok(()),
            PublishOutcome::Dropped => {
                Err(OutletError::Away(self.broker.status().borrow().detail.clone()))
            }
            PublishOutcome::TooLarge => Err(OutletError::TooLarge { bytes: payload.len() }),
        }
    }

    fn publisher(&self, channel: &ChannelName) -> Result<Arc<dyn Publisher>, BrokerError> {
        if let Some(known) = self.publishers.lock().get(channel) {
            return Ok(Arc::clone(known));
        }
        let options = PublisherOptions { reliable: true, ..PublisherOptions::default() };
        let made = self.broker.publisher(channel, options)?;
        self.publishers.lock().put(channel.clone(), Arc::clone(&made));
        Ok(made)
    }

    fn check_up(&self) -> Result<(), OutletError> {
        let status = self.broker.status();
        let status = status.borrow();
        match status.health {
            Health::Up => Ok(()),
            Health::Connecting | Health::Down | Health::InUse | Health::Closed => {
                Err(OutletError::Away(status.detail.clone()))
            }
        }
    }
}

#[async_trait]
impl Outlet for BrokerOutlet {
    async fn deliver(
        &self,
        changes: &[KeyChange],
        messages: &[KeyedMessage],
    ) -> Result<(), OutletError> {
        match &self.keys {
            Some(keys) if keys.is_broker => {
                let messages: Vec<_> =
                    said(messages).map(|(to, text)| (to.clone(), text.clone())).collect();
                return keys.apply(changes, &messages).await;
            }
            Some(keys) => keys.apply(changes, &[]).await.map_err(|error| match error {
                OutletError::Keys(error) => OutletError::KeysAlone(error),
                other => other,
            })?,
            None => {}
        }
        if messages.is_empty() {
            return Ok(());
        }
        if let Some(side) = &self.side {
            return Ok(side.write(messages).await?);
        }
        self.check_up()?;
        said(messages).try_for_each(|(to, text)| self.publish(to, text))
    }

    fn has_keys(&self) -> bool {
        self.keys.is_some()
    }

    async fn own_keys(&self) -> Result<Vec<String>, OutletError> {
        let Some(keys) = &self.keys else { return Ok(Vec::new()) };
        let found = keys.client.values("blaze:config:", MAX_KEYS).await?;
        let own = found.into_iter().filter(|(_, value)| (self.is_own)(value));
        Ok(own.map(|(key, _)| key).collect())
    }

    async fn keys_lost(&self) {
        match &self.keys {
            Some(keys) => keys.client.restarted().await,
            None => std::future::pending().await,
        }
    }

    async fn missing_keys(&self, wanted: &[String]) -> Result<Vec<String>, OutletError> {
        match &self.keys {
            Some(keys) => Ok(keys.client.missing(wanted).await?),
            None => Ok(Vec::new()),
        }
    }
}

/// What is said: where nothing is kept, nothing is taken away.
fn said(messages: &[KeyedMessage]) -> impl Iterator<Item = (&ChannelName, &Bytes)> {
    messages.iter().filter_map(|message| Some((&message.channel, message.value.as_ref()?)))
}

impl Channels for BrokerOutlet {
    fn serve(&self, services: BTreeSet<ServiceName>) {
        let Some(side) = &self.side else { return };
        let mut served = self.served.lock();
        // First what goes: there may be room for no more.
        served.retain(|service| {
            let stays = services.contains(service);
            if !stays && let Some(channel) = changed(service) {
                side.release(&channel);
            }
            stays
        });
        for service in services {
            let Some(channel) = changed(&service).filter(|_| !served.contains(&service)) else {
                continue;
            };
            match side.prepare(&channel) {
                Ok(()) => {
                    served.insert(service);
                }
                // It is tried again when services come or go.
                Err(error) => {
                    tracing::error!(
                        %error,
                        %service,
                        "it cannot be told of changes; it is answered when it asks",
                    );
                }
            }
        }
    }
}

#[cfg(test)]
#[path = "outlet_tests.rs"]
mod tests;
