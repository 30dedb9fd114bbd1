//! The node file `blaze.yaml`: one file serves all programs of a node.
//!
//! ```text
//! text ──(blaze_runtime::config)──▶ serde_json::Value ──[NodeFile::read]──▶ NodeFile + warnings
//!                                                                     └──▶ every fault, each with its path
//! ```
//!
//! Reading is strict: unknown keys, wrong types and values out of range are faults, and all of them
//! are reported at once. Each section states its keys, ranges and defaults in one function, one
//! line per key.

mod access;
mod brokers;
mod control_plane;
mod effect;
mod flow;
mod monitor;
mod pattern;
mod plan_file;
mod readers;
mod ros2;
mod services;
#[cfg(test)]
mod tests;
mod walk;

use std::fmt;
use std::path::PathBuf;

use serde_json::Value;

pub use access::{
    AccessRule, AccessRules, OriginPattern, OriginPatternError, OriginRules, TopicAccess,
};
pub use brokers::{
    Brokers, Chunking, DdsLayerBroker, InterDds, KafkaBroker, LayerBroker, MAX_DDS_DOMAIN, MIN_MTU,
    NodeBroker, RedisBroker, RedisTls,
};
pub use control_plane::{
    AuthSection, ControlPlaneSection, EncryptionKey, EncryptionSection, GrpcSection,
    HistorySection, JwksSource, JwtAlgorithm, JwtKey, LimitsSection, ListenSection, StoreSection,
    TlsSection,
};
pub use flow::{
    BandwidthSection, Codec, Compression, CompressionOverride, FlowSection, LARGE_BYTES, LinkLimit,
    SharePolicy, TopicRule, TopicSettings, TopicValues, WireOverhead,
};
pub use monitor::{LatencyRule, MonitorSection, Observe, Stamp, Thresholds};
pub use pattern::{PatternError, TopicPattern};
pub use plan_file::{FlowSource, PlanFile, PlannedClass, PlannedFlow, PlannedLane, PlannedTopic};
pub use ros2::{Ros2Distro, Ros2Live, Ros2Plugin};
pub use services::{
    AdminSection, CacheSection, ConfigSection, DatabaseSection, LogFormat, LogSection,
    MongoSection, WorkerSection,
};

use crate::MAX_PAYLOAD_BYTES;
use crate::identity::FlowId;
use crate::names::{LayerName, NodeName};
use crate::qos::LayerKind;
pub(crate) use readers::words;
use readers::{parsed, path};
use walk::{Node, Report, Section};
pub(crate) use walk::{describe, nearest};

/// Largest payload, as the readers of numbers take it.
const MAX_BYTES: u32 = MAX_PAYLOAD_BYTES as u32;

/// Something in the file that is not allowed.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Fault {
    /// Where, as `flow.topics[0].match`; empty for the file as a whole.
    pub path: String,
    /// What is wrong, in words that follow the path.
    pub detail: String,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path, self.detail)
    }
}

/// Path and detail, as schemas of a configuration have them.
impl From<Fault> for (String, String) {
    fn from(fault: Fault) -> Self {
        (fault.path, fault.detail)
    }
}

/// Something in the file that is allowed and should be known; of the same form as a fault.
pub type Warning = Fault;

/// A value that may hold a password: it never shows in logs.
#[derive(Clone, PartialEq, Eq)]
pub struct SecretText(String);

impl SecretText {
    /// The text itself.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl From<String> for SecretText {
    fn from(text: String) -> Self {
        Self(text)
    }
}

impl fmt::Debug for SecretText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("(hidden)")
    }
}

/// A choice that the program makes itself unless it is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AutoBool {
    /// The program decides.
    Auto,
    /// Yes.
    Yes,
    /// No.
    No,
}

/// The layer that the node belongs to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerSection {
    /// Its name.
    pub name: LayerName,
    /// What kind of cluster it is.
    pub kind: LayerKind,
}

/// The node itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeSection {
    /// Its name, unique in the whole system.
    pub name: NodeName,
}

/// The whole node file. A section that is missing is `None`, or has its defaults where every key
/// has one.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeFile {
    /// `layer`.
    pub layer: Option<LayerSection>,
    /// `node`.
    pub node: Option<NodeSection>,
    /// `brokers`.
    pub brokers: Brokers,
    /// `admin`: where each program answers `/livez`, `/readyz` and `/metrics`.
    pub admin: AdminSection,
    /// `config`: the main service as the worker reaches it.
    pub config: Option<ConfigSection>,
    /// `cache`.
    pub cache: Option<CacheSection>,
    /// `database`.
    pub database: Option<DatabaseSection>,
    /// `flow`.
    pub flow: FlowSection,
    /// `monitor`.
    pub monitor: MonitorSection,
    /// `log`.
    pub log: LogSection,
    /// `state_dir`; `None`: `/var/lib/blaze`, or without rights there the user's state directory.
    pub state_dir: Option<PathBuf>,
    /// `worker`.
    pub worker: WorkerSection,
    /// `control_plane`.
    pub control_plane: ControlPlaneSection,
}

impl Default for NodeFile {
    /// What an empty file says.
    fn default() -> Self {
        walk::from_empty(NodeFile::section)
    }
}

impl NodeFile {
    /// Reads the tree of a node file.
    ///
    /// # Errors
    /// Every fault of the tree, in the order of the schema.
    pub fn read(tree: &Value) -> Result<(Self, Vec<Warning>), Vec<Fault>> {
        let report = Report::default();
        let root = Node::root(tree, &report);
        let file = root.section(Self::section);
        if let Some(file) = &file {
            file.check_domains(&report);
            effect::warn_of_what_is_not_in_effect(tree, &root);
        }
        let (faults, warnings) = (report.faults.take(), report.warnings.take());
        match file {
            Some(file) if faults.is_empty() => Ok((file, warnings)),
            _ => Err(faults),
        }
    }

    fn section(s: &mut Section<'_>) -> Self {
        Self {
            layer: s.sub("layer", layer),
            node: s.sub("node", |s| Some(NodeSection { name: s.need("name", parsed)? })),
            brokers: s.sub_or_empty("brokers", Brokers::section),
            admin: s.sub_or_empty("admin", AdminSection::section),
            config: s.sub("config", ConfigSection::section),
            cache: s.sub("cache", CacheSection::section),
            database: s.sub("database", DatabaseSection::section),
            flow: s.sub_or_empty("flow", FlowSection::section),
            monitor: s.sub_or_empty("monitor", MonitorSection::section),
            log: s.sub_or_empty("log", LogSection::section),
            state_dir: s.opt("state_dir", path),
            worker: s.sub_or_empty("worker", WorkerSection::section),
            control_plane: s.sub_or_empty("control_plane", ControlPlaneSection::section),
        }
    }

    /// What `blaze-flow` needs besides a file without faults: a layer, a node and at least one
    /// broker.
    #[must_use]
    pub fn check_for_flow(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        let mut demand = |present: bool, path: &str, detail: &str| {
            if !present {
                faults.push(Fault { path: path.to_owned(), detail: detail.to_owned() });
            }
        };
        demand(self.layer.is_some(), "layer", "is required by blaze-flow");
        demand(self.node.is_some(), "node", "is required by blaze-flow");
        let brokers = &self.brokers;
        let any = brokers.node.is_some() || brokers.layer.is_some() || brokers.inter.is_some();
        demand(any, "brokers", "blaze-flow needs at least one of node, layer, inter");
        faults
    }

    /// The Redis for values and signs of life: that of `cache`, else that of `brokers.node`.
    #[must_use]
    pub fn cache_redis(&self) -> Option<&RedisBroker> {
        match (&self.cache, &self.brokers.node) {
            (Some(CacheSection::Redis(redis)), _) | (None, Some(NodeBroker::Redis(redis))) => {
                Some(redis)
            }
            (None, Some(NodeBroker::Memory) | None) => None,
        }
    }

    /// The identity of the flow of this node, if layer and node are given.
    #[must_use]
    pub fn flow_id(&self) -> Option<FlowId> {
        let (layer, node) = (self.layer.as_ref()?, self.node.as_ref()?);
        Some(FlowId::new(layer.name.clone(), node.name.clone()))
    }

    /// Two roles in one DDS domain would hear each other: every domain of the file differs.
    fn check_domains(&self, report: &Report) {
        let mut seen: Vec<(u16, String)> = Vec::new();
        let ros2 = self.brokers.ros2.iter();
        let given = [
            self.brokers
                .layer_domain()
                .map(|domain| (domain, "brokers.layer.dds.domain".to_owned())),
            self.brokers
                .inter
                .as_ref()
                .map(|dds| (dds.domain, "brokers.inter.dds.domain".to_owned())),
        ]
        .into_iter()
        .flatten()
        .chain(ros2.map(|plugin| (plugin.domain, plugin.path.clone() + ".domain")));
        for (domain, path) in given {
            if let Some((_, other)) = seen.iter().find(|(used, _)| *used == domain) {
                let detail =
                    format!("{domain} is also {other}; all DDS domains of a node file differ");
                report.faults.borrow_mut().push(Fault { path, detail });
            } else {
                seen.push((domain, path));
            }
        }
    }
}

fn layer(s: &mut Section<'_>) -> Option<LayerSection> {
    let name = s.need("name", parsed);
    let kind = s.need("kind", parsed);
    Some(LayerSection { name: name?, kind: kind? })
}

/// `auto`, `true` or `false`.
fn auto_bool(node: &Node<'_>) -> Option<AutoBool> {
    match node.value {
        Value::String(text) if text == "auto" => Some(AutoBool::Auto),
        Value::Bool(true) => Some(AutoBool::Yes),
        Value::Bool(false) => Some(AutoBool::No),
        _ => node.expected("auto, true or false"),
    }
}

/// A URL that starts with one of the schemes; it is not repeated in faults, for it may hold a
/// password.
fn url(schemes: &'static [&'static str]) -> impl Fn(&Node<'_>) -> Option<SecretText> {
    move |node| {
        let text = readers::text(node)?;
        let rest = schemes.iter().find_map(|scheme| text.strip_prefix(scheme)).unwrap_or_default();
        if rest.is_empty() || rest.contains(char::is_whitespace) {
            return node.fault(format!("is not a URL that starts with {}", schemes.join(" or ")));
        }
        if !has_valid_ports(rest) {
            return node.fault("has a port that is not between 1 and 65535");
        }
        Some(SecretText(text))
    }
}

/// Whether each port that a URL names is between 1 and 65535. `rest`: what follows the scheme.
fn has_valid_ports(rest: &str) -> bool {
    let place = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let hosts = place.rsplit_once('@').map_or(place, |(_, hosts)| hosts);
    hosts.split(',').all(|host| match host.rsplit_once(':') {
        // The colons of an IPv6 address stand in brackets.
        Some((_, port)) if !port.ends_with(']') => port.parse::<u16>().is_ok_and(|port| port > 0),
        _ => true,
    })
}
