//! The broker port and its adapters.
//!
//! [`Broker`] is what BlazeFlow and the SDK know of a message system; [`memory`] serves services
//! and flows of one process.

pub mod dds;
#[cfg(feature = "kafka")]
pub mod kafka;
pub mod memory;
mod open;
#[allow(dead_code, reason = "each adapter uses its part, and a build may lack one")]
mod outbox;
#[allow(dead_code, reason = "each adapter uses its part, and a build may lack one")]
mod pending;
pub mod port;
pub mod redis;
pub mod retained;
pub mod ros2;
mod subscription;
mod wake;
mod worker_side;

pub use open::{OpenError, layer_fault, node_schema, open_layer, open_node};
pub use port::{
    Begin, Broker, BrokerError, BrokerKind, BrokerStatus, ConsumerOffset, Content, FlowSide,
    Health, Later, PublishOutcome, Publisher, PublisherOptions, Received, Role, SubscribeOptions,
    Subscription, SubscriptionSender, subscription,
};
pub use worker_side::{Held, KeyedMessage, WorkerSide, WriteError};
