//! The tasks of the core: committing, following other processes, looking at the store, trimming,
//! revocations, audit.

use std::time::Duration;

use blaze_domain::config::{Problem, Timestamp};
use blaze_domain::node_file::HistorySection;
use blaze_runtime::supervisor::TaskPolicy;
use blaze_runtime::{CheckStatus, Gate, Readiness, Supervisor};
use rand::RngExt as _;
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::super::barrier::Looks;
use super::super::committer::{Committer, follow, now, unavailable};
use super::ConfigService;
use super::token::Denial;
use crate::store::StoreError;

/// Between two looks whether the store answers. With [`LOOK`] it makes two seconds at most.
const HEALTH: Duration = Duration::from_millis(700);
/// How long such a look may take.
const LOOK: Duration = Duration::from_millis(1200);
/// Between two readings of revoked tokens: they are refused everywhere within five seconds.
const TOKENS: Duration = Duration::from_secs(2);
/// How much faster than time itself the time may go on by which records expire: after 30 days
/// without the service, it has caught up in a little more than a day.
const EXPIRY_PACE: u32 = 24;
/// From this on the clock counts as far ahead: a day.
const LEAP_MS: i64 = 24 * 3_600 * 1_000;
/// Between two tidyings of the store.
const TIDY: Duration = Duration::from_secs(1);
/// Pause of the follower after a failure, full jitter.
const PAUSE: std::ops::Range<Duration> = Duration::from_millis(50)..Duration::from_millis(500);
/// Refusals that are written to the audit together.
const DENIALS: usize = 100;

pub(super) struct Parts {
    pub(super) committer: Committer,
    pub(super) looks: Looks,
    pub(super) denials: mpsc::Receiver<Denial>,
    pub(super) history: HistorySection,
    pub(super) readiness: Readiness,
}

/// Says in the log that the clock is far ahead of the time by which records expire, once until it
/// is not any more. Whether it is.
fn note_leap(time: Timestamp, was_ahead: bool) -> bool {
    let ahead_ms = now().as_millis().saturating_sub(time.as_millis());
    let is_ahead = ahead_ms > LEAP_MS;
    if is_ahead && !was_ahead {
        tracing::warn!(
            hours = ahead_ms / 3_600_000,
            "the clock is far ahead of the last trimming: the service was away for long, or the \
                clock is wrong; history, audit and answers expire 24 times faster than time goes \
                until that is caught up"
        );
    }
    is_ahead
}

impl ConfigService {
    pub(super) fn spawn_tasks(&self, supervisor: &Supervisor, parts: Parts) {
        // All of them live as long as the process: at its end they are told by the token, after the
        // streams have ended.
        let stop = supervisor.shutdown_token();
        let until = |future: futures::future::BoxFuture<'static, ()>| {
            let stop = stop.clone();
            async move {
                tokio::select! {
                    () = stop.cancelled() => {}
                    () = future => {}
                }
            }
        };
        parts.readiness.add("store", Gate::Decides, CheckStatus::Ok, self.described());
        let spawn = |name: &str, future| {
            supervisor.spawn(name, TaskPolicy::Essential, until(future));
        };
        spawn("committer", Box::pin(parts.committer.run()));
        spawn("reads", Box::pin(self.clone().answer_looks(parts.looks)));
        spawn("trimming", Box::pin(self.clone().trim_periodically(parts.history)));
        spawn("tidying", Box::pin(self.clone().tidy_periodically()));
        spawn("tokens", Box::pin(self.clone().refresh_periodically()));
        spawn("health of nodes", Box::pin(self.clone().evaluate_health()));
        spawn("store health", Box::pin(self.clone().watch_health(parts.readiness)));
        spawn("audit of refusals", Box::pin(self.clone().write_denials(parts.denials)));
        if self.inner.store.is_shared() {
            spawn("follower", Box::pin(self.clone().follow_others()));
        }
    }

    fn described(&self) -> String {
        format!("revision {}", self.revision())
    }

    async fn answer_looks(self, mut looks: Looks) {
        while let Some(waiters) = looks.next().await {
            let result = self.newest().await;
            Looks::answer(waiters, &result);
        }
        std::future::pending::<()>().await;
    }

    async fn newest(&self) -> Result<u64, Problem> {
        if !self.inner.store.is_shared() {
            return Ok(self.revision());
        }
        let look = async {
            let head = self.inner.store.head().await?;
            follow(&*self.inner.store, &self.inner.log, Some(head)).await?;
            Ok::<u64, StoreError>(head)
        };
        look.await.map_err(|error| unavailable(&error))
    }

    async fn follow_others(self) {
        loop {
            self.inner.store.foreign_commit().await;
            if let Err(error) = follow(&*self.inner.store, &self.inner.log, None).await {
                if matches!(error, StoreError::Corrupt(_)) {
                    tracing::error!(%error, "the commits of other processes cannot be followed");
                }
                let pause = rand::rng().random_range(PAUSE);
                tokio::time::sleep(pause).await;
            }
        }
    }

    async fn watch_health(self, readiness: Readiness) {
        let mut ticks = interval(HEALTH);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            match timeout(LOOK, self.inner.store.head()).await {
                Ok(Ok(_)) => readiness.set("store", CheckStatus::Ok, self.described()),
                Ok(Err(error)) => {
                    tracing::debug!(%error, "the store does not answer");
                    readiness.set("store", CheckStatus::Failed, error.told());
                }
                Err(_) => readiness.set("store", CheckStatus::Failed, "no answer within 1.2 s"),
            }
        }
    }

    async fn trim_periodically(self, history: HistorySection) {
        let mut ticks = interval(Duration::from_secs(u64::from(history.trim_period_s)));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        ticks.tick().await;
        let (mut moved, mut most, mut is_ahead) = (Instant::now(), Duration::ZERO, false);
        loop {
            // At the start, too: what others trim goes by it.
            match self.inner.store.expiry_time(now(), most).await {
                Ok(time) => {
                    moved = Instant::now();
                    is_ahead = note_leap(time, is_ahead);
                    let trimmed = match most.is_zero() {
                        true => Ok(()),
                        false => self.trim_old(&history, time).await,
                    };
                    if let Err(error) = trimmed {
                        tracing::warn!(%error, "old history was not removed");
                    }
                }
                Err(error) => tracing::warn!(%error, "old history was not removed"),
            }
            ticks.tick().await;
            most = moved.elapsed() * EXPIRY_PACE;
        }
    }

    /// Removes what is both too old, at a time, and too far back.
    async fn trim_old(&self, history: &HistorySection, time: Timestamp) -> Result<(), StoreError> {
        let by_count = self.revision().saturating_sub(history.keep_revisions);
        if by_count <= self.inner.log.floor() {
            return self.remove_expired(history).await;
        }
        let keep = i64::try_from(history.keep_s).unwrap_or(i64::MAX).saturating_mul(1000);
        let before = Timestamp::from_millis(time.as_millis().saturating_sub(keep));
        let by_age = self.inner.store.revision_before(before).await?;
        let floor = by_count.min(by_age);
        if floor > self.inner.log.floor() {
            let floor = self.inner.store.trim(floor, history.keep_versions).await?;
            self.inner.log.raise_floor(floor);
            tracing::info!(floor, "old history was removed");
            return Ok(());
        }
        self.remove_expired(history).await
    }

    /// Answers to repeat, tokens and audit that have expired go with a trimming, also with one that
    /// leaves the floor where it is. A shared store removes them by itself.
    async fn remove_expired(&self, history: &HistorySection) -> Result<(), StoreError> {
        if !self.inner.store.is_shared() {
            let floor = self.inner.log.floor();
            self.inner.store.trim(floor, history.keep_versions).await?;
        }
        Ok(())
    }

    async fn tidy_periodically(self) {
        let mut ticks = interval(TIDY);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if let Err(error) = self.inner.store.tidy().await {
                tracing::debug!(%error, "the store was not tidied");
            }
        }
    }

    async fn refresh_periodically(self) {
        let mut ticks = interval(TOKENS);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if let Err(error) = self.refresh_tokens().await {
                tracing::debug!(%error, "revoked tokens were not read");
            }
        }
    }

    async fn write_denials(self, mut denials: mpsc::Receiver<Denial>) {
        let mut batch = Vec::with_capacity(DENIALS);
        while denials.recv_many(&mut batch, DENIALS).await > 0 {
            let (mut entries, mut readers) = (Vec::new(), Vec::new());
            for denial in batch.drain(..) {
                match denial {
                    Denial::Entry(entry) => entries.push(*entry),
                    Denial::Reader(reader) => readers.push(reader),
                }
            }
            if !entries.is_empty()
                && let Err(error) = self.inner.store.append_audit(&entries).await
            {
                tracing::warn!(%error, entries = entries.len(), "refusals are missing in the audit");
            }
            for reader in readers {
                // Who has gone needs no answer.
                let _ = reader.send(());
            }
        }
        std::future::pending::<()>().await;
    }
}
