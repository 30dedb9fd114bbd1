//! A monitor put together: what it starts, and what its parts share.
//!
//! ```text
//! kernel ─▶ Sampler ─┐                     ┌─▶ /v1/…, /metrics
//! flows, worker ─────┼─▶ Shared ─▶ Health ─┼─▶ log, history
//! broker: pings, signs of life, messages ──┘ └─▶ status stream
//! ```

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_brokers::Broker;
use blaze_brokers::redis::RedisKeys;
use blaze_domain::config::ServiceState;
use blaze_domain::node_file::NodeFile;
use blaze_domain::{FlowId, Scope, ServiceName};
use blaze_runtime::config::Keys;
use blaze_runtime::main_service::MainService;
use blaze_runtime::{CheckStatus, Gate, Readiness, Supervisor, TaskPolicy};
use blaze_sdk::{MetricsEndpoint, ProgramConfig, SdkError, ServiceManager, ServiceOptions};
use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

use crate::admin;
use crate::health::Health;
use crate::latency::Latency;
use crate::limits::HISTORY_STEP;
use crate::look;
use crate::node::{Roots, Sampler};
use crate::pings::{self, Pings};
use crate::report::{Reporter, report};
use crate::services::{Signs, read_messages, read_records};
use crate::settings::{LiveSettings, identity};
use crate::shared::{Shared, moment};
use crate::subscriber::{Meter, Subscribed};

/// The name under which monitors have their configuration.
const NAME: &str = "blaze-monitor";
/// How long the end waits for the sign of life to be taken away.
const LEAVE_WITHIN: Duration = Duration::from_secs(1);

/// What the monitor reads of the file, and what of it changes while it runs.
pub const KEYS: Keys = Keys {
    read: &[
        "layer",
        "node",
        "brokers.node",
        "brokers.layer",
        "admin",
        "cache",
        "config",
        "log",
        "monitor",
    ],
    live: &["admin.flow", "admin.worker", "config", "log.level", "monitor"],
};

/// Whether a file differs from the one of the start in more than what changes while it runs.
#[must_use]
pub fn needs_restart(started: &NodeFile, file: &NodeFile) -> bool {
    started.layer != file.layer
        || started.node != file.node
        || started.brokers.node != file.brokers.node
        || started.brokers.layer != file.brokers.layer
        || started.cache_redis() != file.cache_redis()
        || started.admin.monitor != file.admin.monitor
        || started.log.format != file.log.format
}

/// What a monitor is made of.
pub struct MonitorOptions {
    /// The node file.
    pub file: NodeFile,
    /// Where the kernel's files are.
    pub roots: Roots,
    /// The broker that services of the node are on, and its scope; `None`: pings, signs of life
    /// and messages are left out.
    pub broker: Option<(Scope, Arc<dyn Broker>)>,
}

/// A monitor that runs until its supervisor ends.
pub struct RunningMonitor {
    shared: Arc<Shared>,
    admin: SocketAddr,
    main: watch::Sender<Option<MainService>>,
    service: Mutex<Option<Arc<ServiceManager>>>,
}

impl RunningMonitor {
    /// Starts it. It waits for nobody.
    ///
    /// # Errors
    /// A port, a name or a broker that it cannot work with.
    pub async fn start(options: MonitorOptions, supervisor: &Supervisor) -> anyhow::Result<Self> {
        let MonitorOptions { file, roots, broker } = options;
        let me = identity(&file).map_err(|faults| {
            let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
            anyhow::anyhow!(lines.join("; "))
        })?;
        let shared = Arc::new(shared(&me, &file)?);
        shared.readiness.add("node_values", Gate::Decides, CheckStatus::Failed, "not read yet");
        shared.readiness.add("config", Gate::Shows, CheckStatus::Ok, "");
        let admin = admin::serve(&shared, file.admin.monitor, supervisor).await?;
        shared.set_admin(admin);
        let sampler = Sampler::new(&roots, sample_period(&shared));
        let sampling = sample(Arc::clone(&shared), sampler);
        spawn(supervisor, "node values", sampling);
        spawn(supervisor, "history", keep_history(Arc::clone(&shared)));
        spawn(supervisor, "flows and worker", look::run(Arc::clone(&shared)));
        let reporter = Reporter {
            me: me.clone(),
            epoch: shared.epoch,
            metrics_address: metrics_address(admin, &file),
        };
        let main = watch::Sender::new(shared.live().main.clone());
        let (of_main, changed) = (main.subscribe(), shared.health_changes());
        let state = Arc::clone(&shared.report);
        spawn(
            supervisor,
            "status stream",
            report(reporter, Arc::clone(&shared) as _, state, of_main, changed),
        );
        let service = match broker {
            None => None,
            Some((scope, broker)) => {
                let service = on_broker(&shared, &file, scope, broker, supervisor).await?;
                Some(service)
            }
        };
        Ok(Self { shared, admin, main, service: Mutex::new(service) })
    }

    /// Where it is asked.
    #[must_use]
    pub fn admin(&self) -> SocketAddr {
        self.admin
    }

    /// Its checks.
    #[must_use]
    pub fn readiness(&self) -> &Readiness {
        &self.shared.readiness
    }

    /// What BlazeConfig says; `None`: it is on no broker.
    #[must_use]
    pub fn program(&self) -> Option<ProgramConfig> {
        self.service.lock().as_ref().map(|service| service.program_config())
    }

    /// Takes over what may change while it runs.
    pub fn reload(&self, file: &NodeFile) {
        let live = LiveSettings::of(file);
        self.shared.health.lock().set_thresholds(live.section.thresholds);
        self.shared.latency.lock().set_rules(live.section.latency.clone());
        if live.section.ping_period_s != self.shared.live().section.ping_period_s {
            let period = Duration::from_secs_f64(live.section.ping_period_s);
            self.shared.pings.with(|engine, now| engine.set_period(now, period));
        }
        self.main.send_if_modified(|main| {
            let is_other = *main != live.main;
            main.clone_from(&live.main);
            is_other
        });
        self.shared.set_live(live);
    }

    /// Takes the sign of life away.
    pub async fn stop(&self) {
        let service = self.service.lock().take();
        let Some(service) = service else { return };
        service.cache().set_state(ServiceState::Stopping);
        // Tasks that hold it end with the supervisor; what they leased lapses.
        if let Some(service) = Arc::into_inner(service) {
            let _ = tokio::time::timeout(LEAVE_WITHIN, service.shutdown()).await;
        }
    }
}

fn shared(me: &FlowId, file: &NodeFile) -> anyhow::Result<Shared> {
    let live = LiveSettings::of(file);
    let period = Duration::from_secs_f64(live.section.ping_period_s);
    let health = Health::new(me.clone(), live.section.thresholds, moment());
    let latency = Latency::new(live.section.latency.clone())?;
    let pings = Pings::new(me.clone(), period);
    Ok(Shared::new(me.clone(), live, health, latency, pings))
}

fn sample_period(shared: &Shared) -> Duration {
    Duration::from_secs_f64(shared.live().section.sample_period_s)
}

/// Other machines scrape there; empty on loopback. A port on all addresses is named by the host.
fn metrics_address(admin: SocketAddr, file: &NodeFile) -> String {
    if admin.ip().is_loopback() {
        return String::new();
    }
    if !admin.ip().is_unspecified() {
        return admin.to_string();
    }
    let interface = file.brokers.inter.as_ref().map(|inter| inter.listen);
    match interface.filter(|ip| !ip.is_unspecified()) {
        Some(ip) => SocketAddr::new(ip.into(), admin.port()).to_string(),
        None => {
            let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
            format!("{host}:{}", admin.port())
        }
    }
}

fn spawn(supervisor: &Supervisor, name: &str, task: impl Future<Output = ()> + Send + 'static) {
    let stop = supervisor.shutdown_token();
    supervisor.spawn(name, TaskPolicy::Essential, async move {
        tokio::select! {
            () = task => {}
            () = stop.cancelled() => {}
        }
    });
}

async fn sample(shared: Arc<Shared>, sampler: Sampler) {
    let mut live = shared.live_changes();
    let mut period = sample_period(&shared);
    let mut is_first = true;
    loop {
        let began = Instant::now();
        let sample = sampler.sample(began);
        shared.set_sample(sample, began.elapsed());
        if std::mem::replace(&mut is_first, false) {
            shared.readiness.set("node_values", CheckStatus::Ok, "");
        }
        tokio::select! {
            () = tokio::time::sleep(period.saturating_sub(began.elapsed())) => {}
            Ok(()) = live.changed() => {
                period = sample_period(&shared);
                sampler.set_period(period);
            }
        }
    }
}

async fn keep_history(shared: Arc<Shared>) {
    let mut steps = tokio::time::interval(HISTORY_STEP);
    steps.set_missed_tick_behavior(MissedTickBehavior::Delay);
    steps.tick().await;
    loop {
        steps.tick().await;
        shared.keep_history(SystemTime::now());
    }
}

/// Makes the monitor a service on its broker, and starts what works there.
async fn on_broker(
    shared: &Arc<Shared>,
    file: &NodeFile,
    scope: Scope,
    broker: Arc<dyn Broker>,
    supervisor: &Supervisor,
) -> anyhow::Result<Arc<ServiceManager>> {
    let name: ServiceName = NAME.parse()?;
    let options = ServiceOptions {
        // Its own page has all that a page of the SDK would have.
        metrics: MetricsEndpoint::Off,
        pool_threads: 2,
        epoch: shared.epoch,
        supervisor: Some(supervisor.clone()),
        cache: file.cache_redis().cloned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ..ServiceOptions::new(shared.me.layer.clone(), name, Arc::clone(&broker), scope)
            .on_node(shared.me.node.clone())
    };
    let service = match ServiceManager::start(options.clone()).await {
        Err(SdkError::Cache(error)) => {
            tracing::error!(%error, "cache.redis cannot be used: the sign of life goes as messages");
            ServiceManager::start(ServiceOptions { cache: None, ..options }).await?
        }
        started => started?,
    };
    service.cache().set_state(ServiceState::Ready);
    let service = Arc::new(service);
    let (broker_of, flow_of) = (service.broker().clone(), service.flow().clone());
    spawn(
        supervisor,
        "pings",
        pings::run(Arc::clone(&shared.pings), broker_of.clone(), flow_of.clone()),
    );
    let node = shared.me.node.clone();
    let signs: Arc<Signs> = Arc::clone(&shared.signs);
    match file.cache_redis().map(RedisKeys::open).transpose() {
        Ok(Some(keys)) => spawn(supervisor, "signs of life", read_records(keys, node, signs)),
        Ok(None) => spawn(supervisor, "signs of life", read_messages(broker, node, signs)),
        Err(error) => {
            tracing::error!(%error, "cache.redis cannot be used: signs of life are read as messages");
            spawn(supervisor, "signs of life", read_messages(broker, node, signs));
        }
    }
    let meter = Meter {
        own: shared.me.clone(),
        latency: Arc::clone(&shared.latency),
        pings: Arc::clone(&shared.pings),
    };
    let shared = Arc::clone(shared);
    spawn(supervisor, "latency", async move {
        let mut subscribed = Subscribed::default();
        let mut looks = shared.looks();
        loop {
            let rules = shared.live().section.latency.clone();
            let known: BTreeSet<_> = shared.known_topics();
            subscribed.follow(&rules, known, (&broker_of, &flow_of), &meter);
            tokio::select! {
                changed = looks.changed() => {
                    if changed.is_err() {
                        return;
                    }
                }
                () = subscribed.ended() => {}
            }
        }
    });
    Ok(service)
}
