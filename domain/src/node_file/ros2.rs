//! `brokers.plugins[].ros2`: the ROS 2 network that a flow is on.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use super::TopicPattern;
use super::brokers::{MAX_DDS_DOMAIN, address};
use super::readers::{boolean, free_text, parsed, path, whole};
use super::walk::{Node, Section};
use crate::names::TopicName;
use crate::qos::word_enum;

/// Most hosts that are found by unicast.
const MAX_PEERS: usize = 64;

word_enum!(
    /// Release of ROS 2 whose types are expected.
    Ros2Distro {
        /// May 2022.
        Humble = "humble",
        /// May 2023.
        Iron = "iron",
        /// May 2024.
        Jazzy = "jazzy",
        /// May 2025.
        Kilted = "kilted",
        /// May 2026.
        Lyrical = "lyrical",
        /// The development branch.
        Rolling = "rolling",
    }
);

/// A ROS 2 domain that is bridged.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Plugin {
    /// Where it stands in the file.
    pub(super) path: String,
    /// `ROS_DOMAIN_ID`, 0 to 100.
    pub domain: u16,
    /// Address of the one interface; loopback means the ROS 2 nodes of this host.
    pub interface: Ipv4Addr,
    /// Hosts that multicast does not reach.
    pub peers: Vec<Ipv4Addr>,
    /// Release of ROS 2.
    pub distro: Ros2Distro,
    /// Stands before ROS 2 names: `/a/b` is the topic `<namespace>/a/b`.
    pub namespace: Option<TopicName>,
    /// What changes while the flow runs.
    pub live: Ros2Live,
}

/// The keys of a [`Ros2Plugin`] that take effect without a restart.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Live {
    /// ROS 2 names, without the first slash, that may be bridged.
    pub allow: Vec<TopicPattern>,
    /// Names that are not, whatever `allow` says.
    pub deny: Vec<TopicPattern>,
    /// Whether `rosout`, `parameter_events` and the services that every node has are bridged.
    pub system: bool,
    /// Whether topics of other flows show on the network before anybody there asks for them.
    pub announce: bool,
    /// Folders with definitions of types.
    pub interfaces: Vec<PathBuf>,
}

impl Ros2Plugin {
    pub(super) fn section(s: &mut Section<'_>) -> Option<Self> {
        Some(Self {
            path: s.node.path.clone(),
            domain: s.or("domain", whole(0, MAX_DDS_DOMAIN), 0),
            interface: s.or("interface", address, Ipv4Addr::LOCALHOST),
            peers: s.opt("peers", peers).unwrap_or_default(),
            distro: s.or("distro", parsed, Ros2Distro::Jazzy),
            namespace: s.opt("namespace", namespace).flatten(),
            live: Ros2Live {
                allow: s.or("allow", |node| node.list(parsed), vec![TopicPattern::all()]),
                deny: s.list("deny", parsed),
                system: s.or("system", boolean, false),
                announce: s.or("announce", boolean, true),
                interfaces: s.list("interfaces", path),
            },
        })
    }
}

fn peers(node: &Node<'_>) -> Option<Vec<Ipv4Addr>> {
    let peers = node.list(address)?;
    if peers.len() > MAX_PEERS {
        return node.fault(format!("has {} entries, at most {MAX_PEERS} are allowed", peers.len()));
    }
    Some(peers)
}

/// No text at all, or segments of topics.
fn namespace(node: &Node<'_>) -> Option<Option<TopicName>> {
    if free_text(node)?.is_empty() { Some(None) } else { parsed(node).map(Some) }
}
