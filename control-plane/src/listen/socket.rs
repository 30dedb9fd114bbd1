//! One connection, from its acceptance to its first request.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use axum::Extension;
use axum::middleware::AddExtension;
use axum_server::accept::Accept;
use axum_server::tls_rustls::RustlsAcceptor;
use futures::FutureExt as _;
use futures::future::BoxFuture;
use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::either::Either;
use tokio_util::sync::CancellationToken;
use tower::Layer as _;

use super::{ListenLimits, Peer};
use crate::metrics::{ConnectionMetrics, OpenGauge};

/// Takes a connection, or closes it.
#[derive(Clone)]
pub(super) struct Acceptor {
    pub(super) tls: Option<RustlsAcceptor>,
    pub(super) places: Arc<Semaphore>,
    pub(super) limits: Arc<ListenLimits>,
    pub(super) metrics: ConnectionMetrics,
    pub(super) stop: CancellationToken,
}

type Tls<S> = <RustlsAcceptor as Accept<Socket, S>>::Stream;

impl<S: Send + 'static> Accept<TcpStream, S> for Acceptor {
    type Stream = Either<Socket, Tls<S>>;
    type Service = AddExtension<S, Peer>;
    type Future = BoxFuture<'static, io::Result<(Self::Stream, Self::Service)>>;

    fn accept(&self, stream: TcpStream, service: S) -> Self::Future {
        let acceptor = self.clone();
        Box::pin(async move {
            let peer = Peer { encrypted: acceptor.tls.is_some(), has_asked: Arc::default() };
            let socket = acceptor.socket(stream, Arc::clone(&peer.has_asked))?;
            let Some(tls) = acceptor.tls else {
                return Ok((Either::Left(socket), Extension(peer).layer(service)));
            };
            let shaken = tls.accept(socket, service).await.inspect_err(|error| {
                acceptor.metrics.count(match error.kind() {
                    io::ErrorKind::TimedOut => "handshake_timeout",
                    _ => "handshake_failed",
                });
            });
            let (stream, service) = shaken?;
            Ok((Either::Right(stream), Extension(peer).layer(service)))
        })
    }
}

impl Acceptor {
    fn socket(&self, stream: TcpStream, has_asked: Arc<AtomicBool>) -> io::Result<Socket> {
        let Ok(place) = Arc::clone(&self.places).try_acquire_owned() else {
            self.metrics.count("refused");
            return Err(io::ErrorKind::QuotaExceeded.into());
        };
        self.metrics.count("accepted");
        // Small answers go at once.
        stream.set_nodelay(true)?;
        // The kernel ends a connection whose client acknowledges nothing, or leaves its window
        // closed.
        SockRef::from(&stream).set_tcp_user_timeout(Some(self.limits.write_stall))?;
        let stopped = self.stop.clone().cancelled_owned();
        Ok(Socket {
            stream,
            has_asked,
            silence: Some(
                tokio::time::timeout(self.limits.head_timeout, stopped)
                    .map(|ended| ended.is_err())
                    .boxed(),
            ),
            metrics: self.metrics.clone(),
            _held: (place, self.metrics.open()),
        })
    }
}

/// The stream below TLS. It breaks when no first request comes, which hyper does not bound before
/// it knows the version of HTTP, nor in the handshake of HTTP/2.
pub(super) struct Socket {
    stream: TcpStream,
    has_asked: Arc<AtomicBool>,
    /// Until the first request: ends at its deadline (`true`), or when the port stops.
    silence: Option<BoxFuture<'static, bool>>,
    metrics: ConnectionMetrics,
    _held: (OwnedSemaphorePermit, OpenGauge),
}

impl Socket {
    fn is_silent_too_long(&mut self, context: &mut Context<'_>) -> bool {
        if self.has_asked.load(Ordering::Relaxed) {
            self.silence = None;
        }
        let Some(Poll::Ready(timed_out)) =
            self.silence.as_mut().map(|silence| silence.poll_unpin(context))
        else {
            return false;
        };
        self.silence = None;
        if timed_out {
            self.metrics.count("timeout");
        }
        true
    }

    /// Counts a connection that the kernel ended because the client takes nothing.
    fn counted<T>(&self, result: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if let Poll::Ready(Err(error)) = &result
            && error.kind() == io::ErrorKind::TimedOut
        {
            self.metrics.count("stalled");
        }
        result
    }
}

impl AsyncRead for Socket {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.is_silent_too_long(context) {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.counted(read)
    }
}

impl AsyncWrite for Socket {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.counted(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.counted(written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
