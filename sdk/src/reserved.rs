//! What all parts that speak on channels of BlazeAIoT's own have in common.

use std::time::{Duration, Instant};

use blaze_brokers::{
    Broker, BrokerError, BrokerKind, Content, PublisherOptions, Received, SubscribeOptions,
    Subscription,
};
use blaze_domain::names::ChannelName;
use bytes::Bytes;
use tokio::time::sleep_until;

const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// The clock of tasks, which tests can hold still.
pub(crate) fn now() -> Instant {
    tokio::time::Instant::now().into_std()
}

/// Where a service gets its answers. On Kafka and DDS all share one topic.
pub(crate) fn reply_channel(kind: BrokerKind, own: ChannelName) -> ChannelName {
    match kind {
        BrokerKind::Memory | BrokerKind::Redis => own,
        BrokerKind::Kafka | BrokerKind::Dds | BrokerKind::Ros2 => ChannelName::shared_reply(),
    }
}

/// How a service speaks there. What is lost is said again, so only DDS is asked to repair it:
/// there, whoever listens reliably does not hear who speaks otherwise.
pub(crate) fn speaking(kind: BrokerKind) -> PublisherOptions {
    PublisherOptions {
        reliable: matches!(kind, BrokerKind::Dds | BrokerKind::Ros2),
        ..PublisherOptions::default()
    }
}

/// A channel of this name.
pub(crate) fn channel(name: &str) -> Result<ChannelName, BrokerError> {
    name.parse()
        .map_err(|error| BrokerError::Name { channel: name.to_owned(), reason: format!("{error}") })
}

/// The payload of a message without a header; nothing else is spoken there.
pub(crate) fn bare(received: Received) -> Option<Bytes> {
    match received.content {
        Content::Bare { payload, .. } => Some(payload),
        Content::Frame(_) | Content::Malformed { .. } => None,
    }
}

/// Waits until then, or for ever.
pub(crate) async fn until(next: Option<Instant>) {
    match next {
        Some(next) => sleep_until(next.into()).await,
        None => std::future::pending().await,
    }
}

/// Subscribes as soon as the broker lets it.
pub(crate) async fn subscribe(
    broker: &dyn Broker,
    channel: &ChannelName,
) -> Result<Subscription, BrokerError> {
    let mut pause = FIRST_PAUSE;
    let mut status = broker.status();
    loop {
        match broker.subscribe(channel, SubscribeOptions::default()).await {
            Ok(subscription) => return Ok(subscription),
            Err(BrokerError::Away(reason)) => {
                tracing::debug!(%channel, reason, "the broker is away, the service waits for it");
            }
            Err(error) => return Err(error),
        }
        // A change of the status may mean that it is back.
        let _ = tokio::time::timeout(pause, status.changed()).await;
        if status.has_changed().is_err() {
            return Err(BrokerError::Closed);
        }
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_come_on_a_channel_of_ones_own_only_where_the_broker_makes_channels_as_they_are_named()
     {
        let own: ChannelName = "blaze/reply/slam-0-7f".parse().unwrap();
        for kind in [BrokerKind::Memory, BrokerKind::Redis] {
            assert_eq!(reply_channel(kind, own.clone()), own, "{kind}");
        }
        for kind in [BrokerKind::Kafka, BrokerKind::Dds, BrokerKind::Ros2] {
            assert_eq!(reply_channel(kind, own.clone()), ChannelName::shared_reply(), "{kind}");
        }
    }

    #[test]
    fn only_on_dds_it_matters_to_those_who_listen_how_a_service_speaks() {
        let is_reliable = |kind| speaking(kind).reliable;
        assert!(is_reliable(BrokerKind::Dds) && is_reliable(BrokerKind::Ros2));
        let kinds = [BrokerKind::Memory, BrokerKind::Redis, BrokerKind::Kafka];
        assert!(!kinds.into_iter().any(is_reliable));
    }

    #[test]
    fn a_name_that_no_channel_can_have_is_refused() {
        assert!(channel("blaze/config/get").is_ok_and(|channel| channel.is_reserved()));
        assert!(matches!(channel("a b"), Err(BrokerError::Name { .. })));
    }
}
