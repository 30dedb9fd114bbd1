//! Files that are read again when they change: keys, certificates.
//!
//! Their content is looked at once a second and compared by its hash. That finds every kind of
//! change alike, also the swap of a symlink by Kubernetes and a file that is replaced by another of
//! the same size and time.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::digest::{SHA256, digest};
use blaze_runtime::{Supervisor, TaskPolicy};
use tokio::time::MissedTickBehavior;
use zeroize::Zeroizing;

/// Between two looks.
pub(crate) const PERIOD: Duration = Duration::from_secs(1);
/// Largest file, in bytes.
const MAX_FILE_BYTES: u64 = 1024 * 1024;
/// Quiet time after a change: who writes a file, or two that belong together, needs several steps.
const QUIET: Duration = Duration::from_millis(100);
/// Looks until a file that never rests is read all the same.
const LOOKS: usize = 5;

/// What was found when the files were read again: every fault, each to be logged once.
pub(crate) type Faults = Vec<String>;

/// Hash of each file; `None` for one that cannot be read.
type Look = Vec<Option<[u8; 32]>>;

/// Reads a file that is held in memory.
///
/// # Errors
/// With the path and the reason.
pub(crate) fn read_file(path: &Path) -> Result<Zeroizing<Vec<u8>>, String> {
    let name = path.display();
    let bytes = read(path).map_err(|error| format!("{name} cannot be read: {error}"))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(format!("{name} has more than {MAX_FILE_BYTES} bytes"));
    }
    Ok(bytes)
}

/// At most one byte more than is allowed.
fn read(path: &Path) -> io::Result<Zeroizing<Vec<u8>>> {
    let file = File::open(path)?;
    let known = file.metadata()?.len().min(MAX_FILE_BYTES);
    // Room from the start: bytes that grow leave copies of a key behind.
    let mut bytes = Zeroizing::new(Vec::with_capacity(usize::try_from(known).unwrap_or(0) + 1));
    file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Calls `reload` in the background whenever one of the files has changed, and once soon after the
/// start: a change between the first reading and the first look is not missed. What faults it gives
/// is logged; what held before stays.
pub(crate) fn watch_files(
    supervisor: &Supervisor,
    name: &str,
    files: Vec<PathBuf>,
    period: Duration,
    reload: impl Fn() -> Faults + Send + Sync + 'static,
) {
    if files.is_empty() {
        return;
    }
    let stop = supervisor.shutdown_token();
    let what: Arc<str> = Arc::from(name);
    supervisor.spawn(format!("watch of {name}"), TaskPolicy::Essential, async move {
        tokio::select! {
            () = run(what, files.into(), period, Arc::new(reload)) => {}
            () = stop.cancelled() => {}
        }
    });
}

async fn run(
    what: Arc<str>,
    files: Arc<[PathBuf]>,
    period: Duration,
    reload: Arc<impl Fn() -> Faults + Send + Sync + 'static>,
) {
    let mut seen: Option<Look> = None;
    let mut told: Faults = Vec::new();
    let mut tick = tokio::time::interval(period);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        let Some(mut now) = look(&files).await else { return };
        if seen.as_ref() == Some(&now) {
            continue;
        }
        for _ in 0..LOOKS {
            tokio::time::sleep(QUIET.min(period)).await;
            let before = std::mem::take(&mut now);
            let Some(after) = look(&files).await else { return };
            now = after;
            if now == before {
                break;
            }
        }
        let first = seen.replace(now).is_none();
        let reload = Arc::clone(&reload);
        // The blocking task ends early only when the runtime goes away.
        let Ok(faults) = tokio::task::spawn_blocking(move || reload()).await else {
            return;
        };
        for fault in faults.iter().filter(|fault| !told.contains(fault)) {
            tracing::error!(fault, "{what}: what changed is not used; what held before stays");
        }
        if faults.is_empty() && !first {
            tracing::info!("{what}: read again after a change");
        }
        told = faults;
    }
}

async fn look(files: &Arc<[PathBuf]>) -> Option<Look> {
    let files = Arc::clone(files);
    let hashes = move || {
        files.iter().map(|file| read_file(file).ok().and_then(|bytes| hash(&bytes))).collect()
    };
    tokio::task::spawn_blocking(hashes).await.ok()
}

fn hash(bytes: &[u8]) -> Option<[u8; 32]> {
    digest(&SHA256, bytes).as_ref().try_into().ok()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[tokio::test]
    async fn a_swapped_symlink_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in ["one", "two"] {
            fs::create_dir(path(name)).unwrap();
            fs::write(path(name).join("key"), name).unwrap();
        }
        symlink(path("one"), path("data")).unwrap();
        let file = path("data").join("key");
        let supervisor = Supervisor::new("test");
        let (calls, counted) =
            (Arc::new(AtomicUsize::new(0)), tokio::sync::watch::Sender::new(String::new()));
        let mut told = counted.subscribe();
        let (seen, count) = (file.clone(), Arc::clone(&calls));
        watch_files(&supervisor, "test", vec![file], Duration::from_millis(10), move || {
            count.fetch_add(1, Ordering::Relaxed);
            let text = read_file(&seen).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
            counted.send_replace(text.unwrap_or_default());
            vec!["told once".to_owned()]
        });
        let soon = Duration::from_secs(10);
        let one = told.wait_for(|text| text == "one");
        tokio::time::timeout(soon, one).await.unwrap().unwrap();
        symlink(path("two"), path("new")).unwrap();
        fs::rename(path("new"), path("data")).unwrap();
        let two = told.wait_for(|text| text == "two");
        tokio::time::timeout(soon, two).await.unwrap().unwrap();
        assert_eq!(calls.load(Ordering::Relaxed), 2);
        assert!(supervisor.shutdown(soon).await.is_clean());
    }

    #[test]
    fn faults_name_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let missing = read_file(&folder.path().join("missing")).unwrap_err();
        assert!(missing.contains("missing cannot be read"), "{missing}");
        let large = folder.path().join("large");
        fs::write(&large, vec![0; 1024 * 1024 + 1]).unwrap();
        assert!(read_file(&large).unwrap_err().contains("1048576"));
        assert!(read_file(folder.path()).is_err());
    }
}
