//! The node file as BlazeFlow reads it: at the start, and while it runs.

use std::sync::Arc;

use blaze_brokers::node_schema;
use blaze_domain::node_file::NodeFile;
use blaze_runtime::config::{
    Follower, Keys, Loaded, LocatedFault, Schema, Sources, Verdict, WatchSettings, follow,
    load_typed, watch_with,
};
use blaze_runtime::logs::LogHandle;
use blaze_runtime::{Supervisor, TaskPolicy};
use serde_json::Value;
use tokio::sync::watch;

use super::RunningFlow;
use super::service::FlowService;
use super::settings::LiveSettings;

/// What a flow reads of the file, and what of it changes while it runs.
pub const KEYS: Keys = Keys {
    read: &[
        "layer",
        "node",
        "brokers.node",
        "brokers.layer",
        "brokers.inter",
        "brokers.plugins",
        "admin.flow",
        "cache",
        "flow",
        "log",
        "state_dir",
    ],
    live: &[
        "flow.bandwidth",
        "flow.topics",
        "flow.compression",
        "flow.pool_threads",
        "flow.access",
        "brokers.plugins[0].ros2.allow",
        "brokers.plugins[0].ros2.deny",
        "brokers.plugins[0].ros2.system",
        "brokers.plugins[0].ros2.announce",
        "brokers.plugins[0].ros2.interfaces",
        "log.level",
    ],
};

/// The node file as a flow reads it.
#[must_use]
pub fn schema() -> Schema<NodeFile> {
    node_schema(NodeFile::check_for_flow)
}

/// Whether a file differs from the one of the start in what a flow reads then alone.
fn needs_restart(started: &NodeFile, file: &NodeFile) -> bool {
    let mut same = started.clone();
    same.flow.bandwidth = file.flow.bandwidth.clone();
    same.flow.compression = file.flow.compression;
    same.flow.pool_threads = file.flow.pool_threads;
    same.flow.topics.clone_from(&file.flow.topics);
    same.flow.access.clone_from(&file.flow.access);
    same.log.level.clone_from(&file.log.level);
    if let (Some(same), Some(file)) = (&mut same.brokers.ros2, &file.brokers.ros2) {
        same.live.clone_from(&file.live);
    }
    // What other programs read.
    same.admin.worker = file.admin.worker;
    same.admin.monitor = file.admin.monitor;
    same.config.clone_from(&file.config);
    same.database.clone_from(&file.database);
    same.monitor.clone_from(&file.monitor);
    same.worker.clone_from(&file.worker);
    same.control_plane.clone_from(&file.control_plane);
    same != *file
}

/// The node file that a flow follows.
pub struct Followed {
    /// Where it comes from.
    pub sources: Sources,
    /// What it said.
    pub loaded: Loaded<NodeFile>,
    /// How a change is noticed.
    pub watch: WatchSettings,
    /// Takes `log.level`; `None`: the log is not the flow's.
    pub log: Option<LogHandle>,
}

impl Followed {
    /// A node file that is no file, as of a flow within another program: it stays as it is.
    ///
    /// # Errors
    /// Every fault; they are told with `name` as that of a file.
    pub fn of_tree(
        name: &str,
        tree: &Value,
        log: Option<LogHandle>,
    ) -> Result<Self, Vec<LocatedFault>> {
        let sources = Sources::of_text(name, &tree.to_string());
        Ok(Self {
            loaded: load_typed(&sources, &schema())?,
            sources,
            watch: WatchSettings::of_text(),
            log,
        })
    }
}

/// Takes over what may change while the flow runs, as long as the supervisor does: what the node
/// file says, and over it what BlazeConfig says where the flow is a service. What is faulty changes
/// nothing and shows on `/readyz`; what BlazeConfig said is acknowledged, and `judged` hears what
/// became of it.
pub fn follow_node_file(
    flow: &Arc<RunningFlow>,
    followed: Followed,
    service: Option<&FlowService>,
    supervisor: &Supervisor,
    mut judged: impl FnMut(&Verdict) + Send + 'static,
) {
    let Followed { sources, loaded, watch, log } = followed;
    let program = service.map(|service| service.program().clone());
    let overlays = match &program {
        Some(program) => program.overlays(),
        None => watch::channel(None).1,
    };
    let follower = Follower {
        told: watch_with(supervisor, sources, schema(), loaded, watch, overlays),
        readiness: flow.readiness().clone(),
        keys: KEYS,
        needs_restart,
    };
    let flow = Arc::clone(flow);
    let take = move |loaded: &Loaded<NodeFile>| {
        let file = &loaded.value;
        flow.reload(LiveSettings::from(file));
        if let Some(Err(error)) = log.as_ref().map(|log| log.set_level(&file.log.level)) {
            tracing::error!(%error, "log.level");
        }
        tracing::info!(limit_mbps = file.flow.bandwidth.limit_mbps, "configuration reloaded");
    };
    let tell = move |verdict: Option<&Verdict>, besides: &str| {
        if let Some(program) = &program {
            program.judged(verdict, besides);
        }
        if let Some(verdict) = verdict {
            judged(verdict);
        }
    };
    supervisor.spawn("reload", TaskPolicy::Essential, follow(follower, take, tell));
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn tree(rest: Value) -> Value {
        let mut tree = json!({
            "layer": {
                "name": "edge",
                "kind": "edge",
            }, "node": {"name": "a"}, "brokers": {"layer": {"memory": {}}}
        });
        let Value::Object(rest) = rest else { unreachable!("an object") };
        tree.as_object_mut().unwrap().extend(rest);
        tree
    }

    fn file(rest: Value) -> NodeFile {
        NodeFile::read(&tree(rest)).unwrap().0
    }

    #[test]
    fn only_what_changes_while_it_runs_needs_no_restart() {
        let started = file(json!({}));
        let live = json!({
            "flow": {
                "bandwidth": {"limit_mbps": 7},
                "compression": {"level": 1},
                "pool_threads": 1,
            }, "log": {"level": "debug"},
        });
        assert!(!needs_restart(&started, &file(live)));
        let of_others = json!({
            "admin": {"worker": "127.0.0.1:9999"}, "worker": {"lease_ms": 1000},
            "config": {"server": "https://10.0.0.1:50051"},
            "database": {"embedded": {"path": "worker.db"}}, "monitor": {"ping_period_s": 5},
        });
        assert!(!needs_restart(&started, &file(of_others)));
        for other in [
            json!({"admin": {"flow": "127.0.0.1:9999"}}),
            json!({"flow": {"gateway": true}}),
            json!({"cache": {"redis": {"url": "redis://127.0.0.1"}}}),
        ] {
            assert!(needs_restart(&started, &file(other.clone())), "{other}");
        }
    }

    #[test]
    fn of_a_ros2_network_what_is_bridged_changes_while_it_runs() {
        let on = |ros2: Value| {
            file(json!({"brokers": {"layer": {"memory": {}}, "plugins": [{"ros2": ros2}]}}))
        };
        let started = on(json!({}));
        for live in [
            json!({"allow": ["scan"]}),
            json!({"deny": ["scan"]}),
            json!({"system": true}),
            json!({"announce": false}),
            json!({"interfaces": ["/opt/ros/jazzy/share"]}),
        ] {
            assert!(!needs_restart(&started, &on(live.clone())), "{live}");
        }
        for other in [
            json!({"domain": 1}),
            json!({"interface": "10.0.1.1"}),
            json!({"peers": ["10.0.1.2"]}),
            json!({"distro": "humble"}),
            json!({"namespace": "arm"}),
        ] {
            assert!(needs_restart(&started, &on(other.clone())), "{other}");
        }
        assert!(needs_restart(&started, &file(json!({}))));
    }

    #[test]
    fn directives_that_no_log_takes_are_a_fault() {
        let faults = schema()(&tree(json!({"log": {"level": "blaze_flow[=info"}}))).unwrap_err();
        assert_eq!(faults.len(), 1);
        assert_eq!(faults[0].0, "log.level");
        assert!(schema()(&tree(json!({"log": {"level": "info,blaze_flow=debug"}}))).is_ok());
    }
}
