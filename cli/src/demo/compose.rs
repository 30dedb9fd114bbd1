//! The nodes of the demo in one process: flows, their brokers, and the services on them.
//!
//! ```text
//! robot-1: node broker ─ flow ─┬─ edge layer broker ─┬─ flow ─ node broker: edge-2
//!                              │                     │
//!                              └── DDS on one interface ──┐
//! fog-1:   node broker ─ flow ─ fog layer broker   ───────┤
//! cloud-1: node broker ─ flow ─ cloud layer broker ───────┘
//! ```

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use blaze_domain::ServiceName;
use blaze_flow::flow::settings::FlowSettings;
use blaze_flow::flow::{Beginning, Epochs, FlowOptions, RunningFlow};
use blaze_runtime::Supervisor;
use blaze_runtime::config::Sources;
use blaze_sdk::{
    Advertise, Lease, PublishOptions, Publisher, Request, ServiceManager, ServiceOptions, SubscribeOptions,
    Subscription,
};
use bytes::Bytes;
use futures::future::join_all;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Mutex;

use super::board::{Board, ConsumerCounts, ConsumerId};
use super::brokers::{BrokerSource, NodeBrokers};
use super::domain_id::{self, DEFAULT_DOMAIN, ReservedDomain};
use super::options::{DemoNode, DemoOptions};
use super::recording::{self, Recording};
use super::report::{Report, Style};
use super::roles::{Consumer, PUBLISHING_NODE, PlayedTopic, consumers, played_topics, scope_of};
use super::session::{self, Script, Stage};
use crate::exit::{CliError, Exit};
use crate::node_file;
use crate::output::Format;

/// How long a node may take to be ready.
const READY_TIMEOUT: Duration = Duration::from_secs(30);

/// Runs the demo.
///
/// # Errors
/// [`CliError::Usage`] for options that make no sense, [`CliError::Failed`] for what could not be started.
pub async fn run(options: DemoOptions, format: Format) -> Result<Exit, CliError> {
    let start = Instant::now();
    options.check()?;
    let style = Style::choose(format)?;
    let supervisor = Supervisor::new("demo");
    // Signals are listened to from here on: an end while nodes start is orderly, too.
    let ends = Ends::new(supervisor.clone())?;
    let outcome = tokio::select! {
        outcome = prepare(&options, supervisor.clone(), start) => outcome,
        reason = ends.wait() => Err(CliError::Failed(reason.unwrap_or_else(|| "stopped before it began".to_owned()))),
    };
    let (system, script) = match outcome {
        Ok(prepared) => prepared,
        Err(error) => {
            supervisor.shutdown(Duration::from_secs(1)).await;
            return Err(error);
        }
    };
    let mut report = Report::new(style, std::io::stdout(), std::io::stderr());
    let board = Arc::clone(&system.board);
    let system = EndableSystem { system, ends };
    let outcome = session::run(&system, &board, script, &mut report).await;
    system.system.shutdown().await;
    supervisor.shutdown(Duration::from_secs(1)).await;
    outcome.map(|summary| if summary.ok { Exit::Done } else { Exit::Failed })
}

/// Starts nodes and publishers while the recordings are read.
async fn prepare(options: &DemoOptions, supervisor: Supervisor, start: Instant) -> Result<(System, Script), CliError> {
    let files = options.record.clone();
    let reading = tokio::task::spawn_blocking(move || match files.as_slice() {
        [] => recording::load_built_in(),
        files => recording::load_all(files),
    });
    let nodes = start_nodes(options, &supervisor).await?;
    let recordings = reading
        .await
        .map_err(|error| CliError::Failed(format!("reading the recordings: {error}")))?
        .map_err(|error| CliError::Failed(error.to_string()))?;
    tell_skipped(&recordings);
    let recordings: Vec<Arc<Recording>> = recordings.into_iter().map(Arc::new).collect();
    let topics = played_topics(recordings.iter().map(Arc::as_ref));
    let names = options.nodes();
    let board = Arc::new(Board::new(topics.clone(), &names, start));
    wait_ready(&nodes).await?;
    let system = System {
        nodes,
        topics: topics.clone(),
        board,
        services: Mutex::default(),
        publishers: Vec::new(),
        _advertised: Vec::new(),
        listeners: Mutex::default(),
    };
    let system = system.with_publishers().await?;
    let script = Script {
        consumers: consumers(&topics, &names),
        nodes: names,
        recordings,
        topics,
        duration: options.duration,
    };
    Ok((system, script))
}

fn tell_skipped(recordings: &[Recording]) {
    for recording in recordings {
        let file = recording.path.display();
        for skipped in &recording.skipped {
            eprintln!("blaze: {file}: {} is not played: {}", skipped.topic, skipped.reason);
        }
        if recording.unusable_messages > 0 {
            eprintln!(
                "blaze: {file}: {} messages cannot be played",
                recording.unusable_messages
            );
        }
    }
}

/// A node that runs.
struct RunningNode {
    node: DemoNode,
    brokers: NodeBrokers,
    flow: RunningFlow,
}

struct Nodes {
    running: Vec<RunningNode>,
    /// Keeps other demos off the domain.
    _domain: Option<ReservedDomain>,
}

async fn start_nodes(options: &DemoOptions, supervisor: &Supervisor) -> Result<Nodes, CliError> {
    let listen = match options.listen {
        Some(IpAddr::V4(address)) => address,
        Some(IpAddr::V6(_)) | None => Ipv4Addr::LOCALHOST,
    };
    if !domain_id::is_local(listen) {
        return Err(CliError::Usage(format!(
            "--listen {listen}: no interface of this host has this address."
        )));
    }
    let reserved = if options.is_complete() {
        domain_id::reserve(listen)
    } else {
        None
    };
    let domain = match &reserved {
        Some(reserved) => reserved.domain,
        None if options.is_complete() => {
            return Err(CliError::Failed(
                "every DDS domain from 20 to 100 is in use on this host".to_owned(),
            ));
        }
        None => DEFAULT_DOMAIN,
    };
    // Settings of all nodes first: a faulty --set is told before anything runs.
    let settings: Vec<(DemoNode, FlowSettings)> = options
        .nodes()
        .into_iter()
        .map(|node| Ok((node, settings_of(node, options, listen, domain)?)))
        .collect::<Result<_, CliError>>()?;
    let mut source = BrokerSource::new(options.brokers)?;
    let mut running = Vec::new();
    for (node, settings) in settings {
        let epochs = Epochs::begin(&settings.me, None)
            .map_err(|error| CliError::Failed(format!("{} has no epoch: {error}", node.name())))?;
        let brokers = source.of(node, &settings.me, epochs.first())?;
        let beginning = Beginning {
            epochs,
            layer_prefix: brokers.layer_prefix.clone(),
        };
        let flow_options = FlowOptions {
            settings,
            node: Some(Arc::clone(&brokers.flow_node)),
            layer: Some(brokers.flow_layer.clone()),
            state_dir: None,
        };
        let flow = blaze_flow::flow::start_with(flow_options, beginning, supervisor.child(node.name()))
            .await
            .map_err(|error| CliError::Failed(format!("{} does not start: {error:#}", node.name())))?;
        running.push(RunningNode { node, brokers, flow });
    }
    Ok(Nodes {
        running,
        _domain: reserved,
    })
}

/// What a node of the demo has in its node file, with the user's `--set` on top.
fn settings_of(node: DemoNode, options: &DemoOptions, listen: Ipv4Addr, domain: u16) -> Result<FlowSettings, CliError> {
    let peers: Vec<String> = options.peer.iter().map(|peer| format!("\"{peer}\"")).collect();
    let (layer, name, peers) = (node.layer(), node.name(), peers.join(", "));
    let own = [
        ("layer", format!("{{ name: {layer}, kind: {layer} }}")),
        ("node", format!("{{ name: {name} }}")),
        ("brokers.node", "{ memory: {} }".to_owned()),
        ("brokers.layer", "{ memory: {} }".to_owned()),
        (
            "brokers.inter",
            format!("{{ dds: {{ domain: {domain}, listen: \"{listen}\", peers: [{peers}] }} }}"),
        ),
        ("admin.flow", "\"127.0.0.1:0\"".to_owned()),
    ];
    let sources = Sources {
        overrides: own
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value))
            .chain(
                options
                    .set
                    .iter()
                    .map(|setting| (setting.key.clone(), setting.value.clone())),
            )
            .collect(),
        file_may_be_absent: true,
        ..Sources::default()
    };
    let file = node_file::read(&sources).map_err(|faults| CliError::Usage(format!("--set: {faults}")))?;
    FlowSettings::try_from(&file).map_err(|error| CliError::Usage(format!("--set: {error}")))
}

async fn wait_ready(nodes: &Nodes) -> Result<(), CliError> {
    for running in &nodes.running {
        let name = running.node.name();
        tokio::time::timeout(READY_TIMEOUT, running.flow.ready())
            .await
            .map_err(|_| {
                let waited = READY_TIMEOUT.as_secs();
                CliError::Failed(format!(
                    "{name} was not ready within {waited} s; see http://{}/readyz",
                    running.flow.admin()
                ))
            })?;
        eprintln!("ready node={name} admin={}", running.flow.admin());
    }
    Ok(())
}

/// All nodes of this process and the services on them.
struct System {
    nodes: Nodes,
    topics: Vec<PlayedTopic>,
    board: Arc<Board>,
    services: Mutex<HashMap<(&'static str, DemoNode), Arc<ServiceManager>>>,
    /// In the order of `topics`; none where robot-1 runs elsewhere.
    publishers: Vec<Publisher>,
    _advertised: Vec<Lease>,
    listeners: Mutex<HashMap<ConsumerId, Listener>>,
}

struct Listener {
    subscription: Subscription,
    lease: Lease,
}

impl System {
    /// The service of that name on that node, started with its first topic.
    async fn service(&self, name: &'static str, node: DemoNode) -> Result<Arc<ServiceManager>, String> {
        let mut services = self.services.lock().await;
        if let Some(service) = services.get(&(name, node)) {
            return Ok(Arc::clone(service));
        }
        let running = self.nodes.running.iter().find(|running| running.node == node);
        let running = running.ok_or_else(|| format!("{} does not run here", node.name()))?;
        let scope = scope_of(name, node);
        let broker = Arc::clone(running.brokers.of_services(scope));
        let id = running.flow.id();
        let service_name: ServiceName = name.parse().map_err(|error| format!("{name} {error}"))?;
        let options = ServiceOptions {
            pool_threads: 2,
            ..ServiceOptions::new(id.layer.clone(), service_name, broker, scope)
        };
        let service = ServiceManager::start(options.on_node(id.node.clone()))
            .await
            .map_err(|error| error.to_string())?;
        let service = Arc::new(service);
        services.insert((name, node), Arc::clone(&service));
        Ok(service)
    }

    async fn with_publishers(mut self) -> Result<Self, CliError> {
        if !self.nodes.running.iter().any(|running| running.node == PUBLISHING_NODE) {
            return Ok(self);
        }
        for topic in self.topics.clone() {
            let (publisher, lease) = self.advertise(&topic).await.map_err(|fault| {
                CliError::Failed(format!("{} cannot publish {}: {fault}", topic.service, topic.name))
            })?;
            self.publishers.push(publisher);
            self._advertised.push(lease);
        }
        Ok(self)
    }

    async fn advertise(&self, topic: &PlayedTopic) -> Result<(Publisher, Lease), String> {
        let service = self.service(topic.service, PUBLISHING_NODE).await?;
        let publish = PublishOptions {
            encoding: topic.encoding.clone(),
            reliability: topic.reliability(),
            lifespan: topic.lifespan(),
            large: topic.large,
            ..PublishOptions::default()
        };
        let publisher = service
            .broker()
            .publisher(&topic.name, &publish)
            .map_err(|error| error.to_string())?;
        let advertise = Advertise {
            rate_hz: Some(topic.rate_hz),
            max_bytes: Some(topic.max_bytes as u64),
            encoding: topic.encoding.clone(),
            type_name: topic.type_name.clone(),
            reliability: topic.reliability(),
            lifespan: topic.lifespan(),
            ..Advertise::new(topic.name.clone())
        };
        let lease = service
            .flow()
            .advertise(advertise)
            .await
            .map_err(|error| error.to_string())?;
        Ok((publisher, lease))
    }

    async fn shutdown(self) {
        self.listeners.lock().await.clear();
        drop(self.publishers);
        drop(self._advertised);
        let services = std::mem::take(&mut *self.services.lock().await);
        join_all(
            services
                .into_values()
                .filter_map(Arc::into_inner)
                .map(ServiceManager::shutdown),
        )
        .await;
        join_all(self.nodes.running.into_iter().map(|running| async {
            running.flow.shutdown().await;
            running.brokers.close().await;
        }))
        .await;
    }
}

/// A system, and what may end it before its time.
struct EndableSystem {
    system: System,
    ends: Ends,
}

impl Stage for EndableSystem {
    fn admin_ports(&self) -> Vec<(DemoNode, SocketAddr)> {
        let running = self.system.nodes.running.iter();
        running.map(|running| (running.node, running.flow.admin())).collect()
    }

    async fn listen(&self, consumer: &Consumer, id: ConsumerId) -> Result<(), String> {
        let system = &self.system;
        let topic = system
            .topics
            .iter()
            .find(|topic| topic.name == consumer.topic)
            .ok_or("nobody plays it")?;
        let service = system.service(consumer.service, consumer.node).await?;
        let board = Arc::clone(&system.board);
        let options = SubscribeOptions {
            large: topic.large,
            ..SubscribeOptions::default()
        };
        let subscription = service
            .broker()
            .subscribe(&topic.name, options, move |message| {
                if let Some(frame) = message.frame() {
                    board.frame_arrived(id, frame, unix_ns(), Instant::now());
                }
            })
            .await
            .map_err(|error| error.to_string())?;
        let request = Request {
            type_name: topic.type_name.clone(),
            reliability: topic.reliability(),
            lifespan: topic.lifespan(),
            ..Request::new(topic.name.clone())
        };
        let lease = service
            .flow()
            .request(request)
            .await
            .map_err(|error| error.to_string())?;
        system
            .listeners
            .lock()
            .await
            .insert(id, Listener { subscription, lease });
        Ok(())
    }

    async fn stop_listening(&self, id: ConsumerId) -> Result<(), String> {
        let Some(listener) = self.system.listeners.lock().await.remove(&id) else {
            return Ok(());
        };
        let withdrawn = listener.lease.withdraw().await;
        self.system
            .board
            .set_consumer_counts(id, counts_of(&listener.subscription));
        listener.subscription.close().await;
        withdrawn.map_err(|error| error.to_string())
    }

    fn publisher(&self) -> Option<Box<dyn FnMut(usize, Bytes) + Send>> {
        let publishers = self.system.publishers.clone();
        if publishers.is_empty() {
            return None;
        }
        Some(Box::new(move |topic, payload| {
            if let Some(publisher) = publishers.get(topic) {
                publisher.publish(payload);
            }
        }))
    }

    async fn look(&self) {
        for (id, listener) in self.system.listeners.lock().await.iter() {
            self.system
                .board
                .set_consumer_counts(*id, counts_of(&listener.subscription));
        }
    }

    async fn interrupted(&self) -> Option<String> {
        self.ends.wait().await
    }
}

fn counts_of(subscription: &Subscription) -> ConsumerCounts {
    let stats = subscription.stats();
    ConsumerCounts {
        queue_full: stats.queue_dropped,
        lifespan: stats.expired,
        duplicated: stats.duplicated,
    }
}

fn unix_ns() -> u64 {
    let since_epoch = SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since_epoch.as_nanos()).unwrap_or(u64::MAX)
}

/// What ends the demo before its time: a signal, or a part of it that failed.
struct Ends {
    signals: Mutex<[tokio::signal::unix::Signal; 2]>,
    supervisor: Supervisor,
}

impl Ends {
    fn new(supervisor: Supervisor) -> Result<Self, CliError> {
        let listen = |kind| signal(kind).map_err(|error| CliError::Failed(format!("no signal handlers: {error}")));
        Ok(Self {
            signals: Mutex::new([listen(SignalKind::interrupt())?, listen(SignalKind::terminate())?]),
            supervisor,
        })
    }

    /// Waits for the end; a sentence if it was no signal.
    async fn wait(&self) -> Option<String> {
        let mut signals = self.signals.lock().await;
        let [interrupt, terminate] = &mut *signals;
        tokio::select! {
            _ = interrupt.recv() => None,
            _ = terminate.recv() => None,
            reason = self.supervisor.failed() => Some(reason),
        }
    }
}
