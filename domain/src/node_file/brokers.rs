//! `brokers`: what the node's services, its layer and the other layers are reached over.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use serde_json::Value;

use super::readers::{formed, free_text, parsed, path, text, whole};
use super::walk::{Node, Section};
use super::{Ros2Plugin, SecretText, url};
use crate::qos::word_enum;

/// Highest DDS domain whose ports stay below the range that systems give out by themselves.
pub const MAX_DDS_DOMAIN: u16 = 100;
/// Smallest MTU of the way between flows, in bytes, as IPv6 demands it of every link: a datagram of
/// the link of 1,024 bytes fits one packet together with all headers.
pub const MIN_MTU: u16 = 1280;

/// The brokers of the three scopes; each may be missing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Brokers {
    /// Broker of this node's services.
    pub node: Option<NodeBroker>,
    /// Broker of the layer.
    pub layer: Option<LayerBroker>,
    /// The network of flows.
    pub inter: Option<InterDds>,
    /// The ROS 2 network that is bridged: the entry of `plugins`.
    pub ros2: Option<Ros2Plugin>,
}

impl Brokers {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            node: s.sub("node", |s| {
                s.one_of(&[
                    ("redis", |s| RedisBroker::section(s).map(NodeBroker::Redis)),
                    ("memory", |_| Some(NodeBroker::Memory)),
                ])
            }),
            layer: s.sub("layer", |s| {
                s.one_of(&[
                    ("dds", |s| DdsLayerBroker::section(s).map(LayerBroker::Dds)),
                    ("kafka", |s| KafkaBroker::section(s).map(LayerBroker::Kafka)),
                    ("memory", |_| Some(LayerBroker::Memory)),
                ])
            }),
            inter: s.sub("inter", |s| s.one_of(&[("dds", InterDds::section)])),
            ros2: s.opt("plugins", plugins).flatten(),
        }
    }

    /// DDS domain of the layer broker, if it is one of DDS.
    #[must_use]
    pub fn layer_domain(&self) -> Option<u16> {
        match &self.layer {
            Some(LayerBroker::Dds(dds)) => Some(dds.domain),
            Some(LayerBroker::Kafka(_) | LayerBroker::Memory) | None => None,
        }
    }
}

/// A flow is on one ROS 2 network: a second entry is a fault.
fn plugins(node: &Node<'_>) -> Option<Option<Ros2Plugin>> {
    let entry =
        |node: &Node<'_>| node.section(|s| s.one_of(&[("ros2", Ros2Plugin::section)])).flatten();
    let mut entries = node.list(entry)?.into_iter();
    let first = entries.next();
    for other in entries {
        node.at(other.path).fault::<()>("is a second one; a flow is on one ROS 2 network");
    }
    Some(first)
}

/// Broker of the node scope.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeBroker {
    /// A Redis server.
    Redis(RedisBroker),
    /// Inside the process, for tests and the demo.
    Memory,
}

/// Broker of the layer scope.
#[derive(Debug, Clone, PartialEq)]
pub enum LayerBroker {
    /// A DDS domain on the layer's network.
    Dds(DdsLayerBroker),
    /// A Kafka cluster.
    Kafka(KafkaBroker),
    /// Inside the process, for tests and the demo.
    Memory,
}

/// How a Redis server is reached.
#[derive(Debug, Clone, PartialEq)]
pub struct RedisBroker {
    /// `redis://`, `rediss://` or `redis+unix://`.
    pub url: SecretText,
    /// Stands before every name on this broker.
    pub prefix: String,
    /// User of the access list; the server's default user if absent.
    pub user: Option<String>,
    /// File that holds the password.
    pub password_file: Option<PathBuf>,
    /// Certificates; present means TLS.
    pub tls: Option<RedisTls>,
}

impl RedisBroker {
    pub(super) fn section(s: &mut Section<'_>) -> Option<Self> {
        let url = s.need("url", url(&["redis://", "rediss://", "redis+unix://", "unix://"]));
        let (prefix, user) = (s.or("prefix", prefix, String::new()), s.opt("user", text));
        let (password_file, tls) = (s.opt("password_file", path), s.sub("tls", RedisTls::section));
        Some(Self { url: url?, prefix, user, password_file, tls })
    }
}

/// TLS to Redis.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RedisTls {
    /// Authorities that are trusted instead of the system's.
    pub ca_file: Option<PathBuf>,
    /// Own certificate.
    pub cert_file: Option<PathBuf>,
    /// Key of the own certificate.
    pub key_file: Option<PathBuf>,
}

impl RedisTls {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let tls = Self {
            ca_file: s.opt("ca_file", path),
            cert_file: s.opt("cert_file", path),
            key_file: s.opt("key_file", path),
        };
        if tls.cert_file.is_some() != tls.key_file.is_some() {
            return s.node.fault("cert_file and key_file go together");
        }
        Some(tls)
    }
}

/// DDS as the broker of a layer.
#[derive(Debug, Clone, PartialEq)]
pub struct DdsLayerBroker {
    /// 0 to 100.
    pub domain: u16,
    /// Address of the interface on the layer's network.
    pub interface: Ipv4Addr,
}

impl DdsLayerBroker {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let domain = s.need("domain", whole(0, MAX_DDS_DOMAIN));
        let interface = s.need("interface", address);
        Some(Self { domain: domain?, interface: interface? })
    }
}

/// Kafka as the broker of a layer.
#[derive(Debug, Clone, PartialEq)]
pub struct KafkaBroker {
    /// First brokers to ask, each `HOST:PORT`; at least one.
    pub bootstrap: Vec<String>,
    /// Stands before every name on this broker.
    pub prefix: String,
    /// File that holds the password of an account, `sasl.password`.
    pub password_file: Option<PathBuf>,
    /// Further properties of the client library.
    pub properties: BTreeMap<String, SecretText>,
}

impl KafkaBroker {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let bootstrap = s.need("bootstrap", |node| match node.list(host_port)? {
            list if list.is_empty() && node.value.as_array().is_some_and(Vec::is_empty) => {
                node.fault("needs at least one HOST:PORT")
            }
            list => Some(list),
        });
        let prefix = s.or("prefix", prefix, String::new());
        let password_file = s.opt("password_file", path);
        let properties = s.opt("properties", properties).unwrap_or_default();
        if password_file.is_some() && properties.contains_key("sasl.password") {
            return s.node.fault("password_file and properties.sasl.password exclude each other");
        }
        Some(Self { bootstrap: bootstrap?, prefix, password_file, properties })
    }
}

/// DDS between flows: unicast, known peers.
#[derive(Debug, Clone, PartialEq)]
pub struct InterDds {
    /// 0 to 100, the same for all flows.
    pub domain: u16,
    /// Own address.
    pub listen: Ipv4Addr,
    /// Addresses of other flows; own ones are ignored. One seed on one side is enough.
    pub peers: Vec<Ipv4Addr>,
    /// DDS participants that are probed per peer.
    pub peer_slots: u16,
    /// Largest IP packet of the way, in bytes, at least [`MIN_MTU`].
    pub mtu: u16,
    /// How large messages are cut.
    pub chunking: Chunking,
}

impl InterDds {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let domain = s.need("domain", whole(0, MAX_DDS_DOMAIN));
        let listen = s.need("listen", address);
        let peers = s.list("peers", address);
        let peer_slots = s.or("peer_slots", whole(1, 119), 4);
        let mtu = s.or("mtu", whole(MIN_MTU, u16::MAX), 1500);
        let chunking = s.or("chunking", parsed, Chunking::Auto);
        Some(Self { domain: domain?, listen: listen?, peers, peer_slots, mtu, chunking })
    }
}

word_enum!(
    /// How a large message is cut for the way between flows.
    Chunking {
        /// As the way demands.
        Auto = "auto",
        /// One chunk per IP packet.
        Mtu = "mtu",
        /// Not at all: fragments are left to IP.
        Whole = "whole",
    }
);

pub(super) fn address(node: &Node<'_>) -> Option<Ipv4Addr> {
    let is_of_host = |address: &Ipv4Addr| {
        !(address.is_unspecified() || address.is_multicast() || address.is_broadcast())
    };
    formed("the IPv4 address of one host", |text| text.parse().ok().filter(is_of_host))(node)
}

/// What stands before names: it must leave every name valid on every broker.
fn prefix(node: &Node<'_>) -> Option<String> {
    let text = free_text(node)?;
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | ':' | '/');
    if text.len() > 64 || !text.chars().all(good) {
        return node.fault("has at most 64 of A-Z a-z 0-9 _ - . : /");
    }
    Some(text)
}

fn host_port(node: &Node<'_>) -> Option<String> {
    formed("HOST:PORT", |text| {
        let (host, port) = text.rsplit_once(':')?;
        let good = !host.is_empty()
            && !host.contains(char::is_whitespace)
            && port.parse::<u16>().is_ok_and(|p| p > 0);
        good.then(|| text.to_owned())
    })(node)
}

/// Free keys whose values are scalars; the values may be secrets.
fn properties(node: &Node<'_>) -> Option<BTreeMap<String, SecretText>> {
    let read = |(key, node): (&str, Node<'_>)| {
        let value = match node.value {
            Value::String(text) => text.clone(),
            Value::Bool(value) => value.to_string(),
            Value::Number(value) => value.to_string(),
            Value::Null | Value::Array(_) | Value::Object(_) => {
                return node.expected("text, a number or true or false");
            }
        };
        Some((key.to_owned(), SecretText(value)))
    };
    Some(node.entries().into_iter().filter_map(read).collect())
}
