//! From the node file to what the monitor does.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use blaze_domain::FlowId;
use blaze_domain::node_file::{Fault, MonitorSection, NodeBroker, NodeFile, Observe};
use blaze_runtime::main_service::MainService;

/// What a monitor takes over while it runs.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveSettings {
    /// Section `monitor`.
    pub section: MonitorSection,
    /// Admin ports of the flows here, `HOST:PORT`.
    pub flows: Vec<String>,
    /// Admin port of the worker here.
    pub worker: String,
    /// Where it reports; `None`: nowhere.
    pub main: Option<MainService>,
    /// Programs that belong to this node.
    pub expected: Expected,
}

impl LiveSettings {
    /// What a node file says.
    #[must_use]
    pub fn of(file: &NodeFile) -> Self {
        let section = file.monitor.clone();
        let flows = match section.flows.is_empty() {
            true => vec![reached(file.admin.flow).to_string()],
            false => section.flows.clone(),
        };
        let main = file.config.as_ref().filter(|_| section.report).map(|config| MainService {
            server: config.server.reveal().to_owned(),
            ca_file: config.ca_file.clone(),
            token_file: config.token_file.clone(),
            certificate: config.cert_file.clone().zip(config.key_file.clone()),
        });
        let worker = reached(file.admin.worker).to_string();
        Self { section, flows, worker, main, expected: Expected::of(file) }
    }
}

impl LiveSettings {
    /// Whether a rule subscribes to topics.
    #[must_use]
    pub fn subscribes(&self) -> bool {
        self.section.latency.iter().any(|rule| rule.observe == Observe::Subscribe)
    }
}

/// What of a node file must be there.
///
/// # Errors
/// Everything that the monitor needs and the file does not have.
pub fn identity(file: &NodeFile) -> Result<FlowId, Vec<Fault>> {
    match (&file.layer, &file.node) {
        (Some(layer), Some(node)) => Ok(FlowId::new(layer.name.clone(), node.name.clone())),
        (layer, node) => {
            let missing = [("layer", layer.is_none()), ("node", node.is_none())];
            let faults = missing.into_iter().filter(|(_, is_missing)| *is_missing);
            Err(faults
                .map(|(path, _)| Fault {
                    path: path.to_owned(),
                    detail: "is required by blaze-monitor".to_owned(),
                })
                .collect())
        }
    }
}

/// Programs that belong to this node by its file: without them it has a problem, also when they
/// never ran.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    /// BlazeFlow.
    pub flow: bool,
    /// BlazeConfig's worker.
    pub worker: bool,
}

impl Expected {
    /// A node with a broker of its own, as a robot has, has both; in a layer that shares a broker
    /// they may be on other nodes.
    #[must_use]
    pub fn of(file: &NodeFile) -> Self {
        let is_alone = matches!(&file.brokers.node, Some(NodeBroker::Redis(_)));
        Self {
            flow: is_alone || file.brokers.inter.is_some() || !file.monitor.flows.is_empty(),
            worker: is_alone && file.config.is_some(),
        }
    }
}

/// Where a program of this machine is asked that listens on `address`.
fn reached(address: SocketAddr) -> SocketAddr {
    let loopback = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip => ip,
    };
    SocketAddr::new(loopback, address.port())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn file(tree: &Value) -> NodeFile {
        NodeFile::read(tree).unwrap().0
    }

    #[test]
    fn programs_that_listen_on_all_addresses_are_asked_on_loopback() {
        let live = LiveSettings::of(&file(&json!({
            "admin": {"flow": "0.0.0.0:9101", "worker": "[::]:9102"},
            "config": {"server": "https://main:50051", "token_file": "/t"},
        })));
        assert_eq!(
            (live.flows[0].as_str(), live.worker.as_str()),
            ("127.0.0.1:9101", "[::1]:9102")
        );
        assert_eq!(live.main.unwrap().server, "https://main:50051");
        let silent =
            json!({"monitor": {"report": false}, "config": {"server": "http://127.0.0.1:1"}});
        assert_eq!(LiveSettings::of(&file(&silent)).main, None);
    }

    #[test]
    fn a_monitor_needs_a_layer_and_a_node() {
        let faults = identity(&NodeFile::default()).unwrap_err();
        let paths: Vec<&str> = faults.iter().map(|fault| fault.path.as_str()).collect();
        assert_eq!(paths, ["layer", "node"]);
    }
}
