//! Keeps one connection: connects, lets it be served, and connects again when it is lost.

use std::sync::Arc;
use std::time::{Duration, Instant};

use redis::aio::{AsyncPushSender, MultiplexedConnection, SendError};
use redis::{AsyncConnectionConfig, PushInfo, PushKind, RedisError, Value};
use tokio_util::sync::CancellationToken;

use super::Shared;
use super::pulse::{Backoff, Heard};
use super::state::{Line, LineState, State};
use super::subscriptions::Subscriptions;

/// Until a server that took the connection must have answered to the login.
const CONNECT: Duration = Duration::from_secs(3);
/// A connection that lived this long was good: the next attempt comes soon.
const HELD: Duration = Duration::from_secs(2);
/// Requests that wait for the library to encode them; what is under way is limited elsewhere, in bytes.
const LIBRARY_QUEUE: usize = 256;

/// A connection that stands.
pub(super) struct Session {
    pub(super) connection: MultiplexedConnection,
    /// Cancelled when the connection is gone.
    pub(super) lost: CancellationToken,
    pub(super) heard: Arc<Heard>,
}

/// Why there is no connection.
#[derive(Debug)]
pub(super) enum Failure {
    /// Nobody there, or the connection was lost.
    Away(String),
    /// The server said no.
    Refused(String),
}

impl From<RedisError> for Failure {
    fn from(error: RedisError) -> Self {
        if error.is_timeout() {
            Self::Away("no answer in time".to_owned())
        } else if error.is_io_error() || error.is_connection_dropped() {
            Self::Away(error.to_string())
        } else {
            Self::Refused(error.to_string())
        }
    }
}

impl From<Failure> for LineState {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Away(why) => Self::Away(why),
            Failure::Refused(why) => Self::Refused(why),
        }
    }
}

/// Takes what the server sends unasked. Runs inside the task that reads the socket, so it never waits.
struct Pushes {
    state: Arc<State>,
    subscriptions: Option<Arc<Subscriptions>>,
    lost: CancellationToken,
    heard: Arc<Heard>,
}

impl AsyncPushSender for Pushes {
    fn send(&self, push: PushInfo) -> Result<(), SendError> {
        match push.kind {
            PushKind::Disconnection => self.lost.cancel(),
            PushKind::Message => self.message(push.data),
            _ => {}
        }
        Ok(())
    }
}

impl Pushes {
    fn message(&self, data: Vec<Value>) {
        let now = Instant::now();
        self.heard.note(now);
        let mut data = data.into_iter();
        let (Some(subscriptions), Some(Value::BulkString(channel)), Some(Value::BulkString(payload))) =
            (&self.subscriptions, data.next(), data.next())
        else {
            return;
        };
        if self.state.delivers() {
            subscriptions.deliver(&channel, payload, now);
        }
    }
}

/// What a connection is for.
pub(super) trait Serve: Send {
    fn line(&self) -> Line;

    /// Where messages go that come on it.
    fn subscriptions(&self) -> Option<Arc<Subscriptions>>;

    /// Uses the connection until it is lost, and says why. Dropped when the broker is closed.
    fn serve(&mut self, session: &Session) -> impl Future<Output = Failure> + Send;

    /// The connection is gone or could not be made.
    fn interrupted(&mut self, _why: &str) {}
}

/// Keeps a connection until the broker is closed.
pub(super) async fn keep(shared: Arc<Shared>, mut service: impl Serve) {
    let stop = shared.stop.clone();
    let line = service.line();
    // Also where this task is aborted, nobody holds the connection any longer.
    let _vacate = Vacate(&shared, line);
    let attempts = async {
        let mut backoff = Backoff::default();
        loop {
            let began = Instant::now();
            let failure = attempt(&shared, &mut service).await;
            shared.put_connection(line, None);
            report(&shared, line, &failure);
            let (Failure::Away(why) | Failure::Refused(why)) = &failure;
            service.interrupted(why);
            shared
                .state
                .change(|conditions| conditions.set_line(line, failure.into()));
            if began.elapsed() >= HELD {
                backoff.reset();
            }
            tokio::time::sleep(backoff.next(rand::random())).await;
        }
    };
    tokio::select! {
        biased;
        () = stop.cancelled() => {}
        () = attempts => {}
    }
}

/// Connects and serves; returns when there is no connection any more.
async fn attempt(shared: &Arc<Shared>, service: &mut impl Serve) -> Failure {
    let session = match connect(shared, service.subscriptions()).await {
        Ok(session) => session,
        Err(error) => return error.into(),
    };
    shared.put_connection(service.line(), Some(session.connection.clone()));
    service.serve(&session).await
}

async fn connect(shared: &Shared, subscriptions: Option<Arc<Subscriptions>>) -> redis::RedisResult<Session> {
    let lost = CancellationToken::new();
    let heard = Arc::new(Heard::new(Instant::now()));
    let pushes = Pushes {
        state: Arc::clone(&shared.state),
        subscriptions,
        lost: lost.clone(),
        heard: Arc::clone(&heard),
    };
    // An answer may come late, and then counts: there is no time-out after which something would be sent again.
    let config = AsyncConnectionConfig::new()
        .set_connection_timeout(Some(CONNECT))
        .set_response_timeout(None)
        .set_pipeline_buffer_size(LIBRARY_QUEUE)
        .set_push_sender(pushes);
    let client = &shared.settings.client;
    let connection = client.get_multiplexed_async_connection_with_config(&config).await?;
    heard.note(Instant::now());
    Ok(Session {
        connection,
        lost,
        heard,
    })
}

/// A lost reader may have been too slow for the server: that would be seen nowhere else.
fn report(shared: &Shared, line: Line, failure: &Failure) {
    let (Failure::Away(why) | Failure::Refused(why)) = failure;
    let was_up = shared
        .state
        .read(|conditions| matches!(conditions.line(line), LineState::Up | LineState::Silent));
    if was_up && line.reads() {
        tracing::warn!(
            connection = line.name(),
            why,
            "a reading connection to redis was lost: what is published until it is back is missing; where the server \
             stays up and this repeats, raise its client-output-buffer-limit for pubsub"
        );
    } else {
        tracing::debug!(connection = line.name(), why, "no connection to redis");
    }
}

struct Vacate<'a>(&'a Shared, Line);

impl Drop for Vacate<'_> {
    fn drop(&mut self) {
        let Self(shared, line) = self;
        shared.put_connection(*line, None);
        let ended = LineState::Away("its task has ended".to_owned());
        shared.state.change(|conditions| conditions.set_line(*line, ended));
    }
}
