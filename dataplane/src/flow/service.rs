//! The flow as a service of its node: `blaze-flow` has a configuration in BlazeConfig and shows
//! that it lives.
//!
//! ```text
//! worker ─► local broker ─► ProgramConfig ─► over the node file ─► follow_node_file
//! /readyz ─► starting, ready, unhealthy, stopping ─► watchdog
//! ```
//!
//! It waits for nobody: without a worker the node file alone counts.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use blaze_domain::node_file::RedisBroker;
use blaze_domain::{Scope, ServiceName};
use blaze_runtime::config::Verdict;
use blaze_runtime::{Readiness, Supervisor, TaskPolicy};
use blaze_sdk::{
    CacheManager, MetricsEndpoint, ProgramConfig, SdkError, ServiceManager, ServiceOptions,
    ServiceState,
};

use super::RunningFlow;
use super::node_file::{Followed, follow_node_file};

/// The name under which flows have their configuration.
pub const NAME: &str = "blaze-flow";
/// How long a flow that was ready is not, before others hear of it: a broker that comes back is met
/// in steps.
const UNHEALTHY_AFTER: Duration = Duration::from_secs(3);
/// How long the end waits for the sign of life to be taken away.
const LEAVE_WITHIN: Duration = Duration::from_secs(1);

/// A flow as a service. Dropping it ends what it started.
pub struct FlowService {
    manager: ServiceManager,
    program: ProgramConfig,
}

impl FlowService {
    /// Makes the flow a service on its own broker, that of the node if there is one, else that of
    /// the layer. `None`: it has neither. `cache` is where its sign of life goes; without it, or if
    /// it can never work, that is a message.
    ///
    /// # Errors
    /// `BLAZE_INSTANCE` is no name.
    pub async fn start(
        flow: &RunningFlow,
        cache: Option<RedisBroker>,
        supervisor: &Supervisor,
    ) -> Result<Option<Self>, SdkError> {
        let shared = &flow.shared;
        let local = [Scope::Node, Scope::Layer]
            .into_iter()
            .find_map(|scope| Some((scope, shared.brokers.of(scope)?)));
        let Some((scope, broker)) = local else {
            return Ok(None);
        };
        let Ok(name) = NAME.parse::<ServiceName>() else {
            return Ok(None);
        };
        let options = ServiceOptions::new(shared.me.layer.clone(), name, Arc::clone(broker), scope)
            .on_node(shared.me.node.clone());
        let options = ServiceOptions {
            // Nothing of a flow runs as a callback.
            pool_threads: 1,
            epoch: shared.epoch.load(Ordering::Relaxed),
            supervisor: Some(supervisor.clone()),
            cache,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            metrics: MetricsEndpoint::Off,
            ..options
        };
        let manager = started(options).await?;
        let (readiness, signs) = (shared.readiness.clone(), manager.cache().clone());
        let stop = supervisor.shutdown_token();
        supervisor.spawn("signs of life", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = show(&readiness, &signs) => {}
                () = stop.cancelled() => {}
            }
        });
        let program = manager.program_config();
        Ok(Some(Self { manager, program }))
    }

    /// The same, and the flow follows its configuration from then on, as [`follow_node_file`] says.
    ///
    /// # Errors
    /// As [`FlowService::start`].
    pub async fn follow(
        flow: &Arc<RunningFlow>,
        followed: Followed,
        cache: Option<RedisBroker>,
        supervisor: &Supervisor,
        judged: impl FnMut(&Verdict) + Send + 'static,
    ) -> Result<Option<Self>, SdkError> {
        let service = Self::start(flow, cache, supervisor).await?;
        follow_node_file(flow, followed, service.as_ref(), supervisor, judged);
        Ok(service)
    }

    /// What BlazeConfig says.
    #[must_use]
    pub fn program(&self) -> &ProgramConfig {
        &self.program
    }

    /// Takes the sign of life away. Before the flow's brokers are closed.
    pub async fn stop(self) {
        if tokio::time::timeout(LEAVE_WITHIN, self.manager.shutdown()).await.is_err() {
            tracing::debug!("the sign of life is left to vanish by itself");
        }
    }
}

/// Messages flow also where the cache cannot be told of it.
async fn started(options: ServiceOptions) -> Result<ServiceManager, SdkError> {
    match ServiceManager::start(options.clone()).await {
        Err(SdkError::Cache(error)) => {
            tracing::error!(
                %error,
                "cache.redis cannot be used: the sign of life goes as messages on blaze/watchdog",
            );
            ServiceManager::start(ServiceOptions { cache: None, ..options }).await
        }
        started => started,
    }
}

/// Says how the flow is, as `/readyz` does.
async fn show(readiness: &Readiness, signs: &CacheManager) {
    let mut changed = readiness.changed();
    let mut was_ready = false;
    loop {
        let is_ready = *changed.borrow_and_update();
        was_ready |= is_ready;
        let state = if readiness.is_stopping() {
            ServiceState::Stopping
        } else if is_ready {
            ServiceState::Ready
        } else if was_ready {
            let comes_back = changed.wait_for(|is_ready| *is_ready || readiness.is_stopping());
            if tokio::time::timeout(UNHEALTHY_AFTER, comes_back).await.is_ok() {
                continue;
            }
            ServiceState::Unhealthy
        } else {
            ServiceState::Starting
        };
        signs.set_state(state);
        if changed.changed().await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use blaze_brokers::memory::{MemoryBroker, MemoryHub};
    use blaze_brokers::{Broker as _, Content, SubscribeOptions, Subscription};
    use blaze_domain::node_file::NodeFile;
    use blaze_runtime::{CheckStatus, Gate};
    use serde_json::{Value, json};

    use super::*;

    /// The options of a flow's service on a node's broker, one who reads there, and the signs of
    /// life that it gets.
    async fn on_node() -> (ServiceOptions, MemoryBroker, Subscription) {
        let hub = MemoryHub::new("node");
        let (reader, watchdog) = (hub.broker(), "blaze/watchdog".parse().unwrap());
        let beats = reader.subscribe(&watchdog, SubscribeOptions::default()).await.unwrap();
        let (layer, name) = ("edge".parse().unwrap(), NAME.parse().unwrap());
        let options = ServiceOptions::new(layer, name, Arc::new(hub.broker()), Scope::Node);
        (options.on_node("robot-1".parse().unwrap()), reader, beats)
    }

    #[tokio::test]
    async fn a_cache_that_can_never_work_keeps_no_flow_from_being_a_service() {
        let (options, _reader, mut beats) = on_node().await;
        let cache =
            json!({ "redis": { "url": "redis://127.0.0.1:1", "password_file": "not/there" } });
        let (file, _) = NodeFile::read(&json!({ "cache": cache })).unwrap();
        let cache = Some(file.cache_redis().unwrap().clone());
        let options = ServiceOptions { cache, ..options };
        let refused = ServiceManager::start(options.clone()).await;
        assert!(matches!(refused, Err(SdkError::Cache(_))));
        let manager = started(options).await.unwrap();
        manager.cache().set_state(ServiceState::Ready);
        assert_eq!(beats.receive(&mut Vec::new(), 1).await, 1);
        manager.shutdown().await;
    }

    #[tokio::test(start_paused = true)]
    async fn a_flow_is_unhealthy_when_it_is_not_ready_for_a_while_and_not_when_it_ends() {
        let (options, _reader, mut beats) = on_node().await;
        let manager = ServiceManager::start(options).await.unwrap();
        let readiness = Readiness::new();
        readiness.add("inter", Gate::Decides, CheckStatus::Failed, "");
        let steps = async {
            for (status, seconds) in [
                (CheckStatus::Failed, 1),
                (CheckStatus::Ok, 1),
                (CheckStatus::Failed, 1),
                (CheckStatus::Ok, 1),
                (CheckStatus::Failed, 20),
                (CheckStatus::Ok, 1),
            ] {
                readiness.set("inter", status, "");
                tokio::time::sleep(Duration::from_secs(seconds)).await;
            }
            readiness.stop();
            tokio::time::sleep(Duration::from_secs(4)).await;
        };
        tokio::select! {
            () = steps => {}
            () = show(&readiness, manager.cache()) => {}
        }
        let mut batch = Vec::new();
        beats.receive(&mut batch, 1000).await;
        let states = batch.iter().map(|received| match &received.content {
            Content::Bare { payload, .. } => {
                serde_json::from_slice::<Value>(payload).unwrap()["state"].clone()
            }
            other => panic!("{other:?}"),
        });
        let mut states: Vec<Value> = states.collect();
        states.dedup();
        assert_eq!(states, ["starting", "ready", "unhealthy", "ready", "stopping"]);
        manager.shutdown().await;
    }
}
