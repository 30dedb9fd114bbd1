//! `clock`, `disk` and `descriptors`.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use blaze_domain::node_file::{DatabaseSection, NodeFile, StoreSection};
use blaze_runtime::state::DEFAULT_DIRECTORY;
use rtime_clock::adjtime::{Timex, adjtimex};

use super::check::Finding;
use super::limits::{DESCRIPTORS_FAIL, DESCRIPTORS_WARN};
use super::programs::Kind;
use super::{Node, on_thread};
use crate::output::bytes;

/// What `adjtimex` returns for a clock that nobody keeps, `TIME_ERROR`.
const NOT_SYNCHRONISED: i32 = 5;

/// What the kernel says of its clock.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Clock {
    synchronised: bool,
    error_ms: f64,
}

fn read_clock() -> io::Result<Clock> {
    let mut state = Timex::new();
    let answer = adjtimex(&mut state)?;
    Ok(Clock { synchronised: answer != NOT_SYNCHRONISED, error_ms: state.0.maxerror as f64 / 1e3 })
}

/// `clock`.
pub(super) fn clock(node: &Node) -> Vec<Finding> {
    let limit_ms = node.file.monitor.thresholds.clock_error_ms;
    vec![match read_clock() {
        Ok(clock) => judge_clock(clock, limit_ms),
        Err(error) => Finding::skipped(
            format!("the kernel says nothing of its clock: {error}"),
            "timedatectl timesync-status on the host",
        ),
    }]
}

/// Nothing stops flowing with a wrong clock: ages and latencies are wrong.
fn judge_clock(clock: Clock, limit_ms: f64) -> Finding {
    let error_ms = clock.error_ms;
    if !clock.synchronised {
        return Finding::warn(
            "the clock is not synchronised",
            "timedatectl set-ntp true, or apt install chrony; in a container: on its host",
        );
    }
    if error_ms > limit_ms {
        return Finding::warn(
            format!("the clock may be wrong by {error_ms:.1} ms, the threshold is {limit_ms} ms"),
            "chronyc makestep, with a nearer server in /etc/chrony/chrony.conf; or set \
             monitor.thresholds.clock_error_ms higher",
        );
    }
    Finding::ok(format!("synchronised, wrong by {error_ms:.1} ms at most"))
}

/// A file system as `statvfs` tells it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Space {
    total: u64,
    available: u64,
    files: u64,
    files_available: u64,
    is_read_only: bool,
}

/// Folders that programs write to, each with its key.
fn folders(file: &NodeFile) -> BTreeMap<PathBuf, &'static str> {
    let state = file.state_dir.clone().unwrap_or_else(|| PathBuf::from(DEFAULT_DIRECTORY));
    let mut folders = BTreeMap::from([(state, "state_dir")]);
    if let Some(folder) = &file.worker.state_dir {
        folders.entry(folder.clone()).or_insert("worker.state_dir");
    }
    if let Some(DatabaseSection::Embedded { path }) = &file.database {
        folders.entry(path.clone()).or_insert("database.embedded.path");
    }
    folders
}

/// The database of a main service on this machine.
fn main_store(node: &Node) -> Option<PathBuf> {
    node.main.object()?;
    match &node.file.control_plane.store {
        StoreSection::Sqlite { path } => Some(path.clone()),
        StoreSection::MongoDb(_) => None,
    }
}

/// `disk`: free space where programs keep their state.
pub(super) async fn disk(node: &Node) -> Vec<Finding> {
    let mut folders = folders(&node.file);
    if let Some(path) = main_store(node) {
        folders.entry(path).or_insert("control_plane.store.sqlite.path");
    }
    let least = node.file.monitor.thresholds.disk_free_ratio;
    let looked = folders.into_iter().map(|(folder, key)| async move {
        let asked = folder.clone();
        let found = on_thread(move || space(&asked)).await;
        let found = found.unwrap_or_else(|| Err(io::Error::other("no thread")));
        match found {
            Ok(space) => judge_disk(key, &folder, space, least),
            Err(error) => Finding::fail(
                format!("{key} {}: {error}", folder.display()),
                format!("mkdir -p {}", folder.display()),
            ),
        }
    });
    futures::future::join_all(looked).await
}

/// Of the folder, or where it is not there yet of the one that it will be made in.
fn space(folder: &Path) -> io::Result<Space> {
    let full = std::path::absolute(folder)?;
    let there = full.ancestors().find(|path| path.exists()).unwrap_or(Path::new("/"));
    let found = rustix::fs::statvfs(there)?;
    Ok(Space {
        total: found.f_blocks.saturating_mul(found.f_frsize),
        available: found.f_bavail.saturating_mul(found.f_frsize),
        files: found.f_files,
        files_available: found.f_favail,
        is_read_only: found.f_flag.contains(rustix::fs::StatVfsMountFlags::RDONLY),
    })
}

fn judge_disk(key: &str, folder: &Path, space: Space, least: f64) -> Finding {
    let shown = folder.display();
    let free = space.available as f64 / space.total.max(1) as f64;
    let files = space.files_available as f64 / space.files.max(1) as f64;
    let remedy = format!(
        "du -xh --max-depth=2 {shown} | sort -h | tail shows what to delete; or set {key} to a \
         folder on a larger disk"
    );
    if space.is_read_only {
        let detail = format!("{key} {shown} is on a file system that is read-only");
        return Finding::fail(
            detail,
            format!("mount -o remount,rw $(findmnt -no TARGET -T {shown})"),
        );
    }
    if space.total > 0 && (free < least || space.available == 0) {
        return Finding::fail(
            format!(
                "{key} {shown}: {} of {} are free, {:.1} %, the threshold is {:.1} %",
                bytes(space.available as f64),
                bytes(space.total as f64),
                free * 100.0,
                least * 100.0,
            ),
            remedy,
        );
    }
    if space.files > 0 && files < least {
        return Finding::fail(
            format!("{key} {shown}: {:.1} % of its files (inodes) are free", files * 100.0),
            format!("find {shown} -xdev -type f | wc -l; delete small files"),
        );
    }
    Finding::ok(format!("{key} {shown}: {:.0} % free", free * 100.0))
}

/// Open files of a process, and how many it may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Descriptors {
    pid: u32,
    used: u64,
    limit: u64,
}

/// `descriptors`: of each program that runs here.
pub(super) async fn descriptors(node: &Node) -> Vec<Finding> {
    let root = node.proc.clone();
    let found = on_thread(move || processes(&root)).await.unwrap_or_default();
    if found.is_empty() {
        return vec![node.flow.not_running(&node.name)];
    }
    found.into_iter().map(|(name, found)| judge_descriptors(&name, found)).collect()
}

/// Programs of the product below `/proc`; those of others and those that may not be looked at are
/// left out.
fn processes(proc: &Path) -> Vec<(String, Result<Descriptors, String>)> {
    let names = [Kind::Flow, Kind::Worker, Kind::Monitor, Kind::Main].map(Kind::program);
    let entries = std::fs::read_dir(proc).into_iter().flatten().flatten();
    let mut found = Vec::new();
    for entry in entries {
        let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else {
            continue;
        };
        let comm = std::fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
        if names.contains(&comm.trim()) {
            found.push((comm.trim().to_owned(), descriptors_of(&entry.path(), pid)));
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found
}

fn descriptors_of(process: &Path, pid: u32) -> Result<Descriptors, String> {
    let words = |error: io::Error| format!("process {pid}: {error}");
    let used = std::fs::read_dir(process.join("fd")).map_err(words)?.count() as u64;
    let limits = std::fs::read_to_string(process.join("limits")).map_err(words)?;
    let limit = soft_limit(&limits).ok_or(format!("process {pid}: no limit of open files"))?;
    Ok(Descriptors { pid, used, limit })
}

/// The soft limit of `Max open files`; without one there is none to reach.
fn soft_limit(limits: &str) -> Option<u64> {
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    match line.split_whitespace().next()? {
        "unlimited" => Some(u64::MAX),
        number => number.parse().ok(),
    }
}

fn judge_descriptors(name: &str, found: Result<Descriptors, String>) -> Finding {
    let Descriptors { pid, used, limit } = match found {
        Ok(found) => found,
        Err(reason) => {
            return Finding::skipped(format!("{name}: {reason}"), "sudo blaze doctor");
        }
    };
    let share = used as f64 / limit.max(1) as f64;
    let detail = format!("{name} ({pid}) has {used} of {limit} file descriptors open");
    let more = limit.saturating_mul(4).clamp(65_536, 1_048_576);
    let remedy = format!(
        "prlimit --pid {pid} --nofile={more}:{more}, and for good LimitNOFILE={more} in `systemctl \
         edit {name}`"
    );
    match share {
        share if share >= DESCRIPTORS_FAIL => Finding::fail(detail, remedy),
        share if share >= DESCRIPTORS_WARN => Finding::warn(detail, remedy),
        _ => Finding::ok(detail),
    }
}

#[cfg(test)]
mod tests {
    use super::super::check::Outcome;
    use super::*;

    #[test]
    fn a_clock_is_synchronised_and_good_enough_or_not() {
        let clock = |synchronised, error_ms| judge_clock(Clock { synchronised, error_ms }, 50.0);
        assert_eq!(clock(true, 3.0).result, Outcome::Ok);
        assert_eq!(clock(true, 51.0).result, Outcome::Warn);
        assert_eq!(clock(false, 0.0).result, Outcome::Warn);
    }

    #[test]
    fn a_disk_is_full_by_space_or_by_files_or_read_only() {
        let good = Space {
            total: 1000,
            available: 500,
            files: 100,
            files_available: 50,
            is_read_only: false,
        };
        let judge = |space| judge_disk("state_dir", Path::new("/var/lib/blaze"), space, 0.05);
        assert_eq!(judge(good).result, Outcome::Ok);
        // A file system without a number of files, as btrfs.
        assert_eq!(judge(Space { files: 0, files_available: 0, ..good }).result, Outcome::Ok);
        for bad in [
            Space { available: 49, ..good },
            Space { files_available: 4, ..good },
            Space { is_read_only: true, ..good },
        ] {
            let found = judge(bad);
            assert_eq!(found.result, Outcome::Fail, "{bad:?}");
            assert!(found.detail.contains("state_dir /var/lib/blaze"), "{found:?}");
        }
        assert!(judge(Space { available: 49, ..good }).remedy.starts_with("du -xh"));
    }

    #[test]
    fn a_folder_that_is_not_there_yet_is_on_the_disk_of_the_one_above() {
        let folder = tempfile::tempdir().unwrap();
        let there = space(folder.path()).unwrap();
        let below = space(&folder.path().join("a/b")).unwrap();
        assert_eq!((there.total, there.files), (below.total, below.files));
        assert!(there.total > 0);
    }

    #[test]
    fn descriptors_are_read_from_the_root_that_is_given() {
        let root = tempfile::tempdir().unwrap();
        let process = root.path().join("42");
        std::fs::create_dir_all(process.join("fd")).unwrap();
        std::fs::write(process.join("comm"), "blaze-flow\n").unwrap();
        std::fs::write(
            process.join("limits"),
            "Limit                     Soft Limit           Hard Limit           Units\n\
             Max processes             unlimited            unlimited            processes\n\
             Max open files            10                   4096                 files\n",
        )
        .unwrap();
        for number in 0..8 {
            std::fs::write(process.join("fd").join(number.to_string()), "").unwrap();
        }
        std::fs::create_dir(root.path().join("43")).unwrap();
        std::fs::write(root.path().join("43/comm"), "bash\n").unwrap();
        let found = processes(root.path());
        assert_eq!(found.len(), 1);
        let expected = Descriptors { pid: 42, used: 8, limit: 10 };
        assert_eq!(found[0], ("blaze-flow".to_owned(), Ok(expected)));
        let warned = judge_descriptors("blaze-flow", Ok(expected));
        assert_eq!(warned.result, Outcome::Warn);
        assert!(warned.remedy.starts_with("prlimit --pid 42 --nofile=65536:65536"));
        let full = Descriptors { used: 10, ..expected };
        assert_eq!(judge_descriptors("blaze-flow", Ok(full)).result, Outcome::Fail);
        let endless = Descriptors { limit: u64::MAX, ..expected };
        assert_eq!(judge_descriptors("blaze-flow", Ok(endless)).result, Outcome::Ok);
    }
}
