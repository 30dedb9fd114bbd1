//! One BlazeFlow process, or one of several in a process: tasks, threads, brokers and the link
//! around the pure cores.
//!
//! | who | what | how many |
//! |---|---|---|
//! | control task | control channels, link news → control core → answers, plans | 1 |
//! | scope task | health of a local broker, the leases that it keeps → control core | per local scope |
//! | network task | endpoints of a ROS 2 network → control core | 1 where there is one |
//! | calls task | replies of servers on a ROS 2 network → JSON for calls → message path | 1 where there is one |
//! | types tasks | definitions of ROS 2 types from nodes and other flows, and for those | 8 |
//! | peers task | who else uses the layer broker, and what they say | 1 where there is one |
//! | source task | one topic of one local scope → message path | per topic and scope that is read |
//! | inter thread | joins and leaves the inter scope, as the control core wants | 1 where there is one |
//! | pacer thread | link engine → transport, within the budget | 1 |
//! | transport threads | transport → link engine → message path → brokers | 3 readers and DDS's own |
//! | codec threads | a payload from the message path → LZ4, or JSON or CDR → message path | as many as processors |
//! | codec task | ends these with the process | 1 |
//! | service | its configuration from BlazeConfig, its sign of life: `service.rs` | 1 where it is one |
//! | admin task | `/livez`, `/readyz`, `/metrics`, `/v1/…` | 1 and one per connection |

mod admin;
mod allocation;
mod calls;
mod control_task;
mod definitions;
mod epochs;
mod health;
mod inter;
mod metrics;
pub mod node_file;
pub mod pacing;
mod peers_task;
pub mod plane;
pub mod ros2;
mod routes;
mod scope_task;
pub mod service;
pub mod settings;
mod why;

use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use blaze_brokers::{Broker, BrokerKind};
use blaze_domain::node_file::Ros2Plugin;
use blaze_domain::{FlowId, Priority, Scope};
use blaze_proto::link::link_control::{Egress as SaidEgress, LayerScope};
use blaze_runtime::admin::{AdminServer, CheckStatus, Readiness};
use blaze_runtime::supervisor::{Supervisor, TaskHandle, TaskPolicy};
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

use crate::codec::pool::{self, Spawner};
use crate::control::{ControlConfig, ControlCore};
use crate::lane::core::{DataConfig, DataCore};
use crate::limit::limiter::Limiter;
use crate::link::{Engine, EngineConfig, Limits, NameConflict};
use crate::registry::{LayerNames, peers_channel};
use crate::types::{Types, built_in_for};
use crate::world::LayerScopeId;
use control_task::Leave;
use definitions::Definitions;
pub use epochs::Epochs;
use health::{readiness, watch_health};
use inter::InterScope;
use pacing::Egress;
use peers_task::PeersTask;
use plane::{Plane, wall_ms, wall_ns};
use ros2::Ros2Scope;
pub use routes::LocalBrokers;
use routes::Routes;
use scope_task::ScopeTask;
use settings::{FlowSettings, LiveSettings};

/// The layer broker of a flow, and who shares it.
#[derive(Clone)]
pub struct LayerBroker {
    /// The broker.
    pub broker: Arc<dyn Broker>,
    /// Flows of the layer with an equal identity share it.
    pub id: LayerScopeId,
}

/// What a flow is started with.
pub struct FlowOptions {
    /// From the node file.
    pub settings: FlowSettings,
    /// Broker of the node scope.
    pub node: Option<Arc<dyn Broker>>,
    /// Broker of the layer scope.
    pub layer: Option<LayerBroker>,
    /// Where [`start`] keeps the epoch; `None`: the clock alone gives it.
    pub state_dir: Option<PathBuf>,
}

/// What the parts of one flow share.
pub(crate) struct Shared {
    pub(crate) me: FlowId,
    /// What Hello says of the layer broker while this flow may use it.
    pub(crate) layer_scope: (LayerScope, u64),
    /// Changes when the transport is rebuilt.
    pub(crate) epoch: AtomicU64,
    pub(crate) plane: Arc<Plane>,
    pub(crate) control: Mutex<ControlCore>,
    pub(crate) routes: Routes,
    pub(crate) brokers: LocalBrokers,
    pub(crate) inter: Option<InterScope>,
    pub(crate) ros2: Option<Ros2Scope>,
    pub(crate) egress: Arc<Egress>,
    pub(crate) limiter: Mutex<Limiter>,
    /// ROS 2 types, for conversions.
    pub(crate) types: Arc<Types>,
    /// Definitions that other flows are asked for, and ask for.
    pub(crate) definitions: Definitions,
    pub(crate) live: Mutex<LiveSettings>,
    pub(crate) readiness: Readiness,
    /// Whether the control channels of node and layer are read.
    pub(crate) hears: [AtomicBool; 2],
    /// When the flow started, in seconds since 1970.
    pub(crate) started_s: f64,
}

impl Shared {
    /// Whether control messages of a scope are heard.
    pub(crate) fn hears(&self, scope: Scope) -> bool {
        self.hears[usize::from(scope == Scope::Layer)].load(Ordering::Relaxed)
    }

    /// Names of flows that several programs have: on the inter scope, or on the layer broker.
    fn name_conflicts(&self) -> Vec<NameConflict> {
        let mut conflicts = self.inter.as_ref().map_or_else(Vec::new, InterScope::name_conflicts);
        if !conflicts.iter().any(|conflict| conflict.flow == self.me) {
            conflicts.extend(self.control.lock().namesake(Instant::now()));
        }
        conflicts
    }

    /// Tells the link what its Hellos say of this flow's traffic, and the wall clock, which may
    /// have been set.
    fn tell_link(&self) {
        let now = Instant::now();
        let limit = self.egress.budget() as u64;
        let demand = self.control.lock().load().out_bytes_per_s;
        self.plane.read(|state| {
            if let Some(engine) = &mut state.engine {
                engine.set_wall_clock(now, wall_ns());
                engine.set_egress(SaidEgress {
                    demand_bytes_per_s: demand,
                    limit_bytes_per_s: limit,
                });
            }
        });
    }
}

/// A flow that runs.
pub struct RunningFlow {
    shared: Arc<Shared>,
    supervisor: Supervisor,
    admin: SocketAddr,
    leave: Leave,
    pacer: Option<TaskHandle>,
    control: TaskHandle,
}

/// How long a flow takes at most to let out what is queued.
const DRAIN: Duration = Duration::from_millis(600);
/// How long its good-bye may take to leave.
const GOODBYE: Duration = Duration::from_millis(100);

/// How long brokers may take to deliver what they have taken when the flow ends.
const CLOSE: Duration = Duration::from_millis(1500);

/// What is known of a flow before its brokers are opened.
#[derive(Debug, Clone)]
pub struct Beginning {
    /// The flow's lives; its brokers know it by the first epoch.
    pub epochs: Epochs,
    /// What the layer broker puts before every name.
    pub layer_prefix: String,
}

/// Starts a flow whose brokers need to know nothing of it, as those within a process. It returns as
/// soon as the admin port listens; [`RunningFlow::ready`] waits for the rest.
///
/// # Errors
/// As [`start_with`].
pub async fn start(options: FlowOptions, supervisor: Supervisor) -> anyhow::Result<RunningFlow> {
    let epochs = Epochs::begin(&options.settings.me, options.state_dir.as_deref());
    let beginning = Beginning { epochs, layer_prefix: String::new() };
    start_with(options, beginning, supervisor).await
}

/// Starts a flow whose brokers were opened for the life that has begun; its `state_dir` was used
/// for that already.
///
/// # Errors
/// When the admin port cannot be bound or the inter scope's configuration can never work.
pub async fn start_with(
    options: FlowOptions,
    beginning: Beginning,
    supervisor: Supervisor,
) -> anyhow::Result<RunningFlow> {
    let FlowOptions { settings, node, layer, .. } = options;
    let Beginning { epochs, layer_prefix } = beginning;
    let (epoch, doubt) = (epochs.first(), epochs.doubt().map(str::to_owned));
    let now = Instant::now();
    let layer_scope = layer.as_ref().map(|layer| layer.id);
    let said_layer_scope = said_layer_scope(layer.as_ref());
    let layer_kind = layer.as_ref().map(|layer| layer.broker.kind());

    let (definitions, wishes) = Definitions::new();
    let types = Arc::new(types_of(settings.ros2.as_ref()).asking(definitions.wishes()));
    let mut core = DataCore::new(DataConfig {
        me: settings.me.clone(),
        epoch,
        large_bytes: settings.live.bandwidth.large_bytes.into(),
        salt: rand::random(),
    });
    core.set_types(Arc::clone(&types));
    let engine = settings.inter.as_ref().map(|inter| {
        let config = EngineConfig {
            me: settings.me.clone(),
            kind: settings.kind,
            epoch,
            layer_scope: said_layer_scope,
            max_datagram: inter.wire().max_datagram_bytes(),
            limits: Limits::default(),
        };
        Engine::new(config, now, wall_ns())
    });
    let plane = Plane::new(core, engine);
    let ros2 =
        settings.ros2.as_ref().map(|plugin| Ros2Scope::open(&settings.me, plugin)).transpose()?;
    let brokers = LocalBrokers {
        node,
        layer: layer.map(|layer| layer.broker),
        ros2: ros2.as_ref().map(|ros2| Arc::clone(&ros2.broker) as _),
    };
    let config = ControlConfig {
        me: settings.me.clone(),
        kind: settings.kind,
        epoch,
        node_scope: brokers.node.is_some(),
        layer_scope,
        // Within a process flows hear each other over the link alone.
        replicas: matches!(layer_kind, Some(BrokerKind::Kafka | BrokerKind::Dds))
            .then_some(said_layer_scope.0),
        gateway: settings.gateway,
        inter_scope: settings.inter.is_some(),
        // Channels there are set up beforehand, so all answers share one.
        layer_answers_need_id: matches!(layer_kind, Some(BrokerKind::Kafka | BrokerKind::Dds)),
        layer_names: match layer_kind {
            Some(BrokerKind::Kafka) => LayerNames::Kafka { prefix: layer_prefix },
            _ => LayerNames::Any,
        },
        lease_stores: brokers.lease_stores(),
        rules: settings.live.rules.clone(),
        access: settings.live.access.clone(),
    };
    let inter = settings
        .inter
        .map(|inter| InterScope::new(inter, settings.me.clone(), epochs, Arc::clone(&plane)));
    if let Some(inter) = inter.as_ref().filter(|_| config.begins_inside()) {
        inter.join()?;
    }
    let control = ControlCore::new(config, now);
    let limit = settings.live.bandwidth.limit_bytes_per_s();
    let egress = Egress::new(limit, inter.as_ref().map(InterScope::wire));
    let readiness = readiness(&brokers, inter.is_some());
    let in_doubt = doubt.is_some();
    if let Some(doubt) = doubt {
        readiness.set(
            "epoch",
            CheckStatus::Failed,
            format!("the clock is behind the last start, and that cannot be kept: {doubt}"),
        );
    }
    let shared = Arc::new(Shared {
        me: settings.me.clone(),
        layer_scope: said_layer_scope,
        epoch: AtomicU64::new(epoch),
        routes: Routes::new(Arc::clone(&plane), brokers.clone(), supervisor.clone()),
        plane,
        control: Mutex::new(control),
        brokers,
        inter,
        ros2,
        egress,
        limiter: Mutex::new(Limiter::new(settings.live.bandwidth.clone())),
        types,
        definitions,
        live: Mutex::new(settings.live),
        readiness: readiness.clone(),
        hears: Default::default(),
        started_s: wall_ns() as f64 / 1e9,
    });

    let live = shared.live.lock().clone();
    shared.set_bandwidth(now, &live.bandwidth);
    shared.plane.read(|state| state.core.set_compression(live.compression.clone()));
    start_pool(&shared.plane, live.pool_threads, &supervisor)?;
    let metrics_of = Arc::clone(&shared);
    let admin = AdminServer::bind(
        settings.admin,
        admin::router(Arc::clone(&shared)),
        readiness,
        Arc::new(move || metrics::render(&metrics_of)),
    )
    .await?;
    let address = admin.address();
    admin.serve(&supervisor);

    let ready = Arc::new(Notify::new());
    let leave = Leave::default();
    let task = control_task::ControlTask {
        shared: Arc::clone(&shared),
        ready: Arc::clone(&ready),
        was_ready: false,
        writers: HashMap::new(),
        leave: leave.clone(),
        measured: now,
    };
    let control = supervisor.spawn("control", TaskPolicy::MayEnd, task.run());
    watch_brokers(&shared, &supervisor, epoch);
    let search = definitions::run(Arc::clone(&shared), wishes, supervisor.shutdown_token());
    supervisor.spawn("types", TaskPolicy::Essential, search);
    if shared.ros2.is_some() {
        let follow = ros2::follow_network(Arc::clone(&shared), supervisor.shutdown_token());
        supervisor.spawn("network", TaskPolicy::Essential, follow);
        let answer = calls::answer_calls(Arc::clone(&shared), supervisor.shutdown_token());
        supervisor.spawn("calls", TaskPolicy::Essential, answer);
    }
    supervisor.spawn(
        "health",
        TaskPolicy::Essential,
        watch_health(Arc::clone(&shared), ready, in_doubt, supervisor.shutdown_token()),
    );
    let pacer = match shared.inter.is_some() {
        true => Some(start_inter(&shared, &supervisor)?),
        false => None,
    };
    Ok(RunningFlow { shared, supervisor, admin: address, leave, pacer, control })
}

impl RunningFlow {
    /// The admin port that was bound.
    #[must_use]
    pub fn admin(&self) -> SocketAddr {
        self.admin
    }

    /// Layer and node.
    #[must_use]
    pub fn id(&self) -> &FlowId {
        &self.shared.me
    }

    /// Waits until all checks of `/readyz` are well.
    pub async fn ready(&self) {
        self.shared.readiness.ready().await;
    }

    /// Whether all checks of `/readyz` are well.
    #[must_use]
    pub fn readiness(&self) -> &Readiness {
        &self.shared.readiness
    }

    /// Takes new limits and rules.
    pub fn reload(&self, live: LiveSettings) {
        let now = Instant::now();
        self.shared.set_bandwidth(now, &live.bandwidth);
        self.shared.plane.read(|state| state.core.set_compression(live.compression.clone()));
        if let Some(pool) = self.shared.plane.codec()
            && let Err(error) = pool.resize(pool::threads(live.pool_threads))
        {
            tracing::warn!(%error, "the compression pool keeps the threads that it has");
        }
        {
            let mut control = self.shared.control.lock();
            control.set_rules(now, live.rules.clone());
            control.set_access(now, wall_ms(), live.access.clone());
        }
        if let (Some(ros2), Some(rules)) = (&self.shared.ros2, &live.ros2) {
            ros2.set_rules(rules);
        }
        let folders = live.ros2.as_ref().map(|ros2| ros2.interfaces.clone());
        self.shared.types.set_folders(folders.unwrap_or_default());
        *self.shared.live.lock() = live;
    }

    /// Takes in nothing more, lets out what is queued and says good-bye. The admin port stays.
    pub async fn drain(&self) {
        let shared = &self.shared;
        shared.readiness.stop();
        shared.plane.with(|state| state.core.leave(Instant::now()));
        self.leave.draining.cancel();
        let until = Instant::now() + DRAIN;
        // Nothing is planned any more, and whoever comes next knows where to begin: only then are
        // the bridges draining.
        let _ = tokio::time::timeout(DRAIN, self.leave.handed_over.cancelled()).await;
        while Instant::now() < until && shared.plane.is_draining() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        // With the good-bye others take the topics over: what they write must not be overtaken by
        // what still waits for a broker here.
        while Instant::now() < until + CLOSE && shared.plane.has_unwritten() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        shared.plane.say_goodbye();
        self.leave.gone.cancel();
        let _ = tokio::time::timeout(DRAIN, self.control.finished()).await;
        if let Some(inter) = &shared.inter {
            inter.stop();
            if inter.is_joined() {
                tokio::time::sleep(GOODBYE).await;
            }
        }
        shared.routes.stop();
        let brokers = Scope::LOCAL.map(|scope| shared.brokers.of(scope));
        let closed_by = tokio::time::Instant::now() + CLOSE;
        for broker in brokers.into_iter().flatten() {
            if tokio::time::timeout_at(closed_by, broker.close()).await.is_err() {
                tracing::warn!(
                    broker = %broker.kind(),
                    "the broker did not take everything in time",
                );
            }
        }
        shared.egress.stop();
        shared.plane.stop_compression();
        shared.plane.wake();
        if let Some(pacer) = &self.pacer {
            pacer.finished().await;
        }
    }

    /// Drains and ends all tasks.
    pub async fn shutdown(self) {
        self.drain().await;
        self.supervisor.shutdown(Duration::from_secs(1)).await;
    }
}

/// The types that are built in for the release of the node file, and its folders.
fn types_of(ros2: Option<&Ros2Plugin>) -> Types {
    ros2.map_or_else(Types::default, |plugin| {
        Types::new(built_in_for(plugin.distro), plugin.live.interfaces.clone())
    })
}

/// Starts the threads that compress and convert. They end when the flow has drained, or with the
/// process if it does not.
fn start_pool(plane: &Arc<Plane>, threads: u16, supervisor: &Supervisor) -> anyhow::Result<()> {
    let of_threads = supervisor.clone();
    let spawner: Spawner = Box::new(move |name, run| {
        let started = of_threads.spawn_thread(name, TaskPolicy::MayEnd, run);
        started.map(|_| ())
    });
    plane
        .compress_with(pool::threads(threads), spawner)
        .context("starting the compression pool")?;
    let (plane, shutdown) = (Arc::downgrade(plane), supervisor.shutdown_token());
    let stop = async move {
        shutdown.cancelled().await;
        if let Some(plane) = plane.upgrade() {
            plane.stop_compression();
        }
    };
    supervisor.spawn("codec", TaskPolicy::MayEnd, stop);
    Ok(())
}

/// Starts the threads of the inter scope; gives that of the pacer.
fn start_inter(shared: &Arc<Shared>, supervisor: &Supervisor) -> anyhow::Result<TaskHandle> {
    let of_inter = Arc::clone(shared);
    supervisor.spawn_thread("inter", TaskPolicy::MayEnd, move || {
        if let Some(inter) = &of_inter.inter {
            inter.run();
        }
    })?;
    let sends = Arc::downgrade(shared);
    shared.plane.send_by(Box::new(move |plane| {
        sends.upgrade().is_some_and(|shared| {
            let inter = shared.inter.as_ref();
            inter.is_some_and(|inter| shared.egress.send_at_once(plane, inter))
        })
    }));
    let shared = Arc::clone(shared);
    let run = move || {
        if let Some(inter) = &shared.inter {
            shared.egress.run(&shared.plane, inter);
        }
    };
    Ok(supervisor.spawn_thread("pacer", TaskPolicy::MayEnd, run)?)
}

/// Starts what follows the local brokers.
fn watch_brokers(shared: &Arc<Shared>, supervisor: &Supervisor, epoch: u64) {
    for scope in Scope::LOCAL {
        let Some(broker) = shared.brokers.of(scope) else {
            continue;
        };
        let shares =
            scope == Scope::Layer && matches!(broker.kind(), BrokerKind::Kafka | BrokerKind::Dds);
        let (tell, listened) = watch::channel(true);
        if let (true, Some(channel)) = (shares, peers_channel()) {
            let side = broker.flow_side();
            // Leases are read when it is known whose the broker is.
            tell.send_replace(side.is_none());
            let peers = PeersTask {
                broker: Arc::clone(broker),
                side,
                channel,
                shared: Arc::clone(shared),
                began: epoch,
                listened: tell,
                stop: supervisor.shutdown_token(),
            };
            supervisor.spawn("peers", TaskPolicy::Essential, peers.run());
        }
        let task = ScopeTask {
            shared: Arc::clone(shared),
            scope,
            broker: Arc::clone(broker),
            listened,
            stop: supervisor.shutdown_token(),
        };
        supervisor.spawn(format!("scope {scope}"), TaskPolicy::Essential, task.run());
    }
}

/// What Hello says of the layer broker. One that only this process sees is none to others, and has
/// an identity all the same: flows of this process share it.
fn said_layer_scope(layer: Option<&LayerBroker>) -> (LayerScope, u64) {
    let Some(layer) = layer else {
        return (LayerScope::None, 0);
    };
    let kind = match layer.broker.kind() {
        BrokerKind::Kafka => LayerScope::Kafka,
        BrokerKind::Dds | BrokerKind::Ros2 => LayerScope::Dds,
        BrokerKind::Memory | BrokerKind::Redis => LayerScope::None,
    };
    (kind, layer.id.0)
}

/// Classes in the order of [`Priority::ALL`], for labels.
pub(crate) fn class_label(index: usize) -> &'static str {
    Priority::ALL.get(index).map_or("", |class| class.as_str())
}
