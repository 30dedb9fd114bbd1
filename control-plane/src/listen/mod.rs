//! The ports of REST and gRPC: TCP or TLS, HTTP/1.1 and HTTP/2.
//!
//! ```text
//! accept ─(limit)─▶ TLS handshake ─(10 s)─▶ HTTP ─(first request: 30 s)─▶ unread bodies ─▶ Router
//! ```
//!
//! `axum-server` accepts, serves and drains; hyper bounds heads and HTTP/2. This module adds what
//! both leave open: the number of connections, silence before the first request, clients that do
//! not read, and bodies that nobody reads.

mod socket;
#[cfg(test)]
mod tests;
mod tls;
mod unread;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use axum::{Router, middleware};
use axum_server::tls_rustls::RustlsAcceptor;
use axum_server::{Handle, Server};
use blaze_runtime::{Supervisor, TaskHandle, TaskPolicy};
use hyper_util::rt::TokioTimer;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use crate::metrics::ApiMetrics;
use socket::Acceptor;
use unread::Reader;

pub use tls::{Tls, install_crypto_provider};

/// Lines of a head of HTTP/1.1; one with more is answered 431 by the library, without a body. What
/// has fewer lines and too many bytes reaches the router.
const MAX_HEADER_LINES: usize = 1024;
/// Bytes of a head beyond which the library answers 431. Twice what the contract allows, so that
/// the refusal of the router can have its form.
const MAX_HEAD_BYTES: u32 = 64 * 1024;
/// Requests at once on one connection of HTTP/2.
const MAX_STREAMS: u32 = 1000;
/// Bytes of answers that wait in one stream of HTTP/2.
const STREAM_BUFFER_BYTES: usize = 128 * 1024;

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
    /// For the head of a request, and from the acceptance to the first request.
    pub head_timeout: Duration,
    /// A client that takes no byte for this long loses its connection.
    pub write_stall: Duration,
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
            write_stall: Duration::from_secs(60),
            keep_alive_interval: Duration::from_secs(20),
            keep_alive_timeout: Duration::from_secs(10),
            // Twice the largest body.
            unread_bytes: 16 * 1024 * 1024,
            unread_time: Duration::from_secs(5),
            drain_timeout: Duration::from_secs(30),
        }
    }
}

/// The connection that a request came on. In the extensions of every request, beside
/// `ConnectInfo<SocketAddr>`.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Whether the connection is encrypted.
    pub encrypted: bool,
    has_asked: Arc<AtomicBool>,
}

/// A port that is bound and not served yet; connections wait.
#[derive(Debug)]
pub struct Listener {
    name: &'static str,
    listener: TcpListener,
    address: SocketAddr,
    tls: Option<Tls>,
    protocols: Protocols,
    limits: Arc<ListenLimits>,
}

impl Listener {
    /// Binds the port (0: any). `name` is that in metrics and logs: `rest`, `grpc`. Without `tls`
    /// it speaks plaintext; whether that is allowed was settled before.
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
        let describe = |error: io::Error| {
            io::Error::new(error.kind(), format!("{name} port {address}: {error}"))
        };
        let listener = TcpListener::bind(address).await.map_err(describe)?;
        let address = listener.local_addr().map_err(describe)?;
        Ok(Self { name, listener, address, tls, protocols, limits: Arc::new(limits) })
    }

    /// The address with the real port.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Serves until [`Serving::stop`] or the supervisor's shutdown.
    pub fn serve(self, supervisor: &Supervisor, router: Router, metrics: &ApiMetrics) -> Serving {
        let (name, address) = (self.name, self.address);
        let (drain, handle) = (self.limits.drain_timeout, Handle::new());
        let reader = Reader { limits: Arc::clone(&self.limits), supervisor: supervisor.clone() };
        let app = router
            .layer(middleware::from_fn_with_state(reader, unread::read_on))
            .into_make_service_with_connect_info::<SocketAddr>();
        let stop = supervisor.shutdown_token().child_token();
        let server = self.server(metrics, stop.clone()).handle(handle.clone());
        let stopped = stop.clone();
        let task = async move {
            let served = server.serve(app);
            tokio::pin!(served);
            tokio::select! {
                ended = &mut served => return ended,
                () = stopped.cancelled() => handle.graceful_shutdown(Some(drain)),
            }
            let ended = served.await;
            let left = handle.connection_count();
            if left > 0 {
                tracing::warn!(
                    port = name,
                    left,
                    "connections are cut: their requests did not end"
                );
            }
            ended
        };
        let task = supervisor.spawn(format!("{name} port"), TaskPolicy::Essential, task);
        Serving { address, stop, task }
    }

    fn server(self, metrics: &ApiMetrics, stop: CancellationToken) -> Server<SocketAddr, Acceptor> {
        let (limits, protocols) = (self.limits, self.protocols);
        let acceptor = Acceptor {
            tls: self.tls.map(|tls| {
                RustlsAcceptor::new(tls.config(protocols))
                    .handshake_timeout(limits.handshake_timeout)
            }),
            places: Arc::new(Semaphore::new(limits.connections)),
            limits: Arc::clone(&limits),
            metrics: metrics.connections(self.name),
            stop,
        };
        let mut server = Server::from_listener(self.listener).acceptor(acceptor);
        let builder = server.http_builder();
        builder
            .http1()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head_timeout)
            .max_headers(MAX_HEADER_LINES)
            .max_buf_size(MAX_HEAD_BYTES as usize);
        // A head that does not end holds up the answer to a PING: the keep-alive is its limit of
        // time.
        builder
            .http2()
            .timer(TokioTimer::new())
            .keep_alive_interval(limits.keep_alive_interval)
            .keep_alive_timeout(limits.keep_alive_timeout)
            .max_concurrent_streams(MAX_STREAMS)
            .max_send_buf_size(STREAM_BUFFER_BYTES)
            .max_header_list_size(MAX_HEAD_BYTES);
        match protocols {
            Protocols::Both => server,
            Protocols::Http2 => server.http2_only(),
        }
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

    /// Takes no more connections, and no more requests on those that are open. For the process as a
    /// whole only: before its shutdown began this counts as a failure.
    pub fn stop(&self) {
        self.stop.cancel();
    }

    /// Waits until all requests have ended and the port is closed.
    pub async fn drained(&self) {
        self.task.finished().await;
    }
}
