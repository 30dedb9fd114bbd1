//! The broker port and its adapters.
//!
//! [`Broker`] is what BlazeFlow and the SDK know of a message system; [`memory`] serves services and flows of one process.

#[cfg(feature = "conformance")]
pub mod conformance;
pub mod dds;
#[cfg(feature = "kafka")]
pub mod kafka;
pub mod memory;
pub mod open;
#[allow(dead_code, reason = "its users, the adapters of Redis and Kafka, follow")]
mod outbox;
pub mod port;

pub use open::OpenError;
pub use port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Content, FlowSide, Health, Later, PublishOutcome, Publisher,
    PublisherOptions, Received, Role, SubscribeOptions, Subscription, SubscriptionSender, subscription,
};
