//! The one object of a service.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, BrokerError, OpenError};
use blaze_domain::control::{Common, MAX_TTL_S};
use blaze_domain::node_file::RedisBroker;
use blaze_domain::{InstanceName, LayerName, NodeName, Origin, Scope, ServiceName};
use blaze_runtime::{ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy};

use crate::broker::LocalBroker;
use crate::cache::{CacheError, CacheManager, ServiceState, Store, WatchdogOptions};
use crate::config::{ConfigManager, ProgramConfig};
use crate::flow::FlowManager;
use crate::monitor::{Endpoint, MonitorManager};
use crate::options::ServiceOptions;
use crate::pool::Pool;

/// How long [`ServiceManager::shutdown`] waits for the flow to take leave.
const LEAVE_WITHIN: Duration = Duration::from_secs(1);
/// How long it waits for tasks and for callbacks that run.
const END_WITHIN: Duration = Duration::from_secs(5);

/// Why the SDK refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SdkError {
    /// The broker refused.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// An option has a value that it may not have.
    #[error("{option} {reason}")]
    Option {
        /// The option.
        option: &'static str,
        /// What is wrong with its value.
        reason: String,
    },
    /// The threads for callbacks could not be started.
    #[error("no threads for callbacks: {0}")]
    Threads(#[source] std::io::Error),
    /// The Redis of the cache can never work.
    #[error("cache: {0}")]
    Cache(#[source] OpenError),
    /// Services that it waits for are not ready.
    #[error(transparent)]
    Wait(CacheError),
    /// The service was shut down.
    #[error("the service was shut down")]
    ShutDown,
}

/// Who a service is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Layer that it runs in.
    pub layer: LayerName,
    /// Node that it runs on.
    pub node: Option<NodeName>,
    /// Its name.
    pub service: ServiceName,
    /// Which of several of that name it is.
    pub instance: InstanceName,
    /// Larger is newer.
    pub epoch: u64,
}

impl Identity {
    /// As it stands in the header of each message.
    #[must_use]
    pub fn origin(&self) -> Origin {
        Origin {
            layer: self.layer.to_string(),
            node: self.node.as_ref().map(NodeName::to_string).unwrap_or_default(),
            service: self.service.to_string(),
            instance: self.instance.to_string(),
            epoch: self.epoch,
        }
    }

    /// Names this service in a control message.
    pub(crate) fn sign(&self, common: Common) -> Common {
        Common {
            service: self.service.clone(),
            instance: self.instance.clone(),
            layer: Some(self.layer.clone()),
            node: self.node.clone(),
            epoch: self.epoch,
            ..common
        }
    }
}

/// What the parts of a service share.
pub(crate) struct Shared {
    pub(crate) identity: Identity,
    pub(crate) broker: Arc<dyn Broker>,
    pub(crate) scope: Scope,
    pub(crate) pool: Pool,
    pub(crate) pool_threads: usize,
    pub(crate) supervisor: Supervisor,
    pub(crate) monitor: MonitorManager,
}

impl Shared {
    pub(crate) fn refuse_when_stopping(&self) -> Result<(), SdkError> {
        if self.supervisor.stopping_token().is_cancelled() {
            return Err(SdkError::ShutDown);
        }
        Ok(())
    }
}

/// A service's door into the system: the local broker and the flow. Dropping it ends all that it
/// started; what it leased then lapses at the flow, whereas [`ServiceManager::shutdown`] withdraws
/// it.
pub struct ServiceManager {
    shared: Arc<Shared>,
    broker: LocalBroker,
    flow: FlowManager,
    config: ConfigManager,
    cache: CacheManager,
}

impl ServiceManager {
    /// Starts the service's threads and tasks. It does not wait for the broker or a flow, but for
    /// the services of `wait_for`, saying meanwhile that it is `starting`.
    ///
    /// # Errors
    /// [`SdkError::Option`], [`SdkError::Threads`], [`SdkError::Cache`], or [`SdkError::Wait`] when
    /// a service that it waits for is not ready in time.
    pub async fn start(options: ServiceOptions) -> Result<Self, SdkError> {
        let ttl_s = u32::try_from(options.lease_ttl.as_secs())
            .ok()
            .filter(|ttl_s| (1..=MAX_TTL_S).contains(ttl_s))
            .ok_or_else(|| SdkError::Option {
                option: "lease_ttl",
                reason: format!("is {:?}, 1 s to {MAX_TTL_S} s are allowed", options.lease_ttl),
            })?;
        options.check_watchdog()?;
        options.check_instance()?;
        let store = store(options.cache.as_ref())?;
        let identity = options.identity();
        let monitor = MonitorManager::new(&identity, &options.version)?;
        let endpoint = Endpoint::bind(options.metrics, &monitor).await?;
        let pool_threads = match options.pool_threads {
            0 => std::thread::available_parallelism().map_or(2, usize::from),
            threads => threads,
        }
        .max(2);
        let name = format!("{}-{}", options.service, options.instance);
        let watchdog = WatchdogOptions {
            version: options.version,
            ttl: options.watchdog_ttl,
            metrics: monitor.address().unwrap_or_default().to_owned(),
            by_clock: options.epoch == 0,
        };
        let supervisor = match &options.supervisor {
            Some(parent) => parent.child(name),
            None => observed(name),
        };
        let pool = Pool::start(pool_threads, &supervisor)
            .inspect_err(|_| supervisor.shutdown_token().cancel())
            .map_err(SdkError::Threads)?;
        let shared = Arc::new(Shared {
            identity,
            broker: options.broker,
            scope: options.scope,
            pool,
            pool_threads,
            supervisor,
            monitor,
        });
        let flow = FlowManager::start(
            shared.identity.clone(),
            Arc::clone(&shared.broker),
            &shared.supervisor,
            ttl_s,
            options.control_timeout,
        );
        let config = ConfigManager::start(
            shared.identity.clone(),
            shared.scope,
            Arc::clone(&shared.broker),
            &shared.supervisor,
            shared.pool.handle(),
        );
        let cache = CacheManager::start(
            shared.identity.clone(),
            Arc::clone(&shared.broker),
            store,
            watchdog,
            config.shown(),
            &shared.supervisor,
        );
        if let Some(endpoint) = endpoint {
            endpoint.serve(shared.broker.status(), cache.state(), &shared.supervisor);
        }
        // From here on an early return ends what was started.
        let service =
            Self { broker: LocalBroker::new(Arc::clone(&shared)), shared, flow, config, cache };
        if !options.wait_for.is_empty() {
            service.cache.set_state(ServiceState::Starting);
            let stopping = service.shared.supervisor.stopping_token();
            let waited = tokio::select! {
                waited = service.cache.wait_for(&options.wait_for, options.wait_timeout) =>
                    waited.map_err(SdkError::Wait),
                () = stopping.cancelled() => Err(SdkError::ShutDown),
            };
            if let Err(error) = waited {
                service.shutdown().await;
                return Err(error);
            }
        }
        Ok(service)
    }

    /// Publish and subscribe.
    #[must_use]
    pub fn broker(&self) -> &LocalBroker {
        &self.broker
    }

    /// Advertise and request.
    #[must_use]
    pub fn flow(&self) -> &FlowManager {
        &self.flow
    }

    /// The service's configuration. The first call begins to ask for it.
    #[must_use]
    pub fn config(&self) -> &ConfigManager {
        self.config.want();
        &self.config
    }

    /// The service's configuration, for a program that has a node file besides. Begins to ask for
    /// it; one is enough.
    #[must_use]
    pub fn program_config(&self) -> ProgramConfig {
        ProgramConfig::start(self.config(), &self.shared.supervisor)
    }

    /// Says that the service lives, waits for others, keeps values.
    #[must_use]
    pub fn cache(&self) -> &CacheManager {
        &self.cache
    }

    /// Metrics of the service, its own and those of the SDK.
    #[must_use]
    pub fn monitor(&self) -> &MonitorManager {
        &self.shared.monitor
    }

    /// Who the service is.
    #[must_use]
    pub fn identity(&self) -> &Identity {
        &self.shared.identity
    }

    /// Withdraws all leases, takes its sign of life away, ends all subscriptions, and waits for
    /// tasks and for callbacks that run: at most some 7 s. The broker stays open.
    pub async fn shutdown(self) {
        let (flow, cache) = (self.flow.clone(), self.cache.clone());
        let steps = ShutdownSteps::new(LEAVE_WITHIN + END_WITHIN).on(
            ShutdownPhase::Drain,
            "leases",
            async move {
                tokio::join!(flow.leave(LEAVE_WITHIN), cache.leave(LEAVE_WITHIN));
            },
        );
        let report = self.shared.supervisor.shutdown_with(steps).await;
        if !report.is_clean() {
            tracing::warn!(
                service = %self.shared.identity.service,
                ?report,
                "the service ends, though tasks or callbacks still run"
            );
        }
    }
}

impl Drop for ServiceManager {
    fn drop(&mut self) {
        self.shared.supervisor.stopping_token().cancel();
        self.shared.supervisor.shutdown_token().cancel();
        // Also where no runtime is left to do it.
        self.shared.pool.stop();
    }
}

/// The Redis of the cache, where there is one.
fn store(section: Option<&RedisBroker>) -> Result<Option<Arc<dyn Store>>, SdkError> {
    let open = |section| RedisKeys::open(section).map_err(SdkError::Cache);
    let keys = section.map(open).transpose()?;
    Ok(keys.map(|keys| Arc::new(keys) as Arc<dyn Store>))
}

/// A supervisor of a service's own. Nobody else looks at it, so its failure is logged.
fn observed(name: String) -> Supervisor {
    let supervisor = Supervisor::new(name);
    let watched = supervisor.clone();
    supervisor.spawn("failures", TaskPolicy::MayEnd, async move {
        let end = watched.shutdown_token();
        tokio::select! {
            () = end.cancelled() => {}
            reason = watched.failed() => tracing::error!(
                service = watched.name(),
                reason,
                "a part of the service failed",
            ),
        }
    });
    supervisor
}

/// Milliseconds since 1970.
pub(crate) fn now_ms() -> u64 {
    let since_epoch = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_epoch.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
pub(crate) fn slam() -> Identity {
    Identity {
        layer: "edge".parse().unwrap(),
        node: Some("robot-1".parse().unwrap()),
        service: "slam".parse().unwrap(),
        instance: InstanceName::first(),
        epoch: 17,
    }
}
