//! Files that cannot be read are kept for people, the newest few of them.

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Files that were moved aside and are kept.
pub(super) const KEPT_ASIDE: usize = 3;

/// A file beside another one: its name and `.ending`.
pub(super) fn beside(path: &Path, ending: &str) -> PathBuf {
    companion(path, format!(".{ending}"))
}

fn companion(path: &Path, ending: impl AsRef<OsStr>) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(ending);
    PathBuf::from(name)
}

/// Gives a file the name `<name>.broken-<milliseconds>`, the files that belong to it likewise, and removes all but the
/// newest of these.
///
/// # Errors
/// Those of the file system.
pub(super) fn set_aside(path: &Path, companions: &[&str]) -> io::Result<PathBuf> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let aside = beside(path, &format!("broken-{:013}", now.map_or(0, |now| now.as_millis())));
    fs::rename(path, &aside)?;
    for ending in companions {
        let from = companion(path, ending);
        if from.exists() {
            fs::rename(from, companion(&aside, ending))?;
        }
    }
    let start = beside(path, "broken-");
    let is_one = |found: &PathBuf| {
        let rest = found.as_os_str().as_encoded_bytes();
        let rest = rest.strip_prefix(start.as_os_str().as_encoded_bytes());
        rest.is_some_and(|rest| rest.iter().all(u8::is_ascii_digit))
    };
    let entries = fs::read_dir(path.parent().unwrap_or(Path::new(".")))?;
    let mut all: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(is_one)
        .collect();
    all.sort();
    for old in all.iter().rev().skip(KEPT_ASIDE) {
        fs::remove_file(old)?;
        for ending in companions {
            // Most have none.
            let _ = fs::remove_file(companion(old, ending));
        }
    }
    Ok(aside)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_belongs_to_a_file_goes_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("copy.db");
        let old = beside(&path, "broken-0000000000001");
        for file in [&old, &companion(&old, "-wal"), &path, &companion(&path, "-wal")] {
            fs::write(file, "x").unwrap();
        }
        for number in 2..=KEPT_ASIDE {
            fs::write(beside(&path, &format!("broken-{number:013}")), "x").unwrap();
        }
        let aside = set_aside(&path, &["-wal", "-shm"]).unwrap();
        assert!(aside.exists() && companion(&aside, "-wal").exists());
        assert!(!path.exists() && !companion(&path, "-wal").exists());
        assert!(!old.exists() && !companion(&old, "-wal").exists());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), KEPT_ASIDE + 1);
    }
}
