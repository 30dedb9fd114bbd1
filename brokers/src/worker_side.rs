//! What only a worker of BlazeConfig does on its broker, beside messages: channels that must be
//! there before somebody listens on them, and values that the broker keeps for those who come
//! later.

use std::collections::BTreeSet;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use bytes::Bytes;

use crate::port::BrokerError;

/// A payload that the broker keeps for those who come later, where it can.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyedMessage {
    /// Where it goes.
    pub channel: ChannelName,
    /// Whose value it is: of each key the last one is kept (Kafka).
    pub key: String,
    /// The payload as it is; `None` takes away what is kept of the key.
    pub value: Option<Bytes>,
}

/// Why messages were not written, or nobody knows whether they were.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WriteError {
    /// As everywhere: [`BrokerError::Name`] also for a channel that was not prepared or that the
    /// server does not make.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// Channels are still being made, or the server cannot make them just now. Nothing was written;
    /// what is for others need not wait for them.
    #[error("{} channels are not there yet: {reason}", channels.len())]
    NotYet {
        /// All of them.
        channels: BTreeSet<ChannelName>,
        /// What one of them waits for.
        reason: String,
    },
    /// One is more than the server takes, and would be again.
    #[error("channel {channel}: {bytes} bytes are more than the broker carries")]
    TooLarge {
        /// Where it was to go.
        channel: ChannelName,
        /// Of the payload.
        bytes: usize,
    },
}

/// What became of asking for a lease.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Held {
    /// Whether the one that asked has it.
    pub is_held: bool,
    /// What the last owner that left a note has left.
    pub note: Option<String>,
}

/// What only a worker does on a broker where channels are set up beforehand.
#[async_trait]
pub trait WorkerSide: Send + Sync {
    /// Makes a channel that keeps values, and makes it again when it vanishes, until it is
    /// released. Does not wait for it.
    ///
    /// # Errors
    /// [`BrokerError::Name`] and [`BrokerError::Collision`] where the server can have no such
    /// channel, [`BrokerError::TooManyChannels`].
    fn prepare(&self, channel: &ChannelName) -> Result<(), BrokerError>;

    /// Nothing is said on the channel any more: it stays as it is.
    fn release(&self, channel: &ChannelName);

    /// Writes messages of prepared channels in their order, and waits until the server has them
    /// (Kafka: acknowledged by all replicas that are in sync), or the network's client has taken
    /// them (DDS). What is taken away of a channel that is not prepared is left alone.
    ///
    /// # Errors
    /// [`WriteError`]: some of them may have been written; writing all of them again does no harm.
    async fn write(&self, messages: &[KeyedMessage]) -> Result<(), WriteError>;
}
