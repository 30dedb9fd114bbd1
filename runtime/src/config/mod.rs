//! The configuration of a process: from files, environment and options to a typed value, and again
//! when it changes.
//!
//! ```text
//! file ─────┐
//! overlay ──┤
//! BLAZE__… ─┼─▶ Document (tree + place of every value) ──[schema]──▶ Loaded<T>  or  every fault, each FILE:LINE
//! --set ────┘                                                ▲  │
//!                 directory events, SIGHUP, polling ──[watch]─┤  └─[follow]─▶ the program, `/readyz`, the log
//!                 another overlay ────────────────────────────┘ a faulty change changes nothing
//! ```
//!
//! This module knows no key of any section: the schema is a function that its caller brings.

mod compose;
#[cfg(test)]
mod compose_tests;
mod document;
mod follow;
mod overlay;
mod scalar;
#[cfg(test)]
mod tests;
mod value_origin;
mod watch;
mod yaml;
#[cfg(test)]
mod yaml_documents_tests;

use std::process::ExitCode;
use std::sync::Arc;

use serde_json::Value;

use crate::supervisor::{exit_code, say};

pub use document::{Document, MAX_FILE_BYTES, NamedText, Sources, parse_override};
pub use follow::{Follower, Keys, follow};
pub use overlay::{Overlay, Verdict};
pub use value_origin::{LocatedFault, ValueOrigin};
pub use watch::{Current, WatchSettings, watch, watch_with};
pub use yaml::{located_documents, yaml_documents};

/// A path and what is to be said of it.
pub type Remark = (String, String);

/// Reads a tree into a type: the value and warnings, or every fault.
pub type Schema<T> = Arc<dyn Fn(&Value) -> Result<(T, Vec<Remark>), Vec<Remark>> + Send + Sync>;

/// A schema of a function whose faults and warnings are remarks.
pub fn schema<T: 'static, F: Into<Remark> + 'static>(
    read: impl Fn(&Value) -> Result<(T, Vec<F>), Vec<F>> + Send + Sync + 'static,
) -> Schema<T> {
    let remarks = |faults: Vec<F>| faults.into_iter().map(Into::into).collect();
    Arc::new(move |tree| match read(tree) {
        Ok((value, warnings)) => Ok((value, remarks(warnings))),
        Err(faults) => Err(remarks(faults)),
    })
}

/// A configuration that has no fault.
#[derive(Debug, Clone)]
pub struct Loaded<T> {
    /// What it says.
    pub value: T,
    /// The tree that it was read from.
    pub document: Document,
    /// What is allowed and should be known, in the order of the lines.
    pub warnings: Vec<LocatedFault>,
}

/// Reads all sources by a schema.
///
/// # Errors
/// Every fault of form and of the schema, in the order of the lines.
pub fn load_typed<T>(
    sources: &Sources,
    schema: &Schema<T>,
) -> Result<Loaded<T>, Vec<LocatedFault>> {
    judge(Document::load_with_faults(sources), schema)
}

/// The same for a program that starts: every fault is told on stderr, those of `besides`, too, and
/// so are the warnings.
///
/// # Errors
/// The exit code of a faulty configuration.
pub fn load_or_say<T>(
    sources: &Sources,
    schema: &Schema<T>,
    besides: Option<LocatedFault>,
) -> Result<Loaded<T>, ExitCode> {
    match (load_typed(sources, schema), besides) {
        (Ok(loaded), None) => {
            loaded.warnings.iter().for_each(|warning| say(format_args!("warning: {warning}")));
            Ok(loaded)
        }
        (loaded, besides) => {
            let faults = loaded.err().into_iter().flatten().chain(besides);
            faults.for_each(|fault| say(format_args!("{fault}")));
            Err(ExitCode::from(exit_code::CONFIGURATION))
        }
    }
}

fn judge<T>(
    (document, mut faults): (Option<Document>, Vec<LocatedFault>),
    schema: &Schema<T>,
) -> Result<Loaded<T>, Vec<LocatedFault>> {
    let read = document.map(|document| (schema(document.value()), document));
    match read {
        Some((Ok((value, remarks)), document)) if faults.is_empty() => {
            let mut warnings = located(&document, remarks);
            warnings.sort();
            return Ok(Loaded { value, document, warnings });
        }
        Some((Err(remarks), document)) => faults.extend(located(&document, remarks)),
        Some((Ok(_), _)) | None => {}
    }
    faults.sort();
    faults.dedup();
    Err(faults)
}

fn located(document: &Document, remarks: Vec<Remark>) -> Vec<LocatedFault> {
    remarks.into_iter().map(|(path, detail)| document.fault(path, detail)).collect()
}
