//! Judges the roll-outs that are tried here by what the services say that they changed.
//!
//! ```text
//! flush ──Trials──▶ a window for each roll-out and canary node ──▶ applied
//!                              │ Complaint of a place that it changed, within the window
//!                              ▼
//!                   more than max_unhealthy ──▶ failed: undone here, whoever else is there or not
//! ```
//!
//! A window begins when the changed configuration is told here; in a new life of the worker it begins anew.

use std::collections::BTreeMap;
use std::time::Instant;

use blaze_domain::{DocumentName, NodeName};

use super::health::{Complaint, Trouble};
use super::place::Place;
use super::served::{Served, Trial};

/// Roll-outs times canary nodes that are watched, at most; beyond, canaries are served and not judged, and counted.
pub const MAX_WINDOWS: usize = 10_000;
/// Places that a reason names, at most.
const MAX_NAMED: usize = 5;

/// How a roll-out goes on one canary node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RolloutPhase {
    /// It is undone here, because too many services are in trouble with it.
    Failed,
    /// It is undone here, because it failed on another node.
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
    until: Instant,
    max_unhealthy: u64,
    /// What was said against it, by place.
    troubled: BTreeMap<Place, String>,
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
    /// Looks at the shown documents, right after they were told. Gives whether the reports are others.
    pub fn follow(&mut self, served: &Served, now: Instant) -> bool {
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
                let window = old.remove(&key).unwrap_or_else(|| {
                    is_changed = true;
                    Window::new(&trial, now)
                });
                self.windows.insert(key, window);
            }
        }
        is_changed || !old.is_empty()
    }

    /// Judges by a complaint. Gives the roll-outs that fail because of it: they are to be undone and remembered.
    pub fn complain(&mut self, served: &Served, complaint: &Complaint, now: Instant) -> Vec<Failure> {
        let mut failures = Vec::new();
        let place = &complaint.place;
        let Some(node) = &place.node else { return failures };
        let of_node = self.windows.range_mut((node.clone(), String::new())..);
        for ((_, uid), window) in of_node.take_while(|((at, _), _)| at == node) {
            let is_open = window.phase == RolloutPhase::Applied && now <= window.until;
            if is_open
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

    /// How roll-outs go on nodes that are served here; those that failed come first, for the list may be cut.
    #[must_use]
    pub fn states(&self, is_served: impl Fn(&NodeName) -> bool) -> Vec<RolloutState> {
        let here = self.windows.iter().filter(|((node, _), _)| is_served(node));
        let mut out: Vec<RolloutState> = here
            .map(|((node, uid), window)| RolloutState {
                uid: uid.clone(),
                name: window.name.clone(),
                node: node.clone(),
                phase: window.phase,
                reason: window.reason.clone(),
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
    fn new(trial: &Trial, now: Instant) -> Self {
        let (phase, reason) = match trial.has_failed {
            true => (RolloutPhase::Failed, "it failed here before".to_owned()),
            false => (RolloutPhase::Applied, String::new()),
        };
        Self {
            name: trial.name.clone(),
            until: now + trial.window,
            max_unhealthy: trial.max_unhealthy,
            troubled: BTreeMap::new(),
            phase,
            reason,
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
