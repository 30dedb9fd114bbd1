//! What a change of a layer costs: CPU time and notices, by how many services it touches.

use std::path::Path;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_tests::fleet::{WorkerProcess, WorkerSpec};
use blaze_tests::servers::{RedisKind, RedisOptions, RedisServer};
use serde::Serialize;
use serde_json::{Value, json};
use tokio::task::block_in_place;

use super::figures::{Clock, Spread};
use super::fleet::{Fleet, LAYER, node};

/// Changes of each kind: CPU times come in steps of 10 ms.
const CHANGES: usize = 20;
/// For a notice.
const PATIENCE: Duration = Duration::from_secs(60);
/// Between two changes.
const PAUSE: Duration = Duration::from_millis(200);

/// One line of the report.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Row {
    pub(crate) change: &'static str,
    pub(crate) services: usize,
    /// Of one change.
    pub(crate) notices: usize,
    /// From the status of the answer to the last notice, as another client of the broker gets it.
    pub(crate) last: Spread,
    /// CPU time of one change, in ms.
    pub(crate) worker_cpu_ms: f64,
    pub(crate) main_cpu_ms: f64,
    pub(crate) worker_resident_kib: u64,
}

/// A notice, as it came.
struct Notice {
    at: Instant,
    revision: u64,
}

/// Measures changes of a layer with so many services, with one worker.
///
/// # Errors
/// When there are other notices than there must be.
pub(crate) async fn run(parent: &Path, services: usize) -> anyhow::Result<Vec<Row>> {
    let fleet = Fleet::new(parent, None, 1, services - 1).await?;
    let folder = tempfile::tempdir_in(parent)?;
    let redis = block_in_place(|| RedisServer::start(RedisKind::Redis, RedisOptions::default()))?;
    let spec = WorkerSpec::on_memory(LAYER, &node(0), &fleet.main.server()).on_redis(&redis.url());
    let notices = listen(&redis.url(), &format!("{}:blaze/config/changed/*", node(0)))?;
    let worker = block_in_place(|| WorkerProcess::start(folder.path(), &spec))?;
    // A worker that has just come tells each service what it has.
    for _ in 0..services {
        block_in_place(|| notices.recv_timeout(PATIENCE)).context("a first notice in time")?;
    }
    tokio::time::sleep(PAUSE).await;
    let mut rows = Vec::new();
    for (change, touched) in
        [("nothing that counts", 0), ("one service", 1), ("all services", services)]
    {
        let clocks = (Clock::start(worker.process().id())?, Clock::start(fleet.main_process()?)?);
        let mut last = Vec::with_capacity(CHANGES);
        for number in 0..CHANGES {
            let spec = match touched {
                0 => json!({ "kind": "edge", "overrides": { "nobody": { "round": number } } }),
                1 => json!({ "kind": "edge", "overrides": { "slam": { "round": number } } }),
                _ => json!({ "kind": "edge", "config": { "round": number } }),
            };
            let written = fleet.api.replace_timed("/layers/edge", spec).await?;
            let mut latest = written.answered;
            for _ in 0..touched {
                let notice = block_in_place(|| notices.recv_timeout(PATIENCE))
                    .context("a notice in time")?;
                anyhow::ensure!(
                    notice.revision == written.revision,
                    "a notice of revision {}, though {} was changed",
                    notice.revision,
                    written.revision
                );
                latest = latest.max(notice.at);
            }
            last.push(latest - written.answered);
            // What it leaves for later (copies, acknowledgement) is of this change.
            tokio::time::sleep(PAUSE).await;
        }
        let (worker_cpu_ms, main_cpu_ms) = (clocks.0.used_ms(CHANGES)?, clocks.1.used_ms(CHANGES)?);
        rows.push(Row {
            change,
            services,
            notices: touched,
            last: Spread::of(last),
            worker_cpu_ms,
            main_cpu_ms,
            worker_resident_kib: worker.process().usage().context("the worker runs")?.resident_kib,
        });
    }
    anyhow::ensure!(
        notices.try_recv().is_err(),
        "somebody was told of something that changed nothing"
    );
    Ok(rows)
}

/// Takes the time of every notice, as soon as it comes.
fn listen(url: &str, pattern: &str) -> anyhow::Result<mpsc::Receiver<Notice>> {
    let mut connection = redis::Client::open(url)?.get_connection()?;
    let (tell, notices) = mpsc::sync_channel(100_000);
    let (pattern, (begun, beginning)) = (pattern.to_owned(), mpsc::sync_channel(1));
    std::thread::spawn(move || -> anyhow::Result<()> {
        let mut subscription = connection.as_pubsub();
        subscription.psubscribe(&pattern)?;
        begun.send(())?;
        loop {
            let message = subscription.get_message()?;
            let at = Instant::now();
            let payload: Value = serde_json::from_slice(message.get_payload_bytes())?;
            let revision = payload["revision"].as_u64().context("no revision")?;
            tell.send(Notice { at, revision })?;
        }
    });
    beginning.recv().context("nobody listens")?;
    Ok(notices)
}
