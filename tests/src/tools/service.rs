//! A service that lives by its configuration: says on stdout what it gets, acknowledges it, and
//! shows that it lives. Tests kill it like any service.
//!
//! ```text
//! config {"revision":7,"deleted":false,"config":{…}}      for each change
//! ```

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::Role;
use blaze_brokers::redis::RedisBroker;
use blaze_domain::node_file::{NodeBroker, NodeFile, RedisBroker as RedisSection};
use blaze_domain::{InstanceName, LayerName, NodeName, Scope, ServiceName};
use blaze_runtime::logs::{self, LogFormat};
use blaze_sdk::{AckStatus, ConfigManager, ServiceManager, ServiceOptions, ServiceState};
use clap::Parser;
use serde_json::{Value, json};

/// A service that acknowledges its configuration. SIGTERM ends it.
#[derive(Debug, Parser)]
pub(crate) struct Options {
    /// URL of the Redis of its node
    #[arg(long)]
    redis: String,
    #[arg(long)]
    layer: LayerName,
    #[arg(long)]
    node: NodeName,
    #[arg(long)]
    service: ServiceName,
    #[arg(long)]
    instance: InstanceName,
    /// How long a sign of life counts
    #[arg(long, default_value_t = 3_000)]
    watchdog_ms: u64,
    /// A larger `rate_hz` is rejected
    #[arg(long, default_value_t = u64::MAX)]
    reject_above: u64,
    /// It does not acknowledge a larger `rate_hz` than 10 before this file is there
    #[arg(long)]
    acknowledge_when: Option<PathBuf>,
    /// With a larger `rate_hz` it is unhealthy
    #[arg(long, default_value_t = u64::MAX)]
    unhealthy_above: u64,
}

#[tokio::main]
pub(crate) async fn run(options: &Options) -> anyhow::Result<()> {
    let _logs = logs::init("warn", LogFormat::Text)?;
    let section = section(&options.redis)?;
    let broker = Arc::new(RedisBroker::open(&section, &Role::Service)?);
    let service = ServiceManager::start(ServiceOptions {
        node: Some(options.node.clone()),
        instance: options.instance.clone(),
        cache: Some(section),
        watchdog_ttl: Duration::from_millis(options.watchdog_ms),
        ..ServiceOptions::new(options.layer.clone(), options.service.clone(), broker, Scope::Node)
    })
    .await?;
    service.cache().set_state(ServiceState::Ready);
    let (config, cache) = (service.config().clone(), service.cache().clone());
    let (reject, unhealthy) = (options.reject_above, options.unhealthy_above);
    let (acknowledges, when) = (config.clone(), options.acknowledge_when.clone());
    let take = move |revision: u64, new: Option<&Value>| {
        say(revision, new);
        let rate = new.and_then(|new| new["rate_hz"].as_u64()).unwrap_or(0);
        // This is a thread of the pool for callbacks, which may wait.
        while rate > 10 && when.as_ref().is_some_and(|when| !when.exists()) {
            std::thread::sleep(Duration::from_millis(10));
        }
        acknowledge(&acknowledges, rate, reject);
        cache.set_state(match rate > unhealthy {
            true => ServiceState::Unhealthy,
            false => ServiceState::Ready,
        });
    };
    let take = Arc::new(take);
    let takes = Arc::clone(&take);
    let _listener = config.on_change(move |change| takes(change.revision, change.new.as_deref()));
    // What came before anybody listened is no change any more.
    if let (Some(revision), Some(value)) = (config.revision(), config.value()) {
        tokio::task::spawn_blocking(move || take(revision, Some(&value))).await?;
    }
    tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?.recv().await;
    service.shutdown().await;
    Ok(())
}

fn section(url: &str) -> anyhow::Result<RedisSection> {
    let file = json!({ "brokers": { "node": { "redis": { "url": url } } } });
    let read = NodeFile::read(&file).map_err(|faults| anyhow::anyhow!("{faults:?}"))?;
    match read.0.brokers.node {
        Some(NodeBroker::Redis(section)) => Ok(section),
        other => anyhow::bail!("{other:?} is no Redis"),
    }
}

fn say(revision: u64, config: Option<&Value>) {
    let line = json!({ "revision": revision, "deleted": config.is_none(), "config": config });
    println!("config {line}");
}

fn acknowledge(config: &ConfigManager, rate: u64, reject_above: u64) {
    let said = match rate > reject_above {
        true => config.ack(AckStatus::Rejected, &format!("rate_hz: at most {reject_above}")),
        false => config.ack(AckStatus::Applied, ""),
    };
    if let Err(error) = said {
        eprintln!("not acknowledged: {error}");
    }
}
