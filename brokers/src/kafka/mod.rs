//! Kafka as the broker of a layer.
//!
//! ```text
//! publisher ─► outbox ─► Producer (one per kind) ─► server ─► Consumer (small, large) ─► rings of subscriptions
//!                  Directory: metadata, offsets ◄── health thread: answers, topics, positions ──► status
//! ```
//!
//! A channel is a topic; a message is a record whose headers are the message's header, as text
//! (module `record`). Clients that read channels use no consumer group: each reads all partitions
//! at positions of its own. The lease of workers is one (module `group_lease`). Topics are made by
//! the flow of the layer alone (module `flow_side`), and those of configurations by its worker
//! (module `worker_side`); messages that a service publishes before that wait.

mod admin;
mod clock;
mod consumer;
mod context;
mod directory;
mod examine;
#[cfg(test)]
mod fake_broker;
mod flow_side;
mod gate;
mod group_lease;
mod health;
mod identity;
mod inner;
mod keyed;
mod names;
mod producer;
mod read_to_end;
mod receive;
mod record;
mod settings;
mod topic_creator;
mod topics;
mod waker;
mod worker_side;

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::KafkaBroker as Section;
use blaze_runtime::supervisor::TaskPolicy;
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::open::OpenError;
use crate::outbox::{Admission, LanePublisher};
use crate::port::{
    Begin, Broker, BrokerError, BrokerKind, BrokerStatus, FlowSide, Health, Publisher,
    PublisherOptions, Role, StatusCell, SubscribeOptions, Subscription,
};
use crate::worker_side::WorkerSide;
pub use examine::{LARGEST_RECORD, narrow_topics};
pub use group_lease::{GroupLease, GroupLeaseOptions};

use directory::Directory;
use flow_side::{FlowState, KafkaFlowSide};
use inner::{Inner, Shared};
use names::Names;
use producer::{Keying, Target};
use settings::{Lot, Settings};
use topics::Topics;
use waker::ThreadWaker;
use worker_side::KafkaWorkerSide;

/// How long closing waits for what was taken while the server is known not to answer.
const DRAIN: Duration = Duration::from_secs(1);
/// How long while it answers: a leader that is elected, or a busy server, may take more than a
/// second for its acknowledgement.
const DRAIN_ANSWERED: Duration = Duration::from_secs(3);
/// How long closing waits for threads and tasks beyond that.
const END: Duration = Duration::from_secs(3);
/// How often closing looks whether all was taken.
const DRAIN_TURN: Duration = Duration::from_millis(2);

/// A client of a Kafka cluster.
pub struct KafkaBroker {
    inner: Arc<Inner>,
}

impl KafkaBroker {
    /// Whether a section holds together; connects nowhere.
    ///
    /// # Errors
    /// [`OpenError::Setting`] names the key.
    pub fn check(section: &Section) -> Result<(), OpenError> {
        read(section).map(|_| ())
    }

    /// Begins to connect, in the background. Must be called on a Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] for a property that the client library refuses or that may not be set, and for
    /// TLS where it is not built in.
    pub fn open(section: &Section, role: &Role) -> Result<Self, OpenError> {
        let (settings, names) = read(section)?;
        let shared = Shared::new(settings);
        let refused =
            |reason: String| OpenError::Setting { key: "kafka.properties".to_owned(), reason };
        let directory = Directory::new(&shared).map_err(|error| refused(error.to_string()))?;
        let topics = Topics::default();
        let (layer, flow, worker) = match role {
            Role::Service => (String::new(), None, None),
            Role::Worker => (String::new(), None, Some(Arc::new(worker_side::creator(&names)))),
            Role::Flow { flow, .. } => {
                let state = FlowState::new(&names, &topics);
                (flow.layer.to_string(), Some(Arc::new(state)), None)
            }
        };
        let connecting = format!("connecting to {}", section.bootstrap.join(", "));
        let inner = Arc::new(Inner {
            probe: names.reserved(ChannelName::control().as_str()),
            shared,
            names,
            layer,
            directory,
            topics,
            clients: Mutex::default(),
            flow,
            worker,
            admin: Mutex::default(),
            cluster: OnceLock::new(),
            status: StatusCell::new(Health::Connecting, connecting),
            was_up: AtomicBool::new(false),
            logged_absence: AtomicBool::new(false),
            closed: AtomicBool::new(false),
            waker: ThreadWaker::default(),
        });
        let broker = Self { inner };
        broker.start().map_err(refused)?;
        Ok(broker)
    }

    fn start(&self) -> Result<(), String> {
        let inner = &self.inner;
        let watched = Arc::clone(inner);
        let supervisor = &inner.shared.supervisor;
        supervisor
            .spawn_thread("kafka-health", TaskPolicy::MayEnd, move || health::run(&watched))
            .map_err(|error| error.to_string())?;
        // A new producer needs up to a second for its number: what is surely used gets it
        // beforehand.
        let small = |reliable| {
            let lot = Lot { reliable, large: false };
            inner.producer(lot).map_err(|error| error.to_string())
        };
        if inner.worker.is_some() {
            small(false)?;
        }
        let Some(flow) = inner.flow.clone() else { return Ok(()) };
        small(false)?;
        let producer = small(true)?;
        let shared = Arc::clone(&inner.shared);
        supervisor.spawn("kafka-leases", TaskPolicy::MayEnd, async move {
            flow.keyed.run(&producer, &shared).await;
        });
        Ok(())
    }
}

impl Drop for KafkaBroker {
    fn drop(&mut self) {
        self.inner.begin_close();
        self.inner.end();
    }
}

fn read(section: &Section) -> Result<(Settings, Names), OpenError> {
    let settings = Settings::new(section)?;
    let names = Names::new(&section.prefix)
        .map_err(|reason| OpenError::Setting { key: "kafka.prefix".to_owned(), reason })?;
    Ok((settings, names))
}

#[async_trait]
impl Broker for KafkaBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Kafka
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.inner.status.subscribe()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        let inner = &self.inner;
        let name = inner.names.topic(channel)?;
        let producer = inner.producer(Lot { reliable: options.reliable, large: options.large })?;
        let (topic, new) = inner.topics.of(&name, names::stays_open(channel));
        if new {
            inner.waker.wake();
        }
        let keying = if *channel == ChannelName::shared_reply() {
            Keying::AnswerId
        } else {
            Keying::Writer { depth: options.depth }
        };
        let admission =
            TopicAdmission { shared: Arc::clone(&inner.shared), stays_open: topic.stays_open };
        Ok(Arc::new(LanePublisher { lane: producer.lane(Target { topic, keying }), admission }))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.subscribe_from(channel, options, Begin::Now).await
    }

    async fn subscribe_from(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
        begin: Begin,
    ) -> Result<Subscription, BrokerError> {
        let (inner, channel) = (Arc::clone(&self.inner), channel.clone());
        let subscribe =
            tokio::task::spawn_blocking(move || inner.subscribe(&channel, options, &begin));
        subscribe.await.unwrap_or_else(|_| Err(BrokerError::Closed))
    }

    fn flow_side(&self) -> Option<Arc<dyn FlowSide>> {
        let state = Arc::clone(self.inner.flow.as_ref()?);
        Some(Arc::new(KafkaFlowSide { inner: Arc::clone(&self.inner), state }))
    }

    fn worker_side(&self) -> Option<Arc<dyn WorkerSide>> {
        let creator = Arc::clone(self.inner.worker.as_ref()?);
        Some(Arc::new(KafkaWorkerSide { inner: Arc::clone(&self.inner), creator }))
    }

    async fn close(&self) {
        let inner = &self.inner;
        inner.begin_close();
        let answers = inner.shared.gate.is_open();
        let until = Instant::now() + if answers { DRAIN_ANSWERED } else { DRAIN };
        while !inner.is_drained() && Instant::now() < until && !inner.shared.stop.is_cancelled() {
            tokio::time::sleep(DRAIN_TURN).await;
        }
        inner.end();
        let report = inner.shared.supervisor.shutdown(END).await;
        if !report.is_clean() {
            tracing::warn!(?report, "closing Kafka left something behind");
        }
    }
}

/// Whether messages of a topic are taken.
struct TopicAdmission {
    shared: Arc<Shared>,
    stays_open: bool,
}

impl Admission for TopicAdmission {
    fn is_shut(&self) -> bool {
        !self.shared.gate.lets(self.stays_open)
    }

    fn has_headers(&self) -> bool {
        true
    }
}
