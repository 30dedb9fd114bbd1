//! What one flow needs to know of its node file.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use blaze_domain::node_file::{AccessRules, AutoBool, Chunking, FlowSection, NodeFile};
use blaze_domain::{FlowId, LayerKind};

use crate::limit::budget_bytes_per_s;
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
    /// `limit_mbps`, in units of 1024² bit/s.
    pub limit_mbps: f64,
    /// Payloads above this many bytes make a topic `bulk`.
    pub large_bytes: u64,
    /// Rules for topics.
    pub rules: PlanRules,
    /// Who may advertise and request what.
    pub access: AccessRules,
}

impl LiveSettings {
    /// The budget in wire bytes per second.
    #[must_use]
    pub fn budget_bytes_per_s(&self) -> f64 {
        budget_bytes_per_s(self.limit_mbps)
    }
}

impl From<&FlowSection> for LiveSettings {
    fn from(flow: &FlowSection) -> Self {
        Self {
            limit_mbps: flow.bandwidth.limit_mbps,
            large_bytes: u64::from(flow.bandwidth.large_bytes),
            rules: PlanRules {
                topics: flow.topics.clone(),
            },
            access: flow.access.clone(),
        }
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
            gateway: file.flow.gateway,
            live: LiveSettings::from(&file.flow),
        })
    }
}

impl InterSettings {
    /// The address as the transport wants it.
    #[must_use]
    pub fn listen_address(&self) -> IpAddr {
        IpAddr::V4(self.listen)
    }
}
