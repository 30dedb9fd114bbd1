//! Judges the roll-outs that are tried here by what the services say that they changed.
//!
//! ```text
//! flush ──Trials──▶ a window for each roll-out and canary node ──▶ pending
//!                              │ services were told
//!                              ▼
//!                            open, for as long as the gate says ──▶ applied
//!                              │ Complaint of a place that it changed, within the window
//!                              ▼
//!                   more than max_unhealthy ──▶ failed: undone here, with or without the main service
//! ```
//!
//! A window begins when the changed configuration was told here, by whomever; in a new life of the
//! worker it begins anew. As long as nobody tells it, nobody has it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blaze_domain::{DocumentName, NodeName};

use super::health::{Complaint, Trouble};
use super::served::{Served, Trial};
use super::served_target::ServedTarget;

/// Roll-outs times canary nodes that are watched, at most; beyond, canaries are served and not
/// judged, and counted.
pub const MAX_WINDOWS: usize = 10_000;
/// Places that a reason names, at most.
const MAX_NAMED: usize = 5;

/// How a roll-out goes on one canary node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RolloutPhase {
    /// It is undone here, because too many services are in trouble with it.
    Failed,
    /// It is undone here, because it failed on another node; or services have not been told yet.
    Pending,
    /// Services are told.
    Applied,
}

impl RolloutPhase {
    /// The word in messages.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Applied => "applied",
            Self::Failed => "failed",
        }
    }
}

/// What is told of a roll-out on one canary node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RolloutState {
    /// Which one.
    pub uid: String,
    /// Its name.
    pub name: DocumentName,
    /// On which node.
    pub node: NodeName,
    /// How it goes.
    pub phase: RolloutPhase,
    /// Why it is not there; empty if it is.
    pub reason: String,
}

/// A roll-out that failed just now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// Which one.
    pub uid: String,
    /// Its name.
    pub name: DocumentName,
    /// Why.
    pub reason: String,
}

#[derive(Debug)]
struct Window {
    name: DocumentName,
    length: Duration,
    /// Revision of the documents that it came with: what services were told of an earlier state
    /// does not open it.
    since: u64,
    /// `None`: services were not told yet.
    until: Option<Instant>,
    max_unhealthy: u64,
    /// What was said against it, by place.
    troubled: BTreeMap<ServedTarget, String>,
    phase: RolloutPhase,
    reason: String,
}

/// The roll-outs that are tried here.
#[derive(Debug, Default)]
pub struct Gate {
    /// By node first, because complaints are of a node.
    windows: BTreeMap<(NodeName, String), Window>,
    unwatched: usize,
}

impl Gate {
    /// Looks at the shown documents. Gives whether the reports are others.
    pub fn follow(&mut self, served: &Served) -> bool {
        let mut old = std::mem::take(&mut self.windows);
        let mut is_changed = false;
        self.unwatched = 0;
        for trial in served.trials() {
            for node in &trial.nodes {
                if self.windows.len() >= MAX_WINDOWS {
                    self.unwatched += 1;
                    continue;
                }
                let key = (node.clone(), trial.uid.clone());
                let window = old.remove(&key);
                // That it failed may become known later, from a copy.
                let window = window
                    .filter(|window| !trial.has_failed || window.phase != RolloutPhase::Applied);
                let window = window.unwrap_or_else(|| {
                    is_changed = true;
                    Window::new(&trial, served.state().revision())
                });
                self.windows.insert(key, window);
            }
        }
        is_changed || !old.is_empty()
    }

    /// Opens the windows of what services were told of by now: everything up to this revision.
    /// Gives whether the reports are others.
    pub fn open(&mut self, told: Option<u64>, now: Instant) -> bool {
        let Some(told) = told else { return false };
        let mut is_changed = false;
        for window in self.windows.values_mut() {
            if window.until.is_none() && window.since <= told {
                window.until = Some(now + window.length);
                is_changed = true;
            }
        }
        is_changed
    }

    /// Judges by a complaint. Gives the roll-outs that fail because of it: they are to be undone
    /// and remembered.
    pub fn complain(
        &mut self,
        served: &Served,
        complaint: &Complaint,
        now: Instant,
    ) -> Vec<Failure> {
        let mut failures = Vec::new();
        let place = &complaint.place;
        let Some(node) = &place.node else { return failures };
        let of_node = self.windows.range_mut((node.clone(), String::new())..);
        for ((_, uid), window) in of_node.take_while(|((at, _), _)| at == node) {
            // Whoever names the configuration has it, although it is not known to be told to all.
            let is_open = window.until.map_or(complaint.hash.is_some(), |until| now <= until);
            if is_open
                && window.phase == RolloutPhase::Applied
                && !window.troubled.contains_key(place)
                && !is_of_another_configuration(served, complaint)
                && served.is_changed_by(uid, place)
            {
                window.troubled.insert(place.clone(), words(complaint));
                if window.troubled.len() as u64 > window.max_unhealthy {
                    window.fail();
                    failures.push(Failure {
                        uid: uid.clone(),
                        name: window.name.clone(),
                        reason: window.reason.clone(),
                    });
                }
            }
        }
        for failure in &failures {
            self.undo_elsewhere(&failure.uid, node);
        }
        failures
    }

    /// This worker undoes it for all that it serves.
    fn undo_elsewhere(&mut self, uid: &str, node: &NodeName) {
        for ((_, other), window) in &mut self.windows {
            if other == uid && window.phase == RolloutPhase::Applied {
                window.phase = RolloutPhase::Pending;
                window.reason = format!("undone: it failed on {node}");
            }
        }
    }

    /// How roll-outs go on nodes that are served here; those that failed come first, for the list
    /// may be cut.
    #[must_use]
    pub fn states(&self, is_served: impl Fn(&NodeName) -> bool) -> Vec<RolloutState> {
        let here = self.windows.iter().filter(|((node, _), _)| is_served(node));
        let mut out: Vec<RolloutState> = here
            .map(|((node, uid), window)| RolloutState {
                uid: uid.clone(),
                name: window.name.clone(),
                node: node.clone(),
                phase: window.shown_phase(),
                reason: window.shown_reason(),
            })
            .collect();
        out.sort_by_key(|state| state.phase);
        out
    }

    /// Canaries that are not judged, because there are too many.
    #[must_use]
    pub fn unwatched(&self) -> usize {
        self.unwatched
    }
}

impl Window {
    fn new(trial: &Trial, since: u64) -> Self {
        let (phase, reason) = match trial.has_failed {
            true => (RolloutPhase::Failed, "it failed here before".to_owned()),
            false => (RolloutPhase::Applied, String::new()),
        };
        Self {
            name: trial.name.clone(),
            length: trial.window,
            since,
            until: None,
            max_unhealthy: trial.max_unhealthy,
            troubled: BTreeMap::new(),
            phase,
            reason,
        }
    }

    fn is_untold(&self) -> bool {
        self.phase == RolloutPhase::Applied && self.until.is_none()
    }

    fn shown_phase(&self) -> RolloutPhase {
        if self.is_untold() { RolloutPhase::Pending } else { self.phase }
    }

    fn shown_reason(&self) -> String {
        match self.is_untold() {
            true => "services have not been told yet".to_owned(),
            false => self.reason.clone(),
        }
    }

    fn fail(&mut self) {
        let named = self.troubled.iter().take(MAX_NAMED);
        let named: Vec<String> = named.map(|(place, words)| format!("{place} {words}")).collect();
        let (count, allowed) = (self.troubled.len(), self.max_unhealthy);
        let more = if count > MAX_NAMED { ", …" } else { "" };
        self.phase = RolloutPhase::Failed;
        self.reason = format!("{count} in trouble, {allowed} allowed: {}{more}", named.join(", "));
    }
}

/// Whether a service speaks of a configuration that it was told before the present one.
fn is_of_another_configuration(served: &Served, complaint: &Complaint) -> bool {
    let Some(told) = served.told_to(&complaint.place) else {
        return true;
    };
    match &complaint.hash {
        Some(hash) => told.hash.as_ref() != Some(hash),
        None => complaint.revision.is_some_and(|revision| revision < told.revision),
    }
}

fn words(complaint: &Complaint) -> String {
    let word = match complaint.trouble {
        Trouble::Rejected => "rejected it",
        Trouble::Unhealthy => "is unhealthy",
        Trouble::Lost => "lost its watchdog",
    };
    match complaint.detail.as_str() {
        "" => word.to_owned(),
        detail => format!("{word} ({detail})"),
    }
}

#[cfg(test)]
#[path = "gate_tests.rs"]
mod tests;
