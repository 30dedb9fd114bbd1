//! Changes at a rate, and how long each takes to every watcher: from before it is sent to its
//! reception, by one clock.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tokio::task::JoinSet;
use tokio::time::{sleep_until, timeout};

use super::clients::{Connection, Way};
use super::documents::{Documents, Known, spec};
use super::figures::{Measured, Timing};
use super::subject::Subject;
use super::watches::Watch;

/// Changes that may wait for their answer; at the rates that are asked for there is hardly ever a
/// second one.
const UNDER_WAY: usize = 64;
/// For what is on the way at the end.
const PATIENCE: Duration = Duration::from_secs(60);

/// When each change was sent.
struct Sent {
    base: Instant,
    first_step: u64,
    /// Nanoseconds after `base`, by step; 0 = not yet.
    times: Vec<AtomicU64>,
}

impl Sent {
    fn now(&self) -> anyhow::Result<u64> {
        Ok(u64::try_from(self.base.elapsed().as_nanos())?.max(1))
    }

    /// Which change of this measurement a step is.
    fn index(&self, step: u64) -> anyhow::Result<usize> {
        let index = step.checked_sub(self.first_step).context("a change from before the watch")?;
        let index = usize::try_from(index)?;
        anyhow::ensure!(index < self.times.len(), "a change that nobody made: step {step}");
        Ok(index)
    }
}

/// Loads a server and gives what was seen.
///
/// # Errors
/// When a watcher is not told of every change once and in order, or a change is refused.
pub(crate) async fn run(
    watchers: usize,
    rate_hz: f64,
    subject: &Subject,
    way: &Way,
    timing: &Timing,
) -> anyhow::Result<Measured> {
    let mut watches = Vec::with_capacity(watchers);
    for _ in 0..watchers {
        let mut connection = way.connect().await?;
        let watch = connection.watch().await?;
        watches.push((connection, watch));
    }
    let writer = way.connect().await?;
    let period = Duration::from_secs_f64(1.0 / rate_hz);
    let changes = |time: Duration| (time.as_secs_f64() * rate_hz).ceil() as usize;
    let (before, counted) = (changes(timing.warm_up), changes(timing.measured));
    let window = timing.window();
    let sent = Arc::new(Sent {
        base: Instant::now(),
        first_step: subject.documents.peek_step(),
        times: (0..before + counted).map(|_| AtomicU64::new(0)).collect(),
    });
    let mut tasks = JoinSet::new();
    for (connection, watch) in watches {
        tasks.spawn(one(connection, watch, Arc::clone(&sent), before));
    }
    let mut writing = JoinSet::new();
    writing.spawn(write_all(writer, Arc::clone(&subject.documents), Arc::clone(&sent), period));
    let used = subject.used_in(window).await?;
    let mut latencies = Vec::with_capacity(watchers * counted);
    let ended = async {
        while let Some(done) = writing.join_next().await {
            done??;
        }
        while let Some(done) = tasks.join_next().await {
            latencies.extend(done??);
        }
        anyhow::Ok(())
    };
    timeout(PATIENCE, ended).await.context("a watcher was not told of all changes")??;
    anyhow::ensure!(latencies.len() == watchers * counted, "{} latencies", latencies.len());
    Ok(Measured { operations: counted, time: timing.measured, latencies, used })
}

async fn write_all(
    connection: Connection,
    documents: Arc<Documents>,
    sent: Arc<Sent>,
    period: Duration,
) -> anyhow::Result<()> {
    let mut writes: JoinSet<anyhow::Result<()>> = JoinSet::new();
    let mut next = sent.base;
    for _ in 0..sent.times.len() {
        sleep_until(next.into()).await;
        next += period;
        while writes.len() >= UNDER_WAY {
            if let Some(done) = writes.join_next().await {
                done??;
            }
        }
        while let Some(done) = writes.try_join_next() {
            done??;
        }
        let (mut connection, documents, sent) =
            (connection.clone(), Arc::clone(&documents), Arc::clone(&sent));
        let (number, step) = (documents.any(), documents.next_step());
        writes.spawn(async move {
            let text = spec(number, step);
            let time = &sent.times[sent.index(step)?];
            time.store(sent.now()?, Ordering::Release);
            let revision = connection.put(number, text).await?;
            documents.written(number, Known { revision, step })
        });
    }
    while let Some(done) = writes.join_next().await {
        done??;
    }
    Ok(())
}

/// One watcher: latencies in nanoseconds, without those of the first `before` changes. The
/// connection lives as long.
async fn one(
    _connection: Connection,
    mut watch: Watch,
    sent: Arc<Sent>,
    before: usize,
) -> anyhow::Result<Vec<u64>> {
    let mut latencies: Vec<Option<u64>> = vec![None; sent.times.len()];
    let (mut left, mut last_revision) = (latencies.len(), 0);
    while left > 0 {
        for told in watch.next().await? {
            let now = sent.now()?;
            anyhow::ensure!(
                told.revision > last_revision,
                "{told:?} after revision {last_revision}"
            );
            last_revision = told.revision;
            let index = sent.index(told.step)?;
            let begun = sent.times[index].load(Ordering::Acquire);
            anyhow::ensure!(begun > 0, "{told:?} was told before it was sent");
            anyhow::ensure!(latencies[index].is_none(), "{told:?} came twice");
            latencies[index] = Some(now.saturating_sub(begun));
            left -= 1;
        }
    }
    Ok(latencies.into_iter().skip(before).flatten().collect())
}
