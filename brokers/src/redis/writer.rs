//! The task that writes what publishers hand over.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_runtime::{BEAT, ticks};
use futures::StreamExt as _;
use futures::future::BoxFuture;
use futures::stream::FuturesOrdered;
use redis::aio::MultiplexedConnection;

use super::connection::Session;
use super::gate::{Busy, Gate};
use super::liveness::LOOK;
use super::publisher::{Batch, Keeper, Refusals, Target};
use super::state::{Failure, Line, LineState, ScopeOwnership};
use super::{Shared, server};
use crate::outbox::Waiting;

/// Messages of one batch at most.
const BATCH_MESSAGES: usize = 64;
/// Bytes of one batch at most; one message always fits.
const BATCH_BYTES: usize = 256 * 1024;
/// Batches that are under way at once: enough for 64 × 8 messages per round trip, few enough that
/// batches fill up.
const BATCHES: usize = 8;
/// Nothing more is handed over while this much is not answered.
const UNANSWERED_BYTES: usize = 1024 * 1024;
/// How often refused messages are told.
const COMPLAIN_EVERY: Duration = Duration::from_secs(10);
/// How often what is kept of publishers that have gone is forgotten.
const FORGET_EVERY: Duration = BEAT.saturating_mul(160);

/// Bytes of a batch, and what the server said no to.
type Answer = BoxFuture<'static, Result<(usize, Refusals), Failure>>;

/// Writes one connection of publishers.
pub(super) struct Writer<'a> {
    shared: &'a Shared,
    keeper: Keeper<'a>,
    gate: &'a Arc<Gate>,
    taken: Vec<Waiting<Target>>,
    /// Lost fields and new messages take turns.
    rewrites_next: bool,
    refused: u64,
    complained: Option<Instant>,
}

async fn send(
    mut connection: MultiplexedConnection,
    _busy: Busy,
    batch: Batch,
) -> Result<(usize, Refusals), Failure> {
    let answers = connection.send_packed_commands(&batch.pipeline, 0, batch.pipeline.len()).await?;
    // Not answered, the messages count as dropped.
    Ok((batch.bytes, batch.settle(&answers)))
}

impl<'a> Writer<'a> {
    pub(super) fn new(shared: &'a Shared, line: Line) -> Self {
        Self {
            shared,
            keeper: Keeper { mirror: &shared.mirror, line },
            gate: shared.gate(line.is_large()),
            taken: Vec::with_capacity(BATCH_MESSAGES),
            rewrites_next: false,
            refused: 0,
            complained: None,
        }
    }

    /// Learns who the server is, and whether it lost what was kept.
    async fn meet(&self, session: &Session) -> Result<(), Failure> {
        if self.keeper.line.is_large() {
            return Ok(());
        }
        let mut connection = session.connection.clone();
        let asked = async {
            let facts = server::facts(&mut connection).await?;
            let limits = server::buffer_limits(&mut connection).await?;
            Ok::<_, redis::RedisError>((facts, limits))
        };
        let answered = tokio::time::timeout(Duration::from_secs(3), asked).await;
        let (facts, limits) = answered.map_err(|_| Failure::away("no answer in time"))??;
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
        let mut batch = Batch::with_capacity(self.taken.len());
        for waiting in self.taken.drain(..) {
            batch.publish(waiting, &self.keeper, now);
        }
        Some(batch)
    }

    fn rewrite(&self) -> Option<Batch> {
        let mut batch = Batch::with_capacity(1);
        while batch.pipeline.len() < BATCH_MESSAGES
            && batch.bytes < BATCH_BYTES
            && batch.rewrite(&self.keeper)
        {}
        (!batch.pipeline.is_empty()).then_some(batch)
    }

    fn has_room(&self, batches: usize, session: &Session) -> bool {
        batches < BATCHES && session.liveness.unanswered() < UNANSWERED_BYTES
    }

    fn complain(&mut self, refusals: Refusals) {
        self.refused += refusals.count;
        let Some(why) = refusals.last else { return };
        if self.complained.is_none_or(|at| at.elapsed() >= COMPLAIN_EVERY) {
            let (connection, refused) = (self.keeper.line.name(), self.refused);
            tracing::warn!(connection, refused, why, "redis refuses messages");
            self.complained = Some(Instant::now());
            self.refused = 0;
        }
    }

    /// A flow is told by the end of a lease; a service's publisher takes what it kept with it.
    fn forget(&self) {
        if self.shared.state.read(|conditions| *conditions.scope() == ScopeOwnership::Free) {
            self.shared.mirror.lock().forget_orphans();
        }
    }

    /// Writes what publishers hand over until the connection fails.
    pub(super) async fn serve(mut self, session: &Session) -> Result<Infallible, Failure> {
        self.meet(session).await?;
        self.shared.state.set_line(self.keeper.line, LineState::Up);
        let mut answers = FuturesOrdered::<Answer>::new();
        // What the server has lost is to be written again, which rings no bell.
        let mut looks = ticks(LOOK);
        let mut forgets = ticks(FORGET_EVERY);
        loop {
            while self.gate.is_open() && self.has_room(answers.len(), session) {
                let busy = self.gate.busy();
                let Some(batch) = self.next_batch(Instant::now()) else {
                    break;
                };
                session.liveness.sent(batch.bytes);
                answers.push_back(Box::pin(send(session.connection.clone(), busy, batch)));
            }
            let has_room = self.has_room(answers.len(), session);
            tokio::select! {
                biased;
                Some(answer) = answers.next() => {
                    let (bytes, refusals) = answer?;
                    session.liveness.answered(bytes);
                    self.complain(refusals);
                }
                () = self.gate.outbox.filled(), if has_room => {}
                _ = looks.tick() => {}
                _ = forgets.tick() => self.forget(),
            }
        }
    }
}
