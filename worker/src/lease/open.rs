//! From the settings of a worker to the lease of its layer.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use blaze_brokers::redis::RedisKeys;
use blaze_domain::LayerName;
use blaze_domain::node_file::{DatabaseSection, KafkaBroker, LayerBroker, MongoSection};

use super::{Lease, RedisLease};
use crate::settings::{LocalBroker, WorkerSettings};

/// The lease of the worker's layer: in its MongoDB, else in Redis, else on its Kafka; or that of its
/// node, on the Redis of that. `None`: it must be alone.
///
/// # Errors
/// A section that can never work, or that this program was not built for.
pub fn open(
    settings: &WorkerSettings,
    keys: Option<&Arc<RedisKeys>>,
    worker_id: &str,
) -> anyhow::Result<Option<Arc<dyn Lease>>> {
    let layer = &settings.site.layer;
    let broker = match (&settings.broker, keys) {
        (LocalBroker::Node(_), Some(keys)) if settings.keys_on_broker() => {
            return Ok(Some(of_node(settings, keys, worker_id)));
        }
        (LocalBroker::Node(_), _) => return Ok(None),
        (LocalBroker::Layer(broker), _) => broker,
    };
    let lease = match (&settings.database, keys, broker) {
        (Some(DatabaseSection::MongoDb(section)), _, _) => {
            mongodb(section, layer, worker_id).context("database.mongodb")?
        }
        (_, Some(keys), _) => {
            Arc::new(RedisLease::new(Arc::clone(keys), layer, worker_id.to_owned()))
        }
        (_, None, LayerBroker::Kafka(section)) => {
            // As long as it is held, see `keep`: the rest is for the others to hear of it.
            kafka(section, layer, settings.lease * 9 / 10).context("brokers.layer.kafka")?
        }
        (_, None, LayerBroker::Dds(_) | LayerBroker::Memory) => return Ok(None),
    };
    tracing::info!(
        lease = lease.describe(),
        "of the workers of the layer, the one with the lease serves"
    );
    Ok(Some(lease))
}

fn of_node(settings: &WorkerSettings, keys: &Arc<RedisKeys>, worker_id: &str) -> Arc<dyn Lease> {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let worker = format!("{worker_id} on {}, process {}", host.trim(), std::process::id());
    let started = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let started_ms = u64::try_from(started.as_millis()).unwrap_or(0);
    let place = (&settings.site.layer, &settings.node);
    Arc::new(RedisLease::of_node(Arc::clone(keys), place, started_ms, &worker))
}

#[cfg(feature = "mongodb")]
fn mongodb(
    section: &MongoSection,
    layer: &LayerName,
    owner: &str,
) -> anyhow::Result<Arc<dyn Lease>> {
    let lease = super::MongoLease::new(section.clone(), layer.clone(), owner.to_owned());
    Ok(Arc::new(lease))
}

#[cfg(not(feature = "mongodb"))]
fn mongodb(
    _section: &MongoSection,
    _layer: &LayerName,
    _owner: &str,
) -> anyhow::Result<Arc<dyn Lease>> {
    anyhow::bail!("this program was built without MongoDB (cargo feature `mongodb`)")
}

#[cfg(feature = "kafka")]
fn kafka(
    section: &KafkaBroker,
    layer: &LayerName,
    time: Duration,
) -> anyhow::Result<Arc<dyn Lease>> {
    Ok(Arc::new(super::KafkaLease::open(section, layer, time)?))
}

#[cfg(not(feature = "kafka"))]
fn kafka(
    _section: &KafkaBroker,
    _layer: &LayerName,
    _time: Duration,
) -> anyhow::Result<Arc<dyn Lease>> {
    anyhow::bail!("this program was built without Kafka (cargo feature `kafka`)")
}
