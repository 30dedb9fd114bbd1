//! Reads the configuration again when its file or the overlay changes.
//!
//! Of the file there are three triggers, each enough alone: events of its directory (a Kubernetes
//! ConfigMap swaps a symlink there, so the file itself is never written), SIGHUP, and a slow poll
//! of the content that repairs what an event missed.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use notify::event::{AccessKind, AccessMode, EventKind};
use notify::{RecommendedWatcher, RecursiveMode, Watcher};
use tokio::sync::{mpsc, watch as channel};
use tokio::time::Instant;

use super::compose::Composition;
use super::{Loaded, LocatedFault, Overlay, Schema, Sources, Verdict};
use crate::supervisor::{Supervisor, TaskPolicy};
use crate::{BEAT, ticks};

/// How changes are noticed.
#[derive(Debug, Clone)]
pub struct WatchSettings {
    /// Quiet time after an event before the file is read: an editor writes in several steps.
    pub debounce: Duration,
    /// Between two looks at the content.
    pub poll: Duration,
    /// Whether events of the directory are used.
    pub directory_events: bool,
    /// Whether SIGHUP reads the file again; at most one watch of a process needs it.
    pub hangup: bool,
}

impl Default for WatchSettings {
    fn default() -> Self {
        Self {
            debounce: Duration::from_millis(100),
            poll: BEAT.saturating_mul(32),
            directory_events: true,
            hangup: true,
        }
    }
}

impl WatchSettings {
    /// For a [text](Sources::text): nothing changes it, and SIGHUP is for the program around it.
    #[must_use]
    pub fn of_text() -> Self {
        Self {
            poll: Duration::from_secs(3600),
            directory_events: false,
            hangup: false,
            ..Self::default()
        }
    }
}

/// The configuration that holds now.
#[derive(Debug)]
pub struct Current<T> {
    /// What the program began with.
    pub started: Arc<Loaded<T>>,
    /// The last one without faults.
    pub loaded: Arc<Loaded<T>>,
    /// Faults of the present file content, if it was refused.
    pub faults: Option<Arc<[LocatedFault]>>,
    /// What became of the overlay; `None`: there is none.
    pub overlay: Option<Verdict>,
    /// Number of published readings; the first is 0.
    pub serial: u64,
}

impl<T> Clone for Current<T> {
    fn clone(&self) -> Self {
        Self {
            started: Arc::clone(&self.started),
            loaded: Arc::clone(&self.loaded),
            faults: self.faults.clone(),
            overlay: self.overlay.clone(),
            serial: self.serial,
        }
    }
}

/// Watches the file of `sources` (which the caller has [pinned](Sources::pinned)) from `initial`
/// on. Each change of the content and each SIGHUP is told to the receiver once, faulty or not; the
/// last good value stays.
#[must_use]
pub fn watch<T: Send + Sync + 'static>(
    supervisor: &Supervisor,
    sources: Sources,
    schema: Schema<T>,
    initial: Loaded<T>,
    settings: WatchSettings,
) -> channel::Receiver<Current<T>> {
    let (_, nothing) = channel::channel(None);
    watch_with(supervisor, sources, schema, initial, settings, nothing)
}

/// As [`watch`], with an overlay (values from BlazeConfig) over the file. A faulty file or overlay
/// is ignored, and the other still takes effect. If each is valid alone but the combination is not,
/// the one that changed last is ignored.
#[must_use]
pub fn watch_with<T: Send + Sync + 'static>(
    supervisor: &Supervisor,
    sources: Sources,
    schema: Schema<T>,
    initial: Loaded<T>,
    settings: WatchSettings,
    overlays: channel::Receiver<Option<Overlay>>,
) -> channel::Receiver<Current<T>> {
    let composition = Composition::new(sources, schema, &initial.document);
    let initial = Arc::new(initial);
    let (tell, told) = channel::channel(Current {
        started: Arc::clone(&initial),
        loaded: initial,
        faults: None,
        overlay: None,
        serial: 0,
    });
    let stop = supervisor.shutdown_token();
    let task = Task { composition, tell };
    supervisor.spawn("configuration watch", TaskPolicy::Essential, async move {
        tokio::select! {
            () = task.run(settings, overlays) => {}
            () = stop.cancelled() => {}
        }
    });
    told
}

struct Task<T> {
    composition: Composition<T>,
    tell: channel::Sender<Current<T>>,
}

impl<T: Send + Sync + 'static> Task<T> {
    async fn run(
        mut self,
        settings: WatchSettings,
        mut overlays: channel::Receiver<Option<Overlay>>,
    ) {
        let (events, mut changed) = mpsc::channel(1);
        let mut directories = Directories::new(settings.directory_events.then(|| events.clone()));
        let mut hangup = Hangup::new(settings.hangup);
        let mut poll = ticks(settings.poll);
        // What changed since the first reading is found at once.
        let mut is_first = true;
        // What is there before the first change counts too.
        overlays.mark_changed();
        loop {
            let mut forced = false;
            tokio::select! {
                // Without a sender it stays as it is.
                Ok(()) = overlays.changed() => {
                    let overlay = overlays.borrow_and_update().clone();
                    if self.composition.lay_over(overlay) {
                        self.reload();
                    }
                    continue;
                }
                Some(()) = changed.recv() => quiet(&mut changed, settings.debounce).await,
                () = hangup.recv() => forced = true,
                () = async {}, if is_first => is_first = false,
                _ = poll.tick() => {}
            }
            let sources = self.composition.sources().clone();
            let looked = tokio::task::spawn_blocking(move || {
                // Watched before it is read, so that no change falls between.
                if let Some(file) = sources.resolve_file() {
                    directories.arm(&file);
                }
                (sources.read_file(), directories)
            });
            // The blocking task ends early only when the runtime goes away.
            let Ok((seen, back)) = looked.await else { return };
            directories = back;
            if self.composition.see(seen) || forced {
                self.reload();
            }
        }
    }

    fn reload(&mut self) {
        let judgement = self.composition.judge();
        self.tell.send_modify(|current| {
            current.serial += 1;
            if let Some(loaded) = judgement.loaded {
                current.loaded = Arc::new(loaded);
            }
            current.faults = judgement.faults;
            current.overlay = judgement.overlay;
        });
    }
}

/// Waits until nothing has changed for a while, but not for long: in a directory in which others
/// write as well that may never be, and a change is to be in effect within a second.
async fn quiet(changed: &mut mpsc::Receiver<()>, debounce: Duration) {
    let latest = Instant::now() + debounce * 4;
    while Instant::now() < latest {
        if tokio::time::timeout(debounce, changed.recv()).await.is_err() {
            return;
        }
    }
}

/// SIGHUP, or nothing at all.
struct Hangup(Option<tokio::signal::unix::Signal>);

impl Hangup {
    fn new(wanted: bool) -> Self {
        let register = || tokio::signal::unix::signal(tokio::signal::unix::SignalKind::hangup());
        let failed = |error: &std::io::Error| {
            tracing::warn!(
                %error,
                "SIGHUP will not reload the configuration",
            );
        };
        Self(wanted.then(register).and_then(|signal| signal.inspect_err(failed).ok()))
    }

    async fn recv(&mut self) {
        if let Some(signal) = &mut self.0
            && signal.recv().await.is_some()
        {
            return;
        }
        std::future::pending::<()>().await;
    }
}

/// The directories that are watched: that of the file as it is named, and that of the file that it
/// leads to.
struct Directories {
    watcher: Option<RecommendedWatcher>,
    /// Device and inode of each: another directory under the same name must be watched anew.
    armed: BTreeMap<PathBuf, (u64, u64)>,
}

impl Directories {
    fn new(events: Option<mpsc::Sender<()>>) -> Self {
        let make = |events: mpsc::Sender<()>| {
            notify::recommended_watcher(move |event: notify::Result<notify::Event>| {
                if event.map_or(true, |event| tells_of_a_change(event.kind)) {
                    // Full means that one is waiting already.
                    let _ = events.try_send(());
                }
            })
        };
        let failed = |error: &notify::Error| {
            tracing::warn!(
                %error,
                "no directory events: changes of the configuration are found by polling",
            );
        };
        Self {
            watcher: events.and_then(|events| make(events).inspect_err(failed).ok()),
            armed: BTreeMap::new(),
        }
    }

    fn arm(&mut self, file: &Path) {
        let Some(watcher) = &mut self.watcher else { return };
        let named = Some(directory_of(file).to_owned());
        let real = std::fs::canonicalize(file).ok().map(|real| directory_of(&real).to_owned());
        let wanted: BTreeMap<PathBuf, (u64, u64)> = [named, real]
            .into_iter()
            .flatten()
            .filter_map(|path| Some((path.clone(), identity(&path)?)))
            .collect();
        for path in self
            .armed
            .iter()
            .filter(|(path, id)| wanted.get(*path) != Some(*id))
            .map(|(path, _)| path)
        {
            // It may be gone, and its watch with it.
            let _ = watcher.unwatch(path);
        }
        self.armed.retain(|path, id| wanted.get(path) == Some(id));
        for (path, id) in wanted {
            if self.armed.contains_key(&path) {
                continue;
            }
            match watcher.watch(&path, RecursiveMode::NonRecursive) {
                Ok(()) => {
                    self.armed.insert(path, id);
                }
                Err(error) => {
                    tracing::debug!(
                        %error,
                        path = %path.display(),
                        "directory is not watched, only polled",
                    );
                }
            }
        }
    }
}

/// Our own reading of the file is an event too and must not lead to the next one.
fn tells_of_a_change(kind: EventKind) -> bool {
    match kind {
        EventKind::Access(kind) => kind == AccessKind::Close(AccessMode::Write),
        _ => true,
    }
}

fn directory_of(file: &Path) -> &Path {
    match file.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn identity(path: &Path) -> Option<(u64, u64)> {
    let metadata = std::fs::metadata(path).ok()?;
    Some((metadata.dev(), metadata.ino()))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[tokio::test]
    async fn another_directory_under_the_same_name_is_armed() {
        let parent = tempfile::tempdir().unwrap();
        let directory = parent.path().join("etc");
        let file = directory.join("blaze.yaml");
        let make = || {
            fs::create_dir(&directory).unwrap();
            fs::write(&file, "a: 1").unwrap();
        };
        make();
        let (events, mut changed) = mpsc::channel(1);
        let mut directories = Directories::new(Some(events));
        directories.arm(&file);
        let first = directories.armed.clone();
        assert_eq!(first.len(), 1);
        fs::rename(&directory, parent.path().join("old")).unwrap();
        make();
        directories.arm(&file);
        assert_ne!(directories.armed, first);
        while changed.try_recv().is_ok() {}
        fs::write(&file, "a: 2").unwrap();
        let told = tokio::time::timeout(Duration::from_secs(10), changed.recv()).await;
        assert_eq!(told, Ok(Some(())));
    }
}
