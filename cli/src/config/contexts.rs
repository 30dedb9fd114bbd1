//! Contexts: servers that a person works with, by name. They hold paths of token files, never a
//! token.

use std::collections::BTreeMap;
use std::fs::{DirBuilder, OpenOptions};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use blaze_runtime::environment;
use blaze_runtime::state::{read_small, write_atomically};
use serde::{Deserialize, Serialize};

use crate::exit::CliError;

/// One server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Context {
    /// URL of the main service.
    pub(crate) server: String,
    /// File that holds the token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) token_file: Option<PathBuf>,
    /// Authorities that may sign the server's certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) ca_file: Option<PathBuf>,
    /// Certificate to show to a server that asks for one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) client_cert: Option<PathBuf>,
    /// Its private key; without it, the file of the certificate holds it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) client_key: Option<PathBuf>,
}

/// The file of contexts.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Contexts {
    /// Name of the one that is used where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) current: Option<String>,
    /// All of them.
    #[serde(default)]
    pub(crate) contexts: BTreeMap<String, Context>,
}

/// `$XDG_CONFIG_HOME/blaze/config.yaml`, else `~/.config/blaze/config.yaml`; `None` where neither
/// is known.
pub(crate) fn default_file() -> Option<PathBuf> {
    let configured = environment::variable("XDG_CONFIG_HOME").map(PathBuf::from);
    let home = || environment::variable("HOME").map(|home| PathBuf::from(home).join(".config"));
    // A relative path there is to be ignored, says the standard.
    let base = configured.filter(|path| path.is_absolute()).or_else(home)?;
    Some(base.join("blaze/config.yaml"))
}

/// Reads the file; without one there are no contexts.
///
/// # Errors
/// [`CliError::Failed`] when it cannot be read, [`CliError::Invalid`] for what stands in it.
pub(crate) fn load(file: &Path) -> Result<Contexts, CliError> {
    let invalid = |reason: String| CliError::Invalid(format!("{}: {reason}", file.display()));
    let content = read_small(file)
        .map_err(|error| CliError::Failed(format!("{}: {error}", file.display())))?;
    let Some(content) = content else {
        return Ok(Contexts::default());
    };
    let text = std::str::from_utf8(&content).map_err(|_| invalid("is not UTF-8".to_owned()))?;
    if text.trim().is_empty() {
        return Ok(Contexts::default());
    }
    yaml_serde::from_str(text).map_err(|error| invalid(error.to_string()))
}

/// Changes the file as a whole; two commands at once both take effect. Its mode is 0600, that of a
/// new directory 0700.
///
/// # Errors
/// As [`load`], whatever `change` says, and those of the file system; the old content is then still
/// there.
pub(crate) fn update<T>(
    file: &Path,
    change: impl FnOnce(&mut Contexts) -> Result<T, CliError>,
) -> Result<T, CliError> {
    let failed = |error: std::io::Error| CliError::Failed(format!("{}: {error}", file.display()));
    if let Some(directory) = file.parent() {
        let mut builder = DirBuilder::new();
        builder.recursive(true).mode(0o700);
        builder.create(directory).map_err(failed)?;
    }
    // The lock is on a file of its own, for the other one is replaced. It ends with the handle.
    let lock = OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .mode(0o600)
        .open(file.with_extension("yaml.lock"))
        .map_err(failed)?;
    lock.lock().map_err(failed)?;
    let mut contexts = load(file)?;
    let result = change(&mut contexts)?;
    let text =
        yaml_serde::to_string(&contexts).map_err(|error| CliError::Failed(error.to_string()))?;
    write_atomically(file, text.as_bytes()).map_err(failed)?;
    Ok(result)
}

/// The rule for names of contexts.
///
/// # Errors
/// In words.
pub(crate) fn parse_name(text: &str) -> Result<String, String> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if text.is_empty() || text.len() > 63 || !text.chars().all(allowed) {
        return Err(format!("{text:?} is no name of a context: 1 to 63 of A-Z a-z 0-9 . _ -"));
    }
    Ok(text.to_owned())
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn add(file: &Path, name: &str) {
        update(file, |contexts| {
            let context = Context {
                server: format!("https://{name}.example:8443"),
                token_file: Some(PathBuf::from("/run/token")),
                ca_file: None,
                client_cert: None,
                client_key: None,
            };
            contexts.contexts.insert(name.to_owned(), context);
            contexts.current.get_or_insert_with(|| name.to_owned());
            Ok(())
        })
        .unwrap();
    }

    #[test]
    fn contexts_are_kept_for_the_owner_alone() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("a/blaze/config.yaml");
        assert_eq!(load(&file).unwrap(), Contexts::default());
        add(&file, "lab");
        add(&file, "hall");
        let read = load(&file).unwrap();
        assert_eq!(read.current.as_deref(), Some("lab"));
        assert_eq!(read.contexts.len(), 2);
        assert_eq!(read.contexts["hall"].server, "https://hall.example:8443");
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&file), 0o600);
        assert_eq!(mode(file.parent().unwrap()), 0o700);
    }

    #[test]
    fn a_refused_change_changes_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("config.yaml");
        add(&file, "lab");
        let before = fs::read(&file).unwrap();
        let refused: Result<(), CliError> = update(&file, |contexts| {
            contexts.contexts.clear();
            Err(CliError::Failed("no".to_owned()))
        });
        assert!(refused.is_err());
        assert_eq!(fs::read(&file).unwrap(), before);
    }

    #[test]
    fn two_at_once_both_take_effect() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("config.yaml");
        std::thread::scope(|scope| {
            for name in ["a", "b", "c", "d"] {
                let file = &file;
                scope.spawn(move || add(file, name));
            }
        });
        assert_eq!(load(&file).unwrap().contexts.len(), 4);
    }

    #[test]
    fn what_does_not_belong_there_is_refused_by_name() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("config.yaml");
        fs::write(&file, "contexts: { lab: { server: 'http://x', token: abc } }\n").unwrap();
        let error = load(&file).unwrap_err();
        assert_eq!(error.exit() as u8, 7);
        let text = error.to_string();
        assert!(text.contains("config.yaml") && text.contains("token"), "{text}");
        assert!(parse_name("lab-1.x_y").is_ok());
        assert!(parse_name("a b").is_err() && parse_name("").is_err());
    }
}
