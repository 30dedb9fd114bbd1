//! Space of the file systems.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use procfs_core::{FromBufRead, MountEntry};

use super::file::{Fault, Text};
use super::limits;
use super::metrics::DISK;
use super::sample::{Batch, Label};
use super::sampler::{Collector, Roots};

/// Read-only images: always full, and no concern of anybody.
const IMAGES: [&str; 6] = ["squashfs", "iso9660", "udf", "erofs", "cramfs", "romfs"];

/// File systems on a disk whose source is no path below /dev.
const WITHOUT_DEVICE: [&str; 3] = ["zfs", "bcachefs", "ubifs"];

/// Files of the host that container engines mount from their own disk.
const OF_ENGINES: [&str; 4] =
    ["/etc/hosts", "/etc/hostname", "/etc/resolv.conf", "/dev/termination-log"];

/// Space of one file system.
#[derive(Clone, Copy, Debug)]
pub(super) struct SpaceStat {
    /// Identity of the file system.
    pub(super) id: u64,
    pub(super) total_bytes: u64,
    /// Available to users without privilege.
    pub(super) available_bytes: u64,
}

/// Asks for the space of a mount; `None` where there is none.
pub(super) type SpaceOf = Arc<dyn Fn(&Path) -> Option<SpaceStat> + Send + Sync>;

/// The kernel's answer.
pub(super) fn space_of() -> SpaceOf {
    Arc::new(|mount| {
        let stat = rustix::fs::statvfs(mount).ok()?;
        Some(SpaceStat {
            id: stat.f_fsid,
            total_bytes: stat.f_blocks.saturating_mul(stat.f_frsize),
            available_bytes: stat.f_bavail.saturating_mul(stat.f_frsize),
        })
    })
}

struct Mount {
    path: PathBuf,
    label: Label,
    stat: Option<SpaceStat>,
}

/// Collector `disk`.
pub(super) struct Space {
    mounts: Text,
    space: SpaceOf,
    known: Vec<Mount>,
    /// The mounts were read since the last discovery.
    fresh: bool,
    buffer: Vec<u8>,
}

impl Space {
    pub(super) fn new(roots: &Roots, space: SpaceOf) -> Self {
        let mounts = Text::table(roots.proc.join("self/mounts"));
        Self { mounts, space, known: Vec::new(), fresh: false, buffer: Vec::new() }
    }

    fn read_mounts(&mut self) -> Result<Vec<Mount>, Fault> {
        let Some(text) = self.mounts.read(&mut self.buffer)? else { return Ok(Vec::new()) };
        let entries = Vec::<MountEntry>::from_buf_read(text.as_bytes());
        let entries = entries.map_err(|error| Fault::Form {
            source_name: self.mounts.path().display().to_string(),
            error: error.to_string(),
        })?;
        Ok(select(entries))
    }
}

impl Space {
    /// Asks for the space of all mounts. `false`: they must be read again; below the path of a file
    /// system that was unmounted lies another one.
    fn measure(&mut self) -> bool {
        let mut same = self.fresh;
        for mount in &mut self.known {
            let stat = (self.space)(&mount.path);
            same &= stat.map(|stat| stat.id) == mount.stat.map(|stat| stat.id);
            mount.stat = stat;
        }
        same
    }
}

impl Collector for Space {
    fn name(&self) -> &'static str {
        "disk"
    }

    fn discover(&mut self) {
        self.fresh = false;
    }

    fn collect(&mut self, batch: &mut Batch) {
        if !self.measure() {
            let read = self.read_mounts();
            let mounts = batch.take(read.map(Some));
            self.fresh = mounts.is_some();
            self.known = mounts.unwrap_or_default();
            self.measure();
        }
        for mount in &self.known {
            let Some(stat) = mount.stat else { continue };
            if stat.total_bytes > 0 && stat.available_bytes <= stat.total_bytes {
                batch.two(&DISK, mount.label.clone(), "total", stat.total_bytes as f64);
                batch.two(&DISK, mount.label.clone(), "available", stat.available_bytes as f64);
            }
        }
    }
}

/// The file systems that have space of this node, each once: by its shortest path.
fn select(entries: Vec<MountEntry>) -> Vec<Mount> {
    let mut kept: Vec<MountEntry> = Vec::new();
    for entry in entries.into_iter().filter(has_space) {
        match kept.iter().position(|known| known.fs_spec == entry.fs_spec) {
            Some(known) if entry.fs_file.len() < kept[known].fs_file.len() => kept[known] = entry,
            None if kept.len() < limits::LABEL_VALUES => kept.push(entry),
            Some(_) | None => {}
        }
    }
    // the last mount on a path hides the others
    let mut mounts: Vec<Mount> = Vec::new();
    for entry in kept {
        let path = entry.fs_file.replace("\\040", " ");
        let mount = Mount { label: Label::new(&path), path: path.into(), stat: None };
        match mounts.iter_mut().find(|known| known.path == mount.path) {
            Some(known) => *known = mount,
            None => mounts.push(mount),
        }
    }
    mounts
}

fn has_space(entry: &MountEntry) -> bool {
    let kind = entry.fs_vfstype.as_str();
    let device = entry.fs_spec.starts_with("/dev/") && !entry.fs_spec.starts_with("/dev/loop");
    if IMAGES.contains(&kind) || OF_ENGINES.contains(&entry.fs_file.as_str()) {
        return false;
    }
    let root_of_container = kind == "overlay" && entry.fs_file == "/";
    device || WITHOUT_DEVICE.contains(&kind) || root_of_container
}
