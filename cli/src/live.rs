//! Lets a flow of this process take its settings from BlazeConfig: what it says of service `blaze-flow` on the node, over what
//! the node file says.
//!
//! ```text
//! worker ─► notice ─► ConfigManager (blaze-flow) ─► section `flow` merged over the node file ─► RunningFlow::reload ─► ack
//! ```

use std::sync::Arc;

use blaze_brokers::Broker;
use blaze_domain::config::merge::merge_patch;
use blaze_domain::node_file::NodeFile;
use blaze_domain::{FlowId, Scope};
use blaze_flow::flow::RunningFlow;
use blaze_flow::flow::settings::LiveSettings;
use blaze_runtime::Supervisor;
use blaze_sdk::{AckStatus, ConfigListener, ServiceManager, ServiceOptions};
use serde_json::{Value, json};

use crate::exit::CliError;

/// The name under which flows have their configuration.
pub(crate) const SERVICE: &str = "blaze-flow";
/// The section of it that a running flow takes over.
const SECTION: &str = "flow";

/// A flow that follows BlazeConfig as long as this is held.
pub(crate) struct FollowingFlow {
    service: Arc<ServiceManager>,
    _listener: ConfigListener,
}

impl FollowingFlow {
    /// Begins to follow on the node's broker. `told` is called after each change that was taken over, with its
    /// revision.
    ///
    /// # Errors
    /// [`CliError::Failed`] when the service of the flow does not start.
    pub(crate) async fn start(
        flow: &Arc<RunningFlow>,
        base: Value,
        broker: Arc<dyn Broker>,
        supervisor: &Supervisor,
        told: impl Fn(u64) + Send + Sync + 'static,
    ) -> Result<Self, CliError> {
        let FlowId { layer, node } = flow.id().clone();
        let failed = |error: String| CliError::Failed(format!("the flow of {node} cannot follow BlazeConfig: {error}"));
        let name = SERVICE.parse().map_err(|error| failed(format!("{error}")))?;
        let options = ServiceOptions {
            pool_threads: 2,
            supervisor: Some(supervisor.clone()),
            ..ServiceOptions::new(layer, name, broker, Scope::Node)
        };
        let service = ServiceManager::start(options.on_node(node.clone())).await;
        let service = Arc::new(service.map_err(|error| failed(error.to_string()))?);
        let (acks, flow) = (service.config().clone(), Arc::downgrade(flow));
        let listener = service.config().on_change(move |change| {
            // One that has ended follows nothing any more.
            let Some(flow) = flow.upgrade() else { return };
            let config = change.new.as_deref();
            // That the broker drops it is an outcome: the worker then sees by the watchdog how things are.
            let _ = match settings(&base, config) {
                Ok(live) => {
                    flow.reload(live);
                    told(change.revision);
                    acks.ack(AckStatus::Applied, "")
                }
                Err(faults) => {
                    tracing::error!(%faults, "the configuration of blaze-flow changes nothing");
                    acks.ack(AckStatus::Rejected, &faults)
                }
            };
        });
        Ok(Self {
            service,
            _listener: listener,
        })
    }

    /// Ends it.
    pub(crate) async fn shutdown(self) {
        if let Some(service) = Arc::into_inner(self.service) {
            service.shutdown().await;
        }
    }
}

/// What holds: the node file, and over its section `flow` what BlazeConfig says.
///
/// # Errors
/// Every fault, on one line.
fn settings(base: &Value, config: Option<&Value>) -> Result<LiveSettings, String> {
    let mut tree = base.clone();
    if let Some(section) = config.and_then(|config| config.get(SECTION)) {
        merge_patch(&mut tree, &json!({ SECTION: section }));
    }
    match NodeFile::read(&tree) {
        Ok((file, _)) => Ok(LiveSettings::from(&file.flow)),
        Err(faults) => {
            let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
            Err(lines.join("; "))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_blaze_config_says_holds_over_the_node_file_and_faults_change_nothing() {
        let base = json!({ "flow": { "bandwidth": { "limit_mbps": 40, "min_rate_hz": 5 } } });
        let limit =
            |config: Option<Value>| settings(&base, config.as_ref()).map(|live| live.bandwidth.limit_bytes_per_s());
        let alone = limit(None).unwrap();
        let less = limit(Some(
            json!({ "flow": { "bandwidth": { "limit_mbps": 10 } }, "log": { "level": "off" } }),
        ))
        .unwrap();
        assert!((alone / less - 4.0).abs() < 0.01, "{alone} and {less}");
        assert_eq!(limit(Some(json!({ "other": 1 }))), Ok(alone));
        let error = limit(Some(json!({ "flow": { "bandwidth": { "limit_mbps": -1 } } }))).unwrap_err();
        assert!(error.contains("flow.bandwidth.limit_mbps"), "{error}");
    }
}
