//! Documents from files, directories and standard input, each with the place that it comes from.
//!
//! ```text
//! -f robot.yaml  ─┐
//! -f deploy/     ─┼─► texts (bounded, UTF-8) ─► YAML or JSON ─► documents with FILE:LINE ─► one request
//! -f -           ─┘                                 └─► every fault with FILE:LINE; nothing is sent
//! ```

use std::fmt;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use blaze_domain::config::{Key, json};
use blaze_runtime::config::{LocatedFault, ValueOrigin, located_documents};
use blaze_runtime::state::read_small;
use serde_json::Value;

use super::kinds::key_of;
use crate::exit::CliError;

/// Documents of one request.
pub(crate) const MAX_DOCUMENTS: usize = 1_000;
/// All files together, and the body of one request, in bytes.
pub(crate) const MAX_BYTES: usize = 8 * 1024 * 1024;
/// Nesting of an array of documents: one more than a document may have.
const MAX_DEPTH: usize = blaze_domain::config::MAX_DEPTH + 2;

/// Where a document comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Origin {
    file: Arc<str>,
    /// Where it begins; 0 where that is not known.
    line: usize,
    /// Which document of the file, from 1.
    number: usize,
    /// Whether the file has others.
    several: bool,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.file)?;
        if self.line > 0 {
            write!(f, ":{}", self.line)?;
        }
        if self.several {
            write!(f, " (document {})", self.number)?;
        }
        Ok(())
    }
}

/// A document as it stands in a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Source {
    /// What it is called.
    pub(crate) key: Key,
    /// All of it.
    pub(crate) value: Value,
    /// Where it comes from.
    pub(crate) origin: Origin,
}

/// A file of a key, a certificate or a token, up to 1 MiB.
///
/// # Errors
/// [`CliError::Failed`] that begins with what the file is.
pub(crate) fn small(file: &Path, what: &str) -> Result<Vec<u8>, CliError> {
    let failed = |reason: String| CliError::Failed(format!("{what} {}: {reason}", file.display()));
    let content = read_small(file).map_err(|error| failed(error.to_string()))?;
    content.ok_or_else(|| failed("there is no such file".to_owned()))
}

/// Reads all documents of `-f FILE|DIR|-`. Empty documents are passed over.
///
/// # Errors
/// [`CliError::Failed`] for what cannot be read, [`CliError::Usage`] for a directory without
/// documents, [`CliError::Invalid`] with every fault, one a line.
pub(crate) fn read(paths: &[PathBuf]) -> Result<Vec<Source>, CliError> {
    read_from(paths, &mut std::io::stdin().lock())
}

fn read_from(paths: &[PathBuf], stdin: &mut dyn Read) -> Result<Vec<Source>, CliError> {
    let mut texts = Vec::new();
    let mut left = MAX_BYTES;
    for path in expand(paths)? {
        let name = if is_stdin(&path) { "stdin".to_owned() } else { path.display().to_string() };
        let bytes = if is_stdin(&path) {
            bounded(stdin, left)
        } else {
            std::fs::File::open(&path).and_then(|mut file| bounded(&mut file, left))
        };
        let bytes = bytes.map_err(|error| CliError::Failed(format!("{name}: {error}")))?;
        left -= bytes.len();
        texts.push((path, name, bytes));
    }
    let mut sources = Vec::new();
    let mut faults = Vec::new();
    for (path, name, bytes) in texts {
        match parse(&path, &name, bytes) {
            Ok(values) => {
                for (value, origin) in values {
                    match key_of(&value) {
                        Ok(key) => sources.push(Source { key, value, origin }),
                        Err(reason) => faults.push(format!("{origin}: {reason}")),
                    }
                }
            }
            Err(more) => faults.extend(more),
        }
    }
    if sources.len() > MAX_DOCUMENTS {
        faults.push(format!(
            "{} documents: at most {MAX_DOCUMENTS} go in one request; split them",
            sources.len()
        ));
    }
    if faults.is_empty() { Ok(sources) } else { Err(CliError::Invalid(faults.join("\n  "))) }
}

fn is_stdin(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Directories become their files, sorted; what lies in directories below is not taken.
fn expand(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CliError> {
    if paths.iter().filter(|path| is_stdin(path)).count() > 1 {
        return Err(CliError::Usage(
            "-f - can be given once: there is one standard input".to_owned(),
        ));
    }
    let mut out = Vec::new();
    for path in paths {
        if is_stdin(path) || !path.is_dir() {
            out.push(path.clone());
            continue;
        }
        let failed =
            |error: std::io::Error| CliError::Failed(format!("{}: {error}", path.display()));
        let mut files = Vec::new();
        for entry in std::fs::read_dir(path).map_err(failed)? {
            let file = entry.map_err(failed)?.path();
            let known = file.extension().is_some_and(|extension| {
                ["yaml", "yml", "json"].iter().any(|known| extension == *known)
            });
            if known && file.is_file() {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Err(CliError::Usage(format!(
                "{} holds no file that ends in .yaml, .yml or .json",
                path.display()
            )));
        }
        files.sort();
        out.append(&mut files);
    }
    Ok(out)
}

fn bounded(reader: &mut dyn Read, most: usize) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    // One byte more than allowed tells what is too large.
    reader.take(most as u64 + 1).read_to_end(&mut bytes)?;
    if bytes.len() > most {
        return Err(std::io::Error::other(format!(
            "with this more than {} MiB in one request; split it",
            MAX_BYTES / 1024 / 1024
        )));
    }
    Ok(bytes)
}

/// The documents of one text, or every fault in words.
fn parse(path: &Path, name: &str, bytes: Vec<u8>) -> Result<Vec<(Value, Origin)>, Vec<String>> {
    let text = String::from_utf8(bytes).map_err(|error| {
        let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + good.iter().filter(|byte| **byte == b'\n').count();
        vec![format!("{name}:{line}: is not UTF-8")]
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let looks_like_json = text.trim_start().starts_with(['[', '{']);
    let is_json = path.extension().is_some_and(|extension| extension == "json");
    let values = if is_json {
        parse_json(text, name)?
    } else if is_stdin(path) && looks_like_json {
        // `{ kind: Layer, … }` and `{…}` behind `---` are YAML.
        match parse_json(text, name) {
            Ok(read) => read,
            Err(faults) => parse_yaml(text, name)
                .map_err(|others| if is_quoted(text) { faults } else { others })?,
        }
    } else {
        parse_yaml(text, name)?
    };
    Ok(located(values, name))
}

/// Documents, and the lines on which they begin; 0 where that is not known.
type Parsed = Vec<(usize, Value)>;

fn parse_json(text: &str, name: &str) -> Result<Parsed, Vec<String>> {
    let value = json::parse_within(text.as_bytes(), MAX_DEPTH).map_err(|fault| {
        let pointer =
            if fault.pointer.is_empty() { String::new() } else { format!("{}: ", fault.pointer) };
        vec![format!("{name}:{}: {pointer}{}", fault.line, fault.detail)]
    })?;
    Ok(vec![(0, value)])
}

fn parse_yaml(text: &str, name: &str) -> Result<Parsed, Vec<String>> {
    located_documents(text, MAX_DOCUMENTS).map_err(|faults| {
        let faults = faults.into_iter().map(|fault| in_file(fault, name).to_string());
        faults.collect()
    })
}

/// Whether a text that is neither JSON nor YAML was meant as JSON: its first member has a quoted
/// name.
fn is_quoted(text: &str) -> bool {
    let begin = text.trim_start_matches(|c: char| c.is_whitespace() || matches!(c, '[' | '{'));
    begin.starts_with('"')
}

/// The same fault with the name of the file.
fn in_file(mut fault: LocatedFault, name: &str) -> LocatedFault {
    let line = match fault.place {
        ValueOrigin::File { line, .. } | ValueOrigin::Line(line) => line,
        ValueOrigin::Nowhere
        | ValueOrigin::Overlay { .. }
        | ValueOrigin::Environment(_)
        | ValueOrigin::Override(_) => 0,
    };
    fault.place = ValueOrigin::File { file: Arc::from(name), line };
    fault
}

/// Takes lists apart (`[…]`, and `{"items": […]}` as `blaze get` prints it) and says where each
/// document comes from.
fn located(values: Parsed, name: &str) -> Vec<(Value, Origin)> {
    let mut found = Vec::new();
    for (line, value) in values {
        match value {
            Value::Null => {}
            Value::Array(items) => found.extend(items.into_iter().map(|item| (item, line))),
            Value::Object(mut members)
                if !members.contains_key("kind")
                    && members.get("items").is_some_and(Value::is_array) =>
            {
                if let Some(Value::Array(items)) = members.shift_remove("items") {
                    found.extend(items.into_iter().map(|item| (item, line)));
                }
            }
            other => found.push((other, line)),
        }
    }
    let several = found.len() > 1;
    let file: Arc<str> = Arc::from(name);
    let origin = |line, number| Origin { file: Arc::clone(&file), line, number, several };
    let numbered = (1..).zip(found);
    numbered.map(|(number, (value, line))| (value, origin(line, number))).collect()
}

#[cfg(test)]
#[path = "files_tests.rs"]
mod tests;
