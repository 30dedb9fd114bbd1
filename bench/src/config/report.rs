//! The figures as a table, and as JSON.

use std::path::Path;

use blaze_tests::machine::Machine;
use serde::Serialize;

use super::figures::{Bar, Row};
use super::subject::Subject;

/// All that a run found.
#[derive(Serialize)]
pub(crate) struct Report {
    machine: Machine,
    etcd: String,
    memory: Vec<Memory>,
    rows: Vec<Row>,
}

/// Resident memory once all documents are there.
#[derive(Serialize)]
struct Memory {
    subject: String,
    documents: usize,
    resident_kib: u64,
    database_resident_kib: Option<u64>,
}

/// Medians of all rounds.
#[derive(Serialize)]
struct Median {
    load: String,
    subject: String,
    rate_hz: f64,
    p50_ms: f64,
    p99_ms: f64,
    to_etcd: f64,
    bar: Option<String>,
    holds: Option<bool>,
}

impl Report {
    pub(crate) fn new(machine: Machine, etcd: String) -> Self {
        Self { machine, etcd, memory: Vec::new(), rows: Vec::new() }
    }

    pub(crate) fn print_machine(&self) {
        println!("{}; {}", self.machine, self.etcd);
        for remark in self.machine.remarks() {
            println!("NOTE: {remark}");
        }
    }

    pub(crate) fn add_memory(&mut self, subject: &Subject) -> anyhow::Result<()> {
        let (own, database) = subject.resident_kib()?;
        let mib = |kib: u64| kib as f64 / 1024.0;
        let beside = database.map(|kib| format!(", its database {:.0} MiB", mib(kib)));
        let (name, count) = (&subject.name, subject.documents.count());
        println!(
            "{name}: {count} documents, {:.0} MiB resident{}",
            mib(own),
            beside.unwrap_or_default()
        );
        self.memory.push(Memory {
            subject: name.clone(),
            documents: count,
            resident_kib: own,
            database_resident_kib: database,
        });
        Ok(())
    }

    pub(crate) fn print_head(&self) {
        println!(
            "\n{:<22} {:<19} {:>9} {:>9} {:>9} {:>7} {:>10} {:>9} {:>10} {:>7} {:>7}",
            "LOAD",
            "SERVER",
            "PER S",
            "p50/ms",
            "p99/ms",
            "x ETCD",
            "SERVER us",
            "DB us",
            "CLIENT us",
            "BATCH",
            "ABORTS"
        );
    }

    /// A measurement, and that of etcd just before it.
    pub(crate) fn add(&mut self, etcd: Row, row: Row) {
        let row = row.beside(&etcd);
        print_row(&etcd);
        print_row(&row);
        self.rows.extend([etcd, row]);
    }

    fn medians(&self) -> Vec<Median> {
        let mut medians: Vec<Median> = Vec::new();
        for row in &self.rows {
            let is_known =
                |median: &Median| median.load == row.load && median.subject == row.subject;
            if row.to_etcd.is_none() || medians.iter().any(is_known) {
                continue;
            }
            let same: Vec<&Row> = self
                .rows
                .iter()
                .filter(|other| other.load == row.load && other.subject == row.subject)
                .collect();
            let middle =
                |value: fn(&Row) -> f64| median(same.iter().map(|row| value(row)).collect());
            let to_etcd = middle(|row| row.to_etcd.unwrap_or(f64::NAN));
            // REST is shown, and not judged.
            let bar = row.bar.filter(|_| row.subject.contains("grpc"));
            medians.push(Median {
                load: row.load.clone(),
                subject: row.subject.clone(),
                rate_hz: middle(|row| row.rate_hz),
                p50_ms: middle(|row| row.p50_ms),
                p99_ms: middle(|row| row.p99_ms),
                to_etcd,
                bar: bar.as_ref().map(Bar::to_string),
                holds: bar.map(|bar| bar.holds(to_etcd)),
            });
        }
        medians
    }

    pub(crate) fn print_medians(&self) {
        println!("\nMedians beside etcd; of a watch the ratio of the 99th percentiles:");
        for median in self.medians() {
            let judged = match (&median.bar, median.holds) {
                (Some(bar), Some(true)) => format!("{bar}: holds"),
                (Some(bar), Some(false)) => format!("{bar}: MISSED"),
                _ => String::new(),
            };
            println!(
                "{:<22} {:<19} {:>9.0} {:>9.3} {:>9.3} {:>7.2}  {judged}",
                median.load,
                median.subject,
                median.rate_hz,
                median.p50_ms,
                median.p99_ms,
                median.to_etcd
            );
        }
    }

    pub(crate) fn misses_a_bar(&self) -> bool {
        self.medians().iter().any(|median| median.holds == Some(false))
    }

    /// Writes everything to a file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn write(&self, path: &Path) -> anyhow::Result<()> {
        #[derive(Serialize)]
        struct Whole<'a> {
            #[serde(flatten)]
            report: &'a Report,
            medians: Vec<Median>,
        }
        let whole = Whole { report: self, medians: self.medians() };
        std::fs::write(path, serde_json::to_string_pretty(&whole)? + "\n")?;
        Ok(())
    }
}

/// The one in the middle, or the mean of both: the better of two would hide a bad round.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let at = |place: usize| values.get(place).copied().unwrap_or(f64::NAN);
    f64::midpoint(at(values.len().saturating_sub(1) / 2), at(values.len() / 2))
}

fn print_row(row: &Row) {
    let optional = |value: Option<f64>, digits: usize| {
        let text = value.map(|value| format!("{value:.digits$}"));
        text.unwrap_or_else(|| "-".to_owned())
    };
    let aborts = row.aborts.map(|count| count.to_string());
    println!(
        "{:<22} {:<19} {:>9.0} {:>9.3} {:>9.3} {:>7} {:>10.1} {:>9} {:>10.1} {:>7} {:>7}",
        row.load,
        row.subject,
        row.rate_hz,
        row.p50_ms,
        row.p99_ms,
        optional(row.to_etcd, 2),
        row.server_cpu_us,
        optional(row.database_cpu_us, 1),
        row.client_cpu_us,
        optional(row.batch, 1),
        aborts.unwrap_or_else(|| "-".to_owned())
    );
}
