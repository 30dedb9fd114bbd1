//! The one door for a service into BlazeAIoT.
//!
//! ```text
//!                      ┌─ broker(): publish; subscribe with a callback on a pool of threads
//! ServiceManager ──────┤
//!                      ├─ flow(): advertise and request topics; leases renew themselves
//!                      ├─ config(): its configuration, and callbacks when it changes
//!                      ├─ cache(): says that it lives, waits for others, keeps values for a while
//!                      └─ monitor(): counters, gauges and histograms, served to Prometheus
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
mod cache;
mod config;
mod flow;
mod message;
mod monitor;
mod options;
mod pool;
mod publisher;
mod reserved;
mod service;
mod subscription;

pub use blaze_brokers::PublishOutcome;
pub use broker::LocalBroker;
pub use cache::{
    CacheError, CacheManager, Liveness, MAX_CACHE_KEY_BYTES, MAX_CACHE_TIME, MAX_CACHE_VALUE_BYTES,
    ServiceState,
};
pub use config::{
    AckStatus, BaseConfiguration, BaseSource, ConfigChange, ConfigCounts, ConfigError,
    ConfigListener, ConfigManager, ConfigScope, ConfigSource, ProgramConfig,
};
pub use flow::{
    Advertise, FlowError, FlowEvent, FlowEventKind, FlowEvents, FlowManager, Lease, LeaseState,
    OriginFilter, RefusalCode, Request,
};
pub use message::Message;
pub use monitor::{Counter, Gauge, Histogram, Metric, MetricsEndpoint, MonitorManager};
pub use options::ServiceOptions;
pub use publisher::{PublishOptions, Publisher};
pub use service::{Identity, SdkError, ServiceManager};
pub use subscription::{SubscribeOptions, Subscription, SubscriptionStats};

/// The examples of the page are compiled with those of the crate.
#[cfg(doctest)]
#[doc = include_str!("../../docs/sdk-rust.md")]
struct Page;
