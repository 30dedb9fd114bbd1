//! Redis and Valkey: publish and subscribe, what is kept for late joiners, the flow's leases, and
//! whose scope it is.
//!
//! ```text
//! publisher ─► Gate (queues) ─► Writer ──► connection "publish"        ┐ one more of each for large
//! server ──► connection "read" ─► Subscriptions ─► readers' rings      ┘ messages, when first needed
//!                    ▲ Reader (SUBSCRIBE, UNSUBSCRIBE)
//! Owner (key renewed each second), Leases (hash) ──► connection "publish"           only for a flow
//! all of them ──► State ─► status, gates, whether messages are delivered
//! ```
//!
//! Redis delivers at most once. What was handed to it and not answered when the connection was lost
//! counts as dropped and is never sent again; what was published while a reader was away is
//! missing.

mod connection;
mod examine;
mod flow_side;
mod gate;
mod kept;
mod keys;
mod leases;
mod liveness;
mod lock;
mod lost;
mod owner;
mod publisher;
mod reader;
mod server;
mod settings;
mod state;
mod subscriptions;
mod writer;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use blaze_domain::FlowId;
use blaze_domain::names::ChannelName;
use blaze_domain::node_file::RedisBroker as Section;
use blaze_runtime::supervisor::{Supervisor, TaskPolicy};
use parking_lot::Mutex;
use redis::aio::MultiplexedConnection;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

pub use examine::{RedisReport, examine};
pub use gate::MAX_QUEUE_BYTES;
pub use keys::{KeyChange, KeyError, Record, RedisKeys};
pub use lock::RedisLock;
pub use server::Complaint;

use crate::open::OpenError;
use crate::outbox::LanePublisher;
use crate::port::{
    Broker, BrokerError, BrokerKind, BrokerStatus, FlowSide, Publisher, PublisherOptions, Role,
    SubscribeOptions, Subscription,
};
use flow_side::RedisFlowSide;
use gate::Gate;
use kept::Mirror;
use leases::Leases;
use owner::Owner;
use publisher::Target;
use server::{BufferLimits, ServerFacts};
use settings::{Settings, check_scope};
use state::{Line, LineState, ScopeOwnership, State};
use subscriptions::Subscriptions;

/// How long closing delivers what was taken.
const DRAIN: Duration = Duration::from_secs(1);
/// How long closing waits for the tasks, which end at once when told.
const END: Duration = Duration::from_secs(1);

/// A client of a Redis or Valkey server.
pub struct RedisBroker {
    shared: Arc<Shared>,
    supervisor: Supervisor,
    flow: Option<Flow>,
    /// Which connections have their task.
    started: [AtomicBool; 4],
    closing: AtomicBool,
}

/// The flow that uses this client.
struct Flow {
    flow: FlowId,
    epoch: u64,
    leases: Arc<Leases>,
}

/// What the tasks of a client share.
struct Shared {
    settings: Settings,
    state: Arc<State>,
    gates: [Arc<Gate>; 2],
    subscriptions: [Arc<Subscriptions>; 2],
    connections: [watch::Sender<Option<MultiplexedConnection>>; 4],
    mirror: Mutex<Mirror>,
    /// Which start of the server was met last, if any was; `None` inside where it does not tell.
    last_run: Mutex<Option<Option<String>>>,
    /// It was said what is wrong with the set-up of the server.
    warned: AtomicBool,
    stop: CancellationToken,
}

impl Shared {
    fn new(settings: Settings, role: &Role) -> Self {
        let gates = [Gate::new(false), Gate::new(true)];
        let scope = match role {
            Role::Service | Role::Worker => ScopeOwnership::Free,
            Role::Flow { .. } => ScopeOwnership::Unclaimed,
        };
        let channels = Arc::<AtomicUsize>::default();
        Self {
            state: Arc::new(State::new(scope, settings.place.clone(), gates.clone())),
            gates,
            subscriptions: [
                Subscriptions::new(Arc::clone(&channels)),
                Subscriptions::new(channels),
            ],
            connections: std::array::from_fn(|_| watch::Sender::new(None)),
            mirror: Mutex::default(),
            last_run: Mutex::default(),
            warned: AtomicBool::new(false),
            stop: CancellationToken::new(),
            settings,
        }
    }

    fn gate(&self, large: bool) -> &Arc<Gate> {
        &self.gates[usize::from(large)]
    }

    /// Who reads on a connection, if it is one for reading.
    fn subscriptions_of(&self, line: Line) -> Option<&Arc<Subscriptions>> {
        line.reads().then(|| &self.subscriptions[usize::from(line.is_large())])
    }

    fn set_silent(&self, line: Line, silent: bool) {
        if self.state.set_silent(line, silent)
            && silent
            && let Some(subscriptions) = self.subscriptions_of(line)
        {
            subscriptions.fail_waiting("the server does not answer");
        }
    }

    fn put_connection(&self, line: Line, connection: Option<MultiplexedConnection>) {
        self.connections[line.index()].send_replace(connection);
    }

    fn connection(&self, line: Line) -> Option<MultiplexedConnection> {
        self.connections[line.index()].borrow().clone()
    }

    /// The connection for commands, if the server answers on it.
    fn commands_now(&self) -> Option<MultiplexedConnection> {
        let line = Line::PublishSmall;
        let up = self.state.read(|conditions| *conditions.line(line) == LineState::Up);
        up.then(|| self.connection(line)).flatten()
    }

    /// Waits for the connection for commands. Commands share it with small messages, of which
    /// little is under way.
    async fn commands(&self) -> MultiplexedConnection {
        let mut version = self.state.version();
        loop {
            version.mark_unchanged();
            if let Some(connection) = self.commands_now() {
                return connection;
            }
            // The sender lives in `self`.
            let _ = version.changed().await;
        }
    }

    /// The server has told who it is.
    fn met(&self, facts: ServerFacts, limits: Option<BufferLimits>) {
        let before = self.last_run.lock().replace(facts.run_id.clone());
        // Where the server does not tell, it may have been restarted.
        let same = before.as_ref().is_none_or(|before| before.is_some() && *before == facts.run_id);
        if !same {
            tracing::info!(
                server = facts.version,
                "redis may have been restarted: what it kept is written again"
            );
            self.mirror.lock().rewrite_all();
        }
        if limits.is_none() {
            tracing::debug!("redis does not tell its client-output-buffer-limit");
        }
        let complaints = [facts.complaint(), limits.and_then(BufferLimits::complaint)];
        if complaints != [None, None] && !self.warned.swap(true, Ordering::Relaxed) {
            for complaint in complaints.into_iter().flatten() {
                tracing::warn!(%complaint, "redis is set up so that something gets lost");
            }
        }
        self.state.change(|conditions| {
            conditions.server = facts.version;
            if !same {
                conditions.forget_owner();
            }
        });
    }

    /// Ends what can be ended without waiting.
    fn end(&self) {
        self.state.change(|conditions| conditions.closed = true);
        for gate in &self.gates {
            gate.outbox.close();
        }
        for subscriptions in &self.subscriptions {
            subscriptions.close();
        }
        self.stop.cancel();
    }
}

impl RedisBroker {
    /// Whether it can be the broker of a node scope, by what the section and its files say.
    ///
    /// # Errors
    /// As [`Self::open`], and for a URL with the number of a database.
    pub fn check(section: &Section) -> Result<(), OpenError> {
        check_scope(section)
    }

    /// Connects in the background: the status tells how far it is. Call it inside a Tokio runtime.
    ///
    /// # Errors
    /// [`OpenError`] where it can never work: a file that cannot be read, a URL that is none.
    pub fn open(section: &Section, role: &Role) -> Result<Self, OpenError> {
        let settings = Settings::read(section)?;
        let leases = settings.names.leases();
        let runtime = tokio::runtime::Handle::try_current().map_err(|error| {
            OpenError::Setting { key: "redis".to_owned(), reason: error.to_string() }
        })?;
        let broker = Self {
            shared: Arc::new(Shared::new(settings, role)),
            supervisor: Supervisor::on(runtime, "redis"),
            flow: match role {
                Role::Service | Role::Worker => None,
                Role::Flow { flow, epoch } => Some(Flow {
                    flow: flow.clone(),
                    epoch: *epoch,
                    leases: Arc::new(Leases::new(leases)),
                }),
            },
            started: Default::default(),
            closing: AtomicBool::new(false),
        };
        broker.start(Line::PublishSmall);
        broker.start(Line::ReadSmall);
        let leases = broker.flow.as_ref().map(|flow| Arc::clone(&flow.leases));
        let watching = lost::watch(Arc::clone(&broker.shared), leases);
        broker.supervisor.spawn("redis-lost", TaskPolicy::MayEnd, watching);
        broker.start_flow();
        Ok(broker)
    }

    /// Starts a connection's task, if it has none.
    fn start(&self, line: Line) {
        if self.started[line.index()].swap(true, Ordering::AcqRel) {
            return;
        }
        self.shared.state.set_line(line, LineState::Starting);
        let kept = connection::keep(Arc::clone(&self.shared), line);
        self.supervisor.spawn(format!("redis-{}", line.name()), TaskPolicy::MayEnd, kept);
    }

    fn start_flow(&self) {
        let Some(Flow { flow, epoch, leases }) = &self.flow else {
            return;
        };
        let shared = || Arc::clone(&self.shared);
        let owner = Owner::new(shared(), Arc::clone(leases), flow.to_string(), *epoch);
        self.supervisor.spawn("redis-owner", TaskPolicy::MayEnd, owner.run());
        let writing = leases::write(shared(), Arc::clone(leases));
        self.supervisor.spawn("redis-leases", TaskPolicy::MayEnd, writing);
    }

    fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Acquire)
    }

    /// Why nothing can be asked of the server now.
    fn check_up(&self) -> Result<(), BrokerError> {
        if self.is_closing() {
            return Err(BrokerError::Closed);
        }
        self.shared.state.why_not_up().map_or(Ok(()), |why| Err(BrokerError::Away(why)))
    }
}

#[async_trait]
impl Broker for RedisBroker {
    fn kind(&self) -> BrokerKind {
        BrokerKind::Redis
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.shared.state.status()
    }

    fn publisher(
        &self,
        channel: &ChannelName,
        options: PublisherOptions,
    ) -> Result<Arc<dyn Publisher>, BrokerError> {
        if self.is_closing() {
            return Err(BrokerError::Closed);
        }
        self.start(Line::publish(options.large));
        let target = Target::new(&self.shared.settings.names, channel, options);
        let gate = self.shared.gate(options.large);
        Ok(Arc::new(LanePublisher {
            lane: gate.outbox.lane(target, None),
            admission: Arc::clone(gate),
        }))
    }

    async fn subscribe(
        &self,
        channel: &ChannelName,
        options: SubscribeOptions,
    ) -> Result<Subscription, BrokerError> {
        self.check_up()?;
        let line = Line::read(options.large);
        self.start(line);
        let names = &self.shared.settings.names;
        let name = names.channel(channel);
        let subscriptions = &self.shared.subscriptions[usize::from(options.large)];
        // Dropped on the way out, the subscription is forgotten with the next sweep.
        let (sender, subscription) = crate::port::subscription(options);
        let added = subscriptions.add(&name, channel, sender, options)?;
        added.confirmation.await.unwrap_or(Err(BrokerError::Closed))?;
        if options.with_kept {
            let away = || BrokerError::Away("the connection was lost".to_owned());
            let connection = self.shared.connection(line).ok_or_else(away)?;
            let kept = reader::read_kept(connection, &names.last(channel)).await?;
            subscriptions.join(&name, added.id, kept);
        }
        Ok(subscription)
    }

    fn flow_side(&self) -> Option<Arc<dyn FlowSide>> {
        let flow = self.flow.as_ref()?;
        Some(Arc::new(RedisFlowSide {
            shared: Arc::clone(&self.shared),
            leases: Arc::clone(&flow.leases),
        }))
    }

    async fn close(&self) {
        self.closing.store(true, Ordering::Release);
        let drained = |gate: &Arc<Gate>| {
            let gate = Arc::clone(gate);
            async move { gate.drained(DRAIN).await }
        };
        let [small, large] = &self.shared.gates;
        tokio::join!(drained(small), drained(large));
        if let Some(Flow { flow, epoch, leases }) = &self.flow {
            leases::drained(&self.shared, leases, DRAIN).await;
            owner::release(&self.shared, &flow.to_string(), *epoch).await;
        }
        self.shared.end();
        self.supervisor.shutdown(END).await;
    }
}

impl Drop for RedisBroker {
    fn drop(&mut self) {
        self.shared.end();
    }
}
