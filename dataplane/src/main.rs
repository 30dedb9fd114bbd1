//! The BlazeFlow process: parse, build, run.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, OpenError, Role, check_layer, open_layer, open_node};
use blaze_domain::node_file::{Fault, LayerBroker as LayerSection, NodeBroker, NodeFile};
use blaze_flow::flow::settings::{FlowSettings, LiveSettings};
use blaze_flow::flow::{Beginning, Epochs, FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_runtime::admin::{CheckStatus, Readiness};
use blaze_runtime::config::{Current, Loaded, Schema, Sources, WatchSettings, load_typed, parse_override, watch};
use blaze_runtime::logs::{LogFormat, LogHandle};
use blaze_runtime::supervisor::{ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy, block_on, exit_code};
use blaze_runtime::{logs, ready_line, say, state};
use clap::Parser;

/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(5);

/// BlazeFlow: connects whoever publishes a topic with whoever asks for it, on any broker, on any layer.
#[derive(Parser)]
#[command(name = "blaze-flow", version)]
struct Arguments {
    /// The node file; else BLAZE_CONFIG, ./blaze.yaml, /etc/blaze/blaze.yaml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Only check the configuration: every fault on stderr, exit code 0 or 64.
    #[arg(long)]
    check: bool,
    /// text or json; else as the node file says.
    #[arg(long, value_name = "FORMAT", value_parser = ["text", "json"])]
    log_format: Option<String>,
    /// Overrides one key, as flow.bandwidth.limit_mbps=40; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_override)]
    set: Vec<(String, String)>,
}

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    let mut overrides = std::mem::take(&mut arguments.set);
    if let Some(format) = &arguments.log_format {
        overrides.push(("log.format".to_owned(), format.clone()));
    }
    let sources = Sources::of_process(arguments.config, overrides);
    let loaded = match load_typed(&sources, &schema()) {
        Ok(loaded) => loaded,
        Err(faults) => {
            faults.iter().for_each(|fault| say(format_args!("{fault}")));
            return ExitCode::from(exit_code::CONFIGURATION);
        }
    };
    for warning in &loaded.warnings {
        say(format_args!("warning: {warning}"));
    }
    if cfg!(not(feature = "kafka")) && matches!(loaded.value.brokers.layer, Some(LayerSection::Kafka(_))) {
        say(format_args!(
            "warning: brokers.layer.kafka: this program was built without Kafka (cargo feature `kafka`) and cannot start with it"
        ));
    }
    if arguments.check {
        return ExitCode::SUCCESS;
    }
    match block_on(run(sources.pinned(), loaded)) {
        Ok(code) => code,
        Err(error) => {
            say(format_args!("blaze-flow failed: {error}"));
            ExitCode::from(exit_code::FAILED)
        }
    }
}

/// The node file as this program reads it.
fn schema() -> Schema<NodeFile> {
    let remark = |fault: Fault| (fault.path, fault.detail);
    Arc::new(move |value| match NodeFile::read(value) {
        Ok((file, warnings)) => {
            let mut faults = file.check_for_flow();
            faults.extend(broker_fault(&file));
            if faults.is_empty() {
                Ok((file, warnings.into_iter().map(remark).collect()))
            } else {
                Err(faults.into_iter().map(remark).collect())
            }
        }
        Err(faults) => Err(faults.into_iter().map(remark).collect()),
    })
}

/// What the adapter has against the section of the layer scope. What was not built in is told beside that.
fn broker_fault(file: &NodeFile) -> Option<Fault> {
    match check_layer(file.brokers.layer.as_ref()?) {
        Err(OpenError::Setting { key, reason }) => Some(Fault {
            path: format!("brokers.layer.{key}"),
            detail: reason,
        }),
        Ok(()) | Err(OpenError::NotBuilt { .. } | OpenError::InProcess) => None,
    }
}

async fn run(sources: Sources, loaded: Loaded<NodeFile>) -> ExitCode {
    let supervisor = Supervisor::new("blaze-flow");
    let flow = match start(&supervisor, &loaded.value).await {
        Ok(started) => started,
        Err(error) => {
            say(format_args!("blaze-flow failed: {error:#}"));
            return ExitCode::from(exit_code::FAILED);
        }
    };
    let (flow, log) = flow;
    let flow = Arc::new(flow);
    let started = loaded.value.clone();
    let reloads = watch(&supervisor, sources, schema(), loaded, WatchSettings::default());
    let follow = follow(Arc::clone(&flow), started, reloads, log);
    supervisor.spawn("reload", TaskPolicy::Essential, follow);
    let announced = Arc::clone(&flow);
    let stopping = supervisor.stopping_token();
    supervisor.spawn("ready line", TaskPolicy::MayEnd, async move {
        tokio::select! {
            () = announced.ready() => ready_line(&[("admin", announced.admin())]),
            () = stopping.cancelled() => Ok(()),
        }
    });
    let readiness: Readiness = flow.readiness().clone();
    let steps = ShutdownSteps::new(SHUTDOWN)
        .on(ShutdownPhase::NotReady, "readiness", async move { readiness.stop() })
        .on(ShutdownPhase::Drain, "flow", async move { flow.drain().await });
    supervisor.run(steps).await
}

async fn start(supervisor: &Supervisor, file: &NodeFile) -> anyhow::Result<(RunningFlow, LogHandle)> {
    let format = if file.log.format.as_str() == "json" {
        LogFormat::Json
    } else {
        LogFormat::Text
    };
    let log = logs::init(file.log.level.as_str(), format)?;
    let directory = state::state_directory(file.state_dir.as_deref())?;
    if let Some(refused) = &directory.instead_of {
        tracing::warn!(directory = %directory.path.display(), instead_of = refused, "state is kept elsewhere");
    }
    let settings = FlowSettings::try_from(file)?;
    let epochs = Epochs::begin(&settings.me, Some(&directory.path)).context("keeping the epoch")?;
    let role = Role::Flow {
        flow: settings.me.clone(),
        epoch: epochs.first(),
    };
    let node = node_broker(file, &settings, &role)?;
    let (layer, layer_prefix) = layer_broker(file, &settings, &role)?;
    let options = FlowOptions {
        settings,
        node,
        layer,
        state_dir: Some(directory.path),
    };
    let beginning = Beginning { epochs, layer_prefix };
    Ok((
        blaze_flow::flow::start_with(options, beginning, supervisor.clone()).await?,
        log,
    ))
}

fn node_broker(file: &NodeFile, settings: &FlowSettings, role: &Role) -> anyhow::Result<Option<Arc<dyn Broker>>> {
    Ok(match &file.brokers.node {
        None => None,
        Some(NodeBroker::Memory) => Some(Arc::new(MemoryHub::new(settings.me.to_string()).broker())),
        Some(section) => Some(open_node(section, role).context("brokers.node")?),
    })
}

/// The layer broker and what it puts before every name.
fn layer_broker(
    file: &NodeFile,
    settings: &FlowSettings,
    role: &Role,
) -> anyhow::Result<(Option<LayerBroker>, String)> {
    let Some(section) = &file.brokers.layer else {
        return Ok((None, String::new()));
    };
    let (broker, id, prefix): (Arc<dyn Broker>, _, _) = match section {
        // Only this process sees it, so nobody shares its identity.
        LayerSection::Memory => {
            let hub = MemoryHub::new(settings.me.layer.to_string());
            (Arc::new(hub.broker()), LayerScopeId::private(), String::new())
        }
        LayerSection::Dds(dds) => {
            let broker = open_layer(section, role).context("brokers.layer")?;
            let host = dds.interface.is_loopback().then(this_host);
            (broker, LayerScopeId::dds(dds.domain, host.as_deref()), String::new())
        }
        LayerSection::Kafka(kafka) => {
            let broker = open_layer(section, role).context("brokers.layer")?;
            (broker, LayerScopeId::kafka(&kafka.prefix), kafka.prefix.clone())
        }
    };
    Ok((Some(LayerBroker { broker, id }), prefix))
}

/// What is the same for all processes that share a loopback interface: the boot of the host and the network namespace.
fn this_host() -> String {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let namespace = std::fs::read_link("/proc/self/ns/net").unwrap_or_default();
    format!("{}|{}", boot.trim(), namespace.display())
}

/// What is said of a file that was reloaded in part.
const WAITS: &str = "the node file has changes that need a restart";

/// Whether a file differs from the one of the start in more than what changes while the process runs.
fn needs_restart(started: &NodeFile, file: &NodeFile) -> bool {
    let mut same = started.clone();
    same.flow.bandwidth = file.flow.bandwidth.clone();
    same.flow.compression = file.flow.compression;
    same.flow.pool_threads = file.flow.pool_threads;
    same.flow.topics.clone_from(&file.flow.topics);
    same.flow.access.clone_from(&file.flow.access);
    same.log.level.clone_from(&file.log.level);
    same != *file
}

/// Takes over what may change while the process runs; a faulty file changes nothing and shows on `/readyz`.
async fn follow(
    flow: Arc<RunningFlow>,
    started: NodeFile,
    mut reloads: tokio::sync::watch::Receiver<Current<NodeFile>>,
    log: LogHandle,
) {
    while reloads.changed().await.is_ok() {
        let current = reloads.borrow_and_update().clone();
        match &current.faults {
            Some(faults) => {
                for fault in faults.iter() {
                    tracing::error!("{fault}");
                }
                let first = faults.first().map(ToString::to_string).unwrap_or_default();
                flow.readiness().set("config", CheckStatus::Failed, first);
            }
            None => {
                let file = &current.loaded.value;
                flow.reload(LiveSettings::from(&file.flow));
                if let Err(error) = log.set_level(file.log.level.as_str()) {
                    tracing::error!(%error, "log.level");
                }
                let waits = needs_restart(&started, file);
                if waits {
                    tracing::warn!("{WAITS}");
                }
                flow.readiness()
                    .set("config", CheckStatus::Ok, if waits { WAITS } else { "" });
                tracing::info!(limit_mbps = file.flow.bandwidth.limit_mbps, "configuration reloaded");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn file(rest: serde_json::Value) -> NodeFile {
        let mut tree = json!({
            "layer": {"name": "edge", "kind": "edge"}, "node": {"name": "a"}, "brokers": {"layer": {"memory": {}}}
        });
        let serde_json::Value::Object(rest) = rest else {
            unreachable!("an object")
        };
        tree.as_object_mut().unwrap().extend(rest);
        NodeFile::read(&tree).unwrap().0
    }

    #[test]
    fn only_what_changes_while_it_runs_needs_no_restart() {
        let started = file(json!({}));
        let live = json!({
            "flow": {"bandwidth": {"limit_mbps": 7}, "compression": {"level": 1}, "pool_threads": 1}, "log": {"level": "debug"},
        });
        assert!(!needs_restart(&started, &file(live)));
        for other in [
            json!({"admin": {"flow": "127.0.0.1:9999"}}),
            json!({"flow": {"gateway": true}}),
        ] {
            assert!(needs_restart(&started, &file(other.clone())), "{other}");
        }
    }
}
