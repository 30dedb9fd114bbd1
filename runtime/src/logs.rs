//! Logs to stderr.

use std::io::IsTerminal;

use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, reload};

use crate::environment;

/// How a line is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// Why logs could not be set up or changed.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The text is no level and no directives.
    #[error(
        "{origin}: {text:?} is neither a level nor directives such as info,blaze_flow=debug: \
         {detail}"
    )]
    Level {
        /// Where the text comes from.
        origin: &'static str,
        /// The text.
        text: String,
        /// What is wrong with it.
        detail: String,
    },
    /// Something else in the process has set up logs.
    #[error("logs are set up already")]
    AlreadyInitialised,
    /// The subscriber is gone.
    #[error("logs are no longer there")]
    Gone,
}

/// Changes the level while the process runs.
#[derive(Clone)]
pub struct LogHandle {
    filter: reload::Handle<EnvFilter, Registry>,
    /// `RUST_LOG` stands above the file.
    fixed: bool,
}

impl LogHandle {
    /// Sets the level that the configuration gives; without effect where `RUST_LOG` is set. Answers
    /// whether it has one.
    ///
    /// # Errors
    /// If the text is neither a level nor directives; the old level stays.
    pub fn set_level(&self, level: &str) -> Result<bool, LogError> {
        let filter = filter("log.level", level)?;
        if self.fixed {
            return Ok(false);
        }
        self.filter.reload(filter).map_err(|_| LogError::Gone)?;
        Ok(true)
    }
}

impl std::fmt::Debug for LogHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LogHandle").field("fixed", &self.fixed).finish_non_exhaustive()
    }
}

/// Sends the logs of the process to stderr, from `level` on unless `RUST_LOG` says otherwise.
///
/// # Errors
/// If the level or `RUST_LOG` is wrong, or logs are set up already.
pub fn init(level: &str, format: LogFormat) -> Result<LogHandle, LogError> {
    let colours = std::io::stderr().is_terminal() && environment::variable("NO_COLOR").is_none();
    let from_environment = environment::variable("RUST_LOG");
    let (subscriber, handle) =
        build(level, from_environment.as_deref(), format, colours, std::io::stderr)?;
    tracing::subscriber::set_global_default(subscriber)
        .map_err(|_| LogError::AlreadyInitialised)?;
    Ok(handle)
}

/// Whether the log takes a level or directives.
///
/// # Errors
/// In words that name no other text than the part that is wrong.
pub fn check_level(level: &str) -> Result<(), String> {
    match filter("log.level", level) {
        Ok(_) => Ok(()),
        Err(LogError::Level { detail, .. }) => Err(detail),
        Err(error) => Err(error.to_string()),
    }
}

fn build<W>(
    level: &str,
    from_environment: Option<&str>,
    format: LogFormat,
    colours: bool,
    writer: W,
) -> Result<(impl tracing::Subscriber + Send + Sync, LogHandle), LogError>
where
    W: for<'w> MakeWriter<'w> + Send + Sync + 'static,
{
    let first = match from_environment {
        Some(directives) => filter("RUST_LOG", directives)?,
        None => filter("log.level", level)?,
    };
    let (filter, handle) = reload::Layer::new(first);
    // A closed stderr must not become a panic in whoever logs.
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(writer)
        .with_ansi(colours)
        .log_internal_errors(false);
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    };
    let handle = LogHandle { filter: handle, fixed: from_environment.is_some() };
    Ok((Registry::default().with(filter).with(lines), handle))
}

fn filter(origin: &'static str, text: &str) -> Result<EnvFilter, LogError> {
    let bare = ["off", "error", "warn", "info", "debug", "trace"];
    // EnvFilter takes a word that is no level for the name of a module: a slip would silence
    // everything.
    let known = |part: &str| {
        part.contains(['=', '[']) || bare.contains(&part.to_ascii_lowercase().as_str())
    };
    let wrong = |detail: String| LogError::Level { origin, text: text.to_owned(), detail };
    if let Some(part) = text.split(',').map(str::trim).find(|part| !known(part)) {
        return Err(wrong(format!("{part:?} is no level")));
    }
    EnvFilter::try_new(text).map_err(|error| wrong(error.to_string()))
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use parking_lot::Mutex;

    use super::*;

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().extend_from_slice(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl Lines {
        fn take(&self) -> String {
            String::from_utf8(std::mem::take(&mut *self.0.lock())).unwrap()
        }
    }

    fn logs(
        level: &str,
        environment: Option<&str>,
        format: LogFormat,
        act: impl FnOnce(&LogHandle, &Lines),
    ) {
        let lines = Lines::default();
        let writer = lines.clone();
        let (subscriber, handle) =
            build(level, environment, format, false, move || writer.clone()).unwrap();
        tracing::subscriber::with_default(subscriber, || act(&handle, &lines));
    }

    #[test]
    fn the_level_changes_while_running() {
        logs("info", None, LogFormat::Text, |handle, lines| {
            tracing::debug!("quiet");
            assert_eq!(lines.take(), "");
            assert!(handle.set_level("debug").unwrap());
            tracing::debug!(bytes = 7, "loud");
            assert!(lines.take().contains("loud bytes=7"));
            assert!(handle.set_level("lod").is_err());
            tracing::debug!("still");
            assert!(lines.take().contains("still"));
        });
    }

    #[test]
    fn the_environment_stands_above_the_file() {
        logs("info", Some("debug"), LogFormat::Text, |handle, lines| {
            assert!(!handle.set_level("error").unwrap());
            tracing::debug!("loud");
            assert!(lines.take().contains("loud"));
        });
    }

    #[test]
    fn json_lines_are_objects() {
        logs("info", None, LogFormat::Json, |_, lines| {
            tracing::info!(queue_bytes = 12, "full");
            let line: serde_json::Value = serde_json::from_str(&lines.take()).unwrap();
            assert_eq!((&line["message"], &line["queue_bytes"]), (&"full".into(), &12.into()));
        });
    }

    #[test]
    fn wrong_levels_say_where_they_come_from() {
        let error =
            build("loud", None, LogFormat::Text, false, std::io::sink).err().unwrap().to_string();
        assert!(error.starts_with("log.level: \"loud\""), "{error}");
        let error = build("info", Some("a=loud"), LogFormat::Text, false, std::io::sink)
            .err()
            .unwrap()
            .to_string();
        assert!(error.starts_with("RUST_LOG: \"a=loud\""), "{error}");
    }
}
