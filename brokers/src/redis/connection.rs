//! Keeps one connection: connects, lets it be served, watches it, and connects again when it is
//! lost.
//!
//! The `ConnectionManager` of the library (1.8.1) is not used:
//! - It subscribes again with one SUBSCRIBE and ignores a refusal: one channel that the access list
//!   forbids meanwhile silently costs all others.
//! - After a refused login it never connects again, even when the password is right later.
//! - It does not tell that it is connected again, nor why it is not yet, and puts an unbounded
//!   queue before the push sender.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_runtime::ticks;
use futures::FutureExt as _;
use futures::future::{Fuse, FusedFuture as _};
use redis::aio::{AsyncPushSender, MultiplexedConnection, SendError};
use redis::{AsyncConnectionConfig, PushInfo, PushKind, RedisError, RedisResult, Value};

use super::liveness::{LOOK, Liveness, Look, Watch};
use super::state::{Failure, Line, LineState, State};
use super::subscriptions::Subscriptions;
use super::writer::Writer;
use super::{Shared, reader, server};

/// Until a server that took the connection must have answered to the login.
const CONNECT: Duration = Duration::from_secs(3);
/// A connection that lived this long was good: the next attempt comes soon.
const HELD: Duration = Duration::from_secs(2);
/// Pause after the first failure; each further one doubles it, and a random part is left out.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
const LONGEST_PAUSE: Duration = Duration::from_millis(500);
/// Requests that wait for the library to encode them; what is under way is limited elsewhere, in
/// bytes.
const LIBRARY_QUEUE: usize = 256;

/// A connection that stands.
pub(super) struct Session {
    pub(super) connection: MultiplexedConnection,
    pub(super) liveness: Arc<Liveness>,
}

impl From<RedisError> for Failure {
    fn from(error: RedisError) -> Self {
        Self {
            is_refusal: !(error.is_timeout()
                || error.is_io_error()
                || error.is_connection_dropped()),
            why: if error.is_timeout() {
                "no answer in time".to_owned()
            } else {
                error.to_string()
            },
        }
    }
}

/// Takes what the server sends unasked. Runs inside the task that reads the socket, so it never
/// waits.
struct Pushes {
    state: Arc<State>,
    subscriptions: Option<Arc<Subscriptions>>,
    liveness: Arc<Liveness>,
}

impl AsyncPushSender for Pushes {
    fn send(&self, push: PushInfo) -> Result<(), SendError> {
        match push.kind {
            PushKind::Disconnection => self.liveness.lost.cancel(),
            PushKind::Message => self.message(push.data),
            _ => {}
        }
        Ok(())
    }
}

impl Pushes {
    fn message(&self, data: Vec<Value>) {
        self.liveness.received();
        let mut data = data.into_iter();
        if let (
            Some(subscriptions),
            Some(Value::BulkString(channel)),
            Some(Value::BulkString(payload)),
        ) = (&self.subscriptions, data.next(), data.next())
            && self.state.delivers()
        {
            subscriptions.deliver(&channel, payload, Instant::now());
        }
    }
}

/// Keeps a connection until the broker is closed.
pub(super) async fn keep(shared: Arc<Shared>, line: Line) {
    // Also where this task is aborted, nobody holds the connection any longer.
    let _vacate = Vacate(&shared, line);
    let mut pause = FIRST_PAUSE;
    let attempts = async {
        loop {
            let began = Instant::now();
            let failure = attempt(&shared, line).await;
            shared.put_connection(line, None);
            report(&shared, line, &failure);
            if let Some(subscriptions) = shared.subscriptions_of(line) {
                subscriptions.fail_waiting(&failure.why);
            }
            shared.state.set_line(line, LineState::Failed(failure));
            if began.elapsed() >= HELD {
                pause = FIRST_PAUSE;
            }
            tokio::time::sleep(pause.mul_f64(1.0 - 0.5 * rand::random::<f64>())).await;
            pause = (2 * pause).min(LONGEST_PAUSE);
        }
    };
    shared.stop.run_until_cancelled(attempts).await;
}

/// Connects and serves; returns when there is no connection any more.
async fn attempt(shared: &Shared, line: Line) -> Failure {
    let session = match connect(shared, line).await {
        Ok(session) => session,
        Err(failure) => return failure,
    };
    shared.put_connection(line, Some(session.connection.clone()));
    let served = async {
        let Err(failure) = match shared.subscriptions_of(line) {
            Some(subscriptions) => reader::serve(shared, line, subscriptions, &session).await,
            None => Writer::new(shared, line).serve(&session).await,
        };
        failure
    };
    tokio::select! {
        biased;
        failure = served => failure,
        () = session.liveness.lost.cancelled() => Failure::away("the connection was lost"),
        failure = watch(shared, line, &session) => failure,
    }
}

async fn connect(shared: &Shared, line: Line) -> Result<Session, Failure> {
    let liveness = Arc::<Liveness>::default();
    let pushes = Pushes {
        state: Arc::clone(&shared.state),
        subscriptions: shared.subscriptions_of(line).cloned(),
        liveness: Arc::clone(&liveness),
    };
    // An answer may come late, and then counts: there is no time-out after which something would be
    // sent again.
    let config = AsyncConnectionConfig::new()
        .set_connection_timeout(Some(CONNECT))
        .set_response_timeout(None)
        .set_pipeline_buffer_size(LIBRARY_QUEUE)
        .set_push_sender(pushes);
    let client = shared.settings.client().map_err(|error| Failure::refused(&error.to_string()))?;
    let connection = client.get_multiplexed_async_connection_with_config(&config).await?;
    Ok(Session { connection, liveness })
}

/// Pings a server that is quiet, and tells when it falls silent and when it answers again. Returns
/// when a ping fails.
async fn watch(shared: &Shared, line: Line, session: &Session) -> Failure {
    let mut watch = Watch::new(line.is_large());
    let mut looks = ticks(LOOK);
    let mut answer = std::pin::pin!(Fuse::terminated());
    loop {
        tokio::select! {
            biased;
            answer = &mut answer, if !answer.is_terminated() => match answer {
                Err(error) if !server::is_refusal(&error) => return error.into(),
                _ => session.liveness.received(),
            },
            _ = looks.tick() => match watch.look(&session.liveness) {
                Look::Alive => shared.set_silent(line, false),
                Look::Silent => shared.set_silent(line, true),
                Look::Ping if answer.is_terminated() =>
                    answer.set(ping(session.connection.clone()).fuse()),
                Look::Ping | Look::Unknown => {}
            },
        }
    }
}

async fn ping(mut connection: MultiplexedConnection) -> RedisResult<()> {
    redis::cmd("PING").exec_async(&mut connection).await
}

/// A lost reader may have been too slow for the server: that would be seen nowhere else.
fn report(shared: &Shared, line: Line, failure: &Failure) {
    let why = &failure.why;
    if line.reads() && shared.state.read(|conditions| conditions.line(line).is_connected()) {
        tracing::warn!(
            connection = line.name(),
            why,
            "a reading connection to redis was lost: what is published until it is back is \
             missing; where the server \
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
        let ended = Failure::away("its task has ended");
        shared.state.set_line(*line, LineState::Failed(ended));
    }
}
