//! Whether the process does its work: named checks, each ok or failed.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use parking_lot::Mutex;
use serde::Serialize;
use tokio::sync::watch;

/// Longest detail, in characters.
const MAX_DETAIL_CHARS: usize = 512;

/// State of one check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckStatus {
    /// It holds.
    Ok,
    /// It does not.
    Failed,
}

/// Whether a check decides over the whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gate {
    /// Failed, it makes the process not ready.
    Decides,
    /// It is only shown.
    Shows,
}

/// State of the whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ReadinessStatus {
    /// All deciding checks hold and the process is not stopping.
    Ready,
    /// Something is missing.
    NotReady,
}

/// What `/readyz` answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ReadinessReport {
    /// The whole.
    pub status: ReadinessStatus,
    /// Each check by its name.
    pub checks: BTreeMap<&'static str, CheckReport>,
}

/// One check of a report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct CheckReport {
    /// Its state.
    pub status: CheckStatus,
    /// What it found, in words.
    pub detail: String,
    /// For how long it has had this state, in seconds.
    pub since_s: u64,
}

struct Check {
    gate: Gate,
    status: CheckStatus,
    detail: String,
    since: Instant,
}

/// The checks of a process. Clones share them.
#[derive(Clone)]
pub struct Readiness {
    shared: Arc<Shared>,
}

struct Shared {
    checks: Mutex<Checks>,
    ready: watch::Sender<bool>,
}

#[derive(Default)]
struct Checks {
    by_name: BTreeMap<&'static str, Check>,
    stopping: bool,
}

impl Checks {
    fn ready(&self) -> bool {
        let holds = |check: &Check| check.status == CheckStatus::Ok || check.gate == Gate::Shows;
        !self.stopping && self.by_name.values().all(holds)
    }
}

impl Default for Readiness {
    fn default() -> Self {
        Self::new()
    }
}

impl Readiness {
    /// Without checks: ready.
    #[must_use]
    pub fn new() -> Self {
        Self {
            shared: Arc::new(Shared { checks: Mutex::default(), ready: watch::Sender::new(true) }),
        }
    }

    /// Adds a check. Add all that decide before the work begins, or the process is ready too early.
    pub fn add(
        &self,
        name: &'static str,
        gate: Gate,
        status: CheckStatus,
        detail: impl Into<String>,
    ) {
        let check = Check { gate, status, detail: bounded(detail.into()), since: Instant::now() };
        self.change(|checks| {
            checks.by_name.insert(name, check);
        });
    }

    /// Sets a check; one that was not added decides.
    pub fn set(&self, name: &'static str, status: CheckStatus, detail: impl Into<String>) {
        let detail = bounded(detail.into());
        self.change(|checks| {
            let check = checks.by_name.entry(name).or_insert_with(|| Check {
                gate: Gate::Decides,
                status,
                detail: String::new(),
                since: Instant::now(),
            });
            if check.status != status {
                check.since = Instant::now();
            }
            check.status = status;
            check.detail = detail;
        });
    }

    /// Not ready from now on: the process is stopping.
    pub fn stop(&self) {
        self.change(|checks| checks.stopping = true);
    }

    /// Whether the process is stopping.
    #[must_use]
    pub fn is_stopping(&self) -> bool {
        self.shared.checks.lock().stopping
    }

    fn change(&self, change: impl FnOnce(&mut Checks)) {
        // The lock is held until all are told, so that they are told in the order of the changes.
        let mut checks = self.shared.checks.lock();
        change(&mut checks);
        self.shared.ready.send_replace(checks.ready());
    }

    /// Whether all deciding checks hold and the process is not stopping.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        *self.shared.ready.borrow()
    }

    /// Told at every change of a check; holds [`Readiness::is_ready`].
    #[must_use]
    pub fn changed(&self) -> watch::Receiver<bool> {
        self.shared.ready.subscribe()
    }

    /// Waits until the process is ready.
    pub async fn ready(&self) {
        // The sender lives in `self`.
        let _ = self.changed().wait_for(|ready| *ready).await;
    }

    /// All checks as they are now.
    #[must_use]
    pub fn report(&self) -> ReadinessReport {
        let checks = self.shared.checks.lock();
        let report = |check: &Check| CheckReport {
            status: check.status,
            detail: check.detail.clone(),
            since_s: check.since.elapsed().as_secs(),
        };
        ReadinessReport {
            status: if checks.ready() { ReadinessStatus::Ready } else { ReadinessStatus::NotReady },
            checks: checks.by_name.iter().map(|(name, check)| (*name, report(check))).collect(),
        }
    }
}

impl std::fmt::Debug for Readiness {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Readiness").field(&self.report()).finish()
    }
}

fn bounded(detail: String) -> String {
    match detail.char_indices().nth(MAX_DETAIL_CHARS) {
        Some((end, _)) => format!("{}…", &detail[..end]),
        None => detail,
    }
}
