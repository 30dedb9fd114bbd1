//! The mounted file, and over it what the worker says.

use std::fmt;
use std::path::Path;
use std::sync::Arc;

use blaze_domain::config::json;
use blaze_domain::config::merge::merge_patch;
use blaze_runtime::config::yaml_documents;
use blaze_runtime::state::read_small;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::{ConfigError, ConfigManager, ConfigSource, typed};

/// Where a configuration comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BaseSource {
    /// The mounted file alone.
    File,
    /// The mounted file, and over it what a worker gave, who had it from there.
    Worker(ConfigSource),
}

/// The configuration of a service that starts with a mounted file: usable before there is a broker,
/// and brought up to date by the worker as soon as that answers. What the worker says is merged
/// over the file (RFC 7396).
#[derive(Clone)]
pub struct BaseConfiguration {
    file: Arc<Value>,
    worker: Option<ConfigManager>,
}

impl BaseConfiguration {
    /// Reads a file of at most 1 MiB: JSON if its name ends with `.json`, else YAML. An empty one
    /// is an empty object.
    ///
    /// # Errors
    /// [`ConfigError::File`]: it is not there, cannot be read, or holds no single object.
    pub fn read(file: impl AsRef<Path>) -> Result<Self, ConfigError> {
        let path = file.as_ref();
        let fault = |reason: String| ConfigError::File { file: path.display().to_string(), reason };
        let bytes = read_small(path).map_err(|error| fault(error.to_string()))?;
        let bytes = bytes.ok_or_else(|| fault("is not there".to_owned()))?;
        let is_json =
            path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
        let value = if is_json { of_json(&bytes) } else { of_yaml(&bytes) };
        let value = value.map_err(fault)?;
        if !value.is_object() {
            return Err(fault("must hold an object".to_owned()));
        }
        Ok(Self { file: Arc::new(value), worker: None })
    }

    /// The same, with what the worker says over it from now on.
    #[must_use]
    pub fn with(mut self, config: &ConfigManager) -> Self {
        self.worker = Some(config.clone());
        self
    }

    /// What it is now. Of a service that was deleted only the file is left.
    #[must_use]
    pub fn value(&self) -> Value {
        let mut out = (*self.file).clone();
        if let Some(config) = self.worker.as_ref().and_then(ConfigManager::value) {
            merge_patch(&mut out, &config);
        }
        out
    }

    /// What it is now, as a type.
    ///
    /// # Errors
    /// [`ConfigError::Type`].
    pub fn typed<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        typed::read(&self.value())
    }

    /// Where it comes from now.
    #[must_use]
    pub fn source(&self) -> BaseSource {
        let of_worker = self.worker.as_ref().and_then(ConfigManager::source);
        of_worker.map_or(BaseSource::File, BaseSource::Worker)
    }
}

/// Without the values, for they may be secrets.
impl fmt::Debug for BaseConfiguration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BaseConfiguration").field("source", &self.source()).finish_non_exhaustive()
    }
}

fn of_json(bytes: &[u8]) -> Result<Value, String> {
    json::parse(bytes).map_err(|fault| fault.to_string())
}

fn of_yaml(bytes: &[u8]) -> Result<Value, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "is no UTF-8".to_owned())?;
    match yaml_documents(text, 1) {
        Ok(documents) => {
            Ok(documents.into_iter().next().unwrap_or_else(|| Value::Object(Map::new())))
        }
        Err(faults) => {
            let first = faults.first().map(|fault| format!("{}: {}", fault.place, fault.detail));
            Err(first.unwrap_or_else(|| "is no YAML".to_owned()))
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn file(name: &str, text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(name);
        std::fs::write(&path, text).unwrap();
        (directory, path)
    }

    #[test]
    fn yaml_and_json_say_the_same() {
        for (name, text) in [
            ("a.yaml", "camera:\n  rate_hz: 10\n"),
            ("a.json", r#"{"camera":{"rate_hz":10}}"#),
            ("a", r#"{"camera": {"rate_hz": 10}}"#),
        ] {
            let (_directory, path) = file(name, text);
            let base = BaseConfiguration::read(&path).unwrap();
            assert_eq!(base.value(), json!({"camera": {"rate_hz": 10}}), "{name}");
            assert_eq!(base.source(), BaseSource::File);
        }
        let (_directory, empty) = file("a.yaml", "# nothing\n");
        assert_eq!(BaseConfiguration::read(&empty).unwrap().value(), json!({}));
    }

    #[test]
    fn a_file_that_cannot_be_used_is_named() {
        for (name, text) in [
            ("a.yaml", "a: [1"),
            ("a.json", "{"),
            ("a.json", "[]"),
            ("a.yaml", "a: 1\n---\nb: 2\n"),
        ] {
            let (_directory, path) = file(name, text);
            let error = BaseConfiguration::read(&path).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
        let missing = BaseConfiguration::read("/nowhere/at/all.yaml").unwrap_err();
        assert_eq!(missing.to_string(), "/nowhere/at/all.yaml: is not there");
    }
}
