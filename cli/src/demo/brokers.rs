//! What the services of the demo talk to: brokers within the process, or real servers.
//!
//! | | node scope | layer scope |
//! |---|---|---|
//! | `--brokers memory` | memory | memory |
//! | `--brokers real` | Redis, a prefix per node | Kafka in fog and cloud, a prefix per run; memory at the edge |

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Role, open_layer, open_node};
use blaze_domain::node_file::{KafkaBroker, LayerBroker as LayerSection, NodeBroker, RedisBroker};
use blaze_domain::{FlowId, Scope};
use blaze_flow::flow::LayerBroker;
use blaze_flow::world::LayerScopeId;

use super::options::{Brokers, DemoNode};
use crate::exit::CliError;

/// Where `scripts/services start` writes the addresses of its servers, from the repository's root.
const ENVIRONMENT_FILE: &str = ".services/env";

/// Brokers of one node: the flow's own clients, and one for its services.
pub(super) struct NodeBrokers {
    pub(super) flow_node: Arc<dyn Broker>,
    pub(super) flow_layer: LayerBroker,
    /// What the layer broker puts before every name.
    pub(super) layer_prefix: String,
    /// The node broker as a node file would have it.
    pub(super) node_section: NodeBroker,
    services_node: Arc<dyn Broker>,
    services_layer: Arc<dyn Broker>,
}

impl NodeBrokers {
    /// What a service of that scope talks to.
    pub(super) fn of_services(&self, scope: Scope) -> &Arc<dyn Broker> {
        match scope {
            Scope::Node => &self.services_node,
            Scope::Layer | Scope::Ros2 | Scope::Inter => &self.services_layer,
        }
    }

    /// Closes what its services used.
    pub(super) async fn close(self) {
        self.services_node.close().await;
        self.services_layer.close().await;
        self.flow_node.close().await;
        self.flow_layer.broker.close().await;
    }
}

/// Gives each node its brokers.
pub(super) struct BrokerSource {
    servers: Option<Servers>,
    layers: BTreeMap<&'static str, (MemoryHub, LayerScopeId)>,
    /// Names of this run begin with it on every server.
    run: String,
}

/// Addresses of real servers.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Servers {
    redis: String,
    kafka_fog: String,
    kafka_cloud: String,
}

impl BrokerSource {
    /// Brokers within the process, or servers whose addresses `.services/env` holds.
    ///
    /// # Errors
    /// [`CliError::Usage`] in a build without Kafka, or where there is no such file: what to run.
    pub(super) fn new(brokers: Brokers) -> Result<Self, CliError> {
        let servers = match brokers {
            Brokers::Memory => None,
            Brokers::Real if !cfg!(feature = "kafka") => {
                return Err(CliError::Usage(
                    "--brokers real: this build has no Kafka. Run `cargo run --release -p blaze -- \
                     demo --brokers real` (it needs a C++ compiler and make)."
                        .to_owned(),
                ));
            }
            Brokers::Real => Some(Servers::find()?),
        };
        Ok(Self {
            servers,
            layers: BTreeMap::new(),
            run: format!("blaze-demo-{}", std::process::id()),
        })
    }

    /// The brokers of a node whose flow has this epoch.
    ///
    /// # Errors
    /// [`CliError::Failed`] when a client of a server cannot be made.
    pub(super) fn of(
        &mut self,
        node: DemoNode,
        flow: &FlowId,
        epoch: u64,
    ) -> Result<NodeBrokers, CliError> {
        let role = Role::Flow { flow: flow.clone(), epoch };
        let fault =
            |error: blaze_brokers::OpenError| CliError::Failed(format!("{}: {error}", node.name()));
        let (node_section, flow_node, services_node): (_, Arc<dyn Broker>, Arc<dyn Broker>) =
            match &self.servers {
                None => {
                    let hub = MemoryHub::new(node.name());
                    (NodeBroker::Memory, Arc::new(hub.broker()), Arc::new(hub.broker()))
                }
                Some(servers) => {
                    let section = NodeBroker::Redis(RedisBroker {
                        url: servers.redis.clone().into(),
                        prefix: format!("{}:{}:", self.run, node.name()),
                        user: None,
                        password_file: None,
                        tls: None,
                    });
                    let (flow, services) =
                        (open_node(&section, &role), open_node(&section, &Role::Service));
                    (section, flow.map_err(fault)?, services.map_err(fault)?)
                }
            };
        let kafka = self.servers.as_ref().and_then(|servers| match node {
            DemoNode::Fog1 => Some(servers.kafka_fog.clone()),
            DemoNode::Cloud1 => Some(servers.kafka_cloud.clone()),
            DemoNode::Robot1 | DemoNode::Edge2 => None,
        });
        let (flow_layer, services_layer, layer_prefix): (LayerBroker, Arc<dyn Broker>, String) =
            match kafka {
                None => {
                    let (hub, id) = self
                        .layers
                        .entry(node.layer())
                        .or_insert_with(|| (MemoryHub::new(node.layer()), LayerScopeId::private()));
                    let broker = Arc::new(hub.broker());
                    (LayerBroker { broker, id: *id }, Arc::new(hub.broker()), String::new())
                }
                Some(bootstrap) => {
                    let prefix = format!("{}-{}.", self.run, node.layer());
                    let id = LayerScopeId::kafka(&prefix);
                    let section = LayerSection::Kafka(KafkaBroker {
                        bootstrap: vec![bootstrap],
                        prefix: prefix.clone(),
                        password_file: None,
                        properties: BTreeMap::new(),
                    });
                    let broker = open_layer(&section, &role).map_err(fault)?;
                    (
                        LayerBroker { broker, id },
                        open_layer(&section, &Role::Service).map_err(fault)?,
                        prefix,
                    )
                }
            };
        Ok(NodeBrokers {
            flow_node,
            flow_layer,
            layer_prefix,
            node_section,
            services_node,
            services_layer,
        })
    }
}

impl Servers {
    fn find() -> Result<Self, CliError> {
        let from = std::env::current_dir().unwrap_or_default();
        let Some((path, text)) = environment_file(&from) else {
            return Err(CliError::Usage(format!(
                "--brokers real: there is no {ENVIRONMENT_FILE} here. Run `./scripts/services \
                 install && ./scripts/services start` in the repository, \
                 or write that file with BLAZE_TEST_REDIS_URL, BLAZE_TEST_KAFKA_FOG and \
                 BLAZE_TEST_KAFKA_CLOUD."
            )));
        };
        Self::read(&text).map_err(|missing| {
            CliError::Usage(format!(
                "--brokers real: {} has no {missing}. Run `./scripts/services start`.",
                path.display()
            ))
        })
    }

    fn read(text: &str) -> Result<Self, &'static str> {
        let lines: HashMap<&str, &str> = text
            .lines()
            .filter_map(|line| {
                line.trim().strip_prefix("export ").unwrap_or(line.trim()).split_once('=')
            })
            .map(|(key, value)| (key.trim(), value.trim().trim_matches(['"', '\''])))
            .collect();
        let find = |key: &'static str| lines.get(key).map(|value| (*value).to_owned()).ok_or(key);
        Ok(Self {
            redis: find("BLAZE_TEST_REDIS_URL")?,
            kafka_fog: find("BLAZE_TEST_KAFKA_FOG")?,
            kafka_cloud: find("BLAZE_TEST_KAFKA_CLOUD")?,
        })
    }
}

/// The nearest `.services/env`, here or above.
fn environment_file(from: &Path) -> Option<(PathBuf, String)> {
    from.ancestors().find_map(|folder| {
        let path = folder.join(ENVIRONMENT_FILE);
        std::fs::read_to_string(&path).ok().map(|text| (path, text))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_whatever_form_the_lines_have() {
        let text = "# servers\nBLAZE_TEST_REDIS_URL=redis://127.0.0.1:1\nexport BLAZE_TEST_KAFKA_FOG=\"127.0.0.1:2\"\nBLAZE_TEST_KAFKA_CLOUD = 127.0.0.1:3\n";
        let servers = Servers::read(text).unwrap();
        assert_eq!(
            (servers.redis.as_str(), servers.kafka_fog.as_str(), servers.kafka_cloud.as_str()),
            ("redis://127.0.0.1:1", "127.0.0.1:2", "127.0.0.1:3")
        );
        assert_eq!(Servers::read("BLAZE_TEST_REDIS_URL=x"), Err("BLAZE_TEST_KAFKA_FOG"));
    }

    #[test]
    fn the_file_is_found_from_folders_below() {
        let root = tempfile::tempdir().unwrap();
        let below = root.path().join("a/b");
        std::fs::create_dir_all(&below).unwrap();
        std::fs::create_dir_all(root.path().join(".services")).unwrap();
        std::fs::write(root.path().join(ENVIRONMENT_FILE), "x=1").unwrap();
        let (path, text) = environment_file(&below).unwrap();
        assert_eq!((path, text.as_str()), (root.path().join(ENVIRONMENT_FILE), "x=1"));
    }
}
