//! The task that subscribes the channels of one connection, and what late joiners read first.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::WriterId;
use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream::FuturesOrdered;
use redis::RedisResult;
use redis::aio::MultiplexedConnection;

use super::connection::{Failure, Serve, Session};
use super::kept::read_field;
use super::publisher::unix_time_ns;
use super::pulse::{LOOK, Look, Pulse};
use super::state::{Line, LineState};
use super::subscriptions::{Name, Subscriptions, Work};
use super::{Shared, server};
use crate::port::{BrokerError, Content, Received};

/// How often readers are looked for that have gone.
const SWEEP: Duration = Duration::from_secs(1);
/// Until what is kept for late joiners must have been read.
const READ_KEPT: Duration = Duration::from_secs(10);

type Answer = Pin<Box<dyn Future<Output = Answered> + Send>>;

/// What the server answered.
enum Answered {
    Subscribed(Vec<Name>, RedisResult<()>),
    Unsubscribed(RedisResult<()>),
    Pong(RedisResult<()>),
}

/// Serves one connection of readers.
pub(super) struct Reader {
    shared: Arc<Shared>,
    line: Line,
    subscriptions: Arc<Subscriptions>,
    swept: Instant,
}

/// What is under way on the connection: one change of subscriptions at most, and questions for a sign of life.
struct Questions {
    connection: MultiplexedConnection,
    answers: FuturesOrdered<Answer>,
    working: bool,
}

impl Questions {
    fn ask(&mut self, work: Work) {
        let mut connection = self.connection.clone();
        self.working = true;
        self.answers.push_back(match work {
            Work::Subscribe(names) => Box::pin(async move {
                let result = connection.subscribe(&texts(&names)).await;
                Answered::Subscribed(names, result)
            }),
            Work::Unsubscribe(names) => {
                Box::pin(async move { Answered::Unsubscribed(connection.unsubscribe(&texts(&names)).await) })
            }
        });
    }

    fn ping(&mut self) {
        let mut connection = self.connection.clone();
        self.answers.push_back(Box::pin(async move {
            Answered::Pong(redis::cmd("PING").exec_async(&mut connection).await)
        }));
    }
}

fn texts(names: &[Name]) -> Vec<&str> {
    names.iter().map(|name| &**name).collect()
}

impl Reader {
    pub(super) fn new(shared: Arc<Shared>, line: Line) -> Self {
        let subscriptions = Arc::clone(shared.subscriptions(line.is_large()));
        Self {
            shared,
            line,
            subscriptions,
            swept: Instant::now(),
        }
    }

    fn set(&self, state: LineState) {
        if self
            .shared
            .state
            .read(|conditions| *conditions.line(self.line) != state)
        {
            self.shared
                .state
                .change(|conditions| conditions.set_line(self.line, state));
        }
    }

    /// Asks for the next change. Without one all is subscribed, and the connection is up if the server answers.
    fn work(&self, questions: &mut Questions, answers: bool) {
        if questions.working {
            return;
        }
        match self.subscriptions.take_work() {
            Some(work) => questions.ask(work),
            None if answers => self.set(LineState::Up),
            None => {}
        }
    }

    async fn answered(&self, answered: Answered, questions: &mut Questions, session: &Session) -> Result<(), Failure> {
        match answered {
            Answered::Subscribed(names, result) => {
                questions.working = false;
                self.subscribed(&names, result, session).await?;
            }
            Answered::Unsubscribed(result) => {
                questions.working = false;
                check(result)?;
            }
            Answered::Pong(result) => check(result)?,
        }
        session.heard.note(Instant::now());
        Ok(())
    }

    /// Where the access list forbids one of several, each is asked for alone.
    async fn subscribed(&self, names: &[Name], result: RedisResult<()>, session: &Session) -> Result<(), Failure> {
        match result {
            Ok(()) => self.subscriptions.confirm(names),
            Err(error) if !server::is_refusal(&error) => return Err(error.into()),
            Err(error) if names.len() == 1 => {
                for name in names {
                    tracing::warn!(channel = &**name, error = %error, "redis refuses a subscription");
                    self.subscriptions.refuse(name, &error.to_string());
                }
            }
            Err(_) => {
                for name in names {
                    let mut connection = session.connection.clone();
                    let alone = tokio::select! {
                        alone = connection.subscribe(&**name) => alone,
                        () = session.lost.cancelled() => return Err(lost()),
                    };
                    Box::pin(self.subscribed(std::slice::from_ref(name), alone, session)).await?;
                }
            }
        }
        Ok(())
    }

    fn look(&mut self, pulse: &mut Pulse, questions: &mut Questions, session: &Session) {
        let now = Instant::now();
        let state = self.shared.state.read(|conditions| conditions.line(self.line).clone());
        match pulse.look(now, session.heard.last(), 0) {
            Look::Fine => {}
            Look::Ask => questions.ping(),
            Look::Silent if state == LineState::Up => {
                self.set(LineState::Silent);
                self.subscriptions.fail_waiting("the server does not answer");
            }
            Look::Silent => {}
        }
        if now.duration_since(self.swept) >= SWEEP {
            self.swept = now;
            self.subscriptions.sweep();
        }
    }
}

/// A refusal is an answer, too.
fn check(result: RedisResult<()>) -> Result<(), Failure> {
    match result {
        Err(error) if !server::is_refusal(&error) => Err(error.into()),
        _ => Ok(()),
    }
}

fn lost() -> Failure {
    Failure::Away("the connection was lost".to_owned())
}

impl Serve for Reader {
    fn line(&self) -> Line {
        self.line
    }

    fn subscriptions(&self) -> Option<Arc<Subscriptions>> {
        Some(Arc::clone(&self.subscriptions))
    }

    async fn serve(&mut self, session: &Session) -> Failure {
        self.subscriptions.forget_server();
        let subscriptions = Arc::clone(&self.subscriptions);
        let mut questions = Questions {
            connection: session.connection.clone(),
            answers: FuturesOrdered::new(),
            working: false,
        };
        let mut pulse = Pulse::new(self.line.is_large(), Instant::now());
        let mut looks = tokio::time::interval(LOOK);
        looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        self.work(&mut questions, true);
        loop {
            pulse.expect(!questions.answers.is_empty(), Instant::now());
            tokio::select! {
                biased;
                Some(answered) = questions.answers.next() => {
                    if let Err(failure) = self.answered(answered, &mut questions, session).await {
                        return failure;
                    }
                    self.work(&mut questions, true);
                }
                () = session.lost.cancelled() => return lost(),
                () = subscriptions.changed.notified() => self.work(&mut questions, false),
                _ = looks.tick() => self.look(&mut pulse, &mut questions, session),
            }
        }
    }

    fn interrupted(&mut self, why: &str) {
        self.subscriptions.fail_waiting(why);
    }
}

/// What is kept of a channel for late joiners, in the order of publishing as far as the times tell.
pub(super) async fn read_kept(mut connection: MultiplexedConnection, hash: &str) -> Result<Vec<Received>, BrokerError> {
    let mut command = redis::cmd("HGETALL");
    command.arg(hash);
    let answer = tokio::time::timeout(READ_KEPT, command.query_async::<redis::Value>(&mut connection)).await;
    let value = match answer {
        Ok(Ok(value)) => value,
        Ok(Err(error)) => return Err(BrokerError::Away(error.to_string())),
        Err(_) => {
            return Err(BrokerError::Away(
                "what is kept for late joiners was not read in time".to_owned(),
            ));
        }
    };
    Ok(kept_messages(
        server::pairs(value),
        hash,
        unix_time_ns(),
        Instant::now(),
    ))
}

fn kept_messages(fields: Vec<(Vec<u8>, Vec<u8>)>, hash: &str, now_ns: u64, now: Instant) -> Vec<Received> {
    let mut found = Vec::new();
    let mut damaged_fields = 0;
    for (field, value) in fields {
        let writer: Option<WriterId> = std::str::from_utf8(&field).ok().and_then(|text| text.parse().ok());
        let Some(writer) = writer else {
            damaged_fields += 1;
            continue;
        };
        let (frames, damaged) = read_field(Bytes::from(value), writer);
        damaged_fields += usize::from(damaged);
        found.extend(frames);
    }
    if damaged_fields > 0 {
        tracing::warn!(hash, damaged_fields, "what is kept for late joiners is damaged in part");
    }
    // Stable, and the times of one writer ascend: its order stays.
    found.sort_by_key(|(written_ns, _)| *written_ns);
    let mut seen: HashMap<WriterId, u64> = HashMap::new();
    found.retain(|(_, frame)| {
        let highest = seen.entry(frame.writer()).or_insert(0);
        let newer = frame.sequence() > *highest;
        *highest = frame.sequence().max(*highest);
        newer
    });
    found
        .into_iter()
        .map(|(written_ns, frame)| Received {
            content: Content::Frame(frame),
            at: now,
            broker_age_us: now_ns.saturating_sub(written_ns) / 1_000,
            kept: true,
            place: None,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::Origin;
    use blaze_proto::{Frame, Header};

    fn entry(writer: u8, sequence: u64, written_ns: u64) -> Vec<u8> {
        let header = Header::new("t", Origin::default(), WriterId([writer; 16]), sequence, 0);
        let frame = Frame::new(&header, Bytes::from_static(b"x")).unwrap().to_bytes();
        let mut bytes = u32::try_from(frame.len()).unwrap().to_le_bytes().to_vec();
        bytes.extend(written_ns.to_le_bytes());
        bytes.extend(&frame);
        bytes
    }

    #[test]
    fn kept_messages_come_in_the_order_of_their_times_and_know_their_age() {
        let field = |writer: u8| WriterId([writer; 16]).to_string().into_bytes();
        let fields = vec![
            (field(1), [entry(1, 1, 1_000), entry(1, 2, 4_000_000)].concat()),
            (
                field(2),
                [entry(2, 7, 2_000_000), entry(2, 7, 2_000_000), entry(2, 8, 5_000_000)].concat(),
            ),
            (b"no writer".to_vec(), entry(3, 1, 1)),
        ];
        let found: Vec<_> = kept_messages(fields, "h", 6_000_000, Instant::now())
            .into_iter()
            .map(|message| match message.content {
                Content::Frame(frame) => (frame.writer().0[0], frame.sequence(), message.broker_age_us),
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(found, [(1, 1, 5_999), (2, 7, 4_000), (1, 2, 2_000), (2, 8, 1_000)]);
    }
}
