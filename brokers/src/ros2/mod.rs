//! A ROS 2 network as a broker: what its nodes publish is read as it is, and what other brokers
//! publish is written as if a node had.
//!
//! ```text
//! discovery, ros_discovery_info ─► Knowledge ─► Network: endpoints with type, QoS and node
//! subscribe(topic) ─► a DDS reader per type of owned writers ─► samples ─► frames
//! publisher(topic) ─► a DDS writer per type, in the node `/blaze/<layer>_<node>`
//! ```
//!
//! Readers and writers of flows are marked, and never bridged. RustDDS matches by topic name alone,
//! so types are checked here, by writer. What is read and offered follows the endpoints that come
//! and go.

mod dialect;
mod endpoint;
mod graph;
pub mod names;
mod network;
mod offers;
mod services;
mod shown;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use blaze_domain::names::ChannelName;
use blaze_domain::{FlowId, TopicName};
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::dds::adapter::{Adapter, Topic, TopicPublisher};
use crate::dds::layer::DdsCounts;
use crate::dds::{DdsError, EndpointId, Relay, RelayConfig, SLOTS, TimingQos};
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Publisher, PublisherOptions, SubscribeOptions,
    Subscription, SubscriptionSender,
};
use dialect::Ros;
use names::{Carries, RosName, type_to_dds};
use network::Knowledge;
use offers::{MAX_TYPES, Offer, Offered};
use services::Services;
use shown::AllShown;

pub use dialect::KEPT_SAMPLES;
pub use endpoint::{RosEndpoint, Vendor};
pub use graph::GidLength;
pub use network::{MAX_ENDPOINTS, Network};
pub use shown::Shown;

/// Where a flow meets ROS 2.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ros2Config {
    /// The flow, whose node is `/blaze/<layer>_<node>`.
    pub flow: FlowId,
    /// `ROS_DOMAIN_ID`.
    pub domain: u16,
    /// Address of the one interface; loopback: the ROS 2 nodes of this host.
    pub interface: Ipv4Addr,
    /// Stands before ROS 2 names in topics; may be empty.
    pub namespace: String,
    /// Hosts that multicast does not reach.
    pub peers: Vec<Ipv4Addr>,
    /// Length of gids in the graph.
    pub gid: GidLength,
}

/// Participants of one peer that are announced to, as other implementations do.
const PEER_SLOTS: u16 = 32;
/// Time between two announcements to the same participant.
const ANNOUNCE: Duration = Duration::from_secs(2);
/// Topics that are read or written at once, each.
const MAX_TOPICS: usize = 4096;
/// Topics that show though nobody has asked for them.
pub const MAX_SHOWN: usize = 1000;

/// A participant of a ROS 2 network.
pub struct Ros2Broker {
    inner: Arc<Inner>,
}

/// What the broker shares with its publishers, and with the thread that watches endpoints.
struct Inner {
    adapter: Adapter,
    knowledge: Arc<Knowledge>,
    services: Arc<Services>,
    namespace: String,
    offers: Mutex<BTreeMap<RosName, Vec<Weak<Offer>>>>,
    reads: Mutex<Vec<Read>>,
    shown: Mutex<AllShown>,
}

/// A topic that the flow reads.
struct Read {
    topic: TopicName,
    name: RosName,
    sender: SubscriptionSender,
    options: SubscribeOptions,
    /// DDS types that it is read in.
    types: BTreeSet<String>,
    /// It has more types than are read.
    has_too_many: bool,
}

impl Ros2Broker {
    /// Starts in the background: the status tells how far it is. An interface that is missing is no
    /// error: it is looked for each second.
    ///
    /// # Errors
    /// [`DdsError`] where it can never work, or there is no thread for it.
    pub fn open(config: Ros2Config) -> Result<Self, DdsError> {
        crate::dds::check(config.domain, IpAddr::V4(config.interface))?;
        let knowledge = Arc::new(Knowledge::new());
        let relay = Relay::start(RelayConfig {
            domain: config.domain,
            address: config.interface,
            peers: config.peers.iter().map(Ipv4Addr::to_string).collect(),
            slots: PEER_SLOTS,
            own_slots: SLOTS,
            holds_multicast: false,
            repeat: ANNOUNCE,
        })?;
        let services = Arc::<Services>::default();
        let user = Arc::<OnceLock<Weak<Inner>>>::default();
        let ros = Ros {
            flow: config.flow,
            interface: config.interface,
            gid: config.gid,
            knowledge: Arc::clone(&knowledge),
            services: Arc::clone(&services),
            relay,
            user: Arc::clone(&user),
        };
        let adapter = Adapter::open(Arc::new(ros), config.domain, config.interface)?;
        let inner = Arc::new(Inner {
            adapter,
            knowledge,
            services,
            namespace: config.namespace,
            offers: Mutex::default(),
            reads: Mutex::default(),
            shown: Mutex::default(),
        });
        let _ = user.set(Arc::downgrade(&inner));
        Ok(Self { inner })
    }

    /// The endpoints of ROS 2 nodes, and their changes.
    #[must_use]
    pub fn network(&self) -> watch::Receiver<Arc<Network>> {
        self.inner.knowledge.subscribe()
    }

    /// Requests to services that wait for their replies, and those that were given up because
    /// there were too many.
    #[must_use]
    pub fn requests(&self) -> (usize, u64) {
        self.inner.services.lock().counts()
    }

    /// What it has counted.
    #[must_use]
    pub fn counts(&self) -> DdsCounts {
        self.inner.adapter.counts()
    }

    /// Which writers this flow takes messages of (`true`), and which others do. Messages of those
    /// that are not named wait for a moment, since discovery may be ahead of the decision.
    pub fn set_owned(&self, owned: HashMap<EndpointId, bool>) {
        self.inner.knowledge.set_owned(owned);
        self.inner.adapter.look_again();
    }

    /// Lets topics and services show on the network before anybody there asks for them, or no
    /// longer. Those with names that ROS 2 cannot have are left out. Returns for how many there is no
    /// room.
    pub fn show(&self, topics: impl IntoIterator<Item = (TopicName, Option<Shown>)>) -> usize {
        let inner = &self.inner;
        let mut refused = 0;
        for (topic, wanted) in topics {
            if let Ok(name) = RosName::of_topic(&topic, &inner.namespace) {
                let has_room = inner.shown.lock().set(topic, name.clone(), wanted);
                refused += usize::from(!has_room);
                inner.follow_shown(&name);
            }
        }
        refused
    }
}

#[async_trait]
impl Broker for Ros2Broker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Ros2
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.inner.adapter.status()
    }

    /// Writes a topic. Messages say their type in `encoding`; others are dropped, and so are those in
    /// big-endian CDR or XCDR2. Drops count as `broker_error`.
    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        let (topic, name) = self.inner.name(channel)?;
        let mut offers = self.inner.offers.lock();
        if offers.len() >= MAX_TOPICS && !offers.contains_key(&name) {
            return Err(BrokerError::TooManyChannels(MAX_TOPICS));
        }
        let offer = Arc::new(Offer::new(topic, name, options, Arc::downgrade(&self.inner)));
        offers.entry(offer.name.clone()).or_default().push(Arc::downgrade(&offer));
        drop(offers);
        offer.follow(&self.inner);
        self.inner.follow_shown(&offer.name);
        Ok(offer)
    }

    /// Reads what the owned writers of a topic publish, as frames; also of writers that come later.
    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.inner.adapter.check_up()?;
        let (topic, name) = self.inner.name(channel)?;
        let (sender, subscription) = crate::port::subscription(options);
        let mut reads = self.inner.reads.lock();
        if reads.len() >= MAX_TOPICS {
            return Err(BrokerError::TooManyChannels(MAX_TOPICS));
        }
        let mut read =
            Read { topic, name, sender, options, types: BTreeSet::new(), has_too_many: false };
        read.follow(&self.inner);
        reads.push(read);
        self.inner.note_reads(&reads);
        Ok(subscription)
    }

    async fn close(&self) {
        self.inner.adapter.close().await;
        self.inner.end_reads();
    }
}

impl Inner {
    /// Readers and writers of these names follow the endpoints of others.
    fn follow(&self, names: &BTreeSet<RosName>) {
        for name in names {
            self.offers_of(name).iter().for_each(|offer| offer.follow(self));
            self.follow_shown(name);
        }
        let mut reads = self.reads.lock();
        reads.iter_mut().filter(|read| names.contains(&read.name)).for_each(|it| it.follow(self));
    }

    /// What shows of a topic follows the writers that are used.
    fn follow_shown(&self, name: &RosName) {
        let offers = self.offers_of(name);
        self.shown.lock().follow(self, name, offers.iter().map(Arc::as_ref));
    }

    /// One of the offers of a topic has gone.
    fn forget_offer(&self, name: &RosName) {
        let mut offers = self.offers.lock();
        if let Some(of_name) = offers.get_mut(name) {
            of_name.retain(|offer| offer.strong_count() > 0);
            if of_name.is_empty() {
                offers.remove(name);
            }
        }
        drop(offers);
        self.follow_shown(name);
    }

    fn name(&self, channel: &ChannelName) -> Result<(TopicName, RosName), BrokerError> {
        let refused = |reason: String| BrokerError::Name { channel: channel.to_string(), reason };
        let topic: TopicName =
            channel.as_str().parse().map_err(|error| refused(format!("it {error}")))?;
        let name = RosName::of_topic(&topic, &self.namespace)
            .map_err(|error| refused(error.to_string()))?;
        Ok((topic, name))
    }

    /// The readers of a topic and type.
    fn readers(&self, name: &RosName, type_name: &str) -> Vec<Arc<RosEndpoint>> {
        let mut readers = self.knowledge.endpoints(name, false);
        readers.retain(|reader| reader.type_name.as_deref() == Some(type_name));
        readers
    }

    /// What a writer is to offer, so that all readers of a topic and type are served.
    fn offered(&self, name: &RosName, type_name: &str, published: PublisherOptions) -> Offered {
        Offered::to(published, self.readers(name, type_name).iter().map(Arc::as_ref))
    }

    /// A DDS writer; `None` where ROS 2 can have no such type, or the broker is closed.
    fn writer(
        &self,
        name: &RosName,
        topic: &TopicName,
        type_name: &str,
        offered: Offered,
        large: bool,
    ) -> Option<TopicPublisher> {
        let topic = dds_topic(name, topic, &type_to_dds(type_name)?, offered.timing);
        let Offered { depth, reliable, .. } = offered;
        self.adapter.publisher(topic, PublisherOptions { depth, reliable, large }).ok()
    }

    /// One that is there to be seen, until others write.
    fn idle_writer(
        &self,
        name: &RosName,
        topic: &TopicName,
        type_name: &str,
        offered: Offered,
    ) -> Option<TopicPublisher> {
        if offered.depth == 0 {
            return self.writer(name, topic, type_name, offered, false);
        }
        let topic = dds_topic(name, topic, &type_to_dds(type_name)?, offered.timing);
        Some(self.adapter.keeping(topic, offered.depth))
    }

    /// A reader of requests that is there to be seen, until others read.
    fn idle_reader(
        &self,
        name: &RosName,
        topic: &TopicName,
        type_name: &str,
    ) -> Option<Subscription> {
        let topic = dds_topic(name, topic, &type_to_dds(type_name)?, TimingQos::MARKED);
        let options = SubscribeOptions { max_messages: 1, ..SubscribeOptions::default() };
        let (sender, idle) = crate::port::subscription(options);
        self.adapter.read(topic, sender, options).ok()?;
        Some(idle)
    }

    /// Requests that wait in idle readers are read as soon as somebody reads them.
    fn note_reads(&self, reads: &[Read]) {
        let requests = reads.iter().filter(|read| read.name.carries == Carries::Requests);
        let is_changed = self.services.lock().set_read(requests.map(|it| it.name.to_dds()));
        if is_changed {
            self.adapter.look_again();
        }
    }

    /// What takes time has its turn.
    fn tick(&self, now: Instant) {
        let offers: Vec<Arc<Offer>> =
            self.offers.lock().values().flatten().filter_map(Weak::upgrade).collect();
        offers.iter().for_each(|offer| offer.tick(self, now));
        let mut reads = self.reads.lock();
        let before = reads.len();
        reads.retain(|read| !read.sender.is_closed());
        if reads.len() != before {
            self.note_reads(&reads);
        }
    }

    /// Ends all subscriptions, also those that have no writers.
    fn end_reads(&self) {
        self.reads.lock().drain(..).for_each(|read| read.sender.close());
    }

    fn offers_of(&self, name: &RosName) -> Vec<Arc<Offer>> {
        self.offers.lock().get(name).into_iter().flatten().filter_map(Weak::upgrade).collect()
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.end_reads();
    }
}

impl Read {
    /// Makes readers for types that writers have now, and ends those of types that none has.
    fn follow(&mut self, inner: &Inner) {
        let (now, writers) = (Instant::now(), inner.knowledge.endpoints(&self.name, true));
        let is_used = |dds_type: &String| {
            writers.iter().any(|writer| writer.dds_type == *dds_type)
                || inner.knowledge.is_written(now, &self.name, dds_type)
        };
        for unused in self.types.extract_if(.., |dds_type| !is_used(dds_type)) {
            let topic = dds_topic(&self.name, &self.topic, &unused, TimingQos::MARKED);
            inner.adapter.stop_reading(&topic, &self.sender);
        }
        for writer in writers.iter().filter(|writer| writer.is_readable()) {
            if self.types.contains(&writer.dds_type) {
                continue;
            }
            if self.types.len() >= MAX_TYPES {
                if !std::mem::replace(&mut self.has_too_many, true) {
                    tracing::warn!(topic = %self.topic, limit = MAX_TYPES, "too many types");
                }
                return;
            }
            let topic = dds_topic(&self.name, &self.topic, &writer.dds_type, TimingQos::MARKED);
            match inner.adapter.read(topic, self.sender.clone(), self.options) {
                Ok(()) => _ = self.types.insert(writer.dds_type.clone()),
                Err(error) => tracing::warn!(topic = %self.topic, %error, "not read"),
            }
        }
    }
}

fn dds_topic(name: &RosName, topic: &TopicName, dds_type: &str, timing: TimingQos) -> Topic {
    Topic {
        name: name.to_dds().into(),
        user: topic.as_str().into(),
        type_name: dds_type.into(),
        timing,
    }
}
