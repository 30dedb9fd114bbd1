//! The ports of REST and gRPC: TCP or TLS, HTTP/1.1 and HTTP/2.
//!
//! ```text
//! accept ─(limit)─▶ TLS handshake ─(10 s)─▶ HTTP ─(first head: 30 s)─▶ Router
//!                                            └─ watched: idle, stalled, shutdown ─▶ told, then closed
//! ```
//!
//! Nothing that comes in from outside ends the listener or takes more than its share: connections, the time for each
//! step, and the bytes of a head are bounded, and what became of every connection is counted. Heads up to
//! [`ListenLimits::head_bytes`] reach the router, which answers those that are over the contract's limits itself.

mod activity;
mod connection;
mod counters;
mod stall;
#[cfg(test)]
mod tests;
mod tls;
mod unread;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use blaze_runtime::{Supervisor, TaskHandle, TaskPolicy};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;

use connection::Connection;
use counters::Outcome;

pub use counters::{ListenCounters, metrics_text};
pub use tls::{Tls, install_crypto_provider};

/// What is spoken on a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Protocols {
    /// HTTP/1.1 and HTTP/2, by ALPN, without TLS by the first bytes.
    Both,
    /// HTTP/2 alone: gRPC.
    Http2,
}

/// What a port allows.
#[derive(Debug, Clone)]
pub struct ListenLimits {
    /// Connections at once; more are closed at once.
    pub connections: usize,
    /// For the TLS handshake.
    pub handshake_timeout: Duration,
    /// For the head of a request, and until the first one.
    pub head_timeout: Duration,
    /// Head of a request, in bytes, beyond which the connection answers 431 itself and closes; at least 8192.
    pub head_bytes: usize,
    /// A connection of HTTP/2 without requests is closed after this; one of HTTP/1.1 after [`Self::head_timeout`].
    pub idle_timeout: Duration,
    /// A client that takes no byte for this long loses its connection.
    pub write_stall: Duration,
    /// A client that takes nothing from one answer for this long, though it acknowledges on others, loses its connection.
    pub stream_stall: Duration,
    /// Requests at once on one connection of HTTP/2.
    pub streams: u32,
    /// Bytes of answers that wait in one stream of HTTP/2.
    pub stream_buffer_bytes: usize,
    /// HTTP/2: between a sign of life and a PING.
    pub keep_alive_interval: Duration,
    /// HTTP/2: for the answer to a PING.
    pub keep_alive_timeout: Duration,
    /// Bytes that are still read of a body whose request was answered without it.
    pub unread_bytes: usize,
    /// For how long.
    pub unread_time: Duration,
    /// For open requests when the port stops.
    pub drain_timeout: Duration,
}

impl Default for ListenLimits {
    fn default() -> Self {
        Self {
            connections: 10_000,
            handshake_timeout: Duration::from_secs(10),
            head_timeout: Duration::from_secs(30),
            // Twice what the contract allows, so that the refusal can be told in its form.
            head_bytes: 64 * 1024,
            idle_timeout: Duration::from_secs(300),
            write_stall: Duration::from_secs(60),
            stream_stall: Duration::from_secs(600),
            streams: 1000,
            stream_buffer_bytes: 128 * 1024,
            keep_alive_interval: Duration::from_secs(20),
            keep_alive_timeout: Duration::from_secs(10),
            // Twice the largest body.
            unread_bytes: 16 * 1024 * 1024,
            unread_time: Duration::from_secs(5),
            drain_timeout: Duration::from_secs(30),
        }
    }
}

/// Where a request comes from. In the extensions of every request, beside `ConnectInfo<SocketAddr>`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    /// Address of the client.
    pub address: SocketAddr,
    /// Whether the connection is encrypted.
    pub encrypted: bool,
    /// Whether the client has shown a certificate that was accepted. Who it is says its token alone.
    pub certificate: bool,
}

/// A port that is bound and not served yet; connections wait.
pub struct Listener {
    name: &'static str,
    listener: TcpListener,
    address: SocketAddr,
    tls: Option<Tls>,
    protocols: Protocols,
    limits: Arc<ListenLimits>,
    counters: Arc<ListenCounters>,
}

impl Listener {
    /// Binds the port (0: any). `name` is that in metrics and logs: `rest`, `grpc`. Without `tls` it speaks plaintext;
    /// whether that is allowed was settled before.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub async fn bind(
        name: &'static str,
        address: SocketAddr,
        tls: Option<Tls>,
        protocols: Protocols,
        limits: ListenLimits,
    ) -> io::Result<Self> {
        let describe = |error: io::Error| io::Error::new(error.kind(), format!("{name} port {address}: {error}"));
        let listener = TcpListener::bind(address).await.map_err(describe)?;
        let address = listener.local_addr().map_err(describe)?;
        Ok(Self {
            name,
            listener,
            address,
            tls,
            protocols,
            limits: Arc::new(limits),
            counters: Arc::new(ListenCounters::new(name)),
        })
    }

    /// The address with the real port.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// What became of the connections, for [`metrics_text`].
    #[must_use]
    pub fn counters(&self) -> Arc<ListenCounters> {
        Arc::clone(&self.counters)
    }

    /// Serves until [`Serving::stop`] or the supervisor's shutdown.
    pub fn serve(self, supervisor: &Supervisor, router: Router) -> Serving {
        let (name, address) = (self.name, self.address);
        let stop = supervisor.shutdown_token().child_token();
        let task = self.accept(router, stop.clone());
        let task = supervisor.spawn(format!("{name} port"), TaskPolicy::Essential, task);
        Serving { address, stop, task }
    }

    async fn accept(self, router: Router, stop: CancellationToken) {
        let mut connections = JoinSet::new();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                Some(ended) = connections.join_next() => self.count_panic(&ended),
                accepted = self.listener.accept() => match accepted {
                    Ok((stream, peer)) if connections.len() < self.limits.connections => {
                        self.counters.count(Outcome::Accepted);
                        connections.spawn(self.connection(stream, peer, router.clone(), stop.clone()));
                    }
                    // Dropped, that is closed: whoever asks may come again.
                    Ok(_) => self.counters.count(Outcome::Refused),
                    Err(error) => {
                        // Too many open files, mostly: without a pause this would spin.
                        tracing::warn!(%error, port = self.name, "cannot accept");
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                },
            }
        }
        // From now on connecting is refused, so that clients turn to another process.
        let Self {
            name, listener, limits, ..
        } = self;
        drop(listener);
        let drained = async { while connections.join_next().await.is_some() {} };
        if tokio::time::timeout(limits.drain_timeout, drained).await.is_err() {
            // What is left is aborted with the set.
            tracing::warn!(
                port = name,
                left = connections.len(),
                "connections are cut: their requests did not end"
            );
        }
    }

    fn connection(
        &self,
        stream: TcpStream,
        peer: SocketAddr,
        router: Router,
        stop: CancellationToken,
    ) -> impl Future<Output = ()> + Send + 'static {
        let connection = Connection {
            peer,
            router,
            protocols: self.protocols,
            limits: Arc::clone(&self.limits),
            counters: Arc::clone(&self.counters),
            stop,
        };
        // Of now: a certificate that is renewed holds for the next connection.
        let tls = self.tls.as_ref().map(|tls| tls.config(self.protocols));
        connection.run(stream, tls)
    }

    fn count_panic(&self, ended: &Result<(), JoinError>) {
        if let Err(error) = ended
            && error.is_panic()
        {
            self.counters.count(Outcome::Panicked);
            tracing::error!(port = self.name, "a handler panicked");
        }
    }
}

impl std::fmt::Debug for Listener {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Listener")
            .field("name", &self.name)
            .field("address", &self.address)
            .finish_non_exhaustive()
    }
}

/// A port that is served.
#[derive(Debug, Clone)]
pub struct Serving {
    address: SocketAddr,
    stop: CancellationToken,
    task: TaskHandle,
}

impl Serving {
    /// The address with the real port.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Takes no more connections, and no more requests on those that are open. For the process as a whole only: before
    /// its shutdown began this counts as a failure.
    pub fn stop(&self) {
        self.stop.cancel();
    }

    /// Waits until all requests have ended and the port is closed.
    pub async fn drained(&self) {
        self.task.finished().await;
    }
}
