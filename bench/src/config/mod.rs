//! BlazeConfig beside etcd: the same documents, the same load generator, the same disk, in one run
//! on one machine.
//!
//! ```text
//! connections ──gRPC──▶ etcd                          │ one under load at a time, in turns:
//! (one request  ──gRPC──▶ blaze-config ─▶ MongoDB     │ etcd, BlazeConfig, etcd, BlazeConfig …
//!  each at a    ──gRPC──▶ blaze-config ─▶ SQLite      │
//!  time)        ──REST──▶ the same two                ▼
//!                                         rates, latencies, CPU times from /proc
//! ```
//!
//! Every answer is checked: a GET must give the revision that was acknowledged last, a sample of
//! them the whole content, and what was written is read again. Needs `scripts/services install`,
//! and is meant for release builds: `cargo build --release --workspace --bins &&
//! target/release/blaze-bench config`.

mod clients;
mod closed;
mod documents;
mod fan_out;
mod figures;
mod load;
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

use std::os::unix::ffi::OsStrExt as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_tests::machine;
use blaze_tests::servers::EtcdServer;
use clap::Parser;

use self::clients::Way;
use self::figures::{Measured, Row, Timing};
use self::load::Load;
use self::report::Report;
use self::subject::{Store, Subject, Subjects};

/// Measures BlazeConfig beside etcd.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Seconds per measurement
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Seconds of load before each turn of a measurement
    #[arg(long, default_value_t = 0.5)]
    warm_up: f64,
    /// Turns in which each measurement is made, by etcd and who is beside it alternately: what
    /// slows the machine for seconds slows both
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    turns: u32,
    /// How often everything is measured; medians are judged
    #[arg(long, default_value_t = 1)]
    rounds: usize,
    /// Documents in each store, at least 100
    #[arg(long, default_value_t = 10_000,
        value_parser = clap::value_parser!(u64).range(100..=100_000))]
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
        all.filter(|contender| contender.name().contains(&self.beside)).collect()
    }
}

/// For connections to be closed after a turn.
const CLOSING: Duration = Duration::from_secs(10);

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

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let contenders = arguments.contenders();
    anyhow::ensure!(!contenders.is_empty(), "nobody is called {:?}", arguments.beside);
    let loads = Load::all(&arguments.connections, arguments.watchers, arguments.rate);
    let loads: Vec<Load> =
        loads.into_iter().filter(|load| load.name().contains(&arguments.only)).collect();
    anyhow::ensure!(!loads.is_empty(), "no load is called {:?}", arguments.only);

    let parent = match &arguments.data {
        Some(folder) => folder.clone(),
        None => own_folder()?,
    };
    let folder = tempfile::Builder::new()
        .prefix("blaze-config-bench-")
        .tempdir_in(&parent)
        .with_context(|| format!("a folder in {}", parent.display()))?;
    let mut report = Report::new(machine::describe(folder.path())?, EtcdServer::version()?);
    report.print_machine();

    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let stores: Vec<Store> = [Store::Mongo, Store::Sqlite]
        .into_iter()
        .filter(|store| contenders.iter().any(|contender| contender.store == *store))
        .collect();
    let subjects =
        Subjects::start(folder.path(), &stores, arguments.documents, arguments.second_process)?;
    runtime.block_on(async {
        for subject in subjects.all() {
            subject.fill().await?;
            report.add_memory(subject)?;
        }
        measure(arguments, &subjects, &contenders, &loads, &mut report).await
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
                let etcd = (etcd, etcd.way(false));
                let subject = subjects.of(contender.store)?;
                let subject = (subject, subject.way(contender.rest));
                let (mut beside, mut measured) = (Measured::default(), Measured::default());
                for _ in 0..arguments.turns {
                    let timing = timing.turn(arguments.turns);
                    beside.add(one(load, "etcd", &etcd, &timing).await?);
                    measured.add(one(load, &contender.name(), &subject, &timing).await?);
                }
                let beside = Row::new(round, load, "etcd", beside);
                let row = Row::new(round, load, &contender.name(), measured);
                report.add(beside, row);
            }
        }
    }
    Ok(())
}

/// One turn. What it began has ended after it: else the next one would be measured beside it.
async fn one(
    load: &Load,
    name: &str,
    (subject, way): &(&Subject, Way),
    timing: &Timing,
) -> anyhow::Result<Measured> {
    let before = open_sockets()?;
    let measured = load.run(subject, way, timing).await;
    let measured = measured.with_context(|| format!("{} of {name}", load.name()))?;
    let until = Instant::now() + CLOSING;
    while open_sockets()? > before {
        anyhow::ensure!(
            Instant::now() < until,
            "{} of {name} has left {} connections open",
            load.name(),
            open_sockets()?.saturating_sub(before)
        );
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    Ok(measured)
}

/// Of this process.
fn open_sockets() -> anyhow::Result<usize> {
    let mut count = 0;
    for file in std::fs::read_dir("/proc/self/fd")? {
        // One that was closed meanwhile is none.
        let target = std::fs::read_link(file?.path()).unwrap_or_default();
        count += usize::from(target.as_os_str().as_bytes().starts_with(b"socket:"));
    }
    Ok(count)
}
