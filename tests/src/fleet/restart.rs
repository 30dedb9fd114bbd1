//! The main service away under a fleet, while users read.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use reqwest::Method;
use tokio::task::{JoinSet, block_in_place};

use super::{Api, MainService, Told, Worker};

/// Users, each with one request at a time.
const USERS: usize = 8;
/// Between two requests of a user.
const PACE: Duration = Duration::from_millis(10);
/// Between two looks at all workers: how exact the times of their return are.
const LOOK: Duration = Duration::from_millis(25);
/// Users go on for so long after the last worker has come back.
const AFTER: Duration = Duration::from_secs(1);
/// For all to come back.
const PATIENCE: Duration = Duration::from_secs(60);

/// What happened.
#[derive(Debug, Clone, Default)]
pub struct Restarted {
    /// From the kill to the main service being ready again.
    pub away: Duration,
    /// From then on until each worker was in sync again, the first one first.
    pub back: Vec<Duration>,
    /// How long GETs of users took that were answered after the kill.
    pub gets: Vec<Duration>,
    /// Those that were not answered: nobody listened, or the connection broke.
    pub refused: usize,
    /// The longest time that one of those took to fail.
    pub slowest_refusal: Duration,
    /// Those of them that began after the main service was ready again.
    pub refused_since: usize,
}

/// Kills the main service, leaves it away for a time and starts it again, while eight users read
/// what is at a path of it, 100 times a second at most each. Needs a runtime with several threads.
///
/// # Errors
/// When the main service does not start, or a worker does not come back within a minute.
pub async fn restart(
    main: &mut MainService,
    workers: &[Worker],
    away: Duration,
    path: &'static str,
) -> anyhow::Result<Restarted> {
    let stop = Arc::new(AtomicBool::new(false));
    let mut users = JoinSet::new();
    for _ in 0..USERS {
        users.spawn(read(main.api()?, path, Arc::clone(&stop)));
    }
    // Connections of users are there before the kill.
    main.api()?.get(path).await?;
    block_in_place(|| main.kill())?;
    let killed = Instant::now();
    tokio::time::sleep(away).await;
    block_in_place(|| main.start_again())?;
    let ready = Instant::now();
    let back = come_back(workers, ready).await?;
    tokio::time::sleep(AFTER).await;
    stop.store(true, Ordering::Release);
    let mut restarted = Restarted { away: ready - killed, back, ..Restarted::default() };
    while let Some(done) = users.join_next().await {
        for (begun, taken, is_answered) in done? {
            if is_answered {
                restarted.gets.extend((begun + taken >= killed).then_some(taken));
                continue;
            }
            restarted.refused += 1;
            restarted.refused_since += usize::from(begun > ready);
            restarted.slowest_refusal = restarted.slowest_refusal.max(taken);
        }
    }
    anyhow::ensure!(!restarted.gets.is_empty(), "no user was answered");
    Ok(restarted)
}

/// When each worker is in sync again.
async fn come_back(workers: &[Worker], ready: Instant) -> anyhow::Result<Vec<Duration>> {
    let mut back = Vec::with_capacity(workers.len());
    let mut away: Vec<&Worker> = workers.iter().collect();
    while !away.is_empty() {
        let mut still = Vec::new();
        for worker in away {
            if worker.standing().await?.in_sync {
                back.push(ready.elapsed());
            } else {
                still.push(worker);
            }
        }
        anyhow::ensure!(
            ready.elapsed() < PATIENCE,
            "{} workers have not come back within {PATIENCE:?}",
            still.len()
        );
        away = still;
        tokio::time::sleep(LOOK).await;
    }
    Ok(back)
}

/// A user: when each request began, how long it took, and whether it was answered.
async fn read(api: Api, path: &str, stop: Arc<AtomicBool>) -> Vec<(Instant, Duration, bool)> {
    let mut all = Vec::new();
    while !stop.load(Ordering::Acquire) {
        let begun = Instant::now();
        let told = api.send(Method::GET, path, None).await;
        let is_answered = matches!(told, Told::Done(_));
        all.push((begun, begun.elapsed(), is_answered));
        tokio::time::sleep(PACE).await;
    }
    all
}

/// Waits until every worker has what the main service has of their layer; how long that took.
///
/// # Errors
/// When one has not within the limit.
pub async fn wait_equal(
    api: &Api,
    workers: &[Worker],
    limit: Duration,
) -> anyhow::Result<Duration> {
    let begun = Instant::now();
    let layer = workers.first().context("there are workers")?.layer();
    let mut left: Vec<&Worker> = workers.iter().collect();
    loop {
        let digest = api.digest(layer.as_str()).await?;
        let mut behind = Vec::new();
        for worker in left {
            let standing = worker.standing().await?;
            if !standing.in_sync || standing.digest != digest {
                behind.push(worker);
            }
        }
        if behind.is_empty() {
            return Ok(begun.elapsed());
        }
        anyhow::ensure!(
            begun.elapsed() < limit,
            "{} of {} workers are behind after {limit:?}",
            behind.len(),
            workers.len()
        );
        left = behind;
        tokio::time::sleep(LOOK).await;
    }
}
