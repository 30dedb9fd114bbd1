//! The BlazeMonitoring process: parse, build, run.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::{Broker, Role, node_schema, open_layer, open_node};
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile};
use blaze_domain::{InstanceName, Scope};
use blaze_monitor::node::Roots;
use blaze_monitor::running::{KEYS, MonitorOptions, RunningMonitor, needs_restart};
use blaze_monitor::settings::identity;
use blaze_runtime::admin::say_listening;
use blaze_runtime::config::{
    Follower, Loaded, Schema, Sources, Verdict, WatchSettings, follow, load_or_say, parse_override,
    watch_with,
};
use blaze_runtime::logs::{LogFormat, LogHandle};
use blaze_runtime::supervisor::{
    ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy, block_on, failed,
};
use blaze_runtime::{environment, logs, ready_line};
use clap::Parser;

const NAME: &str = "blaze-monitor";
/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(5);

/// BlazeMonitoring: measures this node, its links and topics, and says what is wrong and where.
#[derive(Parser)]
#[command(name = "blaze-monitor", version)]
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
    /// Overrides one key, as monitor.ping_period_s=10; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_override)]
    set: Vec<(String, String)>,
    /// Where the kernel's /proc is, in a container that has the host's mounted elsewhere.
    #[arg(long, value_name = "FOLDER", default_value = "/proc")]
    proc: PathBuf,
    /// Where the kernel's /sys is.
    #[arg(long, value_name = "FOLDER", default_value = "/sys")]
    sys: PathBuf,
}

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    let mut overrides = std::mem::take(&mut arguments.set);
    if let Some(format) = &arguments.log_format {
        overrides.push(("log.format".to_owned(), format.clone()));
    }
    let sources = Sources::of_process(arguments.config, overrides);
    let instance = environment::parsed::<InstanceName>("BLAZE_INSTANCE").err();
    let loaded = match load_or_say(&sources, &schema(), instance) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.check {
        return ExitCode::SUCCESS;
    }
    let roots = Roots { proc: arguments.proc, sys: arguments.sys };
    block_on(NAME, run(sources.pinned(), loaded, roots))
}

/// The node file as this program reads it.
fn schema() -> Schema<NodeFile> {
    node_schema(|file| identity(file).err().unwrap_or_default())
}

async fn run(sources: Sources, loaded: Loaded<NodeFile>, roots: Roots) -> ExitCode {
    let supervisor = Supervisor::new(NAME);
    let monitor = match start(&supervisor, sources, loaded, roots).await {
        Ok(monitor) => monitor,
        Err(error) => return failed(NAME, format_args!("{error:#}")),
    };
    let readiness = monitor.readiness().clone();
    let steps = ShutdownSteps::new(SHUTDOWN)
        .on(ShutdownPhase::NotReady, "readiness", async move { readiness.stop() })
        .on(ShutdownPhase::Drain, "monitor", async move { monitor.stop().await });
    supervisor.run(steps).await
}

async fn start(
    supervisor: &Supervisor,
    sources: Sources,
    loaded: Loaded<NodeFile>,
    roots: Roots,
) -> anyhow::Result<Arc<RunningMonitor>> {
    let file = &loaded.value;
    let format = if file.log.format.as_str() == "json" { LogFormat::Json } else { LogFormat::Text };
    let log = logs::init(file.log.level.as_str(), format)?;
    let broker = broker(file)?;
    let options = MonitorOptions { file: file.clone(), roots, broker };
    let monitor = Arc::new(RunningMonitor::start(options, supervisor).await?);
    say_listening(monitor.admin());
    follow_node_file(&monitor, supervisor, sources, loaded, log);
    let (announced, stop) = (Arc::clone(&monitor), supervisor.stopping_token());
    supervisor.spawn("ready line", TaskPolicy::MayEnd, async move {
        tokio::select! {
            // Without a reader of stdout the line is of no use.
            () = announced.readiness().ready() => {
                drop(ready_line(&[("admin", announced.admin())]));
            }
            () = stop.cancelled() => {}
        }
    });
    Ok(monitor)
}

/// The broker of the node, else that of the layer; none where only one process could be on it.
fn broker(file: &NodeFile) -> anyhow::Result<Option<(Scope, Arc<dyn Broker>)>> {
    Ok(match (&file.brokers.node, &file.brokers.layer) {
        (Some(section @ NodeBroker::Redis(_)), _) => {
            let broker = open_node(section, &Role::Service).context("brokers.node")?;
            Some((Scope::Node, broker))
        }
        (_, Some(section @ (LayerBroker::Dds(_) | LayerBroker::Kafka(_)))) => {
            let broker = open_layer(section, &Role::Service).context("brokers.layer")?;
            Some((Scope::Layer, broker))
        }
        (Some(NodeBroker::Memory) | None, Some(LayerBroker::Memory) | None) => None,
    })
}

/// Takes over what may change while the process runs; what is faulty changes nothing and shows on
/// `/readyz`.
fn follow_node_file(
    monitor: &Arc<RunningMonitor>,
    supervisor: &Supervisor,
    sources: Sources,
    loaded: Loaded<NodeFile>,
    log: LogHandle,
) {
    let program = monitor.program();
    let overlays = match &program {
        Some(program) => program.overlays(),
        None => tokio::sync::watch::channel(None).1,
    };
    let watch = WatchSettings::default();
    let told = watch_with(supervisor, sources, schema(), loaded, watch, overlays);
    let follower =
        Follower { told, readiness: monitor.readiness().clone(), keys: KEYS, needs_restart };
    let monitor = Arc::clone(monitor);
    let take = move |loaded: &Loaded<NodeFile>| {
        monitor.reload(&loaded.value);
        if let Err(error) = log.set_level(loaded.value.log.level.as_str()) {
            tracing::error!(%error, "log.level");
        }
    };
    let judged = move |verdict: Option<&Verdict>, besides: &str| {
        if let Some(program) = &program {
            program.judged(verdict, besides);
        }
    };
    supervisor.spawn("reload", TaskPolicy::Essential, follow(follower, take, judged));
}
