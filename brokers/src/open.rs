//! From the node file to a broker.

use std::sync::Arc;

use blaze_domain::node_file::{CacheSection, Fault, LayerBroker, NodeBroker, NodeFile};
use blaze_runtime::config::{Schema, schema};
use blaze_runtime::logs::check_level;

use crate::dds::DdsError;
use crate::dds::layer::DdsBroker;
use crate::port::{Broker, Role};
use crate::redis::{RedisBroker, RedisKeys};

/// Why a broker of the node file cannot be used at all. A server that is merely away is no error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// A file that the section names cannot be read or holds no such thing, or a value that the
    /// client library refuses.
    #[error("{key}: {reason}")]
    Setting {
        /// Key below `brokers.node` or `brokers.layer`, such as `redis.password_file`.
        key: String,
        /// What is wrong with it.
        reason: String,
    },
    /// This program was built without that adapter.
    #[error("this program was built without {feature}: build it with `--features {feature}`")]
    NotBuilt {
        /// The cargo feature.
        feature: &'static str,
    },
    /// It has no server: it lives inside the process that opens it.
    #[error("memory: {{}} lives inside one process; other processes need a server")]
    InProcess,
}

/// The node file as a program with brokers reads it: with what the adapters have against its
/// sections, what the log has against its level, and what `check` has against the rest. Reads the
/// files that the sections name, and connects nowhere.
pub fn node_schema(
    check: impl Fn(&NodeFile) -> Vec<Fault> + Send + Sync + 'static,
) -> Schema<NodeFile> {
    schema(move |tree| {
        let (file, warnings) = NodeFile::read(tree)?;
        let mut faults = check(&file);
        faults.extend(broker_faults(&file));
        let level = check_level(&file.log.level).err();
        faults.extend(level.map(|detail| Fault { path: "log.level".to_owned(), detail }));
        if faults.is_empty() { Ok((file, warnings)) } else { Err(faults) }
    })
}

/// What the adapters have against the sections of the brokers and of the cache.
fn broker_faults(file: &NodeFile) -> impl Iterator<Item = Fault> {
    let node = match &file.brokers.node {
        Some(NodeBroker::Redis(redis)) => fault_of("brokers.node", RedisBroker::check(redis)),
        Some(NodeBroker::Memory) | None => None,
    };
    let cache = match &file.cache {
        Some(CacheSection::Redis(redis)) => fault_of("cache", RedisKeys::check(redis)),
        None => None,
    };
    let layer = file.brokers.layer.as_ref();
    let layer = layer.and_then(|layer| fault_of("brokers.layer", check_layer(layer)));
    node.into_iter().chain(layer).chain(cache)
}

/// What the adapter has against the section of the layer scope, without a look at other files, so
/// that a node file can be checked on another machine.
#[must_use]
pub fn layer_fault(file: &NodeFile) -> Option<Fault> {
    match check_layer(file.brokers.layer.as_ref()?) {
        // The program there may have been built with it.
        Err(OpenError::NotBuilt { .. }) => None,
        checked => fault_of("brokers.layer", checked),
    }
}

fn fault_of(section: &str, checked: Result<(), OpenError>) -> Option<Fault> {
    match checked {
        Err(OpenError::Setting { key, reason }) => {
            Some(Fault { path: format!("{section}.{key}"), detail: reason })
        }
        Err(error @ OpenError::NotBuilt { .. }) => {
            Some(Fault { path: section.to_owned(), detail: error.to_string() })
        }
        Ok(()) | Err(OpenError::InProcess) => None,
    }
}

fn check_layer(section: &LayerBroker) -> Result<(), OpenError> {
    match section {
        LayerBroker::Memory => Ok(()),
        LayerBroker::Dds(dds) => DdsBroker::check(dds).map_err(|error| dds_error(&error)),
        #[cfg(feature = "kafka")]
        LayerBroker::Kafka(kafka) => crate::kafka::KafkaBroker::check(kafka),
        #[cfg(not(feature = "kafka"))]
        LayerBroker::Kafka(_) => Err(OpenError::NotBuilt { feature: "kafka" }),
    }
}

/// Connects to the server of a node scope, in the background.
///
/// # Errors
/// [`OpenError`] where it can never work.
pub fn open_node(section: &NodeBroker, role: &Role) -> Result<Arc<dyn Broker>, OpenError> {
    match section {
        NodeBroker::Memory => Err(OpenError::InProcess),
        NodeBroker::Redis(redis) => Ok(Arc::new(RedisBroker::open(redis, role)?)),
    }
}

/// Connects to the server of a layer scope, or takes part in its DDS domain, in the background.
///
/// # Errors
/// [`OpenError`] where it can never work.
pub fn open_layer(section: &LayerBroker, role: &Role) -> Result<Arc<dyn Broker>, OpenError> {
    match section {
        LayerBroker::Memory => Err(OpenError::InProcess),
        LayerBroker::Dds(dds) => {
            Ok(Arc::new(DdsBroker::open(dds).map_err(|error| dds_error(&error))?))
        }
        #[cfg(feature = "kafka")]
        LayerBroker::Kafka(kafka) => Ok(Arc::new(crate::kafka::KafkaBroker::open(kafka, role)?)),
        #[cfg(not(feature = "kafka"))]
        LayerBroker::Kafka(_) => {
            let _ = role;
            Err(OpenError::NotBuilt { feature: "kafka" })
        }
    }
}

fn dds_error(error: &DdsError) -> OpenError {
    let key = match error {
        DdsError::Domain(_) => "dds.domain",
        DdsError::Address(_) | DdsError::AddressMissing { .. } => "dds.interface",
        DdsError::Create { .. } | DdsError::Panicked(_) | DdsError::Hangs(_) => "dds",
    };
    OpenError::Setting { key: key.to_owned(), reason: error.to_string() }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn faults(tree: &Value) -> Vec<String> {
        let faults = node_schema(|_| Vec::new())(tree).err().unwrap_or_default();
        faults.into_iter().map(|(path, _)| path).collect()
    }

    #[test]
    fn what_cannot_start_is_told_beforehand() {
        let redis = |url: &str| json!({ "redis": { "url": url } });
        let node = |url: &str| json!({ "brokers": { "node": redis(url) } });
        let inter = |listen: &str| json!({ "brokers": { "inter": { "dds": { "domain": 1, "listen": listen } } } });
        let secret = json!({ "url": "redis://h", "password_file": "/nowhere/password" });
        for (tree, path) in [
            (node("redis://h:99999"), "brokers.node.redis.url"),
            (node("redis://h:0"), "brokers.node.redis.url"),
            (node("redis://h/first"), "brokers.node.redis.url"),
            // Channels are the same ones in all databases.
            (node("redis://h/1"), "brokers.node.redis.url"),
            (
                json!({ "brokers": { "node": { "redis": secret.clone() } } }),
                "brokers.node.redis.password_file",
            ),
            (json!({ "cache": { "redis": secret } }), "cache.redis.password_file"),
            (json!({ "cache": redis("redis://h/first") }), "cache.redis.url"),
            (inter("0.0.0.0"), "brokers.inter.dds.listen"),
            (inter("239.1.1.1"), "brokers.inter.dds.listen"),
            (json!({ "log": { "level": "a=loud" } }), "log.level"),
        ] {
            assert_eq!(faults(&tree), [path], "{tree}");
        }
        #[cfg(feature = "kafka")]
        for file in ["/nowhere/password", "/dev/null"] {
            let kafka = json!({ "bootstrap": ["h:1"], "password_file": file });
            let tree = json!({ "brokers": { "layer": { "kafka": kafka } } });
            assert_eq!(faults(&tree), ["brokers.layer.kafka.password_file"], "{file}");
        }
        for tree in [
            node("redis://h"),
            node("redis://h/0"),
            json!({ "cache": redis("redis://h/1") }),
            inter("10.0.0.1"),
        ] {
            assert_eq!(faults(&tree), Vec::<String>::new(), "{tree}");
        }
    }
}
