//! The admin port: `/livez`, `/readyz`, `/metrics` and what the program adds.
//!
//! It must answer when all else fails, so nothing that comes in from outside ends it or takes more
//! than its share: the number of connections, the time for a request's head and the sizes of head
//! and body are bounded, and what is no HTTP is counted and closed.

mod readiness;
mod routes;
#[cfg(test)]
mod tests;

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

pub use readiness::{CheckReport, CheckStatus, Gate, Readiness, ReadinessReport, ReadinessStatus};

use crate::supervisor::{Supervisor, TaskHandle, TaskPolicy, say};

/// Gives the metrics in the text format of Prometheus.
pub type MetricsText = Arc<dyn Fn() -> String + Send + Sync>;

/// Makes of the program's own page of metrics the one with `?all=1`.
pub type AllMetrics = Arc<dyn Fn(String) -> Pin<Box<dyn Future<Output = String> + Send>> + Send + Sync>;

/// What the port allows.
#[derive(Debug, Clone)]
pub struct AdminLimits {
    /// Connections at once; more are closed at once.
    pub connections: usize,
    /// For the head of a request, and between two requests.
    pub head_timeout: Duration,
    /// Head of a request, in bytes; at least 8192.
    pub head_bytes: usize,
    /// Body of a request, in bytes.
    pub body_bytes: usize,
    /// For open requests when the process ends.
    pub close_timeout: Duration,
}

impl Default for AdminLimits {
    fn default() -> Self {
        Self {
            connections: 256,
            head_timeout: Duration::from_secs(5),
            head_bytes: 16 * 1024,
            body_bytes: 64 * 1024,
            close_timeout: Duration::from_secs(1),
        }
    }
}

/// Connections by their end.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    accepted: AtomicU64,
    refused: AtomicU64,
    malformed: AtomicU64,
    timed_out: AtomicU64,
    broken: AtomicU64,
    panicked: AtomicU64,
}

impl Counters {
    fn text(&self) -> String {
        let mut text =
            "# HELP blaze_admin_connections_total Connections to the admin port by what \
                        became of them.\n\
                        # TYPE blaze_admin_connections_total counter\n"
                .to_owned();
        for (result, counter) in [
            ("accepted", &self.accepted),
            ("refused", &self.refused),
            ("malformed", &self.malformed),
            ("timed_out", &self.timed_out),
            ("broken", &self.broken),
            ("panicked", &self.panicked),
        ] {
            let count = counter.load(Ordering::Relaxed);
            text.push_str(&format!(
                "blaze_admin_connections_total{{result=\"{result}\"}} {count}\n"
            ));
        }
        text
    }
}

/// A port that is bound and not served yet; connections wait.
pub struct AdminServer {
    listener: TcpListener,
    address: SocketAddr,
    router: Router,
    limits: AdminLimits,
    counters: Arc<Counters>,
}

/// Says on stderr where a program is asked, before it is ready: `admin listening on ADDRESS`.
pub fn say_listening(address: SocketAddr) {
    say(format_args!("admin listening on {address}"));
}

impl AdminServer {
    /// Binds the port (0: any); the program [says so](say_listening). `extra` holds the program's own
    /// routes; unknown paths and methods are answered for all.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub async fn bind(
        address: SocketAddr,
        extra: Router,
        readiness: Readiness,
        metrics: MetricsText,
    ) -> io::Result<Self> {
        Self::bind_with(address, extra, readiness, metrics, AdminLimits::default()).await
    }

    /// The same with other limits.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub async fn bind_with(
        address: SocketAddr,
        extra: Router,
        readiness: Readiness,
        metrics: MetricsText,
        limits: AdminLimits,
    ) -> io::Result<Self> {
        let describe = |error: io::Error| {
            io::Error::new(error.kind(), format!("admin port {address}: {error}"))
        };
        let listener = TcpListener::bind(address).await.map_err(describe)?;
        let address = listener.local_addr().map_err(describe)?;
        let counters = Arc::new(Counters::default());
        let router =
            routes::router(extra, readiness, metrics, Arc::clone(&counters), limits.body_bytes);
        Ok(Self { listener, address, router, limits, counters })
    }

    /// Answers `/metrics?all=1` with what `all` makes of the program's own page.
    #[must_use]
    pub fn all_metrics(mut self, all: AllMetrics) -> Self {
        self.router = routes::with_all_metrics(self.router, all);
        self
    }

    /// The address with the real port.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves until the supervisor's shutdown, also while the process drains.
    pub fn serve(self, supervisor: &Supervisor) -> TaskHandle {
        let stop = supervisor.shutdown_token();
        supervisor.spawn("admin port", TaskPolicy::Essential, self.accept(stop))
    }

    async fn accept(self, stop: CancellationToken) {
        let mut connections = JoinSet::new();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                Some(ended) = connections.join_next() => self.count_panic(&ended),
                accepted = self.listener.accept() => match accepted {
                    Ok((stream, _)) if connections.len() < self.limits.connections => {
                        self.counters.accepted.fetch_add(1, Ordering::Relaxed);
                        connections.spawn(self.connection(stream, stop.clone()));
                    }
                    // Dropped, that is closed: whoever asks may come again.
                    Ok(_) => {
                        self.counters.refused.fetch_add(1, Ordering::Relaxed);
                    }
                    Err(error) => {
                        // Too many open files, mostly: without a pause this would spin.
                        tracing::warn!(%error, "admin port cannot accept");
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                },
            }
        }
        let close = async { while connections.join_next().await.is_some() {} };
        // What is left is aborted with the set.
        let _ = tokio::time::timeout(self.limits.close_timeout, close).await;
    }

    fn count_panic(&self, ended: &Result<(), tokio::task::JoinError>) {
        if let Err(error) = ended
            && error.is_panic()
        {
            self.counters.panicked.fetch_add(1, Ordering::Relaxed);
            tracing::error!("a handler of the admin port panicked");
        }
    }

    fn connection(
        &self,
        stream: TcpStream,
        stop: CancellationToken,
    ) -> impl Future<Output = ()> + Send + 'static {
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.limits.head_timeout)
            .max_buf_size(self.limits.head_bytes.max(8192))
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(self.router.clone()));
        let counters = Arc::clone(&self.counters);
        async move {
            tokio::pin!(connection);
            let result = tokio::select! {
                result = &mut connection => result,
                () = stop.cancelled() => {
                    connection.as_mut().graceful_shutdown();
                    connection.await
                }
            };
            let Err(error) = result else { return };
            let counter = match &error {
                error if error.is_timeout() => &counters.timed_out,
                error if error.is_parse() => &counters.malformed,
                _ => &counters.broken,
            };
            counter.fetch_add(1, Ordering::Relaxed);
            tracing::debug!(%error, "admin connection ended early");
        }
    }
}

impl std::fmt::Debug for AdminServer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AdminServer").field("address", &self.address).finish_non_exhaustive()
    }
}
