//! The task that writes what publishers hand over.

use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::StreamExt as _;
use futures::stream::FuturesOrdered;
use redis::aio::MultiplexedConnection;

use super::connection::{Failure, Serve, Session};
use super::gate::{Busy, Gate};
use super::publisher::{Batch, Keeper, Refusals, Target};
use super::pulse::{LOOK, Look, Pulse};
use super::state::{Line, LineState, Scope};
use super::subscriptions::Subscriptions;
use super::{Shared, server};
use crate::outbox::Waiting;

/// Messages of one batch at most.
const BATCH_MESSAGES: usize = 64;
/// Bytes of one batch at most; one message always fits.
const BATCH_BYTES: usize = 256 * 1024;
/// Batches that are under way at once: enough for 64 × 8 messages per round trip, few enough that batches fill up.
const BATCHES: usize = 8;
/// Nothing more is handed over while this much is not answered.
const UNANSWERED_BYTES: usize = 1024 * 1024;
/// How often refused messages are told.
const COMPLAIN_EVERY: Duration = Duration::from_secs(10);
/// How often what is kept of publishers that have gone is forgotten.
const FORGET_EVERY: Duration = Duration::from_secs(10);

type Answer = Pin<Box<dyn Future<Output = Landed> + Send>>;

/// A batch that was answered, or never will be.
struct Landed {
    bytes: usize,
    outcome: Result<Refusals, Failure>,
}

/// Writes one connection of publishers.
pub(super) struct Writer {
    shared: Arc<Shared>,
    line: Line,
    gate: Arc<Gate>,
    taken: Vec<Waiting<Target>>,
    /// Lost fields and new messages take turns.
    rewrites_next: bool,
    refused: u64,
    complained: Option<Instant>,
    forgot: Instant,
}

/// What is under way on the connection.
struct Flight {
    connection: MultiplexedConnection,
    answers: FuturesOrdered<Answer>,
    bytes: usize,
}

impl Flight {
    fn has_room(&self) -> bool {
        self.answers.len() < BATCHES && self.bytes < UNANSWERED_BYTES
    }

    fn send(&mut self, batch: Batch, busy: Busy) {
        self.bytes += batch.bytes;
        let mut connection = self.connection.clone();
        self.answers.push_back(Box::pin(async move {
            let _busy = busy;
            let bytes = batch.bytes;
            let answers = connection
                .send_packed_commands(&batch.pipeline, 0, batch.pipeline.len())
                .await;
            // Not answered, the messages count as dropped.
            let outcome = answers.map(|answers| batch.settle(&answers)).map_err(Failure::from);
            Landed { bytes, outcome }
        }));
    }
}

impl Writer {
    pub(super) fn new(shared: Arc<Shared>, line: Line) -> Self {
        let gate = Arc::clone(shared.gate(line.is_large()));
        Self {
            shared,
            line,
            gate,
            taken: Vec::with_capacity(BATCH_MESSAGES),
            rewrites_next: false,
            refused: 0,
            complained: None,
            forgot: Instant::now(),
        }
    }

    /// Learns who the server is, and whether it lost what was kept.
    async fn meet(&self, session: &Session) -> Result<(), Failure> {
        if self.line.is_large() {
            return Ok(());
        }
        let mut connection = session.connection.clone();
        let asked = async {
            let facts = server::facts(&mut connection).await?;
            let limits = server::buffer_limits(&mut connection).await?;
            Ok::<_, redis::RedisError>((facts, limits))
        };
        let answered = tokio::time::timeout(Duration::from_secs(3), asked).await;
        let (facts, limits) = answered.map_err(|_| Failure::Away("no answer in time".to_owned()))??;
        self.shared.met(facts, limits);
        Ok(())
    }

    fn next_batch(&mut self, now: Instant) -> Option<Batch> {
        self.rewrites_next = !self.rewrites_next;
        if self.rewrites_next {
            self.rewrite().or_else(|| self.messages(now))
        } else {
            self.messages(now).or_else(|| self.rewrite())
        }
    }

    fn messages(&mut self, now: Instant) -> Option<Batch> {
        self.gate.outbox.take(now, BATCH_MESSAGES, BATCH_BYTES, &mut self.taken);
        if self.taken.is_empty() {
            return None;
        }
        let keeper = Keeper {
            mirror: &self.shared.mirror,
            line: self.line,
        };
        let mut batch = Batch::with_capacity(self.taken.len());
        for waiting in self.taken.drain(..) {
            batch.publish(waiting, &keeper, now);
        }
        Some(batch)
    }

    fn rewrite(&self) -> Option<Batch> {
        let keeper = Keeper {
            mirror: &self.shared.mirror,
            line: self.line,
        };
        let mut batch = Batch::with_capacity(1);
        while batch.pipeline.len() < BATCH_MESSAGES && batch.bytes < BATCH_BYTES && batch.rewrite(&keeper) {}
        (!batch.pipeline.is_empty()).then_some(batch)
    }

    fn fill(&mut self, flight: &mut Flight) {
        while self.gate.is_open() && flight.has_room() {
            let busy = self.gate.busy();
            let Some(batch) = self.next_batch(Instant::now()) else {
                return;
            };
            flight.send(batch, busy);
        }
    }

    /// Takes note of an answer.
    fn landed(&mut self, landed: Landed, flight: &mut Flight, session: &Session) -> Result<(), Failure> {
        flight.bytes = flight.bytes.saturating_sub(landed.bytes);
        let refusals = landed.outcome?;
        session.heard.note(Instant::now());
        self.set(LineState::Up);
        if refusals.count > 0 {
            self.refused += refusals.count;
            self.complain(&refusals.last.unwrap_or_default());
        }
        Ok(())
    }

    fn complain(&mut self, why: &str) {
        let now = Instant::now();
        if self
            .complained
            .is_none_or(|at| now.duration_since(at) >= COMPLAIN_EVERY)
        {
            tracing::warn!(
                connection = self.line.name(),
                refused = self.refused,
                why,
                "redis refuses messages"
            );
            self.complained = Some(now);
            self.refused = 0;
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

    fn look(&mut self, pulse: &mut Pulse, flight: &mut Flight, session: &Session) {
        let now = Instant::now();
        match pulse.look(now, session.heard.last(), flight.bytes) {
            Look::Fine => {}
            Look::Ask => flight.send(Batch::ping(), self.gate.busy()),
            Look::Silent => self.set(LineState::Silent),
        }
        if now.duration_since(self.forgot) >= FORGET_EVERY {
            self.forgot = now;
            // A flow is told by the end of a lease; a service's publisher takes what it kept with it.
            if self.shared.state.read(|conditions| *conditions.scope() == Scope::Free) {
                self.shared.mirror.lock().forget_orphans();
            }
        }
    }
}

impl Serve for Writer {
    fn line(&self) -> Line {
        self.line
    }

    fn subscriptions(&self) -> Option<Arc<Subscriptions>> {
        None
    }

    async fn serve(&mut self, session: &Session) -> Failure {
        if let Err(failure) = self.meet(session).await {
            return failure;
        }
        let mut flight = Flight {
            connection: session.connection.clone(),
            answers: FuturesOrdered::new(),
            bytes: 0,
        };
        let mut pulse = Pulse::new(self.line.is_large(), Instant::now());
        let mut looks = tokio::time::interval(LOOK);
        looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        self.set(LineState::Up);
        loop {
            self.fill(&mut flight);
            pulse.expect(!flight.answers.is_empty(), Instant::now());
            let gate = Arc::clone(&self.gate);
            let has_room = flight.has_room();
            tokio::select! {
                biased;
                Some(landed) = flight.answers.next() => {
                    if let Err(failure) = self.landed(landed, &mut flight, session) {
                        return failure;
                    }
                }
                () = session.lost.cancelled() => {
                    return Failure::Away("the connection was lost".to_owned());
                }
                () = gate.outbox.filled(), if has_room => {}
                _ = looks.tick() => self.look(&mut pulse, &mut flight, session),
            }
        }
    }
}
