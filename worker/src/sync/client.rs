//! Keeps a stream to the main service open: connects, greets, hands on what comes, says what the worker has; after an end of
//! any kind it waits and begins anew.

use std::path::PathBuf;
use std::time::Duration;

use blaze_proto::v1;
use blaze_proto::v1::sync_request::Msg;
use blaze_proto::v1::sync_service_client::SyncServiceClient;
use futures::StreamExt as _;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::WatchStream;
use tokio_util::sync::CancellationToken;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint};
use tonic::{Request, Status, Streaming};

use super::backoff::Backoff;
use super::wire::IncomingError;
use crate::core::Incoming;

/// Largest message that is taken.
const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
/// Time for one connection to come about.
const CONNECT: Duration = Duration::from_millis(1500);
/// Time for the answer to Hello.
const WELCOME: Duration = Duration::from_secs(10);
/// Between two looks whether the other end is still there. A cut link loses packets without a word, and TCP sends again in
/// steps that double: after 30 s the next one comes only 25 s later. So this end notices by itself, and connects anew.
const ALIVE: Duration = Duration::from_secs(3);
/// Time for the answer to such a look.
const ALIVE_ANSWER: Duration = Duration::from_secs(3);
/// Token files are small.
const MAX_TOKEN_BYTES: u64 = 8192;
/// So are files of authorities.
const MAX_CA_BYTES: u64 = 1024 * 1024;

/// Where the main service is and how it knows this worker. Files are read anew for each connection.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MainService {
    /// `https://HOST:PORT`, or `http://` on this machine.
    pub server: String,
    /// Authorities that are trusted instead of the system's.
    pub ca_file: Option<PathBuf>,
    /// File with the token.
    pub token_file: Option<PathBuf>,
}

/// Why there is no stream.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The address is none.
    #[error("config.server: {0}")]
    Address(String),
    /// A file cannot be used.
    #[error("{key}: {path}: {reason}", path = path.display())]
    File {
        /// Key in the node file.
        key: &'static str,
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Nobody answers.
    #[error("no connection: {0}")]
    Transport(String),
    /// The main service refuses.
    #[error("refused: {} ({:?})", .0.message(), .0.code())]
    Refused(Status),
    /// What it says makes no sense.
    #[error(transparent)]
    Wire(#[from] IncomingError),
    /// The engine has ended.
    #[error("the worker is ending")]
    Ending,
}

/// What the engine is told.
#[derive(Debug)]
pub enum SyncEvent {
    /// A connection is being made: who asks, and what does it have?
    Greeting(oneshot::Sender<v1::Hello>),
    /// The main service has accepted it. Cancelling the token ends this stream, and the next greeting is asked for.
    Opened(CancellationToken),
    /// It has said something.
    Said(Incoming),
    /// The stream has ended, or none came about.
    Closed {
        /// Why, for people.
        reason: String,
    },
}

/// Follows the main service until `stop`. What the worker has (`acks`) is said whenever it changes; the newest counts.
pub async fn follow(
    main: watch::Receiver<MainService>,
    events: mpsc::Sender<SyncEvent>,
    acks: watch::Receiver<Option<v1::Ack>>,
    stop: CancellationToken,
) {
    let client = Client { main, events, acks };
    tokio::select! {
        () = client.run() => {}
        () = stop.cancelled() => {}
    }
}

struct Client {
    main: watch::Receiver<MainService>,
    events: mpsc::Sender<SyncEvent>,
    acks: watch::Receiver<Option<v1::Ack>>,
}

/// How a stream ended.
struct End {
    reason: String,
    /// The main service says when to come again.
    again: Option<Duration>,
    contact: Option<Instant>,
}

impl Client {
    async fn run(mut self) {
        let (mut backoff, mut contact) = (Backoff::default(), None);
        loop {
            self.main.borrow_and_update();
            let end = match self.once().await {
                Ok(end) => end,
                Err(ConnectError::Ending) => return,
                Err(error) => End {
                    reason: error.to_string(),
                    again: None,
                    contact: None,
                },
            };
            if end.contact.is_some() {
                contact = end.contact;
                backoff.reset();
            }
            tracing::debug!(reason = end.reason, "not connected with the main service");
            if self.events.send(SyncEvent::Closed { reason: end.reason }).await.is_err() {
                return;
            }
            let since = contact.map(|at: Instant| at.elapsed());
            let wait = end.again.unwrap_or_else(|| backoff.next(since, rand::random()));
            tokio::select! {
                () = tokio::time::sleep(wait) => {}
                // Another address is worth a try at once; without a sender there is none.
                Ok(()) = self.main.changed() => backoff.reset(),
            }
        }
    }

    /// One stream from its beginning to its end.
    async fn once(&mut self) -> Result<End, ConnectError> {
        let main = self.main.borrow().clone();
        let token = token(&main).await?;
        let channel = channel(&main).await?;
        let (send, hello) = oneshot::channel();
        let asked = self.events.send(SyncEvent::Greeting(send)).await;
        asked.map_err(|_| ConnectError::Ending)?;
        let hello = hello.await.map_err(|_| ConnectError::Ending)?;
        let stream = self.open(channel, token, hello).await?;
        Ok(self.listen(stream).await)
    }

    async fn open(
        &self,
        channel: Channel,
        token: Option<MetadataValue<Ascii>>,
        hello: v1::Hello,
    ) -> Result<Streaming<v1::SyncResponse>, ConnectError> {
        // What the last stream said is nothing to this one until the engine says it again.
        let mut acks = self.acks.clone();
        acks.mark_unchanged();
        let acks = WatchStream::from_changes(acks).filter_map(|ack| async move { ack.map(Msg::Ack) });
        let said = futures::stream::iter([Msg::Hello(hello)]).chain(acks);
        let mut request = Request::new(said.map(|msg| v1::SyncRequest { msg: Some(msg) }));
        if let Some(token) = token {
            request.metadata_mut().insert("authorization", token);
        }
        let mut client = SyncServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        match tokio::time::timeout(WELCOME, client.sync(request)).await {
            Ok(Ok(response)) => Ok(response.into_inner()),
            Ok(Err(status)) => Err(ConnectError::Refused(status)),
            Err(_) => Err(ConnectError::Transport("no answer to Hello within 10 s".to_owned())),
        }
    }

    /// Hands on what comes until the stream ends.
    async fn listen(&mut self, mut stream: Streaming<v1::SyncResponse>) -> End {
        let restart = CancellationToken::new();
        let mut contact = Instant::now();
        let mut again = None;
        let mut open = self.events.send(SyncEvent::Opened(restart.clone())).await.is_ok();
        let reason = loop {
            if !open {
                break "the worker is ending".to_owned();
            }
            let message = tokio::select! {
                message = stream.message() => message,
                () = restart.cancelled() => {
                    again = Some(Duration::ZERO);
                    break "the copy is asked for anew".to_owned();
                }
                _ = self.main.changed() => {
                    again = Some(Duration::ZERO);
                    break "the address of the main service was changed".to_owned();
                }
            };
            contact = Instant::now();
            match message.map(|said| said.map(Incoming::try_from)) {
                Ok(Some(Ok(incoming))) => {
                    if let Incoming::GoAway { retry_after, .. } = &incoming {
                        again = Some(*retry_after);
                    }
                    open = self.events.send(SyncEvent::Said(incoming)).await.is_ok();
                }
                Ok(Some(Err(fault))) => break fault.to_string(),
                Ok(None) => break "the main service has ended the stream".to_owned(),
                Err(status) => break ConnectError::Refused(status).to_string(),
            }
        };
        End {
            reason,
            again,
            contact: Some(contact),
        }
    }
}

async fn token(main: &MainService) -> Result<Option<MetadataValue<Ascii>>, ConnectError> {
    let Some(path) = &main.token_file else { return Ok(None) };
    let refuse = |reason: String| ConnectError::File {
        key: "config.token_file",
        path: path.clone(),
        reason,
    };
    let text = read(path, MAX_TOKEN_BYTES).await.map_err(&refuse)?;
    let text = String::from_utf8(text).map_err(|_| refuse("it is no text".to_owned()))?;
    let mut value: MetadataValue<Ascii> = format!("Bearer {}", text.trim())
        .parse()
        .map_err(|_| refuse("it holds no token".to_owned()))?;
    value.set_sensitive(true);
    Ok(Some(value))
}

async fn channel(main: &MainService) -> Result<Channel, ConnectError> {
    let endpoint = Endpoint::from_shared(main.server.clone()).map_err(|error| ConnectError::Address(error.to_string()))?;
    let endpoint = endpoint
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(ALIVE)
        .keep_alive_timeout(ALIVE_ANSWER)
        .keep_alive_while_idle(true);
    let endpoint = match main.server.starts_with("https://") {
        false => endpoint,
        true => {
            let tls = ClientTlsConfig::new();
            let tls = match &main.ca_file {
                None => tls.with_native_roots(),
                Some(path) => {
                    let refuse = |reason| ConnectError::File {
                        key: "config.ca_file",
                        path: path.clone(),
                        reason,
                    };
                    tls.ca_certificate(Certificate::from_pem(read(path, MAX_CA_BYTES).await.map_err(refuse)?))
                }
            };
            endpoint.tls_config(tls).map_err(|error| ConnectError::Transport(chain(&error)))?
        }
    };
    endpoint.connect().await.map_err(|error| ConnectError::Transport(chain(&error)))
}

/// The library's errors say little; what caused them says more.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text = format!("{text}: {cause}");
        source = cause.source();
    }
    text
}

async fn read(path: &std::path::Path, most: u64) -> Result<Vec<u8>, String> {
    let bytes = tokio::fs::read(path).await.map_err(|error| error.to_string())?;
    if bytes.len() as u64 > most {
        return Err(format!("it has {} bytes, at most {most} are read", bytes.len()));
    }
    Ok(bytes)
}
