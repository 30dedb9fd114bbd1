//! What a fleet of workers does with changes: how long a change takes to a service, what it costs,
//! and how a fleet comes back after the main service was away.
//!
//! ```text
//!          ┌─REST─▶ blaze-config ─gRPC─▶ worker 1 … worker n (this process) ─▶ Redis or Kafka ─▶ service 1 … service n
//! changes ─┤            (process)                                                                  (this process)
//!          └────────────────────────────── the clock ─────────────────────────────────────────────────────┘
//! ```
//!
//! Nothing counts that was not right: each change must be heard by each service that it concerns,
//! and by no other. Needs `scripts/services install`, and is meant for release builds: `cargo build
//! --release --workspace --bins && target/release/blaze-bench worker`.

mod delivery;
mod figures;
mod fleet;
mod report;
mod restart;
mod touched;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use blaze_tests::machine;
use clap::{Parser, ValueEnum};

use self::fleet::BrokerKind;
use self::report::Report;

/// Measures workers of BlazeConfig.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Only those: delivery, touched, restart
    #[arg(long, value_delimiter = ',', default_value = "delivery,touched,restart")]
    only: Vec<Part>,
    /// Brokers that services are on
    #[arg(long, value_delimiter = ',', default_value = "redis,kafka")]
    broker: Vec<BrokerKind>,
    /// Workers, each with a service; else 1, 50 and 200 on Redis, 1 and 10 on Kafka
    #[arg(long, value_delimiter = ',')]
    workers: Vec<usize>,
    /// Changes that are measured, of each kind
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    changes: u32,
    /// Shortest pause between a change that was heard and the next one, in ms; the longest is twice
    /// that. Changes within 20 ms become one notice
    #[arg(long, default_value_t = 30)]
    pause_ms: u64,
    /// Services besides the one that is changed, without instances
    #[arg(long, default_value_t = 20)]
    services: usize,
    /// Services that a change of the layer touches
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=20_000))]
    touched: u32,
    /// Workers whose main service is restarted
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=2_000))]
    restarted: u32,
    /// How long it stays away each time, in ms: workers try at longer intervals the longer it does,
    /// up to 2 s
    #[arg(long, value_delimiter = ',', default_value = "0,0,5000,5000")]
    away_ms: Vec<u64>,
    /// Folder for the data of all servers; else the one that holds this program, under target/
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// Write all figures to a file, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    /// From a change to the services' callbacks.
    Delivery,
    /// What a change of a layer costs a worker.
    Touched,
    /// The main service is killed and started.
    Restart,
}

impl Arguments {
    fn workers_on(&self, broker: BrokerKind) -> Vec<usize> {
        if self.workers.is_empty() {
            return broker.usual_counts().to_vec();
        }
        self.workers.clone()
    }

    fn pause(&self) -> std::ops::RangeInclusive<Duration> {
        let shortest = Duration::from_millis(self.pause_ms);
        shortest..=shortest * 2
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let parent = match &arguments.data {
        Some(folder) => folder.clone(),
        None => own_folder()?,
    };
    let folder = tempfile::Builder::new()
        .prefix("blaze-worker-bench-")
        .tempdir_in(&parent)
        .with_context(|| format!("a folder in {}", parent.display()))?;
    let mut report = Report::new(machine::describe(folder.path())?);
    report.print_machine();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        for part in &arguments.only {
            match part {
                Part::Delivery => deliver(arguments, folder.path(), &mut report).await?,
                Part::Touched => report
                    .add_touched(touched::run(folder.path(), arguments.touched as usize).await?),
                Part::Restart => {
                    let away: Vec<_> =
                        arguments.away_ms.iter().copied().map(Duration::from_millis).collect();
                    let (workers, services) = (arguments.restarted as usize, arguments.services);
                    restart::run(folder.path(), workers, services, &away, &mut report).await?;
                }
            }
        }
        anyhow::Ok(())
    })?;
    if let Some(path) = &arguments.json {
        report.write(path)?;
    }
    Ok(if report.misses_a_bar() { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

async fn deliver(
    arguments: &Arguments,
    folder: &std::path::Path,
    report: &mut Report,
) -> anyhow::Result<()> {
    for broker in &arguments.broker {
        for workers in arguments.workers_on(*broker) {
            let plan = delivery::Plan {
                broker: *broker,
                workers,
                changes: arguments.changes as usize,
                pause: arguments.pause(),
                services: arguments.services,
            };
            let rows = delivery::run(folder, &plan).await;
            report.add_delivery(
                rows.with_context(|| format!("{workers} workers on {}", broker.name()))?,
            );
        }
    }
    Ok(())
}

fn own_folder() -> anyhow::Result<PathBuf> {
    let program = std::env::current_exe()?;
    Ok(program.parent().context("this program lies in no folder")?.to_owned())
}
