//! Keeps a stream to the main service open: connects, greets, hands on what comes, says what the
//! worker has; after an end of any kind it waits and begins anew.

use std::time::Duration;

use blaze_proto::v1;
use blaze_proto::v1::sync_request::Msg;
use blaze_proto::v1::sync_service_client::SyncServiceClient;
use blaze_runtime::main_service::{self, Backoff, MainService};
use futures::StreamExt as _;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::WatchStream;
use tokio_util::sync::CancellationToken;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::Channel;
use tonic::{Request, Status, Streaming};

use super::wire::IncomingError;
use crate::core::Incoming;

/// Largest message that is taken.
const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
/// The main service says something every 15 s; one that is silent for so long is as good as away,
/// whatever its host answers.
const SILENCE: Duration = Duration::from_secs(45);
/// A stream that ended sooner was none: the next one is not tried at once.
const GOOD: Duration = Duration::from_secs(10);
/// Time for the answer to Hello.
const WELCOME: Duration = Duration::from_secs(10);
/// Why there is no stream.
#[derive(Debug, thiserror::Error)]
pub enum StreamError {
    /// No connection came about.
    #[error(transparent)]
    Connect(#[from] main_service::ConnectError),
    /// Nobody answers.
    #[error("no connection: {0}")]
    Silent(&'static str),
    /// The main service refuses.
    #[error("refused: {}", main_service::words(.0))]
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
                Err(StreamError::Ending) => return,
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
    async fn once(&mut self) -> Result<End, StreamError> {
        let main = self.main.borrow().clone();
        let (channel, token) = main.connect().await?;
        let (answer, hello) = oneshot::channel();
        let is_safe = main.is_safe();
        let asked = self.events.send(SyncEvent::Greeting { is_safe, answer }).await;
        asked.map_err(|_| StreamError::Ending)?;
        let hello = hello.await.map_err(|_| StreamError::Ending)?;
        let stream = self.open(channel, token, hello).await?;
        Ok(self.listen(stream).await)
    }

    async fn open(
        &self,
        channel: Channel,
        token: Option<MetadataValue<Ascii>>,
        hello: v1::Hello,
    ) -> Result<Streaming<v1::SyncResponse>, StreamError> {
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
            Ok(Err(status)) => Err(StreamError::Refused(status)),
            Err(_) => Err(StreamError::Silent("no answer to Hello within 10 s")),
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
                    break StreamError::Refused(status).to_string();
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
