//! Passwords in files, as Kubernetes and others mount them.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

/// Longest file, in bytes.
const MAX_BYTES: u64 = 64 * 1024;

/// The password that a file holds, without the end of its line. A file that is empty is one that is
/// just being written.
///
/// # Errors
/// For people, with the file's name.
pub fn read_password(path: &Path) -> Result<String, String> {
    let wrong = |what: &dyn std::fmt::Display| format!("{}: {what}", path.display());
    // What is read of a pipe or a device may never come, and is gone then.
    let found = std::fs::metadata(path).map_err(|error| wrong(&error))?;
    if !found.is_file() {
        return Err(wrong(&"it is no file"));
    }
    if found.len() > MAX_BYTES {
        return Err(wrong(&format_args!("it has more than {MAX_BYTES} bytes")));
    }
    let mut text = String::new();
    let read = File::open(path).and_then(|file| file.take(MAX_BYTES).read_to_string(&mut text));
    read.map_err(|error| wrong(&error))?;
    match text.trim_end_matches(['\r', '\n']) {
        "" => Err(wrong(&"it is empty")),
        password => Ok(password.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_holds_no_password_says_why_and_never_waits() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("good"), " p\u{e4}ss \r\n").unwrap();
        assert_eq!(read_password(&path("good")).unwrap(), " p\u{e4}ss ");
        std::fs::write(path("empty"), "\n").unwrap();
        std::fs::write(path("binary"), [0xff, 0xfe]).unwrap();
        std::fs::write(path("large"), vec![b'x'; 65_537]).unwrap();
        let made = std::process::Command::new("mkfifo").arg(path("pipe")).status().unwrap();
        assert!(made.success());
        for (name, reason) in [
            ("empty", "it is empty"),
            ("binary", "UTF-8"),
            ("large", "65536"),
            ("pipe", "it is no file"),
            (".", "it is no file"),
            ("missing", "No such file"),
        ] {
            let error = read_password(&path(name)).unwrap_err();
            assert!(error.contains(name) && error.contains(reason), "{error}");
        }
    }
}
