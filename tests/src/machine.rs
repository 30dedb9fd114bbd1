//! Where something was measured: figures depend on it.

use std::fs::File;
use std::io::{Seek as _, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::Serialize;

/// File systems that keep nothing on a disk.
const IN_MEMORY: [&str; 2] = ["tmpfs", "ramfs"];
/// Load of a machine that does nothing else.
const IDLE: f64 = 0.5;
/// Writes that are synced to see what that costs.
const SYNCS: usize = 50;
const BLOCK: [u8; 4096] = [7; 4096];
/// How often an idler looks at the time.
const LOOK: Duration = Duration::from_millis(5);

/// A thread that sees how long the machine lets nobody do anything, until it is dropped.
#[derive(Debug)]
pub struct Idler(Arc<AtomicU64>);

impl Idler {
    /// Looks at the time from now on.
    #[must_use]
    pub fn start() -> Self {
        let latest = Arc::<AtomicU64>::default();
        let seen = Arc::downgrade(&latest);
        std::thread::spawn(move || {
            let mut before = Instant::now();
            while let Some(seen) = seen.upgrade() {
                std::thread::sleep(LOOK);
                let now = Instant::now();
                let late = now.duration_since(before).saturating_sub(LOOK);
                seen.fetch_max(
                    u64::try_from(late.as_nanos()).unwrap_or(u64::MAX),
                    Ordering::Relaxed,
                );
                before = now;
            }
        });
        Self(latest)
    }

    /// By how much it woke up too late at most.
    #[must_use]
    pub fn latest(&self) -> Duration {
        Duration::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// What figures depend on.
#[derive(Debug, Clone, Serialize)]
pub struct Machine {
    /// Its name.
    pub processor: String,
    /// How many of them this process may use.
    pub processors: usize,
    /// Of the whole machine.
    pub memory_mib: u64,
    /// Type of the file system that data is on.
    pub file_system: String,
    /// Whether all data is lost with the power: then writes mean nothing.
    pub in_memory: bool,
    /// To write 4 KiB in place and sync them, at the median.
    pub sync_ms: f64,
    /// Programs that wanted a processor in the minute before.
    pub load_average: f64,
    /// Whether this program, and so the rest of the workspace beside it, was built with
    /// optimisation.
    pub optimised: bool,
}

/// Looks at the machine and at the disk of a folder.
///
/// # Errors
/// When the folder cannot be written.
pub fn describe(folder: &Path) -> anyhow::Result<Machine> {
    let processor = value_of("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".to_owned());
    let memory = value_of("/proc/meminfo", "MemTotal").unwrap_or_default();
    let memory_kib: u64 = memory.trim_end_matches(" kB").parse().unwrap_or(0);
    let mounts = std::fs::read_to_string("/proc/self/mounts")?;
    let folder = folder.canonicalize()?;
    let file_system = file_system(&mounts, &folder).unwrap_or("unknown");
    Ok(Machine {
        processor,
        processors: std::thread::available_parallelism()?.get(),
        memory_mib: memory_kib / 1024,
        file_system: file_system.to_owned(),
        in_memory: IN_MEMORY.contains(&file_system),
        sync_ms: sync_ms(&folder)?,
        load_average: load_average().unwrap_or_default(),
        optimised: !cfg!(debug_assertions),
    })
}

impl Machine {
    /// What makes the figures mean little, in whole sentences.
    #[must_use]
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = Vec::new();
        if self.load_average > IDLE {
            remarks.push(format!(
                "others use this machine (load {:.1}): figures mean little",
                self.load_average
            ));
        }
        if self.in_memory {
            remarks.push(
                "this file system is in memory, where syncing costs nothing: choose another one \
                 with --data"
                    .to_owned(),
            );
        }
        if !self.optimised {
            remarks.push("built without optimisation: figures of blaze mean little".to_owned());
        }
        remarks
    }
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} x {}, {} MiB; data on {}, 4 KiB written and synced in {:.2} ms",
            self.processors, self.processor, self.memory_mib, self.file_system, self.sync_ms
        )
    }
}

fn load_average() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    text.split(' ').next()?.parse().ok()
}

fn value_of(file: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let mut pairs = text.lines().filter_map(|line| line.split_once(':'));
    let (_, value) = pairs.find(|(found, _)| found.trim() == name)?;
    Some(value.trim().to_owned())
}

/// Type of the file system of a folder: that of the deepest mount above it, the last one where two
/// are the same.
fn file_system<'a>(mounts: &'a str, folder: &Path) -> Option<&'a str> {
    let fields = mounts.lines().map(|line| line.split(' ').collect::<Vec<_>>());
    let above = fields.filter_map(|fields| match fields[..] {
        [_, place, kind, ..] if folder.starts_with(place) => {
            Some((Path::new(place).components().count(), kind))
        }
        _ => None,
    });
    above.max_by_key(|(depth, _)| *depth).map(|(_, kind)| kind)
}

/// In place, as a log does that was given its room before: a file that grows costs more.
fn sync_ms(folder: &Path) -> anyhow::Result<f64> {
    let path = folder.join("sync");
    let mut file = File::create(&path)?;
    file.write_all(&vec![0; SYNCS * BLOCK.len()])?;
    file.sync_all()?;
    file.rewind()?;
    let mut times = Vec::with_capacity(SYNCS);
    for _ in 0..SYNCS {
        let begin = Instant::now();
        file.write_all(&BLOCK)?;
        file.sync_data()?;
        times.push(begin.elapsed());
    }
    std::fs::remove_file(path)?;
    times.sort_unstable();
    Ok(times.get(SYNCS / 2).context("no write")?.as_secs_f64() * 1e3)
}
