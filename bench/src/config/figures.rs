//! What one measurement gives.

use std::time::{Duration, Instant};

use serde::Serialize;

use super::load::Load;
use super::subject::Used;

/// How long a load runs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Timing {
    /// Before anything counts.
    pub(crate) warm_up: Duration,
    /// What counts.
    pub(crate) measured: Duration,
}

/// From when to when it counts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Window {
    pub(crate) begin: Instant,
    pub(crate) end: Instant,
}

impl Timing {
    /// One of several turns.
    pub(crate) fn turn(&self, turns: u32) -> Self {
        Self { measured: self.measured / turns, ..*self }
    }

    /// The window of a load that begins now.
    pub(crate) fn window(&self) -> Window {
        let begin = Instant::now() + self.warm_up;
        Window { begin, end: begin + self.measured }
    }
}

impl Window {
    pub(crate) fn contains(&self, time: Instant) -> bool {
        (self.begin..self.end).contains(&time)
    }
}

/// What one turn of a load, or several, gave.
#[derive(Debug, Default)]
pub(crate) struct Measured {
    /// Done in the window: requests, or changes that were told to all watchers.
    pub(crate) operations: usize,
    pub(crate) time: Duration,
    /// In nanoseconds.
    pub(crate) latencies: Vec<u64>,
    pub(crate) used: Used,
}

impl Measured {
    /// Adds another turn.
    pub(crate) fn add(&mut self, turn: Self) {
        self.operations += turn.operations;
        self.time += turn.time;
        self.latencies.extend(turn.latencies);
        self.used.add(turn.used);
    }

    pub(crate) fn figures(self) -> (Figures, Used) {
        (Figures::of(self.operations, self.time, self.latencies), self.used)
    }
}

/// What the load generator saw.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Figures {
    /// Done in the window: requests, or changes that were told to all watchers.
    pub(crate) operations: usize,
    pub(crate) rate_hz: f64,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
}

impl Figures {
    /// Of latencies in nanoseconds.
    pub(crate) fn of(operations: usize, window: Duration, mut latencies: Vec<u64>) -> Self {
        latencies.sort_unstable();
        let quantile = |q: f64| {
            let index =
                ((latencies.len() as f64 * q) as usize).min(latencies.len().saturating_sub(1));
            latencies.get(index).copied().unwrap_or_default() as f64 / 1e6
        };
        Self {
            operations,
            rate_hz: operations as f64 / window.as_secs_f64(),
            p50_ms: quantile(0.5),
            p99_ms: quantile(0.99),
        }
    }
}

/// One line of the report.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Row {
    pub(crate) round: usize,
    pub(crate) load: String,
    pub(crate) subject: String,
    pub(crate) operations: usize,
    pub(crate) rate_hz: f64,
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    /// To etcd in the measurement just before: of rates, or of the 99th percentiles of a watch.
    pub(crate) to_etcd: Option<f64>,
    /// What it must or may be.
    #[serde(skip)]
    pub(crate) bar: Option<Bar>,
    /// CPU time per operation, in microseconds: of the server, of its database, of this program.
    pub(crate) server_cpu_us: f64,
    pub(crate) database_cpu_us: Option<f64>,
    pub(crate) client_cpu_us: f64,
    /// Requests that were written in one transaction, in the mean; none if nothing was written.
    pub(crate) batch: Option<f64>,
    /// Transactions that the database undid.
    pub(crate) aborts: Option<i64>,
}

/// What the ratio to etcd must be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Bar {
    AtLeast(f64),
    AtMost(f64),
}

impl Bar {
    pub(crate) fn holds(self, ratio: f64) -> bool {
        match self {
            Self::AtLeast(bar) => ratio >= bar,
            Self::AtMost(bar) => ratio <= bar,
        }
    }
}

impl std::fmt::Display for Bar {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AtLeast(bar) => write!(f, ">= {bar:.1}"),
            Self::AtMost(bar) => write!(f, "<= {bar:.1}"),
        }
    }
}

impl Row {
    pub(crate) fn new(round: usize, load: &Load, subject: &str, measured: Measured) -> Self {
        let (figures, used) = measured.figures();
        let per_operation =
            |time: Duration| time.as_secs_f64() * 1e6 / figures.operations.max(1) as f64;
        Self {
            round,
            load: load.name(),
            subject: subject.to_owned(),
            operations: figures.operations,
            rate_hz: figures.rate_hz,
            p50_ms: figures.p50_ms,
            p99_ms: figures.p99_ms,
            to_etcd: None,
            bar: load.bar(subject.contains("sqlite")),
            server_cpu_us: per_operation(used.server),
            database_cpu_us: used.database.map(per_operation),
            client_cpu_us: per_operation(used.client),
            batch: used.batch(),
            aborts: used.aborts,
        }
    }

    /// Fills in the ratio.
    pub(crate) fn beside(mut self, etcd: &Self) -> Self {
        let ratio = match self.bar {
            Some(Bar::AtMost(_)) => self.p99_ms / etcd.p99_ms,
            Some(Bar::AtLeast(_)) | None => self.rate_hz / etcd.rate_hz,
        };
        self.to_etcd = ratio.is_finite().then_some(ratio);
        self
    }
}
