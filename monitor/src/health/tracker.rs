//! From conditions, which come and go, to problems, which do not flap.
//!
//! ```text
//! condition ──present for `after`──► problem ──absent for BETTER_AFTER──► over
//! states    ──the worst problem, held for HOLD──► state of the node, of a service
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::codes::{Code, Scope, find};
use super::limits::{BETTER_AFTER, HOLD, MAX_DETAIL, MAX_PROBLEMS};
use super::{Change, Moment, Problem, State};

/// Something that is wrong right now.
#[derive(Debug, Clone)]
pub(super) struct Condition {
    code: &'static Code,
    name: String,
    detail: String,
    after: Duration,
}

impl Condition {
    /// `None` if the table has no such code.
    pub(super) fn new(scope: Scope, code: &str, name: &str, detail: String) -> Option<Self> {
        let code = find(scope, code)?;
        Some(Self { code, name: name.to_owned(), detail: cut(detail), after: code.after })
    }

    /// With a longer time until it is a problem.
    pub(super) fn lasting(mut self, after: Duration) -> Self {
        self.after = self.after.max(after);
        self
    }

    fn key(&self) -> Key {
        (self.code.scope, self.code.code, self.name.clone())
    }
}

type Key = (Scope, &'static str, String);

#[derive(Debug)]
struct Entry {
    condition: Condition,
    since: Moment,
    is_problem: bool,
    absent_since: Option<Instant>,
}

impl Entry {
    fn problem(&self) -> Problem {
        let Condition { code, name, detail, .. } = &self.condition;
        Problem::new(code, name.clone(), self.since.unix_ms, detail.clone())
    }
}

/// Conditions and the problems that they became.
#[derive(Debug, Default)]
pub(super) struct Tracker {
    entries: BTreeMap<Key, Entry>,
}

impl Tracker {
    /// Takes all conditions of now; those of a frozen scope are not known. `left_out` counts what
    /// had no room elsewhere.
    pub(super) fn update(
        &mut self,
        now: Moment,
        mut conditions: Vec<Condition>,
        frozen: Option<Scope>,
        left_out: usize,
    ) -> Vec<Change> {
        conditions.sort_by_key(|condition| condition.code.scope);
        let mut present = BTreeSet::new();
        let mut without_room = left_out;
        for condition in conditions {
            let key = condition.key();
            if !present.contains(&key) && !self.note(&key, condition, now) {
                without_room += 1;
                continue;
            }
            present.insert(key);
        }
        self.note_left_out(now, without_room, &mut present);
        self.judge(now.at, &present, frozen)
    }

    /// Whether there is room for it.
    fn note(&mut self, key: &Key, condition: Condition, now: Moment) -> bool {
        let is_full = self.entries.len() >= MAX_PROBLEMS;
        match self.entries.get_mut(key) {
            Some(entry) => {
                entry.condition = condition;
                entry.absent_since = None;
                true
            }
            None if is_full => false,
            None => {
                let entry = Entry { condition, since: now, is_problem: false, absent_since: None };
                self.entries.insert(key.clone(), entry);
                true
            }
        }
    }

    /// The rest, counted in one; it has always room.
    fn note_left_out(&mut self, now: Moment, count: usize, present: &mut BTreeSet<Key>) {
        let detail = format!("{count} more problems, services or topics are not listed");
        let rest = Condition::new(Scope::Node, "more_problems", "blaze-monitor", detail);
        let Some(rest) = rest.filter(|_| count > 0) else { return };
        let key = rest.key();
        let fresh =
            || Entry { condition: rest.clone(), since: now, is_problem: false, absent_since: None };
        let entry = self.entries.entry(key.clone()).or_insert_with(fresh);
        entry.condition = rest.clone();
        entry.absent_since = None;
        present.insert(key);
    }

    fn judge(
        &mut self,
        now: Instant,
        present: &BTreeSet<Key>,
        frozen: Option<Scope>,
    ) -> Vec<Change> {
        let mut changes = Vec::new();
        self.entries.retain(|key, entry| {
            if frozen == Some(key.0) {
                entry.absent_since = None;
                return entry.is_problem;
            }
            if present.contains(key) {
                let lasted = now.saturating_duration_since(entry.since.at);
                if !entry.is_problem && lasted >= entry.condition.after {
                    entry.is_problem = true;
                    changes.push(Change::Raised(entry.problem()));
                }
                return true;
            }
            let absent_since = *entry.absent_since.get_or_insert(now);
            let is_over = now.saturating_duration_since(absent_since) >= BETTER_AFTER;
            if entry.is_problem && is_over {
                changes.push(Change::Cleared(entry.problem()));
            }
            entry.is_problem && !is_over
        });
        changes
    }

    /// All problems, by scope, code and name.
    pub(super) fn problems(&self) -> impl Iterator<Item = Problem> + '_ {
        self.entries.values().filter(|entry| entry.is_problem).map(Entry::problem)
    }

    /// The worst state of the problems of some scopes and names.
    pub(super) fn worst(&self, counts: impl Fn(Scope, &str) -> bool) -> Option<State> {
        let entries = self
            .entries
            .iter()
            .filter(|((scope, _, name), entry)| entry.is_problem && counts(*scope, name));
        entries.map(|(_, entry)| entry.condition.code.state).max()
    }
}

/// A state that holds for a while.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing {
    pub(super) state: State,
    pub(super) since_unix_ms: u64,
    changed: Option<Instant>,
}

impl Standing {
    pub(super) fn new(state: State, unix_ms: u64) -> Self {
        Self { state, since_unix_ms: unix_ms, changed: None }
    }

    /// Whether it changed. A change that comes too early is made by a later call.
    pub(super) fn set(&mut self, state: State, now: Moment) -> bool {
        let held = self.changed.map(|changed| now.at.saturating_duration_since(changed));
        if state == self.state || held.is_some_and(|held| held < HOLD) {
            return false;
        }
        *self = Self { state, since_unix_ms: now.unix_ms, changed: Some(now.at) };
        true
    }
}

fn cut(detail: String) -> String {
    match detail.char_indices().nth(MAX_DETAIL) {
        Some((end, _)) => format!("{}…", &detail[..end]),
        None => detail,
    }
}
