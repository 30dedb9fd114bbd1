//! Connections that each have one request under way.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::clients::{Connection, Way};
use super::documents::{Documents, Known, check_spec, spec};
use super::figures::{Measured, Timing, Window};
use super::load::{APPLIED, Work};
use super::subject::Subject;

/// Of so many answers to a GET one is compared with the whole content.
const SAMPLE: usize = 64;
/// Documents that are read again after writing.
const READ_AGAIN: usize = 32;
/// For the requests that are under way at the end.
const PATIENCE: Duration = Duration::from_secs(60);

/// Loads a server and gives what was seen.
///
/// # Errors
/// At the first answer that is none or not right.
pub(crate) async fn run(
    work: Work,
    connections: usize,
    subject: &Subject,
    way: &Way,
    timing: &Timing,
) -> anyhow::Result<Measured> {
    let mut ready = Vec::with_capacity(connections);
    for _ in 0..connections {
        let mut connection = way.connect().await?;
        // Whatever is done once per connection is not measured.
        check(&mut connection, &subject.documents, 0, true).await?;
        ready.push(connection);
    }
    let window = timing.window();
    let mut tasks = JoinSet::new();
    for connection in ready {
        tasks.spawn(one(work, connection, Arc::clone(&subject.documents), window));
    }
    let used = subject.used_in(window).await?;
    let mut latencies = Vec::new();
    let ended = async {
        while let Some(done) = tasks.join_next().await {
            latencies.extend(done??);
        }
        anyhow::Ok(())
    };
    timeout(PATIENCE, ended).await.context("requests were not answered")??;
    if work != Work::Get {
        let mut connection = way.connect().await?;
        for _ in 0..READ_AGAIN {
            let number = subject.documents.any();
            check(&mut connection, &subject.documents, number, true).await?;
        }
    }
    anyhow::ensure!(!latencies.is_empty(), "nothing was done in the window: measure for longer");
    Ok(Measured { operations: latencies.len(), time: timing.measured, latencies, used })
}

/// One request after another; the latencies of those that ended in the window, in nanoseconds.
async fn one(
    work: Work,
    mut connection: Connection,
    documents: Arc<Documents>,
    window: Window,
) -> anyhow::Result<Vec<u64>> {
    let mut latencies = Vec::with_capacity(1 << 16);
    let mut count = 0_usize;
    loop {
        let took = match work {
            Work::Get => {
                check(&mut connection, &documents, documents.any(), count.is_multiple_of(SAMPLE))
                    .await?
            }
            Work::Put => put(&mut connection, &documents).await?,
            Work::Apply => apply(&mut connection, &documents, &documents.some(APPLIED)).await?,
        };
        count += 1;
        let now = Instant::now();
        if window.contains(now) {
            latencies.push(took.as_nanos().try_into()?);
        } else if now >= window.end {
            return Ok(latencies);
        }
    }
}

/// Reads a document that nobody writes now: it must have what was acknowledged last. The time that
/// reading took.
async fn check(
    connection: &mut Connection,
    documents: &Documents,
    number: usize,
    whole: bool,
) -> anyhow::Result<Duration> {
    let known = documents.known(number)?;
    let begin = Instant::now();
    let found = connection.get(number).await?;
    let took = begin.elapsed();
    let revision = found.revision;
    anyhow::ensure!(
        revision == known.revision,
        "{number} has revision {revision}, written was {known:?}"
    );
    if whole {
        check_spec(number, known.step, &found.spec()?)?;
    }
    Ok(took)
}

async fn put(connection: &mut Connection, documents: &Documents) -> anyhow::Result<Duration> {
    let (number, step) = (documents.any(), documents.next_step());
    let text = spec(number, step);
    let begin = Instant::now();
    let revision = connection.put(number, text).await?;
    let took = begin.elapsed();
    documents.written(number, Known { revision, step })?;
    Ok(took)
}

/// Replaces or makes documents in one revision. The time that it took.
///
/// # Errors
/// When it is refused.
pub(crate) async fn apply(
    connection: &mut Connection,
    documents: &Documents,
    numbers: &[usize],
) -> anyhow::Result<Duration> {
    let step = documents.next_step();
    let items = numbers.iter().map(|number| (*number, spec(*number, step))).collect();
    let begin = Instant::now();
    let revision = connection.apply(items).await?;
    let took = begin.elapsed();
    for number in numbers {
        documents.written(*number, Known { revision, step })?;
    }
    Ok(took)
}
