//! Passwords in files, as Kubernetes and others mount them.

use std::path::Path;

/// The password that a file holds, without the end of its line. A file that is empty is one that is
/// just being written.
///
/// # Errors
/// For people, with the file's name.
pub fn read_password(path: &Path) -> Result<String, String> {
    let text =
        std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    match text.trim_end_matches(['\r', '\n']) {
        "" => Err(format!("{}: it is empty", path.display())),
        password => Ok(password.to_owned()),
    }
}
