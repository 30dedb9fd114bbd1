//! What a service is started with.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::Broker;
use blaze_domain::control::DEFAULT_TTL_S;
use blaze_domain::node_file::RedisBroker;
use blaze_domain::{InstanceName, LayerName, NodeName, Scope, ServiceName};
use blaze_runtime::Supervisor;

use crate::service::now_ms;
use crate::{Identity, MetricsEndpoint, SdkError};

/// Bounds of `watchdog_ttl`.
const MIN_WATCHDOG_TTL: Duration = Duration::from_secs(1);
const MAX_WATCHDOG_TTL: Duration = Duration::from_secs(3600);
const MAX_VERSION_BYTES: usize = 256;

/// Who a service is and what it works with.
#[derive(Clone)]
pub struct ServiceOptions {
    /// Layer that it runs in.
    pub layer: LayerName,
    /// Node that it runs on; absent for a service of a layer.
    pub node: Option<NodeName>,
    /// Its name.
    pub service: ServiceName,
    /// Which of several of that name it is.
    pub instance: InstanceName,
    /// The local broker. The service does not close it.
    pub broker: Arc<dyn Broker>,
    /// How far that broker reaches.
    pub scope: Scope,
    /// Threads for callbacks; 0 = as many as the process may use cores (cgroups count). At least
    /// two are started.
    pub pool_threads: usize,
    /// Time to live of the service's leases, 1 s to 1 day; they are renewed at a third of it.
    pub lease_ttl: Duration,
    /// How long to wait for a flow's answer to an advertise, request or withdraw.
    pub control_timeout: Duration,
    /// Larger is newer; 0 = milliseconds since 1970 at the start.
    pub epoch: u64,
    /// The service's tasks and threads run under a child of it: their failure is its failure, and
    /// its shutdown ends them, though without withdrawing leases; for that call
    /// [`ServiceManager::shutdown`](crate::ServiceManager::shutdown) before. Absent = under a
    /// supervisor of their own, whose failure is logged.
    pub supervisor: Option<Supervisor>,
    /// Redis in which the service keeps values and says that it lives (`cache.redis` of the node
    /// file). Without one it says so by messages.
    pub cache: Option<RedisBroker>,
    /// How long a sign of life counts, 1 s to 1 h; it is given every third of it.
    pub watchdog_ttl: Duration,
    /// Version of the program, for those who look at services; at most 256 bytes.
    pub version: String,
    /// Where its metrics are served. A program that serves them at a port of its own turns it off.
    pub metrics: MetricsEndpoint,
    /// Services that must be ready before this one has started.
    pub wait_for: Vec<ServiceName>,
    /// How long to wait for them.
    pub wait_timeout: Duration,
}

impl ServiceOptions {
    /// A service on no particular node, with the default bounds: the instance that the variable
    /// `BLAZE_INSTANCE` names, else the first one.
    #[must_use]
    pub fn new(
        layer: LayerName,
        service: ServiceName,
        broker: Arc<dyn Broker>,
        scope: Scope,
    ) -> Self {
        Self {
            layer,
            node: None,
            service,
            instance: of_environment().ok().flatten().unwrap_or_else(InstanceName::first),
            broker,
            scope,
            pool_threads: 0,
            lease_ttl: Duration::from_secs(DEFAULT_TTL_S.into()),
            control_timeout: Duration::from_secs(10),
            epoch: 0,
            supervisor: None,
            cache: None,
            watchdog_ttl: Duration::from_secs(15),
            version: String::new(),
            metrics: MetricsEndpoint::Environment,
            wait_for: Vec::new(),
            wait_timeout: Duration::from_secs(30),
        }
    }

    /// Whether the environment names an instance that can be none, and nobody has chosen another
    /// one.
    pub(crate) fn check_instance(&self) -> Result<(), SdkError> {
        match of_environment() {
            Err(error) if self.instance == InstanceName::first() => Err(error),
            Ok(_) | Err(_) => Ok(()),
        }
    }

    /// Whether the sign of life can be given like that.
    pub(crate) fn check_watchdog(&self) -> Result<(), SdkError> {
        if !(MIN_WATCHDOG_TTL..=MAX_WATCHDOG_TTL).contains(&self.watchdog_ttl) {
            return Err(SdkError::Option {
                option: "watchdog_ttl",
                reason: format!(
                    "is {:?}, {MIN_WATCHDOG_TTL:?} to {MAX_WATCHDOG_TTL:?} are allowed",
                    self.watchdog_ttl
                ),
            });
        }
        if self.version.len() > MAX_VERSION_BYTES || self.version.chars().any(char::is_control) {
            return Err(SdkError::Option {
                option: "version",
                reason: format!(
                    "must have at most {MAX_VERSION_BYTES} bytes and no control characters"
                ),
            });
        }
        Ok(())
    }

    /// Who the service is. One without an epoch of its own begins now.
    pub(crate) fn identity(&self) -> Identity {
        Identity {
            layer: self.layer.clone(),
            node: self.node.clone(),
            service: self.service.clone(),
            instance: self.instance.clone(),
            epoch: if self.epoch == 0 { now_ms() } else { self.epoch },
        }
    }

    /// The same service on a node.
    #[must_use]
    pub fn on_node(mut self, node: NodeName) -> Self {
        self.node = Some(node);
        self
    }
}

/// The instance that the environment names, if it names one.
fn of_environment() -> Result<Option<InstanceName>, SdkError> {
    named(blaze_runtime::environment::variable("BLAZE_INSTANCE").as_deref())
}

fn named(text: Option<&str>) -> Result<Option<InstanceName>, SdkError> {
    let fault = |error| SdkError::Option {
        option: "BLAZE_INSTANCE",
        reason: format!("is no name of an instance: {error}"),
    };
    text.map(|text| text.parse().map_err(fault)).transpose()
}

#[cfg(test)]
mod tests {
    use blaze_brokers::memory::MemoryHub;

    use super::*;
    use crate::ServiceManager;

    fn options() -> ServiceOptions {
        let broker = Arc::new(MemoryHub::new("node").broker());
        ServiceOptions::new("edge".parse().unwrap(), "slam".parse().unwrap(), broker, Scope::Node)
    }

    #[test]
    fn the_environment_may_name_the_instance() {
        assert_eq!(options().instance.as_str(), "0");
        assert_eq!(named(None).unwrap(), None);
        assert_eq!(named(Some("left")).unwrap(), Some("left".parse().unwrap()));
        let error = named(Some("Left!")).unwrap_err();
        assert!(matches!(error, SdkError::Option { option: "BLAZE_INSTANCE", .. }), "{error}");
    }

    #[tokio::test]
    async fn options_that_cannot_be_are_named() {
        for (bad, option) in [
            (
                ServiceOptions { watchdog_ttl: Duration::from_millis(999), ..options() },
                "watchdog_ttl",
            ),
            (ServiceOptions { version: "1\n2".to_owned(), ..options() }, "version"),
        ] {
            let error = ServiceManager::start(bad).await.err().unwrap();
            assert!(
                matches!(error, SdkError::Option { option: named, .. } if named == option),
                "{error}"
            );
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_service_that_waits_for_another_ends_with_its_supervisor() {
        let parent = Supervisor::new("t");
        let waits = ServiceManager::start(ServiceOptions {
            supervisor: Some(parent.clone()),
            wait_for: vec!["blaze-flow".parse().unwrap()],
            wait_timeout: Duration::from_secs(3600),
            ..options().on_node("robot-1".parse().unwrap())
        });
        let stops = async {
            tokio::time::sleep(Duration::from_secs(5)).await;
            parent.stopping_token().cancel();
        };
        let (result, ()) =
            tokio::join!(tokio::time::timeout(Duration::from_secs(60), waits), stops);
        assert!(matches!(result.unwrap(), Err(SdkError::ShutDown)));
    }
}
