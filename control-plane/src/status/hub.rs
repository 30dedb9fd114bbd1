//! Where streams of monitors and readers meet.
//!
//! ```text
//! stream ──Session──▶ summary, answer ─▶ Fleet, Questions
//!    ▲                                        │
//!    └── channel (bounded, never waited for) ◀┴── look (Interest), ask (Query) ◀── readers
//! ```

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::state::State;
use blaze_domain::config::{Code, Problem};
use blaze_domain::{LayerName, NodeName};
use parking_lot::Mutex;
use tokio::sync::{Notify, mpsc};
use tokio::time::{Instant, timeout_at};

use super::fleet::{Change, Fleet};
use super::health::Now;
use super::limits::{HELD_PERIODS, MAX_SUMMARY_BYTES, QUERY_TIME, QUEUED, RENEW_INTEREST};
use super::questions::{Asked, Question, Questions, Reply};
use super::summary::Report;
use super::{Refusal, StatusMetrics};

/// What a monitor gets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ToMonitor {
    /// Somebody looks.
    Interest {
        /// Between two summaries, in ms.
        period_ms: u32,
    },
    /// A question.
    Query {
        /// Comes back with the answer.
        id: u64,
        /// `TARGET PATH`.
        name: String,
    },
    /// The stream ends.
    GoAway {
        /// After how long it may come again.
        retry_after_ms: u32,
        /// Why.
        reason: String,
    },
}

/// Which monitor comes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MonitorHello {
    /// Its layer.
    pub layer: LayerName,
    /// Its node.
    pub node: NodeName,
    /// Version of the program.
    pub version: String,
    /// Larger after each start.
    pub epoch: u64,
    /// Where its metrics are scraped; empty: nowhere from outside.
    pub metrics_address: String,
}

/// Why there is no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Failed {
    /// The node does not report here.
    #[error("its monitor does not report to the main service")]
    Unreachable,
    /// Nothing came in time.
    #[error("its monitor did not answer within 5 s")]
    Timeout,
    /// Too many ask other things.
    #[error("it is asked too much at once")]
    Overloaded,
}

impl Failed {
    fn as_str(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::Timeout => "timeout",
            Self::Overloaded => "overloaded",
        }
    }

    /// The refusal of a request that needs this node.
    #[must_use]
    pub fn problem(self, node: &NodeName) -> Problem {
        let detail = format!("node {node} cannot be asked: {self}");
        Problem::new(Code::NodeUnreachable, detail).retry_after(5)
    }
}

/// The open stream of one node.
#[derive(Debug)]
struct Line {
    connection: u64,
    epoch: u64,
    /// `None` once the stream shall end.
    sender: Mutex<Option<mpsc::Sender<ToMonitor>>>,
    questions: Mutex<Questions>,
    /// A question has ended.
    room: Notify,
    interest: Mutex<Interest>,
}

#[derive(Debug, Default)]
struct Interest {
    /// Period and until when it is wanted.
    wanted: Option<(Duration, Instant)>,
    /// Period and when it was sent.
    sent: Option<(Duration, Instant)>,
}

impl Interest {
    /// Notes that somebody looks; what is to be sent now, if anything.
    fn look(&mut self, period: Duration, now: Instant) -> Option<u32> {
        let until = now + period * HELD_PERIODS;
        self.wanted = match self.wanted {
            Some((shorter, held)) if held > now && shorter < period => Some((shorter, held)),
            _ => Some((period, until)),
        };
        let (period, _) = self.wanted?;
        let is_known =
            self.sent.is_some_and(|(sent, at)| sent == period && now < at + RENEW_INTEREST);
        if is_known {
            return None;
        }
        self.sent = Some((period, now));
        u32::try_from(period.as_millis()).ok()
    }
}

#[derive(Debug, Default)]
struct Inner {
    fleet: Fleet,
    lines: HashMap<NodeName, Arc<Line>>,
    connections: u64,
}

/// All nodes that report here.
#[derive(Debug)]
pub struct Hub {
    inner: Mutex<Inner>,
    metrics: StatusMetrics,
}

/// A monitor's open stream; it counts as gone when this is dropped.
#[derive(Debug)]
pub struct Session {
    hub: Arc<Hub>,
    line: Arc<Line>,
    node: NodeName,
}

/// Now, by the clocks.
#[must_use]
pub(crate) fn now() -> Now {
    Now { at: Instant::now(), time: crate::core::now() }
}

impl Hub {
    /// Nobody reports yet.
    #[must_use]
    pub fn new(metrics: StatusMetrics) -> Self {
        Self { inner: Mutex::default(), metrics }
    }

    /// Its counters.
    #[must_use]
    pub fn metrics(&self) -> &StatusMetrics {
        &self.metrics
    }

    /// Looks at what is known.
    pub fn read<T>(&self, look: impl FnOnce(&Fleet) -> T) -> T {
        look(&self.inner.lock().fleet)
    }

    /// Takes over layers and nodes of the configuration.
    pub fn configure(&self, state: &State) {
        self.inner.lock().fleet.configure(state, now());
    }

    /// A monitor has come. An older stream of the node ends.
    ///
    /// # Errors
    /// [`Problem`] with the reason of the metric.
    pub fn enter(
        self: &Arc<Self>,
        hello: &MonitorHello,
        state: &State,
        now: Now,
    ) -> Result<(Session, mpsc::Receiver<ToMonitor>), (Refusal, Problem)> {
        let mut inner = self.inner.lock();
        inner.fleet.configure(state, now);
        let node = &hello.node;
        if inner.fleet.layer_of(node) != Some(&hello.layer) {
            let detail = format!(
                "the configuration has no node {node} in layer {}: create it, or correct the node \
                 file",
                hello.layer
            );
            return Err((Refusal::UnknownNode, Problem::new(Code::PermissionDenied, detail)));
        }
        if inner.lines.get(node).is_some_and(|line| line.epoch > hello.epoch) {
            let detail = format!("a monitor of node {node} that started later reports");
            return Err((Refusal::OlderEpoch, Problem::new(Code::RevisionConflict, detail)));
        }
        let entered = inner.fleet.enter(node, &hello.layer, hello.metrics_address.clone(), now);
        entered.map_err(|error| {
            let problem = Problem::new(Code::Overloaded, error.to_string()).retry_after(30);
            (Refusal::TooManyNodes, problem)
        })?;
        inner.connections += 1;
        let (sender, receiver) = mpsc::channel(QUEUED);
        let line = Arc::new(Line {
            connection: inner.connections,
            epoch: hello.epoch,
            sender: Mutex::new(Some(sender)),
            questions: Mutex::default(),
            room: Notify::new(),
            interest: Mutex::default(),
        });
        let before = inner.lines.insert(node.clone(), Arc::clone(&line));
        self.metrics.streams(inner.lines.len());
        drop(inner);
        if let Some(before) = before {
            before.close("a newer stream of this node has come");
        }
        Ok((Session { hub: Arc::clone(self), line, node: node.clone() }, receiver))
    }

    /// Evaluates ages; streams of nodes that the configuration does not have any more end.
    pub fn tick(&self, state: &State, now: Now) -> Vec<Change> {
        let mut inner = self.inner.lock();
        inner.fleet.configure(state, now);
        let changes = inner.fleet.tick(now);
        let Inner { fleet, lines, .. } = &mut *inner;
        lines.retain(|node, line| {
            let stays = fleet.entry(node).is_some();
            if stays {
                line.questions.lock().tidy(now.at);
            } else {
                line.close("the node is no longer in the configuration of this layer");
            }
            stays
        });
        self.metrics.streams(inner.lines.len());
        changes
    }

    /// Somebody looks at these nodes now, and will again within a few periods.
    pub fn look<'n>(&self, nodes: impl IntoIterator<Item = &'n NodeName>, period: Duration) {
        let now = Instant::now();
        let inner = self.inner.lock();
        for node in nodes {
            let Some(line) = inner.lines.get(node) else { continue };
            if let Some(period_ms) = line.interest.lock().look(period, now) {
                // Who reads nothing gets none; it is sent again later.
                let _ = line.send(ToMonitor::Interest { period_ms });
            }
        }
    }

    /// Asks a node. Whoever asks the same within half a second shares the answer.
    ///
    /// # Errors
    /// [`Failed`].
    pub async fn ask(&self, node: &NodeName, question: &Question) -> Result<Arc<Reply>, Failed> {
        let line = self.inner.lock().lines.get(node).cloned();
        let answer = match line {
            Some(line) => line.ask(question).await,
            None => Err(Failed::Unreachable),
        };
        self.metrics.query(match &answer {
            Ok((_, true)) => "shared",
            Ok((reply, false)) if reply.status < 400 => "ok",
            Ok(_) => "failed",
            Err(failed) => failed.as_str(),
        });
        answer.map(|(reply, _)| reply)
    }

    /// Whether a node has an open stream.
    #[must_use]
    pub fn is_connected(&self, node: &NodeName) -> bool {
        self.inner.lock().lines.contains_key(node)
    }
}

impl Line {
    fn send(&self, message: ToMonitor) -> bool {
        let sender = self.sender.lock();
        sender.as_ref().is_some_and(|sender| sender.try_send(message).is_ok())
    }

    fn close(&self, reason: &str) {
        let go_away = ToMonitor::GoAway { retry_after_ms: 1000, reason: reason.to_owned() };
        self.send(go_away);
        self.sender.lock().take();
        // Whoever waits for an answer gets none.
        *self.questions.lock() = Questions::default();
        self.room.notify_waiters();
    }

    /// The answer, and whether it was another one's.
    async fn ask(&self, question: &Question) -> Result<(Arc<Reply>, bool), Failed> {
        let until = Instant::now() + QUERY_TIME;
        loop {
            let room = self.room.notified();
            let asked = self.questions.lock().ask(question, Instant::now());
            let (mut waiting, shared) = match asked {
                Asked::Answered(reply) => return Ok((reply, true)),
                Asked::Open(waiting) => (waiting, true),
                Asked::Send(id, waiting) => {
                    let query = ToMonitor::Query { id, name: question.as_str().to_owned() };
                    (self.sent(id, query).then_some(waiting).ok_or(Failed::Unreachable)?, false)
                }
                Asked::Full => {
                    timeout_at(until, room).await.map_err(|_| Failed::Overloaded)?;
                    continue;
                }
            };
            let answered = timeout_at(until, waiting.wait_for(Option::is_some)).await;
            let answered = answered.map_err(|_| {
                // Its place is free.
                self.room.notify_waiters();
                Failed::Timeout
            })?;
            // The sender is gone without an answer when the stream or its time has ended.
            let reply = answered.ok().and_then(|reply| reply.clone());
            return reply.map(|reply| (reply, shared)).ok_or(match Instant::now() < until {
                true => Failed::Unreachable,
                false => Failed::Timeout,
            });
        }
    }

    fn sent(&self, id: u64, query: ToMonitor) -> bool {
        let sent = self.send(query);
        if !sent {
            self.questions.lock().give_up(id);
        }
        sent
    }
}

impl Session {
    /// Which node.
    #[must_use]
    pub fn node(&self) -> &NodeName {
        &self.node
    }

    /// Takes a summary.
    ///
    /// # Errors
    /// Why it is not taken; the stream goes on.
    pub fn summary(&self, json: String, now: Now) -> Result<(), Refusal> {
        if json.len() > MAX_SUMMARY_BYTES {
            return Err(Refusal::SummaryTooLarge);
        }
        let report = Report::read(json, now).map_err(|error| {
            tracing::debug!(node = %self.node, %error, "a summary is not taken");
            Refusal::BadSummary
        })?;
        let mut inner = self.hub.inner.lock();
        // A stream that was replaced says nothing any more.
        let is_newest =
            inner.lines.get(&self.node).is_some_and(|line| line.connection == self.line.connection);
        if !is_newest || !inner.fleet.report(&self.node, report) {
            return Err(Refusal::OlderEpoch);
        }
        drop(inner);
        self.hub.metrics.summary();
        Ok(())
    }

    /// Takes the answer to a question.
    ///
    /// # Errors
    /// If nobody waits for it.
    pub fn answer(&self, id: u64, status: u32, json: String, now: Now) -> Result<(), Refusal> {
        let status = u16::try_from(status).ok().filter(|status| (200..600).contains(status));
        let taken = self.line.questions.lock().answer(id, status.unwrap_or(502), json, now.at);
        self.line.room.notify_waiters();
        if taken { Ok(()) } else { Err(Refusal::UnknownAnswer) }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        let mut inner = self.hub.inner.lock();
        let is_own =
            inner.lines.get(&self.node).is_some_and(|line| line.connection == self.line.connection);
        if is_own {
            inner.lines.remove(&self.node);
            self.hub.metrics.streams(inner.lines.len());
        }
        drop(inner);
        self.line.close("the stream has ended");
    }
}
