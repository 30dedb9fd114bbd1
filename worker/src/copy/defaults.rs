//! The mounted file: documents to start from where there is no copy yet.
//!
//! ```text
//! /etc/blaze/defaults.yaml (A6) ──[yaml_documents]──▶ values ──[spec]──▶ documents ──[placement]──▶ those of the layer's view
//!        ▲ every 500 ms: path without links, size, time, inode
//!        └── DefaultsWatch: reads it again when they change; a faulty file changes nothing but the status
//! ```
//!
//! Documents have revision 0, for no store gave them one. Roll-outs are left out: nobody would
//! watch over their gate. What a secret's text is does not count in the hash of a configuration,
//! its version does: a file in which only a text changes changes no hash.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::Read as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::LayerName;
use blaze_domain::config::placement::placement;
use blaze_domain::config::state::State;
use blaze_domain::config::{
    Code, Document, FieldFault, Key, Kind, MAX_DOCUMENT_BYTES, MAX_DOCUMENTS, Timestamp, spec,
};
use blaze_runtime::config::{ValueOrigin, yaml_documents};
use blaze_runtime::{Supervisor, TaskPolicy};
use serde_json::Value;
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

/// Largest file, in bytes (64 MiB).
const MAX_BYTES: u64 = 64 * 1024 * 1024;
/// Quiet time after a change: who writes a file needs several steps.
const QUIET: Duration = Duration::from_millis(100);
/// Looks until a file that never rests is read all the same.
const LOOKS: usize = 5;
/// Faults that are told, at most.
const MAX_FAULTS: usize = 100;
/// What a document from the file says of who changed it.
const SOURCE: &str = "file";

/// What the mounted file says for one layer.
#[derive(Clone, PartialEq)]
pub struct Defaults {
    /// The documents of the layer's view, in the order of their keys, all of revision 0.
    pub documents: Vec<Arc<Document>>,
    /// Documents of other layers' views, which do not count here.
    pub left_out: usize,
}

/// Without the documents, for they may hold texts of secrets.
impl fmt::Debug for Defaults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Defaults")
            .field("documents", &self.documents.len())
            .field("left_out", &self.left_out)
            .finish()
    }
}

/// Why the file is not used: every fault with its place, `FILE:LINE` or `FILE (document N)`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("; "))]
pub struct DefaultsError(pub Vec<String>);

/// Reads the file.
///
/// # Errors
/// Every fault, a hundred at most.
pub fn read(path: &Path, layer: &LayerName) -> Result<Defaults, DefaultsError> {
    let name = path.display();
    let one = |detail: String| DefaultsError(vec![format!("{name}: {detail}")]);
    let file = File::open(path).map_err(|error| one(format!("cannot be read: {error}")))?;
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| one(format!("cannot be read: {error}")))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(one(format!("has more than {MAX_BYTES} bytes")));
    }
    let text = String::from_utf8(bytes).map_err(|error| {
        let good = error.as_bytes().get(..error.utf8_error().valid_up_to()).unwrap_or_default();
        let line = 1 + good.iter().filter(|byte| **byte == b'\n').count();
        DefaultsError(vec![format!("{name}:{line}: is not UTF-8")])
    })?;
    let documents = parse(&text, &name.to_string())?;
    Ok(in_view(documents, layer))
}

/// All documents of a text, by key.
///
/// # Errors
/// Every fault, a hundred at most.
fn parse(text: &str, name: &str) -> Result<BTreeMap<Key, Document>, DefaultsError> {
    let values = yaml_documents(text, MAX_DOCUMENTS).map_err(|faults| {
        let place = |place: &ValueOrigin| match place {
            ValueOrigin::Line(line) | ValueOrigin::File { line, .. } => format!("{name}:{line}"),
            ValueOrigin::Nowhere
            | ValueOrigin::Overlay { .. }
            | ValueOrigin::Environment(_)
            | ValueOrigin::Override(_) => name.to_owned(),
        };
        let told = faults.iter().take(MAX_FAULTS).map(|fault| {
            let path =
                if fault.path.is_empty() { String::new() } else { format!("{}: ", fault.path) };
            format!("{}: {path}{}", place(&fault.place), fault.detail)
        });
        DefaultsError(told.collect())
    })?;
    let mut documents = BTreeMap::new();
    let mut faults = Vec::new();
    for (number, value) in (1_usize..).zip(values.into_iter().flat_map(listed)) {
        let place = format!("{name} (document {number})");
        match document(value) {
            Err(found) => {
                faults.extend(found.iter().map(|fault| format!("{place}: {}", told(fault))));
            }
            Ok(document) => {
                let key = document.key.clone();
                if documents.insert(key.clone(), document).is_some() {
                    faults.push(format!("{place}: {key} is there twice"));
                }
            }
        }
    }
    faults.truncate(MAX_FAULTS);
    if faults.is_empty() { Ok(documents) } else { Err(DefaultsError(faults)) }
}

/// A list of documents in one YAML document counts as its entries.
fn listed(value: Value) -> Vec<Value> {
    match value {
        Value::Array(items) => items,
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Object(_) => {
            vec![value]
        }
    }
}

fn told(fault: &FieldFault) -> String {
    if fault.pointer.is_empty() {
        fault.detail.clone()
    } else {
        format!("{}: {}", fault.pointer, fault.detail)
    }
}

/// One document, by the rules of `/apply` as far as they look at one document alone.
fn document(value: Value) -> Result<Document, Vec<FieldFault>> {
    let envelope = spec::parse_envelope(value, None)?;
    let key = envelope.key()?;
    let mut faults = Vec::new();
    if envelope.delete {
        faults.push(fault("/delete", "deletes nothing here: leave the document out"));
    }
    faults.extend(spec::check(&key, &envelope.labels, &envelope.annotations, &envelope.spec));
    let size = spec::document_size(&envelope.labels, &envelope.annotations, &envelope.spec);
    if size > MAX_DOCUMENT_BYTES {
        let detail = format!("has {size} bytes, at most {MAX_DOCUMENT_BYTES} are allowed");
        faults.push(fault("/spec", &detail));
    }
    if !faults.is_empty() {
        return Err(faults);
    }
    Ok(Document {
        // The same every time, so that what does not change in the file does not change here.
        uid: format!("{SOURCE}:{key}"),
        key,
        revision: 0,
        create_time: Timestamp::default(),
        update_time: Timestamp::default(),
        updated_by: SOURCE.to_owned(),
        labels: envelope.labels,
        annotations: envelope.annotations,
        spec: Arc::new(envelope.spec),
        status: None,
    })
}

fn fault(pointer: &str, detail: &str) -> FieldFault {
    FieldFault {
        pointer: pointer.to_owned(),
        code: Code::ValidationFailed,
        detail: detail.to_owned(),
        document: None,
    }
}

fn in_view(mut documents: BTreeMap<Key, Document>, layer: &LayerName) -> Defaults {
    documents.retain(|key, _| key.kind() != Kind::Rollout);
    let all = documents.len();
    let state = State::new(0, documents.into_values());
    let documents: Vec<Arc<Document>> = state
        .all()
        .map(|(_, held)| &held.document)
        .filter(|document| placement(&state, document).visible.contains(layer))
        .map(Arc::clone)
        .collect();
    Defaults { left_out: all - documents.len(), documents }
}

/// What is known of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Status {
    /// What it said when it was last without fault; none: it never was.
    pub current: Option<Arc<Defaults>>,
    /// Why what it says now is not used; `current` is then older than the file.
    pub problem: Option<DefaultsError>,
}

/// Reads the file now, and again whenever it changes: within a second of the change, also when
/// Kubernetes swaps the link that it lies behind. The task ends with the supervisor.
#[must_use]
pub fn watch_file(
    supervisor: &Supervisor,
    path: PathBuf,
    layer: LayerName,
    period: Duration,
) -> watch::Receiver<Status> {
    let (tell, told) = watch::channel(Status::default());
    let stop = supervisor.shutdown_token();
    let watched = Watched { path, layer, period, tell };
    supervisor.spawn("watch of the mounted file", TaskPolicy::Essential, async move {
        tokio::select! {
            () = watched.run() => {}
            () = stop.cancelled() => {}
        }
    });
    told
}

struct Watched {
    path: PathBuf,
    layer: LayerName,
    period: Duration,
    tell: watch::Sender<Status>,
}

/// What tells two states of a file apart: where it really is, device, inode, size, and time in
/// seconds and nanoseconds. None: it is not there.
type Look = Option<(PathBuf, [u64; 3], (i64, i64))>;

impl Watched {
    async fn run(self) {
        // It was never looked at.
        let mut seen: Option<Look> = None;
        let mut tick = tokio::time::interval(self.period);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tick.tick().await;
            let Some(mut now) = self.look().await else { return };
            if seen.as_ref() == Some(&now) {
                continue;
            }
            for _ in 0..LOOKS {
                // At the start somebody waits for it.
                if seen.is_none() {
                    break;
                }
                tokio::time::sleep(QUIET.min(self.period)).await;
                let before = now;
                let Some(after) = self.look().await else { return };
                now = after;
                if now == before {
                    break;
                }
            }
            seen = Some(now);
            let (path, layer) = (self.path.clone(), self.layer.clone());
            // The blocking task ends early only when the runtime goes away.
            let Ok(read) = tokio::task::spawn_blocking(move || read(&path, &layer)).await else {
                return;
            };
            self.note(read);
        }
    }

    async fn look(&self) -> Option<Look> {
        let path = self.path.clone();
        let look = move || {
            let real = path.canonicalize().ok()?;
            let found = real.metadata().ok()?;
            let which = [found.dev(), found.ino(), found.size()];
            Some((real, which, (found.mtime(), found.mtime_nsec())))
        };
        tokio::task::spawn_blocking(look).await.ok()
    }

    fn note(&self, read: Result<Defaults, DefaultsError>) {
        let file = self.path.display();
        self.tell.send_if_modified(|status| match read {
            Ok(defaults) => {
                let is_new = status.current.as_deref() != Some(&defaults);
                let was_faulty = status.problem.take().is_some();
                if is_new {
                    let (documents, left_out) = (defaults.documents.len(), defaults.left_out);
                    tracing::info!(%file, documents, left_out, "the mounted file was read");
                    status.current = Some(Arc::new(defaults));
                }
                is_new || was_faulty
            }
            Err(error) => {
                let is_new = status.problem.as_ref() != Some(&error);
                if is_new {
                    let has_older = status.current.is_some();
                    tracing::error!(
                        %error,
                        has_older,
                        "the mounted file is not used; what it said before stays",
                    );
                    status.problem = Some(error);
                }
                is_new
            }
        });
    }
}

#[cfg(test)]
#[path = "defaults_tests.rs"]
mod tests;
