//! A TCP proxy that holds up what passes.

use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;

use anyhow::Context as _;
use parking_lot::{Condvar, Mutex};

/// Read at a time.
const CHUNK: usize = 16 * 1024;

/// What was read waits here while nothing may pass.
#[derive(Default)]
struct Gate {
    closed: Mutex<bool>,
    changed: Condvar,
}

impl Gate {
    fn set(&self, closed: bool) {
        *self.closed.lock() = closed;
        self.changed.notify_all();
    }

    fn pass(&self) {
        self.changed.wait_while(&mut self.closed.lock(), |closed| *closed);
    }
}

/// A TCP proxy; it ends with this process.
pub struct Proxy {
    address: SocketAddr,
    gate: Arc<Gate>,
}

impl Proxy {
    /// Listens on a free port of loopback.
    ///
    /// # Errors
    /// When the system gives no port.
    pub fn start(target: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).context("a proxy")?;
        let address = listener.local_addr()?;
        let gate = Arc::<Gate>::default();
        let of_connections = Arc::clone(&gate);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                // A client whose target is away finds its connection closed.
                let _ = serve(client, target, &of_connections);
            }
        });
        Ok(Self { address, gate })
    }

    /// Where clients connect to.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Accepts connections and keeps those that are there, but lets nothing pass until
    /// [`Proxy::heal`].
    pub fn stall(&self) {
        self.gate.set(true);
    }

    /// What was stalled goes on.
    pub fn heal(&self) {
        self.gate.set(false);
    }
}

fn serve(client: TcpStream, target: SocketAddr, gate: &Arc<Gate>) -> std::io::Result<()> {
    let server = TcpStream::connect(target)?;
    for (from, to) in [(client.try_clone()?, server.try_clone()?), (server, client)] {
        // Small messages at once, as without the proxy.
        to.set_nodelay(true)?;
        let gate = Arc::clone(gate);
        std::thread::spawn(move || pump(from, to, &gate));
    }
    Ok(())
}

/// Moves bytes until one side ends.
fn pump(mut from: TcpStream, mut to: TcpStream, gate: &Gate) {
    let mut buffer = vec![0; CHUNK];
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        gate.pass();
        if to.write_all(&buffer[..length]).is_err() {
            let _ = from.shutdown(Shutdown::Both);
            return;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}
