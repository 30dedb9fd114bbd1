//! DDS as the broker of a layer: user topic `a/b` is the DDS topic `bt/a/b`, reserved topics keep
//! their names, and each sample is one `blaze::v1::Frame` (`brokers/idl/blaze_frame.idl`), readable
//! by any DDS program.
//!
//! ```text
//! publisher ─► outbox ─► sender thread ─► Slot (a DDS writer) ─► RustDDS ─► network
//! network ─► RustDDS ─► reading threads (small, large) ─► Channel (one or two DDS readers) ─► readers' rings
//! lifecycle thread: participant, writers, readers; presence of others; builds all anew when RustDDS dies
//! ```
//!
//! There is no server: the broker is up while a participant stands on the interface. A participant
//! that dies without a good-bye would hold the windows of all reliable writers for as long as its
//! lease; `presence` finds it, and `farewell` says good-bye in its name, to the own participant
//! only.

mod channel;
mod deliver;
mod kept;
mod life;
mod make;
mod names;
mod near;
mod presence;
mod probe;
mod seen;
mod send;
mod shared;
mod slot;
mod worker_side;

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::DdsLayerBroker as Section;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::DdsError;
use super::reader::StoppableThread;
use crate::outbox::{Admission, LanePublisher};
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Publisher, PublisherOptions, SubscribeOptions,
    Subscription,
};
use crate::worker_side::WorkerSide;
use send::Target;
use shared::Shared;
use worker_side::DdsWorkerSide;

pub use shared::MAX_QUEUE_BYTES;

/// How long closing delivers what was taken.
const DRAIN: Duration = Duration::from_secs(1);
/// How long readers have to take what they have acknowledged, before its writer goes: RustDDS
/// forgets what was not read of a writer that has gone.
const LINGER: Duration = Duration::from_millis(150);
/// How long a message may wait for RustDDS.
const LONGEST_WAIT: Duration = Duration::from_secs(5);
/// The same of one that must not be lost.
const RELIABLE_WAIT: Duration = Duration::from_secs(120);
/// How long a subscription may take to be made.
const SUBSCRIBE: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(5);

/// What a broker has counted since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DdsCounts {
    /// Samples that were not a sequence of octets.
    pub malformed: u64,
    /// How often RustDDS died and was built anew.
    pub rebuilds: u64,
    /// Participants to whom good-bye was said in their absence.
    pub expelled: u64,
}

/// A participant of the layer's DDS domain.
pub struct DdsBroker {
    shared: Arc<Shared>,
    worker: Arc<DdsWorkerSide>,
    threads: Mutex<Vec<StoppableThread>>,
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
        let shared = Shared::new(section.domain, section.interface);
        let threads = vec![
            life::start(&shared)?,
            send::start(&shared)?,
            channel::start(&shared, false)?,
            channel::start(&shared, true)?,
        ];
        Ok(Self {
            worker: Arc::new(DdsWorkerSide::new(&shared)),
            shared,
            threads: Mutex::new(threads),
        })
    }

    /// What it has counted.
    #[must_use]
    pub fn counts(&self) -> DdsCounts {
        *self.shared.counts.lock()
    }

    /// Ends or blocks the event loop of RustDDS, for tests of what follows.
    #[cfg(feature = "fault-injection")]
    pub fn inject(&self, fault: super::Fault) {
        *self.shared.fault.lock() = Some(fault);
        self.shared.wake_lifecycle();
    }

    fn is_closing(&self) -> bool {
        self.shared.closing.load(Ordering::Acquire)
    }

    fn check_up(&self) -> Result<(), BrokerError> {
        if self.is_closing() {
            return Err(BrokerError::Closed);
        }
        if self.shared.is_up() { Ok(()) } else { Err(self.shared.away()) }
    }
}

#[async_trait]
impl Broker for DdsBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Dds
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.shared.status.subscribe()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        if self.is_closing() {
            return Err(BrokerError::Closed);
        }
        let target = Target::new(&self.shared, names::topic(channel), options);
        let longest_wait =
            if options.reliable || options.depth > 0 { RELIABLE_WAIT } else { LONGEST_WAIT };
        Ok(Arc::new(DdsPublisher {
            lane: self.shared.outbox.lane(target, Some(longest_wait)),
            admission: Arc::clone(&self.shared),
        }))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.check_up()?;
        let (sender, subscription) = crate::port::subscription(options);
        let made = self.shared.channels.add(channel, sender, options)?;
        self.shared.wake_lifecycle();
        match tokio::time::timeout(SUBSCRIBE, made).await {
            Ok(Ok(())) => Ok(subscription),
            Ok(Err(_)) => Err(BrokerError::Closed),
            Err(_) => Err(BrokerError::Away("RustDDS made no reader in time".to_owned())),
        }
    }

    fn worker_side(&self) -> Option<Arc<dyn WorkerSide>> {
        Some(Arc::clone(&self.worker) as Arc<dyn WorkerSide>)
    }

    async fn close(&self) {
        if self.shared.closing.swap(true, Ordering::AcqRel) {
            return;
        }
        let until = Instant::now() + DRAIN;
        let up = || self.shared.is_up();
        while up()
            && Instant::now() < until
            && !(self.shared.is_drained() && self.shared.slots.are_acknowledged())
        {
            tokio::time::sleep(LOOK).await;
        }
        if up() {
            tokio::time::sleep(LINGER).await;
        }
        self.shared.end();
        let threads = std::mem::take(&mut *self.threads.lock());
        // Joins the threads: the good-bye takes a moment.
        let _ = tokio::task::spawn_blocking(move || drop(threads)).await;
    }
}

impl Drop for DdsBroker {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Release);
        self.shared.end();
        for thread in std::mem::take(&mut *self.threads.lock()) {
            drop(thread.unwaited());
        }
    }
}

/// Writes one channel.
type DdsPublisher = LanePublisher<Target, Arc<Shared>>;

impl Admission for Arc<Shared> {
    fn is_shut(&self) -> bool {
        self.is_down()
    }
}
