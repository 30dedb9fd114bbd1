//! Small files that outlive the process: where they lie, how they are written whole or not at all,
//! and epochs.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use tempfile::NamedTempFile;

use crate::environment;

/// Where state lies unless the configuration says otherwise.
pub const DEFAULT_DIRECTORY: &str = "/var/lib/blaze";
/// Largest file that is read back, in bytes.
const MAX_SMALL_FILE_BYTES: u64 = 1024 * 1024;

/// A directory that this process may write to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateDirectory {
    /// Which one.
    pub path: PathBuf,
    /// Why it is not the one that was asked for; to be logged once.
    pub instead_of: Option<String>,
}

/// The configured directory (default `/var/lib/blaze`), or without rights there
/// `$XDG_STATE_HOME/blaze`, or `~/.local/state/blaze`. It is made if it does not exist.
///
/// # Errors
/// If none of them can be written to; the text names each with its reason.
pub fn state_directory(configured: Option<&Path>) -> io::Result<StateDirectory> {
    let user = environment::variable("XDG_STATE_HOME")
        .map(PathBuf::from)
        .filter(|path| path.is_absolute());
    let home =
        || environment::variable("HOME").map(|home| PathBuf::from(home).join(".local/state"));
    resolve(
        configured.unwrap_or(Path::new(DEFAULT_DIRECTORY)),
        user.or_else(home).map(|state| state.join("blaze")),
    )
}

fn resolve(wanted: &Path, fallback: Option<PathBuf>) -> io::Result<StateDirectory> {
    let refused = match probe(wanted) {
        Ok(()) => {
            return Ok(StateDirectory { path: wanted.to_owned(), instead_of: None });
        }
        Err(error) => format!("{}: {error}", wanted.display()),
    };
    let Some(path) = fallback else {
        return Err(io::Error::other(format!(
            "no directory for state: {refused}; neither XDG_STATE_HOME nor HOME is set"
        )));
    };
    match probe(&path) {
        Ok(()) => Ok(StateDirectory { path, instead_of: Some(refused) }),
        Err(error) => Err(io::Error::other(format!(
            "no directory for state: {refused}; {}: {error}",
            path.display()
        ))),
    }
}

/// Makes the directory if need be and finds out by writing whether it can be written to.
fn probe(directory: &Path) -> io::Result<()> {
    fs::create_dir_all(directory)?;
    NamedTempFile::new_in(directory)?.close()
}

/// Replaces a small file in one step: a reader, and a machine that loses power, sees the old or the
/// new content. Only the owner may read it.
///
/// # Errors
/// Those of the file system; the old content is then still there.
pub fn write_atomically(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut file = NamedTempFile::new_in(parent_of(path))?;
    file.write_all(content)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    // The rename itself is in the directory.
    File::open(parent_of(path))?.sync_all()
}

/// A small file; `None` if there is none.
///
/// # Errors
/// Those of the file system, and one for a file above 1 MiB.
pub fn read_small(path: &Path) -> io::Result<Option<Vec<u8>>> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    let mut content = Vec::new();
    file.take(MAX_SMALL_FILE_BYTES + 1).read_to_end(&mut content)?;
    if content.len() as u64 > MAX_SMALL_FILE_BYTES {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("is larger than {MAX_SMALL_FILE_BYTES} bytes"),
        ));
    }
    Ok(Some(content))
}

/// Why an epoch was not kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unkept {
    /// For people.
    pub reason: String,
    /// The clock is behind the last epoch that was kept, so that the next life may get the same
    /// one.
    pub is_doubtful: bool,
}

/// The next epoch of the flow of a node: max(milliseconds since 1970, stored + 1), so that it grows
/// although the clock may stand still or go back. Kept in `flow-epoch.<layer>.<node>`; two
/// processes never get the same one, as long as it can be kept. Where the disk is full or cannot be
/// written to, it is as good as the clock.
#[must_use]
pub fn next_epoch(directory: &Path, layer: &str, node: &str) -> (u64, Option<Unkept>) {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
    next_epoch_at(directory, layer, node, u64::try_from(now).unwrap_or(u64::MAX))
}

fn next_epoch_at(directory: &Path, layer: &str, node: &str, now_ms: u64) -> (u64, Option<Unkept>) {
    let mut stored = 0;
    match keep_epoch(directory, layer, node, now_ms, &mut stored) {
        Ok(epoch) => (epoch, None),
        Err(error) => {
            let reason = format!("{}: {error}", directory.display());
            let unkept = Unkept { reason, is_doubtful: now_ms <= stored };
            (now_ms.max(stored.saturating_add(1)), Some(unkept))
        }
    }
}

/// `stored` is what was kept last, also where nothing can be kept any more.
fn keep_epoch(
    directory: &Path,
    layer: &str,
    node: &str,
    now_ms: u64,
    stored: &mut u64,
) -> io::Result<u64> {
    for name in [layer, node] {
        if name.is_empty() || !name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-') {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{name:?} cannot be part of a file name"),
            ));
        }
    }
    let path = directory.join(format!("flow-epoch.{layer}.{node}"));
    *stored = stored_epoch(&path)?;
    // The lock is on a file of its own, for the epoch's file is replaced. It ends with the handle.
    let lock = OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .mode(0o600)
        .open(directory.join(format!("flow-epoch.{layer}.{node}.lock")))?;
    lock.lock()?;
    *stored = stored_epoch(&path)?;
    let Some(after_stored) = stored.checked_add(1) else {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("{} is exhausted: remove it", path.display()),
        ));
    };
    let epoch = now_ms.max(after_stored);
    write_atomically(&path, format!("{epoch}\n").as_bytes())?;
    Ok(epoch)
}

fn stored_epoch(path: &Path) -> io::Result<u64> {
    let Some(content) = read_small(path)? else { return Ok(0) };
    Ok(parse_epoch(&content).unwrap_or_else(|| {
        tracing::warn!(
            path = %path.display(),
            "the stored epoch cannot be read and is taken from the clock",
        );
        0
    }))
}

fn parse_epoch(content: &[u8]) -> Option<u64> {
    std::str::from_utf8(content).ok()?.trim().parse().ok()
}

fn parent_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(directory)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn epochs_only_grow() {
        let directory = tempfile::tempdir().unwrap();
        let kept = |node, now| {
            let (epoch, unkept) = next_epoch_at(directory.path(), "edge", node, now);
            assert_eq!(unkept, None);
            epoch
        };
        let next = |now| kept("robot-1", now);
        assert_eq!(next(1000), 1000);
        assert_eq!(next(1000), 1001);
        assert_eq!(next(5), 1002);
        assert_eq!(next(5000), 5000);
        assert_eq!(kept("robot-2", 7), 7);
        assert_eq!(
            names(directory.path()),
            [
                "flow-epoch.edge.robot-1",
                "flow-epoch.edge.robot-1.lock",
                "flow-epoch.edge.robot-2",
                "flow-epoch.edge.robot-2.lock"
            ]
        );
        fs::write(directory.path().join("flow-epoch.edge.robot-1"), "garbage").unwrap();
        assert_eq!(next(6000), 6000);
        fs::write(directory.path().join("flow-epoch.edge.robot-1"), u64::MAX.to_string()).unwrap();
        for layer in ["edge", "../edge"] {
            let (_, unkept) = next_epoch_at(directory.path(), layer, "robot-1", 1);
            assert!(unkept.is_some(), "{layer}");
        }
    }

    #[test]
    fn an_epoch_that_cannot_be_kept_is_as_good_as_the_clock() {
        let directory = tempfile::tempdir().unwrap();
        let next = |now| {
            let (epoch, unkept) = next_epoch_at(directory.path(), "edge", "robot-1", now);
            (epoch, unkept.map(|unkept| unkept.is_doubtful))
        };
        assert_eq!(next(1000), (1000, None));
        // What stands in its way stands for a disk that is full: root may write everywhere.
        let lock = directory.path().join("flow-epoch.edge.robot-1.lock");
        fs::remove_file(&lock).unwrap();
        fs::create_dir(&lock).unwrap();
        assert_eq!(next(2000), (2000, Some(false)));
        assert_eq!(next(2001), (2001, Some(false)));
        assert_eq!(next(900), (1001, Some(true)));
        fs::remove_dir(&lock).unwrap();
        assert_eq!(next(2002), (2002, None));
    }

    #[test]
    fn two_at_once_get_different_epochs() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path();
        let mut epochs: Vec<u64> = std::thread::scope(|scope| {
            let take = || (0..20).map(|_| next_epoch_at(path, "l", "n", 1).0).collect::<Vec<_>>();
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(take)).collect();
            threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
        });
        epochs.sort_unstable();
        assert_eq!(epochs, (1..=80).collect::<Vec<u64>>());
    }

    #[test]
    fn a_file_is_replaced_whole() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("state.json");
        assert_eq!(read_small(&path).unwrap(), None);
        write_atomically(&path, b"one").unwrap();
        write_atomically(&path, b"two").unwrap();
        assert_eq!(read_small(&path).unwrap().unwrap(), b"two");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(names(directory.path()), ["state.json"]);
        // A directory cannot be replaced by a file: nothing is left behind.
        fs::create_dir(directory.path().join("taken")).unwrap();
        assert!(write_atomically(&directory.path().join("taken"), b"x").is_err());
        assert_eq!(names(directory.path()), ["state.json", "taken"]);
    }

    #[test]
    fn the_directory_falls_back_and_says_why() {
        let directory = tempfile::tempdir().unwrap();
        let blocked = directory.path().join("file");
        fs::write(&blocked, "").unwrap();
        let good = directory.path().join("a/b");
        let direct = resolve(&good, None).unwrap();
        assert_eq!((direct.path.as_path(), direct.instead_of), (good.as_path(), None));
        let other = resolve(&blocked.join("below"), Some(good.clone())).unwrap();
        assert_eq!(other.path, good);
        assert!(other.instead_of.unwrap().starts_with(&blocked.display().to_string()));
        assert!(resolve(&blocked, None).is_err());
        assert!(resolve(&blocked, Some(blocked.join("x"))).is_err());
        assert!(names(&good).is_empty());
    }
}
