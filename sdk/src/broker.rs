//! The local broker, whichever it is.

use std::sync::Arc;

use blaze_brokers::{BrokerStatus, PublisherOptions};
use blaze_domain::TopicName;
use blaze_domain::names::ChannelName;
use tokio::sync::watch;

use crate::service::Shared;
use crate::subscription::{self, SubscribeOptions, Subscription};
use crate::{Message, PublishOptions, Publisher, SdkError};

/// Publishes and subscribes on the service's broker.
#[derive(Clone)]
pub struct LocalBroker {
    shared: Arc<Shared>,
}

impl LocalBroker {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared }
    }

    /// A publisher for a topic, with an identity of its own. The broker may be away: messages are
    /// dropped until it is back.
    ///
    /// # Errors
    /// [`SdkError::Option`] or [`SdkError::Broker`], when the broker cannot carry the topic.
    pub fn publisher(
        &self,
        topic: &TopicName,
        options: &PublishOptions,
    ) -> Result<Publisher, SdkError> {
        options.check()?;
        self.shared.refuse_when_stopping()?;
        let to = self.shared.broker.publisher(
            &ChannelName::from(topic),
            PublisherOptions {
                depth: options.depth,
                reliable: options.reliability == blaze_domain::Reliability::Reliable,
                large: options.large,
            },
        )?;
        let origin = self.shared.identity.origin();
        Ok(Publisher::new(topic, origin, options, to, self.shared.monitor.topics()))
    }

    /// Calls back for each message of a topic that is published from now on, on the service's pool
    /// of threads. Messages of one writer come one at a time and in order (unless `concurrency`
    /// says otherwise); those of different writers may come at the same time. A slow callback holds
    /// up neither other writers nor other subscriptions. A callback that panics is counted and
    /// logged, and the next message comes.
    ///
    /// # Errors
    /// [`SdkError::Option`], or [`SdkError::Broker`] when it cannot be subscribed now.
    pub async fn subscribe<F>(
        &self,
        topic: &TopicName,
        options: SubscribeOptions,
        callback: F,
    ) -> Result<Subscription, SdkError>
    where
        F: Fn(Message) + Send + Sync + 'static,
    {
        options.check()?;
        self.shared.refuse_when_stopping()?;
        let source =
            self.shared.broker.subscribe(&ChannelName::from(topic), options.of_the_port()).await?;
        Ok(subscription::start(&self.shared, topic, options, source, Box::new(callback)))
    }

    /// Whether the broker answers, and its changes.
    #[must_use]
    pub fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.shared.broker.status()
    }
}
