//! From the node file to what the worker does.

use std::path::{Path, PathBuf};
use std::time::Duration;

use blaze_domain::Scope;
use blaze_domain::node_file::{
    AutoBool, DatabaseSection, Fault, LayerBroker, NodeBroker, NodeFile, RedisBroker,
};
use blaze_runtime::main_service::{MainService, is_this_machine};

use crate::core::Site;
use crate::core::messages::Delivery;

/// Which broker services are on.
#[derive(Debug, Clone, PartialEq)]
pub enum LocalBroker {
    /// Of the node.
    Node(NodeBroker),
    /// Of the layer.
    Layer(LayerBroker),
}

/// What a worker does.
#[derive(Debug, Clone, PartialEq)]
pub struct WorkerSettings {
    /// Whom it serves.
    pub site: Site,
    /// The node that it runs on.
    pub node: blaze_domain::NodeName,
    /// Where services are.
    pub broker: LocalBroker,
    /// Where keys go; `None`: there is no Redis.
    pub keys: Option<RedisBroker>,
    /// The main service; `None`: it serves what it has.
    pub main: Option<MainService>,
    /// The database of its copy.
    pub database: Option<DatabaseSection>,
    /// Where the last-known-good file lies; `None`: below the state directory of the node.
    pub state_dir: Option<PathBuf>,
    /// Key of the copies.
    pub key_file: Option<PathBuf>,
    /// The mounted file.
    pub defaults_file: Option<PathBuf>,
    /// How services get secrets.
    pub delivery: Delivery,
    /// How long it answers alone.
    pub lease: Duration,
}

impl WorkerSettings {
    /// What a node file says.
    ///
    /// # Errors
    /// Everything that the worker needs and the file does not have.
    pub fn of(file: &NodeFile) -> Result<Self, Vec<Fault>> {
        let mut faults = Vec::new();
        let mut missing = |path: &str, detail: &str| {
            faults.push(Fault { path: path.to_owned(), detail: detail.to_owned() });
        };
        let brokers = &file.brokers;
        let broker = match (&brokers.node, &brokers.layer) {
            (Some(node), _) => Some(LocalBroker::Node(node.clone())),
            (None, Some(layer)) => Some(LocalBroker::Layer(layer.clone())),
            (None, None) => {
                missing(
                    "brokers",
                    "blaze-worker needs node or layer: services ask for their configuration there",
                );
                None
            }
        };
        if file.layer.is_none() {
            missing("layer", "is required by blaze-worker");
        }
        if file.node.is_none() {
            missing("node", "is required by blaze-worker");
        }
        let (Some(layer), Some(node), Some(broker)) = (&file.layer, &file.node, broker) else {
            return Err(faults);
        };
        let is_node_scope = matches!(broker, LocalBroker::Node(_));
        let keys = file.cache_redis().cloned();
        Ok(Self {
            site: Site {
                layer: layer.name.clone(),
                node: is_node_scope.then(|| node.name.clone()),
            },
            node: node.name.clone(),
            delivery: delivery(file.worker.deliver_secrets, &broker, keys.as_ref()),
            broker,
            keys,
            main: file.config.as_ref().map(|config| MainService {
                server: config.server.reveal().to_owned(),
                ca_file: config.ca_file.clone(),
                token_file: config.token_file.clone(),
                certificate: config.cert_file.clone().zip(config.key_file.clone()),
            }),
            database: file.database.clone(),
            state_dir: file.worker.state_dir.clone(),
            key_file: file.worker.key_file.clone(),
            defaults_file: file.worker.defaults_file.clone(),
            lease: Duration::from_millis(file.worker.lease_ms.into()),
        })
    }

    /// Scope of the broker that services are on.
    #[must_use]
    pub fn scope(&self) -> Scope {
        match &self.broker {
            LocalBroker::Node(_) => Scope::Node,
            LocalBroker::Layer(_) => Scope::Layer,
        }
    }

    /// Whether the keys are on the broker's own server, so that keys and notices can go together.
    #[must_use]
    pub fn keys_on_broker(&self) -> bool {
        match (&self.broker, &self.keys) {
            (LocalBroker::Node(NodeBroker::Redis(broker)), Some(keys)) => broker == keys,
            (
                LocalBroker::Node(NodeBroker::Redis(_) | NodeBroker::Memory)
                | LocalBroker::Layer(_),
                _,
            ) => false,
        }
    }

    /// Folder of the copies, below the state directory of the node unless the file names one.
    #[must_use]
    pub fn copy_folder(&self, state_directory: &Path) -> PathBuf {
        match &self.state_dir {
            Some(folder) => folder.clone(),
            None => state_directory.join("worker"),
        }
    }
}

/// `auto`: as text where nobody else reads along. What goes to the keys is readable by whoever
/// reads these.
fn delivery(wanted: AutoBool, broker: &LocalBroker, keys: Option<&RedisBroker>) -> Delivery {
    let is_private = match broker {
        LocalBroker::Node(NodeBroker::Memory) | LocalBroker::Layer(LayerBroker::Memory) => true,
        LocalBroker::Node(NodeBroker::Redis(redis)) => reads_nobody_else(redis),
        LocalBroker::Layer(LayerBroker::Dds(_) | LayerBroker::Kafka(_)) => false,
    };
    match wanted {
        AutoBool::Yes => Delivery::Text,
        AutoBool::Auto if is_private && keys.is_none_or(reads_nobody_else) => Delivery::Text,
        AutoBool::Auto | AutoBool::No => Delivery::Redacted,
    }
}

/// Over TLS, a Unix socket or loopback.
fn reads_nobody_else(redis: &RedisBroker) -> bool {
    let url = redis.url.reveal();
    if redis.tls.is_some() || url.starts_with("rediss://") {
        return true;
    }
    match url.strip_prefix("redis://") {
        Some(rest) => is_this_machine(rest),
        None => url.starts_with("redis+unix://") || url.starts_with("unix://"),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn settings(rest: Value) -> Result<WorkerSettings, Vec<Fault>> {
        let mut tree =
            json!({ "layer": { "name": "edge", "kind": "edge" }, "node": { "name": "robot-1" } });
        let Value::Object(rest) = rest else {
            panic!("an object");
        };
        tree.as_object_mut().unwrap().extend(rest);
        WorkerSettings::of(&NodeFile::read(&tree).unwrap().0)
    }

    fn redis(url: &str) -> Value {
        json!({ "node": { "redis": { "url": url } } })
    }

    #[test]
    fn the_broker_of_the_node_comes_before_that_of_the_layer() {
        let both = json!({
            "node": { "redis": { "url": "redis://127.0.0.1" } },
            "layer": { "memory": {} },
        });
        let on_node = settings(json!({ "brokers": both })).unwrap();
        assert_eq!(on_node.site.node.as_ref().unwrap().as_str(), "robot-1");
        assert!(on_node.keys_on_broker());
        let on_layer = settings(json!({ "brokers": { "layer": { "memory": {} } } })).unwrap();
        assert_eq!((on_layer.site.node, on_layer.keys), (None, None));
        let elsewhere = json!({
            "brokers": redis("redis://127.0.0.1"),
            "cache": { "redis": { "url": "redis://10.0.0.1" } },
        });
        assert!(!settings(elsewhere).unwrap().keys_on_broker());
    }

    #[test]
    fn what_is_missing_is_told_at_once() {
        let faults = WorkerSettings::of(&NodeFile::default()).unwrap_err();
        let paths: Vec<_> = faults.iter().map(|fault| fault.path.as_str()).collect();
        assert_eq!(paths, ["brokers", "layer", "node"]);
    }

    #[test]
    fn secrets_go_as_text_only_where_nobody_else_reads_along() {
        for (url, delivery) in [
            ("redis://127.0.0.1:6379", Delivery::Text),
            ("redis://user:p@ss@localhost/0", Delivery::Text),
            ("redis://[::1]:6379", Delivery::Text),
            ("redis+unix:///run/redis.sock", Delivery::Text),
            ("rediss://10.0.0.1", Delivery::Text),
            ("redis://10.0.0.1", Delivery::Redacted),
            ("redis://127.0.0.1.example.org", Delivery::Redacted),
            ("redis://localhost@evil.example.org", Delivery::Redacted),
        ] {
            assert_eq!(
                settings(json!({ "brokers": redis(url) })).unwrap().delivery,
                delivery,
                "{url}"
            );
        }
        let cache = json!({
            "brokers": redis("redis://127.0.0.1"),
            "cache": { "redis": { "url": "redis://10.0.0.1" } },
        });
        assert_eq!(settings(cache).unwrap().delivery, Delivery::Redacted);
        let forced =
            json!({ "brokers": redis("redis://10.0.0.1"), "worker": { "deliver_secrets": true } });
        assert_eq!(settings(forced).unwrap().delivery, Delivery::Text);
        let never = json!({
            "brokers": redis("redis://127.0.0.1"),
            "worker": { "deliver_secrets": false },
        });
        assert_eq!(settings(never).unwrap().delivery, Delivery::Redacted);
    }
}
