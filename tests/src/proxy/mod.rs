//! A TCP proxy that breaks connections on purpose.
//!
//! ```text
//! client ─► listener ─► connection ─┬─ pump up   ─► target
//!              ▲            ▲       └─ pump down ◄─ target
//!              └── orders ──┴── Settings (watch)
//! ```
//!
//! Its tasks run on a runtime of its own, so that it works beside tests that block their thread.

mod listener;
mod pump;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::Duration;

use anyhow::Context as _;
use blaze_runtime::{Supervisor, TaskPolicy};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

use crate::network::{Host, inside};
use listener::Listener;

/// Orders are carried out at once; the rest is for a machine that does much else.
const ORDER: Duration = Duration::from_secs(10);
/// Orders that wait: each caller waits for its own.
const ORDERS: usize = 16;

/// What the proxy does with connections now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    Forward,
    Stall,
    Cut,
}

/// How a connection is ended from outside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ending {
    Close,
    Reset,
}

/// What connections look at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    pub(crate) mode: Mode,
    /// What was read waits so long.
    pub(crate) delay: Duration,
    /// Bytes per second of each connection and direction; `None` = no limit.
    pub(crate) bytes_per_s: Option<u64>,
    /// Counts endings: a connection that began at a smaller number ends.
    pub(crate) endings: u64,
    pub(crate) ending: Ending,
}

/// What the listener is told.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Order {
    Delay(Duration),
    Throttle(u64),
    Cut,
    Stall,
    Reset,
    Heal,
}

pub(crate) type Orders = mpsc::Receiver<(Order, SyncSender<std::io::Result<()>>)>;

#[derive(Debug, Default)]
pub(crate) struct Counters {
    pub(crate) accepted: AtomicU64,
    pub(crate) unreached: AtomicU64,
    pub(crate) too_many: AtomicU64,
    pub(crate) open: AtomicU64,
    pub(crate) cut: AtomicU64,
    pub(crate) reset: AtomicU64,
    pub(crate) up_bytes: AtomicU64,
    pub(crate) down_bytes: AtomicU64,
}

/// What a proxy counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ProxyStats {
    /// Connections that clients made.
    pub accepted: u64,
    /// Of these: closed, because the target did not accept.
    pub unreached: u64,
    /// Of these: closed, because there were too many.
    pub too_many: u64,
    /// Of these: open now.
    pub open: u64,
    /// Of these: closed by [`Proxy::cut`].
    pub cut: u64,
    /// Of these: reset by [`Proxy::reset`].
    pub reset: u64,
    /// Bytes given to the target.
    pub up_bytes: u64,
    /// Bytes given to clients.
    pub down_bytes: u64,
}

/// A TCP proxy in this process; it ends when dropped. Its calls return when they are in effect.
pub struct Proxy {
    address: SocketAddr,
    orders: mpsc::Sender<(Order, SyncSender<std::io::Result<()>>)>,
    counters: Arc<Counters>,
    runtime: Option<Runtime>,
}

impl Proxy {
    /// Listens on a free port of loopback.
    ///
    /// # Errors
    /// When the system gives no port or no thread.
    pub fn start(target: SocketAddr) -> anyhow::Result<Self> {
        Self::listen((Ipv4Addr::LOCALHOST, 0).into(), target)
    }

    /// Listens on an address; port 0 is any free one.
    ///
    /// # Errors
    /// As [`Proxy::start`], and when the address is taken.
    pub fn listen(address: SocketAddr, target: SocketAddr) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("proxy")
            .enable_all()
            .build()?;
        let counters = Arc::<Counters>::default();
        let (orders, received) = mpsc::channel(ORDERS);
        let supervisor = Supervisor::on(runtime.handle().clone(), "proxy");
        let kept = (supervisor.clone(), Arc::clone(&counters));
        let listener = runtime
            .block_on(Listener::bind(address, target, kept.0, kept.1))
            .with_context(|| format!("a proxy on {address}"))?;
        let address = listener.address();
        supervisor.spawn("listener", TaskPolicy::MayEnd, listener.run(received));
        Ok(Self {
            address,
            orders,
            counters,
            runtime: Some(runtime),
        })
    }

    /// Listens on a host of a network, and reaches the target from there.
    ///
    /// # Errors
    /// As [`Proxy::listen`].
    pub fn listen_on(host: &Host, port: u16, target: SocketAddr) -> anyhow::Result<Self> {
        // The runtime's threads are started inside the namespace and so stay there.
        inside(&host.namespace, || Self::listen((host.address, port).into(), target))
    }

    /// Where clients connect to.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Holds all that passes for so long, both ways; zero ends it. Throughput stays, up to 1 MiB on the way.
    ///
    /// # Errors
    /// When the proxy has ended; so with the other calls.
    pub fn delay(&self, delay: Duration) -> anyhow::Result<()> {
        self.tell(Order::Delay(delay))
    }

    /// Lets so many bytes per second pass, at least 1, for each connection and direction.
    ///
    /// # Errors
    /// As [`Proxy::delay`].
    pub fn throttle(&self, bytes_per_s: u64) -> anyhow::Result<()> {
        self.tell(Order::Throttle(bytes_per_s.max(1)))
    }

    /// Closes all connections and refuses new ones until [`Proxy::heal`].
    ///
    /// # Errors
    /// As [`Proxy::delay`].
    pub fn cut(&self) -> anyhow::Result<()> {
        self.tell(Order::Cut)
    }

    /// Accepts connections and keeps those that are there, but lets nothing pass until [`Proxy::heal`].
    ///
    /// # Errors
    /// As [`Proxy::delay`]; after a cut also when the port was taken by somebody else.
    pub fn stall(&self) -> anyhow::Result<()> {
        self.tell(Order::Stall)
    }

    /// Ends all connections with RST to both sides. New ones are treated as before.
    ///
    /// # Errors
    /// As [`Proxy::delay`].
    pub fn reset(&self) -> anyhow::Result<()> {
        self.tell(Order::Reset)
    }

    /// Forwards everything at once again. What was stalled goes on.
    ///
    /// # Errors
    /// As [`Proxy::stall`].
    pub fn heal(&self) -> anyhow::Result<()> {
        self.tell(Order::Heal)
    }

    /// What it counted so far.
    #[must_use]
    pub fn stats(&self) -> ProxyStats {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let counters = &self.counters;
        ProxyStats {
            accepted: read(&counters.accepted),
            unreached: read(&counters.unreached),
            too_many: read(&counters.too_many),
            open: read(&counters.open),
            cut: read(&counters.cut),
            reset: read(&counters.reset),
            up_bytes: read(&counters.up_bytes),
            down_bytes: read(&counters.down_bytes),
        }
    }

    fn tell(&self, order: Order) -> anyhow::Result<()> {
        let (done, result) = sync_channel(1);
        self.orders
            .try_send((order, done))
            .map_err(|_| anyhow::anyhow!("the proxy has ended or is told too much at once"))?;
        result
            .recv_timeout(ORDER)
            .context("the proxy does not answer")?
            .with_context(|| format!("{order:?} of the proxy on {}", self.address))
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Also inside an asynchronous test, where waiting for it is not allowed.
            runtime.shutdown_background();
        }
    }
}
