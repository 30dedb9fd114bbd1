//! The one door for a service into BlazeAIoT.
//!
//! ```text
//!                      ┌─ broker(): publish; subscribe with a callback on a pool of threads
//! ServiceManager ──────┤
//!                      └─ flow(): advertise and request topics; leases renew themselves
//! ```
//!
//! ```
//! use std::sync::Arc;
//!
//! use blaze_brokers::memory::MemoryHub;
//! use blaze_domain::Scope;
//! use blaze_sdk::{PublishOptions, ServiceManager, ServiceOptions, SubscribeOptions};
//!
//! # #[tokio::main]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let hub = MemoryHub::new("node");
//! let options = ServiceOptions::new(
//!     "edge".parse()?,
//!     "logger".parse()?,
//!     Arc::new(hub.broker()),
//!     Scope::Node,
//! );
//! let service = ServiceManager::start(options.on_node("robot-1".parse()?)).await?;
//! let topic = "imu/data".parse()?;
//!
//! let (heard, mut hears) = tokio::sync::mpsc::channel(16);
//! let subscription = service
//!     .broker()
//!     .subscribe(&topic, SubscribeOptions::default(), move |message| {
//!         let _ = heard.try_send((message.sequence(), message.payload().clone()));
//!     })
//!     .await?;
//!
//! let publisher = service.broker().publisher(&topic, &PublishOptions::default())?;
//! publisher.publish("hello".into());
//!
//! assert_eq!(hears.recv().await, Some((Some(1), "hello".into())));
//! assert_eq!(subscription.stats().delivered, 1);
//! service.shutdown().await;
//! # Ok(())
//! # }
//! ```

mod broker;
mod flow;
mod message;
mod pool;
mod publisher;
mod service;
mod subscription;

pub use blaze_brokers::PublishOutcome;
pub use broker::LocalBroker;
pub use flow::{
    Advertise, FlowError, FlowEvent, FlowEventKind, FlowEvents, FlowManager, Lease, LeaseState, OriginFilter,
    RefusalCode, Request,
};
pub use message::Message;
pub use publisher::{PublishOptions, Publisher};
pub use service::{Identity, SdkError, ServiceManager, ServiceOptions};
pub use subscription::{SubscribeOptions, Subscription, SubscriptionStats};
