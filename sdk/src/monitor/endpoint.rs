//! Where a service serves its metrics: `/metrics`, `/livez` and `/readyz`.

use std::net::SocketAddr;
use std::sync::Arc;

use blaze_brokers::{BrokerStatus, Health};
use blaze_domain::config::ServiceState;
use blaze_runtime::{AdminServer, CheckStatus, Gate, Readiness, Supervisor, TaskPolicy};
use tokio::sync::watch;

use super::MonitorManager;
use crate::SdkError;

const VARIABLE: &str = "BLAZE_METRICS";
const BROKER: &str = "broker";
const SERVICE: &str = "service";

/// Where a service serves its metrics over HTTP. They are recorded in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MetricsEndpoint {
    /// As the variable `BLAZE_METRICS` says: `IP:PORT`, or `off`, the default.
    #[default]
    Environment,
    /// Nowhere.
    Off,
    /// At this address; port 0 is any port. Nobody is asked who he is: choose loopback, unless the
    /// network is trusted.
    At(SocketAddr),
}

impl MetricsEndpoint {
    fn address(self) -> Result<Option<SocketAddr>, SdkError> {
        match self {
            Self::Environment => named(blaze_runtime::environment::variable(VARIABLE).as_deref()),
            Self::Off => Ok(None),
            Self::At(address) => Ok(Some(address)),
        }
    }

    fn option(self) -> &'static str {
        if self == Self::Environment { VARIABLE } else { "metrics" }
    }
}

/// The address that a text names.
pub(super) fn named(text: Option<&str>) -> Result<Option<SocketAddr>, SdkError> {
    let fault = |_| SdkError::Option {
        option: VARIABLE,
        reason: "must be IP:PORT, such as 127.0.0.1:0 for any port, or off".to_owned(),
    };
    match text {
        None | Some("off") => Ok(None),
        Some(text) => text.parse().map(Some).map_err(fault),
    }
}

/// A port that is bound; connections wait until it is served.
pub(crate) struct Endpoint {
    server: AdminServer,
    readiness: Readiness,
}

impl Endpoint {
    /// Binds the port, if there is to be one, and gives its address to the monitor.
    pub(crate) async fn bind(
        endpoint: MetricsEndpoint,
        monitor: &MonitorManager,
    ) -> Result<Option<Self>, SdkError> {
        let Some(address) = endpoint.address()? else {
            return Ok(None);
        };
        let readiness = Readiness::new();
        // Before anybody can ask: without them it would be ready.
        readiness.add(BROKER, Gate::Decides, CheckStatus::Failed, "not connected yet");
        readiness.add(SERVICE, Gate::Decides, CheckStatus::Failed, "starting");
        let text = monitor.clone();
        let metrics = Arc::new(move || text.text());
        let server = AdminServer::bind(address, Default::default(), readiness.clone(), metrics)
            .await
            .map_err(|error| SdkError::Option {
                option: endpoint.option(),
                reason: error.to_string(),
            })?;
        monitor.served_at(server.address());
        Ok(Some(Self { server, readiness }))
    }

    /// Serves until the supervisor's shutdown. `/readyz` follows the broker and the state of the
    /// service.
    pub(crate) fn serve(
        self,
        mut broker: watch::Receiver<BrokerStatus>,
        mut state: watch::Receiver<Option<ServiceState>>,
        supervisor: &Supervisor,
    ) {
        self.server.serve(supervisor);
        let (readiness, stop) = (self.readiness, supervisor.stopping_token());
        let follow = async move {
            loop {
                show_broker(&readiness, &broker.borrow_and_update());
                show_state(&readiness, *state.borrow_and_update());
                let changed = tokio::select! {
                    () = stop.cancelled() => break,
                    changed = broker.changed() => changed,
                    changed = state.changed() => changed,
                };
                if changed.is_err() {
                    // The broker or the service is gone.
                    break;
                }
            }
            readiness.stop();
        };
        supervisor.spawn("readiness", TaskPolicy::MayEnd, follow);
    }
}

fn show_broker(readiness: &Readiness, broker: &BrokerStatus) {
    let status = if broker.health == Health::Up { CheckStatus::Ok } else { CheckStatus::Failed };
    readiness.set(BROKER, status, broker.detail.clone());
}

/// A service that gives no state is ready as long as its broker is.
fn show_state(readiness: &Readiness, state: Option<ServiceState>) {
    let (status, detail) = match state {
        None => (CheckStatus::Ok, "gives no state"),
        Some(ServiceState::Ready) => (CheckStatus::Ok, ServiceState::Ready.as_str()),
        Some(state) => (CheckStatus::Failed, state.as_str()),
    };
    readiness.set(SERVICE, status, detail);
}
