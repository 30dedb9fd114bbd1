//! The broker port and its adapters.
//!
//! [`Broker`] is what BlazeFlow and the SDK know of a message system; [`memory`] serves services and flows of one process.

#[cfg(feature = "conformance")]
pub mod conformance;
pub mod dds;
pub mod memory;
pub mod port;

pub use port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Content, Health, PublishOutcome, Publisher, PublisherOptions,
    Received, SubscribeOptions, Subscription, SubscriptionSender, subscription,
};
