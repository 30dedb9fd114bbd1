//! What one flow needs to know of its node file.

use std::net::{Ipv4Addr, SocketAddr};

use blaze_domain::node_file::{
    AccessRules, AutoBool, BandwidthSection, Chunking, FlowSection, NodeFile, Ros2Live, Ros2Plugin,
};
use blaze_domain::{FlowId, LayerKind};

use crate::lane::compress_stage::CompressionRules;
use crate::link::dds::Wire;
use crate::plan::PlanRules;

/// The inter scope of a flow.
#[derive(Debug, Clone, PartialEq)]
pub struct InterSettings {
    /// DDS domain.
    pub domain: u16,
    /// Address of the one interface that is used.
    pub listen: Ipv4Addr,
    /// Other hosts; one seed on one side is enough.
    pub peers: Vec<Ipv4Addr>,
    /// DDS participants that are probed per peer.
    pub peer_slots: u16,
    /// Largest IP packet on the way, in bytes.
    pub mtu: u16,
    /// How large datagrams are made.
    pub chunking: Chunking,
}

/// What may change while the flow runs.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveSettings {
    /// What may be sent on the inter scope.
    pub bandwidth: BandwidthSection,
    /// How payloads are compressed for the inter scope.
    pub compression: CompressionRules,
    /// Threads for compression; 0: cores of the control group.
    pub pool_threads: u16,
    /// Rules for topics.
    pub rules: PlanRules,
    /// Who may advertise and request what.
    pub access: AccessRules,
    /// What of the ROS 2 network is bridged.
    pub ros2: Option<Ros2Live>,
}

impl From<&FlowSection> for LiveSettings {
    fn from(flow: &FlowSection) -> Self {
        Self {
            bandwidth: flow.bandwidth.clone(),
            compression: CompressionRules { base: flow.compression, topics: flow.topics.clone() },
            pool_threads: flow.pool_threads,
            rules: PlanRules { topics: flow.topics.clone() },
            access: flow.access.clone(),
            ros2: None,
        }
    }
}

impl From<&NodeFile> for LiveSettings {
    fn from(file: &NodeFile) -> Self {
        let ros2 = file.brokers.ros2.as_ref().map(|plugin| plugin.live.clone());
        Self { ros2, ..Self::from(&file.flow) }
    }
}

/// What one flow needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowSettings {
    /// Layer and node.
    pub me: FlowId,
    /// Kind of the layer.
    pub kind: LayerKind,
    /// Address of the admin port; port 0 = any free one.
    pub admin: SocketAddr,
    /// The inter scope, if the node has one.
    pub inter: Option<InterSettings>,
    /// The ROS 2 network, if the node has one.
    pub ros2: Option<Ros2Plugin>,
    /// Whether it is on the inter scope for the flows that share its layer broker.
    pub gateway: AutoBool,
    /// What may change.
    pub live: LiveSettings,
}

/// A node file lacks what a flow needs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the node file has no {0} section")]
pub struct MissingSection(&'static str);

impl TryFrom<&NodeFile> for FlowSettings {
    type Error = MissingSection;

    fn try_from(file: &NodeFile) -> Result<Self, MissingSection> {
        let layer = file.layer.as_ref().ok_or(MissingSection("layer"))?;
        let node = file.node.as_ref().ok_or(MissingSection("node"))?;
        let inter = file.brokers.inter.as_ref().map(|inter| InterSettings {
            domain: inter.domain,
            listen: inter.listen,
            peers: inter.peers.clone(),
            peer_slots: inter.peer_slots,
            mtu: inter.mtu,
            chunking: inter.chunking,
        });
        Ok(Self {
            me: FlowId::new(layer.name.clone(), node.name.clone()),
            kind: layer.kind,
            admin: file.admin.flow,
            inter,
            ros2: file.brokers.ros2.clone(),
            gateway: file.flow.gateway,
            live: LiveSettings::from(file),
        })
    }
}

impl InterSettings {
    /// What datagrams become on the wire.
    pub(crate) fn wire(&self) -> Wire {
        Wire::new(self.mtu.into(), self.chunking, self.listen.is_loopback())
    }
}
