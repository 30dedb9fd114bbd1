//! Files of /proc and /sys: opened once, read again and again, never without a limit.

use std::borrow::Cow;
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use super::limits;

/// A source that is there and cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
    /// The permissions of the file.
    #[error(
        "{} cannot be read: permission denied. Run the monitor as root, or: chmod a+r {}",
        .0.display(), .0.display()
    )]
    Denied(PathBuf),
    /// Another fault of the file.
    #[error("{} cannot be opened: {error}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The error of the kernel.
        error: std::io::Error,
    },
    /// More than the limit.
    #[error("{} has more than {limit} bytes, the most that is read", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The limit in bytes.
        limit: usize,
    },
    /// A form that the parser does not know.
    #[error("{source_name} has an unknown form: {error}")]
    Form {
        /// File or library.
        source_name: String,
        /// The fault that the parser names.
        error: String,
    },
    /// A library or a system call answers with an error.
    #[error("{0}")]
    Answer(String),
}

/// A file that is read once a period. The descriptor stays open: the kernel writes the content anew
/// for each read at offset 0.
#[derive(Debug)]
pub(super) struct Text {
    path: PathBuf,
    limit: usize,
    file: Option<File>,
}

impl Text {
    /// A file of one value; its content comes with a single read.
    pub(super) fn attribute(path: PathBuf) -> Self {
        Self { path, limit: limits::ATTRIBUTE_BYTES, file: None }
    }

    /// A table of many lines, which the kernel hands out in pieces.
    pub(super) fn table(path: PathBuf) -> Self {
        Self { path, limit: limits::TABLE_BYTES, file: None }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the content into `buffer`. `None`: the file is not there, or has no value at present.
    pub(super) fn read<'b>(
        &mut self,
        buffer: &'b mut Vec<u8>,
    ) -> Result<Option<Cow<'b, str>>, Fault> {
        if self.file.is_none() {
            self.file = open(&self.path)?;
        }
        let Some(file) = &self.file else { return Ok(None) };
        match fill(file, buffer, self.limit) {
            Ok(length) if length > self.limit => {
                Err(Fault::TooLarge { path: self.path.clone(), limit: self.limit })
            }
            Ok(length) => Ok(Some(String::from_utf8_lossy(&buffer[..length]))),
            Err(_) => {
                // the device may be another one when it is back
                self.file = None;
                Ok(None)
            }
        }
    }

    /// Reads one number; `None` also for `N/A`, an empty file and whatever else is no number.
    pub(super) fn number(&mut self, buffer: &mut Vec<u8>) -> Result<Option<f64>, Fault> {
        let text = self.read(buffer)?;
        Ok(text.and_then(|text| text.trim().parse::<f64>().ok()).filter(|value| value.is_finite()))
    }
}

fn open(path: &Path) -> Result<Option<File>, Fault> {
    let error = match File::open(path) {
        Ok(file) => return Ok(Some(file)),
        Err(error) => error,
    };
    match error.kind() {
        ErrorKind::PermissionDenied => Err(Fault::Denied(path.to_owned())),
        ErrorKind::NotFound | ErrorKind::NotADirectory => Ok(None),
        // ENODEV, ENXIO: the file outlived its device
        _ if matches!(error.raw_os_error(), Some(6 | 19)) => Ok(None),
        _ => Err(Fault::Open { path: path.to_owned(), error }),
    }
}

/// Fills `buffer` from the start of `file` and returns the number of bytes, at most `limit` + 1.
fn fill(file: &File, buffer: &mut Vec<u8>, limit: usize) -> std::io::Result<usize> {
    let mut length = 0;
    loop {
        if buffer.len() == length {
            let size = (length * 2).clamp(limits::ATTRIBUTE_BYTES + 1, limits::TABLE_BYTES + 1);
            buffer.resize(size, 0);
        }
        let end = buffer.len().min(limit + 1);
        match file.read_at(&mut buffer[length..end], length as u64)? {
            0 => return Ok(length),
            bytes => length += bytes,
        }
        if length > limit || limit == limits::ATTRIBUTE_BYTES {
            return Ok(length);
        }
    }
}

/// The trimmed content of a small file that is read at discovery; `None` for an empty one.
pub(super) fn word(path: &Path) -> Option<String> {
    let mut bytes = Vec::new();
    let limit = limits::ATTRIBUTE_BYTES as u64;
    File::open(path).ok()?.take(limit).read_to_end(&mut bytes).ok()?;
    let text = String::from_utf8_lossy(&bytes);
    let clean = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
    let name: String = clean.chars().filter(|c| !c.is_control()).take(limits::NAME_CHARS).collect();
    (!name.is_empty()).then_some(name)
}

/// The entries of a directory whose name passes `keep`, in natural order: `temp2` before `temp10`.
pub(super) fn entries(directory: &Path, keep: impl Fn(&str) -> bool) -> Vec<(String, PathBuf)> {
    let Ok(read) = std::fs::read_dir(directory) else { return Vec::new() };
    let mut found: Vec<_> = read
        .take(limits::DIRECTORY_ENTRIES)
        .filter_map(|entry| {
            let entry = entry.ok()?;
            let name = entry.file_name().into_string().ok()?;
            keep(&name).then(|| (name, entry.path()))
        })
        .collect();
    found.sort_by_cached_key(|(name, _)| (natural(name), name.clone()));
    found
}

/// Text and number of each part of a name.
fn natural(name: &str) -> Vec<(String, u64)> {
    let mut parts = vec![(String::new(), 0_u64)];
    for c in name.chars() {
        let last = parts.len() - 1;
        match c.to_digit(10) {
            Some(digit) => {
                parts[last].1 = parts[last].1.saturating_mul(10).saturating_add(u64::from(digit));
            }
            None if parts[last].1 == 0 => parts[last].0.push(c),
            None => parts.push((c.to_string(), 0)),
        }
    }
    parts
}

#[cfg(test)]
mod quick {
    use super::*;

    #[test]
    fn a_file_is_read_to_its_limit_and_not_beyond() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table");
        let mut buffer = Vec::new();
        std::fs::write(&path, vec![b'a'; limits::TABLE_BYTES]).unwrap();
        let text = Text::table(path.clone()).read(&mut buffer).unwrap().unwrap().len();
        assert_eq!(text, limits::TABLE_BYTES);
        std::fs::write(&path, vec![b'a'; limits::TABLE_BYTES + 1]).unwrap();
        let fault = Text::table(path.clone()).read(&mut buffer).unwrap_err();
        assert!(matches!(fault, Fault::TooLarge { limit: limits::TABLE_BYTES, .. }), "{fault}");
        let fault = Text::attribute(path).read(&mut buffer).unwrap_err();
        assert!(matches!(fault, Fault::TooLarge { limit: limits::ATTRIBUTE_BYTES, .. }), "{fault}");
        assert!(buffer.len() <= limits::TABLE_BYTES + 1);
    }

    #[test]
    fn what_is_no_number_is_no_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("value");
        let mut text = Text::attribute(path.clone());
        let mut buffer = Vec::new();
        assert_eq!(text.number(&mut buffer).unwrap(), None, "no file");
        let contents = [("42\n", Some(42.0)), ("", None), ("N/A\n", None), ("nan\n", None)];
        for (content, value) in contents {
            std::fs::write(&path, content).unwrap();
            assert_eq!(text.number(&mut buffer).unwrap(), value, "{content:?}");
        }
        let mut folder = Text::attribute(folder.path().to_owned());
        assert_eq!(
            folder.number(&mut buffer).unwrap(),
            None,
            "a directory opens, but has no value"
        );
    }

    #[test]
    fn names_are_sorted_by_their_numbers() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["temp10", "temp9", "temp1", "other"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let names = entries(folder.path(), |name| name.starts_with("temp"));
        let names: Vec<_> = names.into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["temp1", "temp9", "temp10"]);
    }
}
