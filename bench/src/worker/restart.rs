//! The main service is killed and started under a fleet, while users read.

use std::path::Path;
use std::time::Duration;

use blaze_tests::fleet::{restart, wait_equal};
use serde::Serialize;

use super::figures::{Clock, Spread};
use super::fleet::Fleet;
use super::report::Report;

/// What users read.
const READ: &str = "/services/slam";
/// For everything to be as it was.
const PATIENCE: Duration = Duration::from_secs(60);
/// Workers that came back are counted in steps of this length after the main service was ready.
const STEP_MS: u128 = 250;

/// One line of the report.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Row {
    pub(crate) workers: usize,
    /// From the kill to the main service being ready again.
    pub(crate) away_ms: f64,
    /// From then on until workers were in sync again.
    pub(crate) back: Spread,
    pub(crate) first_back_ms: f64,
    /// How many in each quarter of a second.
    pub(crate) by_quarter: Vec<usize>,
    /// GETs of users that were answered, from the kill on.
    pub(crate) gets: Spread,
    /// Those that were not, because nobody listened or the connection broke.
    pub(crate) refused: usize,
    /// CPU time of the main service, with its start and a second after the last one was back.
    pub(crate) main_cpu_ms: f64,
}

/// Restarts the main service of so many workers as often as times are named that it stays away.
///
/// # Errors
/// When somebody does not come back.
pub(crate) async fn run(
    parent: &Path,
    workers: usize,
    services: usize,
    away: &[Duration],
    report: &mut Report,
) -> anyhow::Result<()> {
    let mut fleet = Fleet::new(parent, None, workers, services).await?;
    fleet.start_workers(workers).await?;
    for away in away {
        let restarted = restart(&mut fleet.main, &fleet.workers, *away, READ).await?;
        // A process begins with nothing used.
        let main_cpu_ms = Clock::since_start(fleet.main_process()?).used_ms(1)?;
        wait_equal(&fleet.api, &fleet.workers, PATIENCE).await?;
        let last = restarted.back.last().copied().unwrap_or_default();
        let mut by_quarter = vec![0; usize::try_from(last.as_millis() / STEP_MS)? + 1];
        for time in &restarted.back {
            by_quarter[usize::try_from(time.as_millis() / STEP_MS)?] += 1;
        }
        report.add_restart(Row {
            workers,
            away_ms: restarted.away.as_secs_f64() * 1e3,
            first_back_ms: restarted.back.first().map_or(0.0, |first| first.as_secs_f64() * 1e3),
            back: Spread::of(restarted.back),
            by_quarter,
            gets: Spread::of(restarted.gets),
            refused: restarted.refused,
            main_cpu_ms,
        });
    }
    Ok(())
}
