//! One process per file.

use std::fs::{File, OpenOptions};
use std::io::{Read as _, Seek as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use super::connection::file_error;
use crate::store::StoreError;

/// How long the one before has to let go of it. A process that this one is just starting has a copy
/// of all open files until its program begins, and the lock with them.
const LET_GO: Duration = Duration::from_millis(250);
/// Between two tries.
const AGAIN: Duration = Duration::from_millis(10);

/// Held while it lives; the system lets go of it when the process ends, however that happens.
#[derive(Debug)]
pub(super) struct FileLock {
    _file: File,
}

impl FileLock {
    /// Locks `<path>.lock`, and writes the process id into it for people. Blocks for a moment where
    /// another one has it.
    ///
    /// # Errors
    /// [`StoreError::Refused`] if another process has it, and as [`file_error`].
    pub(super) fn take(path: &Path) -> Result<Self, StoreError> {
        let lock = beside(path, "lock");
        let failed = |error: std::io::Error| file_error(&lock, "cannot be written", &error);
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(0o600);
        let mut file = options.open(&lock).map_err(failed)?;
        let until = Instant::now() + LET_GO;
        loop {
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => break,
                Err(Errno::WOULDBLOCK) if Instant::now() < until => std::thread::sleep(AGAIN),
                Err(Errno::WOULDBLOCK) => return Err(in_use(path, &mut file)),
                Err(error) => return Err(failed(error.into())),
            }
        }
        file.set_len(0).map_err(failed)?;
        file.rewind().map_err(failed)?;
        writeln!(file, "{}", std::process::id()).map_err(failed)?;
        Ok(Self { _file: file })
    }
}

/// A file beside another one: its name and `.ending`.
pub(super) fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    PathBuf::from(name)
}

fn in_use(path: &Path, file: &mut File) -> StoreError {
    let mut holder = String::new();
    // Only for the message: without it, the message is shorter.
    let _ = file.take(20).read_to_string(&mut holder);
    let by = match holder.trim() {
        "" => "another process".to_owned(),
        id => format!("process {id}"),
    };
    StoreError::Refused(format!(
        "{} is used by {by}; one process per SQLite file: stop it, or use \
         `control_plane.store.mongodb` for several",
        path.display()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_one_is_told_who_has_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("store.db");
        let first = FileLock::take(&path).unwrap();
        // A lock belongs to the open file, so the same process is refused as another would be.
        let error = FileLock::take(&path).unwrap_err();
        let StoreError::Refused(text) = error else { panic!("{error}") };
        assert!(text.contains(&format!("process {}", std::process::id())), "{text}");
        assert!(text.contains("mongodb"), "{text}");
        drop(first);
        FileLock::take(&path).unwrap();
    }

    #[test]
    fn whoever_lets_go_of_it_in_a_moment_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("store.db");
        let first = FileLock::take(&path).unwrap();
        let (waits, is_waiting) = std::sync::mpsc::sync_channel(1);
        let second = std::thread::spawn(move || {
            waits.send(()).unwrap();
            FileLock::take(&path).map(|_| ())
        });
        is_waiting.recv().unwrap();
        drop(first);
        second.join().unwrap().unwrap();
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let error = FileLock::take(Path::new("/nonexistent/blaze/store.db")).unwrap_err();
        assert!(error.to_string().contains("/nonexistent/blaze/store.db.lock"), "{error}");
    }
}
