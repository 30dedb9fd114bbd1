//! The monitor's own control group (v2): what a container or a unit may use.

use std::path::{Component, Path, PathBuf};

use procfs_core::{FromBufRead, ProcessCGroups};

use super::file::{Fault, Text};
use super::metrics::{CGROUP_CPUS, CGROUP_MEMORY, CGROUP_THROTTLED};
use super::sample::Batch;
use super::sampler::{Collector, Roots};

/// Collector `cgroup`. Only the group itself is looked at, not those above it.
pub(super) struct Cgroup {
    membership: PathBuf,
    mount: PathBuf,
    files: Option<Files>,
    buffer: Vec<u8>,
}

struct Files {
    limit: Text,
    used: Text,
    quota: Text,
    stat: Text,
}

impl Cgroup {
    pub(super) fn new(roots: &Roots) -> Self {
        let membership = roots.proc.join("self/cgroup");
        Self { membership, mount: roots.sys.join("fs/cgroup"), files: None, buffer: Vec::new() }
    }
}

impl Collector for Cgroup {
    fn name(&self) -> &'static str {
        "cgroup"
    }

    fn discover(&mut self) {
        let text = Text::table(self.membership.clone()).read(&mut self.buffer).ok().flatten();
        let folder = text.and_then(|text| folder(&self.mount, &text));
        self.files = folder.map(|folder| Files {
            limit: Text::attribute(folder.join("memory.max")),
            used: Text::attribute(folder.join("memory.current")),
            quota: Text::attribute(folder.join("cpu.max")),
            stat: Text::attribute(folder.join("cpu.stat")),
        });
    }

    fn collect(&mut self, batch: &mut Batch) {
        let Some(files) = &mut self.files else { return };
        let buffer = &mut self.buffer;
        // `max` is no number: no limit, no series
        if let Some(limit) = batch.take(files.limit.number(buffer)) {
            batch.one(&CGROUP_MEMORY, "limit", limit);
        }
        if let Some(used) = batch.take(files.used.number(buffer)) {
            batch.one(&CGROUP_MEMORY, "used", used);
        }
        let cpus = quota(&mut files.quota, buffer);
        if let Some(cpus) = batch.take(cpus) {
            batch.plain(&CGROUP_CPUS, cpus);
        }
        let throttled = throttled(&mut files.stat, buffer);
        if let Some(seconds) = batch.take(throttled) {
            batch.plain(&CGROUP_THROTTLED, seconds);
        }
    }
}

/// The folder of the group. A path with `..` lies outside of the namespace: then its root is all
/// that can be seen.
fn folder(mount: &Path, text: &str) -> Option<PathBuf> {
    let groups = ProcessCGroups::from_buf_read(text.as_bytes()).ok()?;
    let own = groups.0.into_iter().find(|group| group.hierarchy == 0)?;
    let path = Path::new(own.pathname.trim_start_matches('/'));
    let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    Some(if inside { mount.join(path) } else { mount.to_owned() })
}

fn quota(file: &mut Text, buffer: &mut Vec<u8>) -> Result<Option<f64>, Fault> {
    let text = file.read(buffer)?;
    Ok(text.and_then(|text| {
        let (quota, period) = text.trim().split_once(' ')?;
        let cpus = quota.parse::<f64>().ok()? / period.parse::<f64>().ok()?;
        (cpus > 0.0).then_some(cpus)
    }))
}

fn throttled(file: &mut Text, buffer: &mut Vec<u8>) -> Result<Option<f64>, Fault> {
    let text = file.read(buffer)?;
    Ok(text.and_then(|text| {
        let micros = text.lines().find_map(|line| line.strip_prefix("throttled_usec "))?;
        Some(micros.trim().parse::<u64>().ok()? as f64 / 1e6)
    }))
}
