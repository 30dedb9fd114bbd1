//! `Sync` as bytes: a main service that says whatever a test lets it, and a worker likewise. So
//! what was recorded is sent as it was, and what no version of ours says can be said.
//!
//! ```text
//! real worker ─▶ RawMain ─Session─▶ test ─RawStream─▶ real main service
//! ```

use std::convert::Infallible;
use std::net::SocketAddr;
use std::task::{Context, Poll};

use bytes::{Buf as _, BufMut as _, Bytes};
use futures::StreamExt as _;
use futures::stream::BoxStream;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::codegen::{Body, BoxFuture, Service, StdError, http};
use tonic::server::{NamedService, StreamingService};
use tonic::transport::Channel;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status, Streaming};

const PATH: &str = "/blaze.v1.SyncService/Sync";
/// Messages on their way; a test takes them one by one.
const QUEUE: usize = 1024;

/// Leaves messages as they are.
#[derive(Debug, Clone, Copy, Default)]
struct AsIs;

impl Codec for AsIs {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        *self
    }

    fn decoder(&mut self) -> Self {
        *self
    }
}

impl Encoder for AsIs {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, to: &mut EncodeBuf<'_>) -> Result<(), Status> {
        to.put(item);
        Ok(())
    }
}

impl Decoder for AsIs {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, from: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(from.copy_to_bytes(from.remaining())))
    }
}

/// One stream of a worker to a [`RawMain`].
pub(crate) struct Session {
    /// What the worker says.
    pub(crate) said: Streaming<Bytes>,
    /// What it is told; dropping it ends the stream.
    pub(crate) tell: mpsc::Sender<Result<Bytes, Status>>,
}

#[derive(Clone)]
struct Method(mpsc::Sender<Session>);

impl StreamingService<Bytes> for Method {
    type Response = Bytes;
    type ResponseStream = BoxStream<'static, Result<Bytes, Status>>;
    type Future = BoxFuture<Response<Self::ResponseStream>, Status>;

    fn call(&mut self, request: Request<Streaming<Bytes>>) -> Self::Future {
        let sessions = self.0.clone();
        Box::pin(async move {
            let (tell, told) = mpsc::channel(QUEUE);
            let said = request.into_inner();
            let session = Session { said, tell };
            let gone = |_| Status::unavailable("the test is over");
            sessions.send(session).await.map_err(gone)?;
            let told = futures::stream::unfold(told, |mut told| async move {
                Some((told.recv().await?, told))
            });
            Ok(Response::new(told.boxed()))
        })
    }
}

impl<B> Service<http::Request<B>> for Method
where
    B: Body + Send + 'static,
    B::Error: Into<StdError> + Send + 'static,
{
    type Response = http::Response<tonic::body::Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let method = self.clone();
        Box::pin(async move { Ok(tonic::server::Grpc::new(AsIs).streaming(method, request).await) })
    }
}

impl NamedService for Method {
    const NAME: &'static str = "blaze.v1.SyncService";
}

/// A main service that says what a test lets it say. It ends when dropped.
pub(crate) struct RawMain {
    pub(crate) address: SocketAddr,
    sessions: mpsc::Receiver<Session>,
    _server: JoinSet<()>,
}

impl RawMain {
    pub(crate) async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (send, sessions) = mpsc::channel(QUEUE);
        let mut server = JoinSet::new();
        server.spawn(async move {
            let router = tonic::transport::Server::builder().add_service(Method(send));
            router.serve_with_incoming(TcpIncoming::from(listener)).await.unwrap();
        });
        Self { address, sessions, _server: server }
    }

    /// The next stream that a worker opens.
    pub(crate) async fn session(&mut self) -> Session {
        self.sessions.recv().await.unwrap()
    }
}

/// A stream to a main service.
pub(crate) struct RawStream {
    pub(crate) say: mpsc::Sender<Bytes>,
    pub(crate) told: Streaming<Bytes>,
}

impl RawStream {
    /// Opens one and says the first message, without which nobody answers.
    pub(crate) async fn open(main: SocketAddr, first: Bytes) -> Result<Self, Status> {
        let channel = Channel::from_shared(format!("http://{main}")).unwrap();
        let mut client = tonic::client::Grpc::new(channel.connect().await.unwrap());
        client.ready().await.unwrap();
        let (say, said) = mpsc::channel(QUEUE);
        say.send(first).await.unwrap();
        let said =
            futures::stream::unfold(
                said,
                |mut said| async move { Some((said.recv().await?, said)) },
            );
        let told =
            client.streaming(Request::new(said), PathAndQuery::from_static(PATH), AsIs).await?;
        Ok(Self { say, told: told.into_inner() })
    }
}
