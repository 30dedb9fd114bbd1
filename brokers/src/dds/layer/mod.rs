//! DDS as the broker of a layer: user topic `a/b` is the DDS topic `bt/a/b`, reserved topics keep
//! their names, and each sample is one `blaze::v1::Frame` (`brokers/idl/blaze_frame.idl`), readable
//! by any DDS program.

mod frames;
mod names;
mod signs;
mod worker_side;

use std::net::IpAddr;
use std::sync::Arc;

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::DdsLayerBroker as Section;
use tokio::sync::watch;

use super::DdsError;
use super::adapter::Adapter;
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Publisher, PublisherOptions, SubscribeOptions,
    Subscription,
};
use crate::worker_side::WorkerSide;
use frames::Frames;
use worker_side::DdsWorkerSide;

pub use super::adapter::{DdsCounts, MAX_QUEUE_BYTES};

/// A participant of the layer's DDS domain.
pub struct DdsBroker {
    adapter: Arc<Adapter>,
    worker: Arc<DdsWorkerSide>,
}

impl DdsBroker {
    /// Checks a section.
    ///
    /// # Errors
    /// [`DdsError`] where it can never work.
    pub fn check(section: &Section) -> Result<(), DdsError> {
        super::check(section.domain, IpAddr::V4(section.interface)).map(|_| ())
    }

    /// Starts in the background: the status tells how far it is. An interface that is missing is no
    /// error: it is looked for each second.
    ///
    /// # Errors
    /// [`DdsError`] where it can never work, or there is no thread for it.
    pub fn open(section: &Section) -> Result<Self, DdsError> {
        Self::check(section)?;
        let adapter = Arc::new(Adapter::open(Arc::new(Frames), section.domain, section.interface)?);
        Ok(Self { worker: Arc::new(DdsWorkerSide::new(&adapter)), adapter })
    }

    /// What it has counted.
    #[must_use]
    pub fn counts(&self) -> DdsCounts {
        self.adapter.counts()
    }

    /// Ends or blocks the event loop of RustDDS, for tests of what follows.
    #[cfg(feature = "fault-injection")]
    pub fn inject(&self, fault: super::Fault) {
        self.adapter.inject(fault);
    }
}

#[async_trait]
impl Broker for DdsBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Dds
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.adapter.status()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        Ok(Arc::new(self.adapter.publisher(names::topic(channel), options)?))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.adapter.subscribe(names::topic(channel), options).await
    }

    fn worker_side(&self) -> Option<Arc<dyn WorkerSide>> {
        Some(Arc::clone(&self.worker) as Arc<dyn WorkerSide>)
    }

    async fn close(&self) {
        self.adapter.close().await;
    }
}
