//! Keeps a stream to the main service open: connects, greets, hands on what comes, says what the
//! worker has; after an end of any kind it waits and begins anew.

use std::path::{Path, PathBuf};
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
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status, Streaming};

use super::backoff::Backoff;
use super::wire::IncomingError;
use crate::core::Incoming;
use crate::settings::is_this_machine;

/// Largest message that is taken.
const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
/// Time for one connection to come about.
const CONNECT: Duration = Duration::from_millis(1500);
/// Time for files to be read, a connection to come about and TLS to be agreed upon.
const REACH: Duration = Duration::from_secs(5);
/// The main service says something every 15 s; one that is silent for so long is as good as away,
/// whatever its host answers.
const SILENCE: Duration = Duration::from_secs(45);
/// A stream that ended sooner was none: the next one is not tried at once.
const GOOD: Duration = Duration::from_secs(10);
/// Time for the answer to Hello.
const WELCOME: Duration = Duration::from_secs(10);
/// Between two looks whether the other end is still there. A cut link loses packets without a word,
/// and TCP sends again in steps that double: after 30 s the next one comes only 25 s later. So this
/// end notices by itself, and connects anew.
const ALIVE: Duration = Duration::from_secs(3);
/// Time for the answer to such a look.
const ALIVE_ANSWER: Duration = Duration::from_secs(3);
/// Token files are small.
const MAX_TOKEN_BYTES: u64 = 8192;
/// So are files of authorities, certificates and keys.
const MAX_PEM_BYTES: u64 = 1024 * 1024;

/// How each part of a file in PEM form begins.
const PEM: &[u8] = b"-----BEGIN ";

/// Where the main service is and how it knows this worker. Files are read anew for each connection.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MainService {
    /// `https://HOST:PORT`, or `http://` on this machine.
    pub server: String,
    /// Authorities that are trusted instead of the system's.
    pub ca_file: Option<PathBuf>,
    /// File with the token.
    pub token_file: Option<PathBuf>,
    /// Files with the own certificate and its key, for a main service that asks for one.
    pub certificate: Option<(PathBuf, PathBuf)>,
}

impl MainService {
    /// Whether nobody else can read what is said: over TLS, or within this machine.
    #[must_use]
    pub fn is_safe(&self) -> bool {
        match self.server.strip_prefix("http://") {
            Some(rest) => is_this_machine(rest),
            None => self.server.starts_with("https://"),
        }
    }
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
    #[error("refused: {}", words(.0))]
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
    Greeting {
        /// Secrets come as text over this connection.
        is_safe: bool,
        /// Where the answer goes.
        answer: oneshot::Sender<v1::Hello>,
    },
    /// The main service has accepted it. Cancelling the token ends this stream, and the next
    /// greeting is asked for.
    Opened(CancellationToken),
    /// It has said something.
    Said(Incoming),
    /// The stream has ended, or none came about.
    Closed {
        /// Why, for people.
        reason: String,
        /// What came cannot be taken, and would come again: only everything anew helps.
        is_unreadable: bool,
    },
}

/// Follows the main service until `stop`. What the worker has (`acks`) is said whenever it changes;
/// the newest counts.
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
    is_unreadable: bool,
    /// It was a good one: whatever failed before counts no more.
    was_good: bool,
    /// The main service says when to come again.
    again: Option<Duration>,
    contact: Option<Instant>,
}

impl Client {
    async fn run(mut self) {
        // Whoever has just started is as impatient as whoever was in contact just now.
        let (mut backoff, mut contact) = (Backoff::default(), Instant::now());
        loop {
            self.main.borrow_and_update();
            let end = match self.once().await {
                Ok(end) => end,
                Err(ConnectError::Ending) => return,
                Err(error) => End {
                    reason: error.to_string(),
                    is_unreadable: false,
                    was_good: false,
                    again: None,
                    contact: None,
                },
            };
            contact = end.contact.unwrap_or(contact);
            if end.was_good {
                backoff.reset();
            }
            tracing::debug!(reason = end.reason, "not connected with the main service");
            let closed = SyncEvent::Closed { reason: end.reason, is_unreadable: end.is_unreadable };
            if self.events.send(closed).await.is_err() {
                return;
            }
            let since = Some(contact.elapsed());
            let pause = backoff.next(since, rand::random());
            // The main service knows best; a wish of our own counts only if it is not the next of
            // many.
            let wait = end.again.filter(|again| end.was_good || !again.is_zero()).unwrap_or(pause);
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
        let reached =
            tokio::time::timeout(REACH, async { Ok((token(&main).await?, channel(&main).await?)) })
                .await;
        let (token, channel) = reached.unwrap_or_else(|_| {
            let reason = format!("no connection within {} s", REACH.as_secs());
            Err(ConnectError::Transport(reason))
        })?;
        let (answer, hello) = oneshot::channel();
        let is_safe = main.is_safe();
        let asked = self.events.send(SyncEvent::Greeting { is_safe, answer }).await;
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
        let acks =
            WatchStream::from_changes(acks).filter_map(|ack| async move { ack.map(Msg::Ack) });
        let said = futures::stream::iter([Msg::Hello(hello)]).chain(acks);
        let mut request = Request::new(said.map(|msg| v1::SyncRequest { msg: Some(msg) }));
        if let Some(token) = token {
            request.metadata_mut().insert("authorization", token);
        }
        let mut client =
            SyncServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        match tokio::time::timeout(WELCOME, client.sync(request)).await {
            Ok(Ok(response)) => Ok(response.into_inner()),
            Ok(Err(status)) => Err(ConnectError::Refused(status)),
            Err(_) => Err(ConnectError::Transport("no answer to Hello within 10 s".to_owned())),
        }
    }

    /// Hands on what comes until the stream ends.
    async fn listen(&mut self, mut stream: Streaming<v1::SyncResponse>) -> End {
        let restart = CancellationToken::new();
        let began = Instant::now();
        let mut contact = began;
        let (mut again, mut is_unreadable) = (None, false);
        let mut open = self.events.send(SyncEvent::Opened(restart.clone())).await.is_ok();
        let reason = loop {
            if !open {
                break "the worker is ending".to_owned();
            }
            let message = tokio::select! {
                message = tokio::time::timeout(SILENCE, stream.message()) => match message {
                    Ok(message) => message,
                    Err(_) => break format!(
                        "the main service has said nothing for {} s",
                        SILENCE.as_secs(),
                    ),
                },
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
                // A message of a newer protocol.
                Ok(Some(Err(IncomingError::Unknown))) => {}
                Ok(Some(Err(fault))) => {
                    is_unreadable = true;
                    break fault.to_string();
                }
                Ok(None) => break "the main service has ended the stream".to_owned(),
                Err(status) => {
                    // The library's word for a message that is too large.
                    is_unreadable = status.code() == tonic::Code::OutOfRange;
                    break ConnectError::Refused(status).to_string();
                }
            }
        };
        End {
            reason,
            is_unreadable,
            was_good: began.elapsed() >= GOOD,
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
    let endpoint = Endpoint::from_shared(main.server.clone())
        .map_err(|error| ConnectError::Address(error.to_string()))?;
    let endpoint = endpoint
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(ALIVE)
        .keep_alive_timeout(ALIVE_ANSWER)
        .keep_alive_while_idle(true);
    let endpoint = match main.server.starts_with("https://") {
        false => endpoint,
        true => {
            let tls = ClientTlsConfig::new().timeout(CONNECT);
            let tls = match &main.ca_file {
                None => tls.with_native_roots(),
                Some(path) => {
                    tls.ca_certificate(Certificate::from_pem(pem("config.ca_file", path).await?))
                }
            };
            let tls = match &main.certificate {
                None => tls,
                Some((certificate, key)) => {
                    let certificate = pem("config.cert_file", certificate).await?;
                    tls.identity(Identity::from_pem(
                        certificate,
                        pem("config.key_file", key).await?,
                    ))
                }
            };
            endpoint.tls_config(tls).map_err(|error| ConnectError::Transport(chain(&error)))?
        }
    };
    endpoint.connect().await.map_err(|error| ConnectError::Transport(chain(&error)))
}

/// What a file in PEM form holds; `key` names it in the node file.
async fn pem(key: &'static str, path: &Path) -> Result<Vec<u8>, ConnectError> {
    let refuse = |reason| ConnectError::File { key, path: path.to_owned(), reason };
    let text = read(path, MAX_PEM_BYTES).await.map_err(refuse)?;
    // The library takes a file without any for one with none, and then only the other end says that
    // something is missing.
    let has_some = text.windows(PEM.len()).any(|start| start == PEM);
    has_some.then_some(text).ok_or_else(|| refuse("it holds nothing in PEM form".to_owned()))
}

/// What a refusal says, with what caused it where the connection broke.
fn words(status: &Status) -> String {
    let cause = std::error::Error::source(status).map(chain);
    let text = match cause {
        Some(cause) => format!("{} ({:?}): {cause}", status.message(), status.code()),
        None => format!("{} ({:?})", status.message(), status.code()),
    };
    // As TLS names it. It comes after the connection does, in answer to the first call.
    match text.contains("CertificateRequired") {
        true => format!(
            "the main service asks for a client certificate: name it with config.cert_file and \
             config.key_file [{text}]"
        ),
        false => text,
    }
}

/// The library's errors say little; what caused them says more.
fn chain(error: &(dyn std::error::Error + 'static)) -> String {
    let causes: Vec<String> = anyhow::Chain::new(error).map(ToString::to_string).collect();
    causes.join(": ")
}

async fn read(path: &Path, most: u64) -> Result<Vec<u8>, String> {
    let bytes = tokio::fs::read(path).await.map_err(|error| error.to_string())?;
    if bytes.len() as u64 > most {
        return Err(format!("it has {} bytes, at most {most} are read", bytes.len()));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tls_and_this_machine_are_safe() {
        for (server, is_safe) in [
            ("https://config.example.org:50051", true),
            ("http://127.0.0.1:50051", true),
            ("http://[::1]:50051", true),
            ("http://localhost", true),
            ("http://10.0.3.1:50051", false),
            ("http://localhost.example.org", false),
            ("http://127.0.0.1@evil.example.org", false),
            ("ftp://127.0.0.1", false),
        ] {
            let main = MainService { server: server.to_owned(), ..MainService::default() };
            assert_eq!(main.is_safe(), is_safe, "{server}");
        }
    }
}
