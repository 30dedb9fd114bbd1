//! The BlazeFlow process: parse, build, run.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Role, open_layer, open_node};
use blaze_domain::InstanceName;
use blaze_domain::node_file::{LayerBroker as LayerSection, NodeBroker, NodeFile};
use blaze_flow::flow::node_file::{Followed, follow_node_file, schema};
use blaze_flow::flow::ros2::this_host;
use blaze_flow::flow::service::FlowService;
use blaze_flow::flow::settings::FlowSettings;
use blaze_flow::flow::{Beginning, Epochs, FlowOptions, LayerBroker, RunningFlow};
use blaze_flow::world::LayerScopeId;
use blaze_runtime::admin::{Readiness, say_listening};
use blaze_runtime::config::{Loaded, Sources, WatchSettings, load_or_say, parse_override};
use blaze_runtime::logs::{LogFormat, LogHandle};
use blaze_runtime::state::StateDirectory;
use blaze_runtime::supervisor::{
    ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy, block_on, failed,
};
use blaze_runtime::{environment, logs, ready_line, state};
use clap::Parser;

const NAME: &str = "blaze-flow";
/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(5);

/// BlazeFlow: connects the publishers of a topic with the services that request it, on any broker
/// and any layer.
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
    let instance = environment::parsed::<InstanceName>("BLAZE_INSTANCE").err();
    let loaded = match load_or_say(&sources, &schema(), instance) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.check {
        return ExitCode::SUCCESS;
    }
    block_on(NAME, run(sources.pinned(), loaded))
}

async fn run(sources: Sources, loaded: Loaded<NodeFile>) -> ExitCode {
    let supervisor = Supervisor::new(NAME);
    let (flow, log, service) = match begin(&supervisor, &loaded.value).await {
        Ok(started) => started,
        Err(error) => return failed(NAME, format_args!("{error:#}")),
    };
    let followed = Followed { sources, loaded, watch: WatchSettings::default(), log: Some(log) };
    follow_node_file(&flow, followed, service.as_ref(), &supervisor, |_| {});
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
        .on(ShutdownPhase::Drain, "flow", async move {
            if let Some(service) = service {
                service.stop().await;
            }
            flow.drain().await;
        });
    supervisor.run(steps).await
}

/// Starts the flow, and makes it a service where others could be on the same broker.
async fn begin(
    supervisor: &Supervisor,
    file: &NodeFile,
) -> anyhow::Result<(Arc<RunningFlow>, LogHandle, Option<FlowService>)> {
    let (flow, log) = start(supervisor, file).await?;
    let local = (&file.brokers.node, &file.brokers.layer);
    // In memory there is nobody but the flow itself.
    let is_alone =
        matches!(local, (Some(NodeBroker::Memory), _) | (None, Some(LayerSection::Memory)));
    let service = match is_alone {
        true => None,
        false => FlowService::start(&flow, file.cache_redis().cloned(), supervisor)
            .await
            .context("as a service of its node")?,
    };
    Ok((Arc::new(flow), log, service))
}

async fn start(
    supervisor: &Supervisor,
    file: &NodeFile,
) -> anyhow::Result<(RunningFlow, LogHandle)> {
    let format = if file.log.format.as_str() == "json" { LogFormat::Json } else { LogFormat::Text };
    let log = logs::init(file.log.level.as_str(), format)?;
    let directory = state_directory(file.state_dir.as_deref());
    let settings = FlowSettings::try_from(file)?;
    let epochs = Epochs::begin(&settings.me, Some(&directory));
    let role = Role::Flow { flow: settings.me.clone(), epoch: epochs.first() };
    let node = node_broker(file, &settings, &role)?;
    let (layer, layer_prefix) = layer_broker(file, &settings, &role)?;
    let options = FlowOptions { settings, node, layer, state_dir: Some(directory) };
    let beginning = Beginning { epochs, layer_prefix };
    let flow = blaze_flow::flow::start_with(options, beginning, supervisor.clone()).await?;
    say_listening(flow.admin());
    Ok((flow, log))
}

/// Where state is kept. A flow keeps its epoch alone, and starts without it where the disk is full.
fn state_directory(configured: Option<&Path>) -> PathBuf {
    match state::state_directory(configured) {
        Ok(StateDirectory { path, instead_of }) => {
            if let Some(refused) = instead_of {
                tracing::warn!(
                    directory = %path.display(),
                    instead_of = refused,
                    "state is kept elsewhere",
                );
            }
            path
        }
        Err(error) => {
            tracing::warn!(%error, "no state is kept");
            configured.unwrap_or(Path::new(state::DEFAULT_DIRECTORY)).to_owned()
        }
    }
}

fn node_broker(
    file: &NodeFile,
    settings: &FlowSettings,
    role: &Role,
) -> anyhow::Result<Option<Arc<dyn Broker>>> {
    Ok(match &file.brokers.node {
        None => None,
        Some(NodeBroker::Memory) => {
            Some(Arc::new(MemoryHub::new(settings.me.to_string()).broker()))
        }
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
