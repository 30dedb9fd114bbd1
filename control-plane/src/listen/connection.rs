//! One connection, from its first byte to its last.

use std::convert::Infallible;
use std::error::Error;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::ConnectInfo;
use hyper::Request;
use hyper::body::Incoming;
use hyper::rt::Executor;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use parking_lot::Mutex;
use rustls::ServerConfig;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tower::Service as _;

use super::activity::{Activity, Trouble, WatchedBody};
use super::counters::Outcome;
use super::stall::StallGuard;
use super::unread::{Patience, ReadOn};
use super::{ListenCounters, ListenLimits, Peer, Protocols};

/// Lines of a head of HTTP/1.1; one with more is answered 431 by the library, without a body. What has fewer lines and too
/// many bytes reaches the router.
const MAX_HEADER_LINES: usize = 1024;
/// When all requests have ended, what they answered gets this long to reach the client.
const LINGER: Duration = Duration::from_secs(5);

pub(super) struct Connection {
    pub(super) peer: SocketAddr,
    pub(super) router: Router,
    pub(super) protocols: Protocols,
    pub(super) limits: Arc<ListenLimits>,
    pub(super) counters: Arc<ListenCounters>,
    pub(super) stop: CancellationToken,
}

impl Connection {
    pub(super) async fn run(self, stream: TcpStream, tls: Option<Arc<ServerConfig>>) {
        let _open = self.counters.opened();
        // Small answers go at once; without it they are only slower.
        let _ = stream.set_nodelay(true);
        let stream = StallGuard::new(stream, self.limits.write_stall, Arc::clone(&self.counters));
        let mut peer = Peer {
            address: self.peer,
            encrypted: tls.is_some(),
            certificate: false,
        };
        let Some(config) = tls else {
            return self.serve(stream, peer).await;
        };
        let handshake = TlsAcceptor::from(config).accept(stream);
        let shaken = tokio::select! {
            shaken = tokio::time::timeout(self.limits.handshake_timeout, handshake) => shaken,
            () = self.stop.cancelled() => return,
        };
        match shaken {
            Ok(Ok(stream)) => {
                peer.certificate = stream.get_ref().1.peer_certificates().is_some();
                self.serve(stream, peer).await;
            }
            Ok(Err(error)) => {
                self.counters.count(Outcome::Handshake);
                tracing::debug!(%error, peer = %self.peer, "TLS handshake failed");
            }
            Err(_) => self.counters.count(Outcome::HandshakeTimeout),
        }
    }

    async fn serve<S>(self, stream: S, peer: Peer)
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let activity = Activity::new();
        let (requests, router) = (Arc::clone(&activity), self.router.clone());
        let streams = OwnStreams(StreamTasks::new(Arc::clone(&self.counters)));
        let (tasks, patience) = (streams.0.clone(), self.patience());
        let service = service_fn(move |mut request: Request<Incoming>| {
            let running = requests.begin();
            request.extensions_mut().insert(ConnectInfo(peer.address));
            request.extensions_mut().insert(peer);
            let (parts, body) = request.into_parts();
            let body = ReadOn::new(body, &parts.headers, patience, tasks.clone());
            let answer = router.clone().call(Request::from_parts(parts, body));
            async move {
                let answer = answer.await?;
                Ok::<_, Infallible>(answer.map(|body| WatchedBody::new(body, running)))
            }
        });
        let builder = self.builder(&streams);
        let connection = builder.serve_connection(TokioIo::new(stream), service);
        tokio::pin!(connection);
        tokio::select! {
            ended = &mut connection => {
                if let Err(error) = ended {
                    self.count_error(&*error, &activity);
                }
                return;
            }
            () = self.stop.cancelled() => {}
            trouble = activity.trouble(&self.limits) => {
                self.count_trouble(trouble);
                if trouble == Trouble::Stalled {
                    return;
                }
            }
        }
        connection.as_mut().graceful_shutdown();
        let linger = if activity.has_served() { LINGER } else { Duration::ZERO };
        tokio::select! {
            // How it ends now is of no interest.
            _ = &mut connection => {}
            () = activity.quiet(linger) => {}
            // That it is idle is known; that nobody reads ends it all the same.
            () = stalled(&activity, &self.limits) => self.count_trouble(Trouble::Stalled),
        }
    }

    fn patience(&self) -> Patience {
        Patience {
            bytes: self.limits.unread_bytes,
            time: self.limits.unread_time,
        }
    }

    fn builder(&self, streams: &OwnStreams) -> Builder<StreamTasks> {
        let limits = &self.limits;
        let mut builder = Builder::new(streams.0.clone());
        builder
            .http1()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head_timeout)
            .max_headers(MAX_HEADER_LINES)
            .max_buf_size(limits.head_bytes.max(8192));
        // A head that does not end holds up the answer to a PING: the keep-alive is its limit of time.
        builder
            .http2()
            .timer(TokioTimer::new())
            .keep_alive_interval(limits.keep_alive_interval)
            .keep_alive_timeout(limits.keep_alive_timeout)
            .max_concurrent_streams(limits.streams)
            .max_send_buf_size(limits.stream_buffer_bytes)
            .max_header_list_size(u32::try_from(limits.head_bytes).unwrap_or(u32::MAX));
        match self.protocols {
            Protocols::Both => builder,
            Protocols::Http2 => builder.http2_only(),
        }
    }

    fn count_trouble(&self, trouble: Trouble) {
        self.counters.count(match trouble {
            Trouble::NoRequest => Outcome::Timeout,
            Trouble::Idle => Outcome::Idle,
            Trouble::Stalled => Outcome::Stalled,
        });
    }

    fn count_error(&self, error: &(dyn Error + Send + Sync + 'static), activity: &Activity) {
        let known = error.downcast_ref::<hyper::Error>();
        let is_timeout = known.is_some_and(hyper::Error::is_timeout);
        let outcome = match known {
            // Between two requests HTTP/1.1 waits for a head as well.
            _ if is_timeout && activity.has_served() => Outcome::Idle,
            _ if is_timeout => Outcome::Timeout,
            Some(error) if error.is_parse() => Outcome::Malformed,
            // The guard of the stream has counted it.
            _ if is_stall(error) => return,
            _ => Outcome::Broken,
        };
        self.counters.count(outcome);
        tracing::debug!(%error, peer = %self.peer, "connection ended early");
    }
}

/// Waits until an answer is not taken.
async fn stalled(activity: &Activity, limits: &ListenLimits) {
    while activity.trouble(limits).await != Trouble::Stalled {
        // Silence was told already: look again later.
        tokio::time::sleep(limits.write_stall).await;
    }
}

fn is_stall(error: &(dyn Error + 'static)) -> bool {
    let mut cause = Some(error);
    while let Some(error) = cause {
        if let Some(error) = error.downcast_ref::<std::io::Error>()
            && error.kind() == std::io::ErrorKind::TimedOut
        {
            return true;
        }
        cause = error.source();
    }
    false
}

/// Runs the requests of a connection of HTTP/2, and reads on what was left of bodies.
#[derive(Clone)]
pub(super) struct StreamTasks {
    tasks: Arc<Mutex<JoinSet<()>>>,
    counters: Arc<ListenCounters>,
}

impl StreamTasks {
    fn new(counters: Arc<ListenCounters>) -> Self {
        Self {
            tasks: Arc::new(Mutex::new(JoinSet::new())),
            counters,
        }
    }

    fn reap(&self, tasks: &mut JoinSet<()>) {
        while let Some(ended) = tasks.try_join_next() {
            if ended.is_err_and(|error| error.is_panic()) {
                self.counters.count(Outcome::Panicked);
                tracing::error!("a handler panicked");
            }
        }
    }
}

impl<F> Executor<F> for StreamTasks
where
    F: Future + Send + 'static,
    F::Output: Send + 'static,
{
    fn execute(&self, future: F) {
        let mut tasks = self.tasks.lock();
        self.reap(&mut tasks);
        tasks.spawn(async move {
            future.await;
        });
    }
}

/// Ends what still runs for a connection when the connection is gone.
struct OwnStreams(StreamTasks);

impl Drop for OwnStreams {
    fn drop(&mut self) {
        let mut tasks = self.0.tasks.lock();
        self.0.reap(&mut tasks);
        // The tasks hold the set that holds them: it must be told.
        tasks.abort_all();
    }
}
