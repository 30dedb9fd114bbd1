//! Accepts connections and carries out orders.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use blaze_runtime::{Supervisor, TaskPolicy};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use super::pump::pump;
use super::{Counters, Ending, Mode, Order, Orders, Settings};

/// Connections at a time.
const MAX_OPEN: u64 = 1_024;
/// How long the target may take to accept.
const CONNECT: Duration = Duration::from_secs(5);

pub(super) struct Listener {
    address: SocketAddr,
    target: SocketAddr,
    /// `None` while it is cut: the system then refuses.
    socket: Option<TcpListener>,
    settings: watch::Sender<Settings>,
    supervisor: Supervisor,
    counters: Arc<Counters>,
}

impl Listener {
    pub(super) async fn bind(
        address: SocketAddr,
        target: SocketAddr,
        supervisor: Supervisor,
        counters: Arc<Counters>,
    ) -> std::io::Result<Self> {
        let socket = TcpListener::bind(address).await?;
        Ok(Self {
            address: socket.local_addr()?,
            target,
            socket: Some(socket),
            settings: watch::Sender::new(Settings {
                mode: Mode::Forward,
                delay: Duration::ZERO,
                bytes_per_s: None,
                endings: 0,
                ending: Ending::Close,
            }),
            supervisor,
            counters,
        })
    }

    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Works until nobody can give orders any more.
    pub(super) async fn run(mut self, mut orders: Orders) {
        loop {
            tokio::select! {
                biased;
                order = orders.recv() => {
                    let Some((order, done)) = order else { return };
                    // Nobody waits any more if the caller gave up.
                    let _ = done.try_send(self.obey(order).await);
                }
                client = accept(self.socket.as_ref()) => self.serve(client),
            }
        }
    }

    async fn obey(&mut self, order: Order) -> std::io::Result<()> {
        match order {
            Order::Delay(delay) => self.settings.send_modify(|settings| settings.delay = delay),
            Order::Throttle(rate) => self.settings.send_modify(|settings| settings.bytes_per_s = Some(rate)),
            Order::Cut => {
                self.socket = None;
                self.end(Ending::Close, Mode::Cut);
            }
            Order::Reset => {
                let mode = self.settings.borrow().mode;
                self.end(Ending::Reset, mode);
            }
            Order::Stall => {
                self.open().await?;
                self.settings.send_modify(|settings| settings.mode = Mode::Stall);
            }
            Order::Heal => {
                self.open().await?;
                self.settings.send_modify(|settings| {
                    *settings = Settings {
                        mode: Mode::Forward,
                        delay: Duration::ZERO,
                        bytes_per_s: None,
                        ..*settings
                    };
                });
            }
        }
        Ok(())
    }

    async fn open(&mut self) -> std::io::Result<()> {
        if self.socket.is_none() {
            self.socket = Some(TcpListener::bind(self.address).await?);
        }
        Ok(())
    }

    fn end(&self, ending: Ending, mode: Mode) {
        self.settings.send_modify(|settings| {
            settings.mode = mode;
            settings.ending = ending;
            settings.endings += 1;
        });
    }

    fn serve(&self, client: TcpStream) {
        let counters = Arc::clone(&self.counters);
        counters.accepted.fetch_add(1, Ordering::Relaxed);
        if counters.open.load(Ordering::Relaxed) >= MAX_OPEN {
            counters.too_many.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let open = Open::new(counters);
        let (target, settings) = (self.target, self.settings.subscribe());
        self.supervisor.spawn("connection", TaskPolicy::MayEnd, async move {
            connection(client, target, settings, &open.counters).await;
        });
    }
}

/// The next client. An error of one, or too many open files, is no reason to end.
async fn accept(socket: Option<&TcpListener>) -> TcpStream {
    let Some(socket) = socket else {
        return std::future::pending().await;
    };
    loop {
        if let Ok((client, _)) = socket.accept().await {
            return client;
        }
        tokio::task::yield_now().await;
    }
}

/// Counts a connection while it is open.
struct Open {
    counters: Arc<Counters>,
}

impl Open {
    fn new(counters: Arc<Counters>) -> Self {
        counters.open.fetch_add(1, Ordering::Relaxed);
        Self { counters }
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        self.counters.open.fetch_sub(1, Ordering::Relaxed);
    }
}

async fn connection(
    mut client: TcpStream,
    target: SocketAddr,
    mut settings: watch::Receiver<Settings>,
    counters: &Counters,
) {
    let begun = settings.borrow().endings;
    let count = |counter: &AtomicU64| counter.fetch_add(1, Ordering::Relaxed);
    let reached = tokio::time::timeout(CONNECT, TcpStream::connect(target)).await;
    let Ok(Ok(mut server)) = reached else {
        count(&counters.unreached);
        return;
    };
    // Small messages at once, as without the proxy.
    let _ = client.set_nodelay(true);
    let _ = server.set_nodelay(true);
    let ended = {
        let (pumps, other) = (settings.clone(), settings.clone());
        let (from_client, to_client) = client.split();
        let (from_server, to_server) = server.split();
        tokio::select! {
            biased;
            ended = settings.wait_for(|settings| settings.endings > begun) => ended.ok().map(|settings| settings.ending),
            // An error on one side ends both, as a broken connection does.
            _ = async { tokio::try_join!(
                pump(from_client, to_server, pumps, &counters.up_bytes),
                pump(from_server, to_client, other, &counters.down_bytes),
            ) } => return,
        }
    };
    match ended {
        Some(Ending::Reset) => {
            let _ = client.set_zero_linger();
            let _ = server.set_zero_linger();
            count(&counters.reset);
        }
        Some(Ending::Close) => {
            count(&counters.cut);
        }
        // The proxy ends.
        None => {}
    }
}
