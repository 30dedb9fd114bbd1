//! A ROS 2 network as a broker: what its nodes publish is read as it is, and what other brokers
//! publish is written as if a node had.
//!
//! ```text
//! discovery, ros_discovery_info ─► Knowledge ─► Network: endpoints with type, QoS and node
//! subscribe(topic, type) ─► DDS reader ─► samples of owned writers ─► frames
//! publisher(topic, type) ─► DDS writer, in the node `/blaze/<layer>_<node>`
//! ```
//!
//! Readers and writers of flows are marked, and never bridged. RustDDS matches by topic name alone,
//! so types are checked here, by writer.

mod dialect;
mod endpoint;
mod graph;
pub mod names;
mod network;

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::{FlowId, TopicName};
use tokio::sync::watch;

use crate::dds::adapter::{Adapter, Topic};
use crate::dds::layer::DdsCounts;
use crate::dds::{DdsError, EndpointId, Relay, RelayConfig, SLOTS, Terms};
use crate::port::{
    BrokerError, BrokerStatus, Publisher, PublisherOptions, SubscribeOptions, Subscription,
};
use dialect::Ros;
use names::{InexpressibleName, RosName, type_to_dds};
use network::Knowledge;

pub use dialect::KEPT_SAMPLES;
pub use endpoint::{RosEndpoint, Vendor};
pub use graph::GidLength;
pub use network::{MAX_ENDPOINTS, Network};

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

/// What a topic is on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RosTopic {
    /// The topic.
    pub topic: TopicName,
    /// Its type, `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Offered by a writer, or asked for by a reader.
    pub deadline: Option<Duration>,
    /// Lease of liveliness, likewise.
    pub lease: Option<Duration>,
}

/// A participant of a ROS 2 network.
pub struct Ros2Network {
    adapter: Adapter,
    knowledge: Arc<Knowledge>,
    namespace: String,
}

impl Ros2Network {
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
        let ros =
            Ros { flow: config.flow, gid: config.gid, knowledge: Arc::clone(&knowledge), relay };
        let adapter = Adapter::open(Arc::new(ros), config.domain, config.interface)?;
        Ok(Self { adapter, knowledge, namespace: config.namespace })
    }

    /// Whether the participant stands, and its changes.
    #[must_use]
    pub fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.adapter.status()
    }

    /// The endpoints of ROS 2 nodes, and their changes.
    #[must_use]
    pub fn network(&self) -> watch::Receiver<Arc<Network>> {
        self.knowledge.subscribe()
    }

    /// What it has counted.
    #[must_use]
    pub fn counts(&self) -> DdsCounts {
        self.adapter.counts()
    }

    /// Which writers this flow takes messages of (`true`), and which others do. Messages of those
    /// that are not named wait for a moment, since discovery may be ahead of the decision.
    pub fn set_owned(&self, owned: HashMap<EndpointId, bool>) {
        self.knowledge.set_owned(owned);
        self.adapter.look_again();
    }

    /// A writer of a topic. Messages of another type than its own, and those that are no
    /// little-endian CDR, are dropped.
    ///
    /// # Errors
    /// [`BrokerError::Name`] where ROS 2 can have no such topic or type.
    pub fn publisher(
        &self,
        topic: &RosTopic,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        Ok(Arc::new(self.adapter.publisher(self.topic(topic)?, options)?))
    }

    /// Reads what the owned writers of a topic publish in its type, as frames.
    ///
    /// # Errors
    /// [`BrokerError::Name`] where ROS 2 can have no such topic or type; others when it cannot be
    /// read now.
    pub async fn subscribe(
        &self,
        topic: &RosTopic,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.adapter.subscribe(self.topic(topic)?, options).await
    }

    /// Delivers what was taken, as far as that goes within a second, then ends.
    pub async fn close(&self) {
        self.adapter.close().await;
    }

    fn topic(&self, topic: &RosTopic) -> Result<Topic, BrokerError> {
        let refused =
            |reason: String| BrokerError::Name { channel: topic.topic.to_string(), reason };
        let name = RosName::of_topic(&topic.topic, &self.namespace)
            .map_err(|error: InexpressibleName| refused(error.to_string()))?;
        let type_name = type_to_dds(&topic.type_name)
            .ok_or_else(|| refused(format!("{:?} is no type of ROS 2", topic.type_name)))?;
        Ok(Topic {
            name: name.to_dds().into(),
            user: topic.topic.as_str().into(),
            type_name: type_name.into(),
            terms: Terms { marked: true, deadline: topic.deadline, lease: topic.lease },
        })
    }
}
