//! Where `scripts/services` puts things.

use std::path::{Path, PathBuf};

/// The folder of everything installed and running: `BLAZE_SERVICES_DIR`, else `.services` in the
/// checkout.
pub(super) fn folder() -> PathBuf {
    std::env::var_os("BLAZE_SERVICES_DIR")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../.services"), PathBuf::from)
}

/// An installed file or folder.
///
/// # Errors
/// Names the command to run when it is not there.
pub(crate) fn path(relative: &str) -> anyhow::Result<PathBuf> {
    let path = folder().join(relative);
    anyhow::ensure!(path.exists(), "{} is missing: run `scripts/services install`", path.display());
    Ok(path)
}

/// The lines `NAME=VALUE` of the file that `scripts/services start` writes; none when there is no
/// such file.
pub(super) fn environment(name: &str) -> Option<String> {
    let text = std::fs::read_to_string(folder().join("env")).ok()?;
    text.lines()
        .filter_map(|line| line.trim().split_once('='))
        .find(|(key, value)| key.trim() == name && !value.trim().is_empty())
        .map(|(_, value)| value.trim().to_owned())
}
