//! The figures as tables, and as JSON.

use std::path::Path;

use blaze_tests::machine::Machine;
use serde::Serialize;

use super::figures::Spread;
use super::{delivery, restart, touched};

/// A user's GET while the main service comes back, at the 99th percentile.
const GET_MS: f64 = 1000.0;

/// All that a run found.
#[derive(Serialize)]
pub(crate) struct Report {
    machine: Machine,
    delivery: Vec<delivery::Row>,
    touched: Vec<touched::Row>,
    restarts: Vec<restart::Row>,
}

impl Report {
    pub(crate) fn new(machine: Machine) -> Self {
        Self { machine, delivery: Vec::new(), touched: Vec::new(), restarts: Vec::new() }
    }

    pub(crate) fn print_machine(&self) {
        println!("{}", self.machine);
        for remark in self.machine.remarks() {
            println!("NOTE: {remark}");
        }
    }

    pub(crate) fn add_delivery(&mut self, rows: Vec<delivery::Row>) {
        if self.delivery.is_empty() {
            println!("\nFrom a change to the services' callbacks, in ms: median, 99th percentile");
            println!(
                "{:<7} {:>7} {:<9} {:>7} {:>16} {:>16} {:>16} {:>14} {:>14} {:>8} {:>8}",
                "BROKER",
                "WORKERS",
                "CHANGED",
                "HEARD",
                "AFTER 2xx",
                "AFTER REQUEST",
                "LAST, AFTER 2xx",
                "PUT",
                "BROKER ALONE",
                "MAIN cpu",
                "ALL cpu"
            );
        }
        for row in &rows {
            println!(
                "{:<7} {:>7} {:<9} {:>7} {:>16} {:>16} {:>16} {:>14} {:>14} {:>8.2} {:>8.2}",
                row.broker,
                row.workers,
                row.whom.name(),
                row.after_answer.count,
                pair(&row.after_answer),
                pair(&row.after_request),
                pair(&row.last),
                pair(&row.put),
                pair(&row.plain),
                row.main_cpu_ms,
                row.own_cpu_ms
            );
        }
        if let Some(row) = rows.first() {
            let (alone, both) = (&row.worker, &row.with_service);
            println!(
                "        one worker of {} takes {:.2} MiB, {:.1} threads, {:.1} descriptors; with \
                 its service {:.2} MiB, {:.1}, {:.1}",
                row.workers,
                alone.resident_kib / 1024.0,
                alone.threads,
                alone.descriptors,
                both.resident_kib / 1024.0,
                both.threads,
                both.descriptors
            );
        }
        self.delivery.extend(rows);
    }

    pub(crate) fn add_touched(&mut self, rows: Vec<touched::Row>) {
        println!("\nWhat a change of a layer costs one worker, in ms");
        println!(
            "{:<20} {:>8} {:>8} {:>18} {:>11} {:>11} {:>11}",
            "TOUCHES",
            "SERVICES",
            "NOTICES",
            "LAST p50, p99",
            "WORKER cpu",
            "MAIN cpu",
            "WORKER MiB"
        );
        for row in &rows {
            println!(
                "{:<20} {:>8} {:>8} {:>18} {:>11.2} {:>11.2} {:>11.1}",
                row.change,
                row.services,
                row.notices,
                pair(&row.last),
                row.worker_cpu_ms,
                row.main_cpu_ms,
                row.worker_resident_kib as f64 / 1024.0
            );
        }
        self.touched.extend(rows);
    }

    pub(crate) fn add_restart(&mut self, row: restart::Row) {
        if self.restarts.is_empty() {
            println!("\nThe main service is killed and started under its workers, in ms");
            println!(
                "{:>7} {:>8} {:>24} {:>8} {:>24} {:>9}  BACK IN EACH 250 ms",
                "WORKERS",
                "AWAY",
                "IN SYNC p50, p99, max",
                "REFUSED",
                "GET p50, p99, max",
                "MAIN cpu"
            );
        }
        let quarters: Vec<String> = row.by_quarter.iter().map(ToString::to_string).collect();
        println!(
            "{:>7} {:>8.0} {:>24} {:>8} {:>24} {:>9.0}  {}",
            row.workers,
            row.away_ms,
            triple(&row.back),
            row.refused,
            triple(&row.gets),
            row.main_cpu_ms,
            quarters.join(" ")
        );
        if row.gets.p99_ms > GET_MS {
            println!("MISSED: a user's GET at the 99th percentile may take {GET_MS} ms");
        }
        self.restarts.push(row);
    }

    pub(crate) fn misses_a_bar(&self) -> bool {
        self.restarts.iter().any(|row| row.gets.p99_ms > GET_MS)
    }

    /// Writes everything to a file.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn write(&self, path: &Path) -> anyhow::Result<()> {
        std::fs::write(path, serde_json::to_string_pretty(self)? + "\n")?;
        Ok(())
    }
}

fn pair(spread: &Spread) -> String {
    format!("{:.2}, {:.2}", spread.p50_ms, spread.p99_ms)
}

fn triple(spread: &Spread) -> String {
    format!("{:.1}, {:.1}, {:.1}", spread.p50_ms, spread.p99_ms, spread.max_ms)
}
