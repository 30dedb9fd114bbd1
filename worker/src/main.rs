//! The BlazeConfig worker's process: parse, build, run.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::redis::RedisKeys;
use blaze_brokers::{Broker, Role, node_schema, open_layer, open_node};
use blaze_domain::InstanceName;
use blaze_domain::node_file::{DatabaseSection, Fault, LayerBroker, NodeBroker, NodeFile};
use blaze_runtime::admin::{Readiness, say_listening};
use blaze_runtime::config::{
    Current, Follower, Keys, Loaded, Schema, Sources, WatchSettings, follow, load_or_say,
    parse_override, watch_with,
};
use blaze_runtime::logs::{LogFormat, LogHandle};
use blaze_runtime::supervisor::{
    ShutdownPhase, ShutdownSteps, Supervisor, TaskPolicy, block_on, failed,
};
use blaze_runtime::{environment, forbid_core_dumps, logs, read_password, ready_line, say, state};
use blaze_worker::admin::Shown;
use blaze_worker::copy::Vault;
use blaze_worker::lease;
use blaze_worker::running::{RunningWorker, WorkerOptions};
use blaze_worker::settings::{LocalBroker, WorkerSettings};
use clap::Parser;

const NAME: &str = "blaze-worker";
/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(5);

/// BlazeConfig's worker: every service of a node or layer has its configuration, also when the main
/// service is gone.
#[derive(Parser)]
#[command(name = "blaze-worker", version)]
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
    /// Overrides one key, as worker.lease_ms=2000; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_override)]
    set: Vec<(String, String)>,
}

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    if let Err(error) = forbid_core_dumps() {
        say(format_args!("warning: a core dump could hold secrets: {error}"));
    }
    let mut overrides = std::mem::take(&mut arguments.set);
    if let Some(format) = &arguments.log_format {
        overrides.push(("log.format".to_owned(), format.clone()));
    }
    let sources = Sources::of_process(arguments.config, overrides);
    let (instance, fault) = match environment::parsed::<InstanceName>("BLAZE_INSTANCE") {
        Ok(instance) => (instance.unwrap_or_else(InstanceName::first), None),
        Err(fault) => (InstanceName::first(), Some(fault)),
    };
    let loaded = match load_or_say(&sources, &schema(true), fault) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.check {
        return ExitCode::SUCCESS;
    }
    block_on(NAME, run(sources.pinned(), loaded, instance))
}

/// The node file as this program reads it. A password file is looked at only `at_start`: later it
/// may be about to be replaced, which says nothing against what else has changed.
fn schema(at_start: bool) -> Schema<NodeFile> {
    node_schema(move |file| {
        let mut faults = WorkerSettings::of(file).err().unwrap_or_default();
        #[cfg(feature = "mongodb")]
        if let Some(DatabaseSection::MongoDb(section)) = &file.database
            && let Err(detail) = blaze_worker::copy::check_uri(section)
        {
            faults.push(Fault { path: "database.mongodb.uri".to_owned(), detail });
        }
        if at_start
            && let Some(DatabaseSection::MongoDb(section)) = &file.database
            && let Some(Err(detail)) = section.password_file.as_deref().map(read_password)
        {
            faults.push(Fault { path: "database.mongodb.password_file".to_owned(), detail });
        }
        let key = Vault::load(file.worker.key_file.as_deref());
        faults.extend(key.err().map(|error| Fault {
            path: "worker.key_file".to_owned(),
            detail: error.to_string().trim_start_matches("worker.key_file: ").to_owned(),
        }));
        faults
    })
}

async fn run(sources: Sources, loaded: Loaded<NodeFile>, instance: InstanceName) -> ExitCode {
    let supervisor = Supervisor::new(NAME);
    match start(&supervisor, sources, loaded, instance).await {
        Ok((worker, readiness)) => {
            let steps = ShutdownSteps::new(SHUTDOWN)
                .on(ShutdownPhase::NotReady, "readiness", async move { readiness.stop() })
                .on(ShutdownPhase::Drain, "worker", async move { worker.drain().await });
            supervisor.run(steps).await
        }
        Err(error) => failed(NAME, format_args!("{error:#}")),
    }
}

async fn start(
    supervisor: &Supervisor,
    sources: Sources,
    loaded: Loaded<NodeFile>,
    instance: InstanceName,
) -> anyhow::Result<(Arc<RunningWorker>, Readiness)> {
    let file = &loaded.value;
    let format = if file.log.format.as_str() == "json" { LogFormat::Json } else { LogFormat::Text };
    let log = logs::init(file.log.level.as_str(), format)?;
    let settings = WorkerSettings::of(file).map_err(|faults| {
        let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
        anyhow::anyhow!(lines.join("; "))
    })?;
    let (readiness, shown) = (Readiness::new(), Shown::default());
    let address =
        shown.serve(file.admin.worker, settings.scope(), readiness.clone(), supervisor).await?;
    say_listening(address);
    let worker = Arc::new(begin(settings, file, instance, supervisor).await?);
    shown.set(Arc::clone(&worker));
    let overlays = worker.own().overlays();
    let told =
        watch_with(supervisor, sources, schema(false), loaded, WatchSettings::default(), overlays);
    let follow = follow_node_file(Arc::clone(&worker), told, log, readiness.clone());
    supervisor.spawn("reload", TaskPolicy::Essential, follow);
    let stop = supervisor.stopping_token();
    supervisor.spawn("ready line", TaskPolicy::MayEnd, async move {
        tokio::select! {
            // Without a reader of stdout there is nobody to tell.
            () = shown.begun() => drop(ready_line(&[("admin", address)])),
            () = stop.cancelled() => {}
        }
    });
    Ok((worker, readiness))
}

async fn begin(
    settings: WorkerSettings,
    file: &NodeFile,
    instance: InstanceName,
    supervisor: &Supervisor,
) -> anyhow::Result<RunningWorker> {
    let broker: Arc<dyn Broker> = match &settings.broker {
        LocalBroker::Node(NodeBroker::Memory) | LocalBroker::Layer(LayerBroker::Memory) => {
            Arc::new(MemoryHub::new(settings.site.layer.to_string()).broker())
        }
        LocalBroker::Node(section) => open_node(section, &Role::Worker).context("brokers.node")?,
        LocalBroker::Layer(section) => {
            open_layer(section, &Role::Worker).context("brokers.layer")?
        }
    };
    let keys = settings.keys.as_ref().map(RedisKeys::open).transpose();
    let keys = keys.context("cache")?.map(Arc::new);
    let directory = state::state_directory(file.state_dir.as_deref())?;
    let life: u32 = rand::random();
    let worker_id = format!("{}-{life:08x}", settings.node);
    let lease = lease::open(&settings, keys.as_ref(), &worker_id)?;
    let options = WorkerOptions {
        folder: Some(settings.copy_folder(&directory.path)),
        settings,
        broker,
        keys,
        lease,
        worker_id,
        instance,
    };
    RunningWorker::start(options, supervisor).await
}

/// What the worker reads of the file, and what of it changes while it runs.
const KEYS: Keys = Keys {
    read: &[
        "layer",
        "node",
        "brokers.node",
        "brokers.layer",
        "admin.worker",
        "cache",
        "config",
        "database",
        "log",
        "state_dir",
        "worker",
    ],
    live: &[
        "config.server",
        "config.ca_file",
        "config.token_file",
        "config.cert_file",
        "config.key_file",
        "log.level",
    ],
};

/// Takes over what may change while the process runs; what is faulty changes nothing and shows on
/// `/readyz`.
async fn follow_node_file(
    worker: Arc<RunningWorker>,
    told: tokio::sync::watch::Receiver<Current<NodeFile>>,
    log: LogHandle,
    readiness: Readiness,
) {
    let follower = Follower { told, readiness, keys: KEYS, needs_restart };
    let take = |loaded: &Loaded<NodeFile>| {
        if let Ok(WorkerSettings { main: Some(main), .. }) = WorkerSettings::of(&loaded.value) {
            worker.set_main(main);
        }
        if let Err(error) = log.set_level(loaded.value.log.level.as_str()) {
            tracing::error!(%error, "log.level");
        }
    };
    follow(follower, take, |verdict, besides| worker.own().judged(verdict, besides)).await;
}

/// Whether a file differs from the one of the start in more than what changes while the process
/// runs.
fn needs_restart(started: &NodeFile, file: &NodeFile) -> bool {
    let (Ok(mut before), Ok(mut after)) = (WorkerSettings::of(started), WorkerSettings::of(file))
    else {
        return true;
    };
    if before.main.is_some() && after.main.is_some() {
        (before.main, after.main) = (None, None);
    }
    before != after
        || started.admin.worker != file.admin.worker
        || started.state_dir != file.state_dir
        || started.log.format != file.log.format
}
