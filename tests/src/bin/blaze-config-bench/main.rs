//! BlazeConfig beside etcd: the same documents, the same load generator, the same disk, in one run on one machine.
//!
//! ```text
//! connections ──gRPC──▶ etcd                          │ one under load at a time, in turns:
//! (one request  ──gRPC──▶ blaze-config ─▶ MongoDB     │ etcd, BlazeConfig, etcd, BlazeConfig …
//!  each at a    ──gRPC──▶ blaze-config ─▶ SQLite      │
//!  time)        ──REST──▶ the same two                ▼
//!                                         rates, latencies, CPU times from /proc
//! ```
//!
//! Every answer is checked: a GET must give the revision that was acknowledged last, a sample of them the whole content,
//! and what was written is read again. Needs `scripts/services install`, and is meant for release builds:
//! `cargo build --release --workspace --bins && target/release/blaze-config-bench`.

mod clients;
mod closed;
mod documents;
mod fan_out;
mod figures;
mod load;
mod machine;
mod report;
mod subject;
mod watches;

/// Generated from `proto/etcd.proto`.
#[allow(
    missing_docs,
    dead_code,
    unreachable_pub,
    clippy::all,
    clippy::pedantic,
    reason = "generated code"
)]
mod etcd {
    include!(concat!(env!("OUT_DIR"), "/etcdserverpb.rs"));
}

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser;

use clients::Way;
use figures::{Row, Timing};
use load::Load;
use report::Report;
use subject::{Store, Subject, Subjects};

/// Measures BlazeConfig beside etcd.
#[derive(Parser)]
#[command(name = "blaze-config-bench", version)]
struct Arguments {
    /// Seconds per measurement
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Seconds of load before each measurement
    #[arg(long, default_value_t = 1.0)]
    warm_up: f64,
    /// How often everything is measured; medians are judged
    #[arg(long, default_value_t = 1)]
    rounds: usize,
    /// Documents in each store, at least 100
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(100..=100_000))]
    documents: u64,
    /// Connections, each with one request at a time
    #[arg(long, value_delimiter = ',', default_value = "1,16,64")]
    connections: Vec<usize>,
    /// Watchers that are told of every change
    #[arg(long, default_value_t = 50)]
    watchers: usize,
    /// Changes per second that they are told of
    #[arg(long, default_value_t = 200.0)]
    rate: f64,
    /// Only loads whose name contains this: get, put, apply, watch
    #[arg(long, default_value = "")]
    only: String,
    /// Only those whose name contains this beside etcd: grpc, rest, mongodb, sqlite
    #[arg(long, default_value = "")]
    beside: String,
    /// A second main service on MongoDB, so that reads have to ask the database
    #[arg(long)]
    second_process: bool,
    /// Folder for the data of all servers; else the one that holds this program, under target/
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// Write all figures to a file, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Exit with 1 if a median misses its bar
    #[arg(long)]
    check: bool,
}

impl Arguments {
    fn timing(&self) -> Timing {
        Timing {
            warm_up: Duration::from_secs_f64(self.warm_up),
            measured: Duration::from_secs_f64(self.seconds),
        }
    }

    fn contenders(&self) -> Vec<Contender> {
        let all = Contender::ALL.into_iter();
        all.filter(|contender| contender.name().contains(&self.beside))
            .collect()
    }
}

/// Who is measured beside etcd.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Contender {
    store: Store,
    rest: bool,
}

impl Contender {
    const ALL: [Self; 4] = [
        Self::new(Store::Mongo, false),
        Self::new(Store::Sqlite, false),
        Self::new(Store::Mongo, true),
        Self::new(Store::Sqlite, true),
    ];

    const fn new(store: Store, rest: bool) -> Self {
        Self { store, rest }
    }

    fn name(self) -> String {
        let interface = if self.rest { "rest" } else { "grpc" };
        format!("blaze {interface} {}", self.store.name())
    }
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let contenders = arguments.contenders();
    anyhow::ensure!(!contenders.is_empty(), "nobody is called {:?}", arguments.beside);
    let loads = Load::all(&arguments.connections, arguments.watchers, arguments.rate);
    let loads: Vec<Load> = loads
        .into_iter()
        .filter(|load| load.name().contains(&arguments.only))
        .collect();
    anyhow::ensure!(!loads.is_empty(), "no load is called {:?}", arguments.only);

    let parent = match &arguments.data {
        Some(folder) => folder.clone(),
        None => own_folder()?,
    };
    let folder = tempfile::Builder::new()
        .prefix("blaze-config-bench-")
        .tempdir_in(&parent)
        .with_context(|| format!("a folder in {}", parent.display()))?;
    let mut report = Report::new(machine::describe(folder.path())?);
    report.print_machine();

    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let stores: Vec<Store> = [Store::Mongo, Store::Sqlite]
        .into_iter()
        .filter(|store| contenders.iter().any(|contender| contender.store == *store))
        .collect();
    let subjects = Subjects::start(folder.path(), &stores, arguments.documents, arguments.second_process)?;
    runtime.block_on(async {
        for subject in subjects.all() {
            subject.fill().await?;
            report.add_memory(subject)?;
        }
        measure(&arguments, &subjects, &contenders, &loads, &mut report).await
    })?;
    drop(subjects);

    report.print_medians();
    if let Some(path) = &arguments.json {
        report.write(path)?;
    }
    let missed = arguments.check && report.misses_a_bar();
    Ok(if missed { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn own_folder() -> anyhow::Result<PathBuf> {
    let program = std::env::current_exe()?;
    Ok(program.parent().context("this program lies in no folder")?.to_owned())
}

async fn measure(
    arguments: &Arguments,
    subjects: &Subjects,
    contenders: &[Contender],
    loads: &[Load],
    report: &mut Report,
) -> anyhow::Result<()> {
    let timing = arguments.timing();
    report.print_head();
    for round in 1..=arguments.rounds {
        for load in loads {
            for contender in contenders {
                let etcd = subjects.etcd();
                let beside = one(round, load, "etcd", etcd, &etcd.way(false), &timing).await?;
                let subject = subjects.of(contender.store)?;
                let way = subject.way(contender.rest);
                let row = one(round, load, &contender.name(), subject, &way, &timing).await?;
                report.add(beside, row);
            }
        }
    }
    Ok(())
}

async fn one(
    round: usize,
    load: &Load,
    name: &str,
    subject: &Subject,
    way: &Way,
    timing: &Timing,
) -> anyhow::Result<Row> {
    let measured = load.run(subject, way, timing).await;
    let (figures, used) = measured.with_context(|| format!("{} of {name}", load.name()))?;
    Ok(Row::new(round, load, name, &figures, &used))
}
