//! From the node file to a broker.

use std::sync::Arc;

use blaze_domain::node_file::{Fault, LayerBroker, NodeBroker, NodeFile};
use blaze_runtime::config::{Schema, schema};
use blaze_runtime::logs::check_level;

use crate::dds::DdsError;
use crate::dds::layer::DdsBroker;
use crate::port::{Broker, Role};

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

/// The node file as a program with brokers reads it: with what the adapter has against the section
/// of the layer scope, what the log has against its level, and what `check` has against the rest.
/// Connects nowhere and reads no other file, so that a node file can be checked on another machine.
pub fn node_schema(
    check: impl Fn(&NodeFile) -> Vec<Fault> + Send + Sync + 'static,
) -> Schema<NodeFile> {
    schema(move |tree| {
        let (file, warnings) = NodeFile::read(tree)?;
        let mut faults = check(&file);
        faults.extend(layer_fault(&file));
        let level = check_level(&file.log.level).err();
        faults.extend(level.map(|detail| Fault { path: "log.level".to_owned(), detail }));
        if faults.is_empty() { Ok((file, warnings)) } else { Err(faults) }
    })
}

/// What the adapter has against the section of the layer scope. One that was not built in, or that
/// lives inside one process, is told at the start.
#[must_use]
pub fn layer_fault(file: &NodeFile) -> Option<Fault> {
    match check_layer(file.brokers.layer.as_ref()?) {
        Err(OpenError::Setting { key, reason }) => {
            Some(Fault { path: format!("brokers.layer.{key}"), detail: reason })
        }
        Ok(()) | Err(OpenError::NotBuilt { .. } | OpenError::InProcess) => None,
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
        NodeBroker::Redis(redis) => Ok(Arc::new(crate::redis::RedisBroker::open(redis, role)?)),
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
