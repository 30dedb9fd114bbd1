//! What a program does with its configuration while it runs: takes over what is good, and says what
//! is not.
//!
//! ```text
//! Current ─▶ good and new ─▶ the program ─▶ is anything left for a restart? ─┬─▶ `/readyz`, check `config`
//!         └▶ faulty ─────────────────────────────────────────────────────────┼─▶ the log, each fault once
//!                                                                            └─▶ the source of the overlay
//! ```

use std::sync::Arc;

use serde_json::Value;
use tokio::sync::watch;

use super::value_origin::join;
use super::{Current, Loaded, LocatedFault, ValueOrigin, Verdict};
use crate::admin::{CheckStatus, Readiness};

/// Keys that are named at a time, at most.
const MAX_NAMED: usize = 5;

/// The keys of a program, as paths: what stands below one belongs to it.
#[derive(Debug, Clone, Copy)]
pub struct Keys {
    /// What it reads at all. The file is for other programs too.
    pub read: &'static [&'static str],
    /// Of these, what it takes over while it runs.
    pub live: &'static [&'static str],
}

/// How a program follows its configuration.
pub struct Follower<T> {
    /// Where changes are told.
    pub told: watch::Receiver<Current<T>>,
    /// Has the check `config`.
    pub readiness: Readiness,
    /// Its keys.
    pub keys: Keys,
    /// Whether two configurations differ in what is read at the start alone.
    pub needs_restart: fn(&T, &T) -> bool,
}

/// Hands each good configuration to `take`, shows the others, and tells `judged` what became of the
/// overlay whenever that is something else than before, with what is to be said of it besides. Ends
/// with the watch.
pub async fn follow<T: Send + Sync>(
    mut follower: Follower<T>,
    mut take: impl FnMut(&Loaded<T>),
    mut judged: impl FnMut(Option<&Verdict>, &str),
) {
    let started = Arc::clone(&follower.told.borrow().started);
    let mut taken = Arc::clone(&started);
    let (mut waits, mut logged, mut verdict) = (String::new(), Vec::new(), None);
    while follower.told.changed().await.is_ok() {
        let current = follower.told.borrow_and_update().clone();
        if !Arc::ptr_eq(&current.loaded, &taken) {
            taken = Arc::clone(&current.loaded);
            take(&taken);
            let before = std::mem::replace(&mut waits, follower.what_waits(&started, &taken));
            if !waits.is_empty() && waits != before {
                tracing::warn!("{waits}");
            }
        }
        let faults = current.all_faults();
        for fault in faults.iter().filter(|fault| !logged.contains(*fault)) {
            tracing::error!("{fault}");
        }
        match faults.first() {
            Some(fault) => follower.readiness.set("config", CheckStatus::Failed, fault.to_string()),
            None => follower.readiness.set("config", CheckStatus::Ok, waits.as_str()),
        }
        logged = faults;
        if verdict != current.overlay {
            judged(current.overlay.as_ref(), &waits);
            verdict = current.overlay;
        }
    }
}

impl<T> Current<T> {
    /// Why what there is now does not count in full, those of the file first.
    #[must_use]
    pub fn all_faults(&self) -> Vec<LocatedFault> {
        let of_overlay = self.overlay.as_ref().and_then(|verdict| verdict.faults.as_ref());
        let both = self.faults.iter().chain(of_overlay);
        both.flat_map(|faults| faults.iter().cloned()).collect()
    }
}

impl<T> Follower<T> {
    /// What is to be said of keys that do not take effect now; empty: they all do.
    fn what_waits(&self, started: &Loaded<T>, now: &Loaded<T>) -> String {
        if !(self.needs_restart)(&started.value, &now.value) {
            return String::new();
        }
        let mut paths = Vec::new();
        different(started.document.value(), now.document.value(), "", &mut paths);
        let below = |path: &str, keys: &[&str]| keys.iter().any(|key| is_at_or_below(path, key));
        paths.retain(|path| below(path, self.keys.read) && !below(path, self.keys.live));
        let origin_of = |path: &String| match now.document.locate(path) {
            place @ ValueOrigin::Overlay { .. } => Some(place),
            _ => None,
        };
        let (laid_over, of_file): (Vec<String>, Vec<String>) =
            paths.into_iter().partition(|path| origin_of(path).is_some());
        let mut out = Vec::new();
        if !of_file.is_empty() || laid_over.is_empty() {
            let of_file = match of_file.is_empty() {
                true => String::new(),
                false => format!(": {}", named(&of_file)),
            };
            out.push(format!("the node file has changes that need a restart{of_file}"));
        }
        if let Some(place) = laid_over.first().and_then(origin_of) {
            let names = named(&laid_over);
            out.push(format!("{place} gives what counts in the node file alone: {names}"));
        }
        out.join("; ")
    }
}

fn named(paths: &[String]) -> String {
    let names = paths.iter().take(MAX_NAMED).map(String::as_str);
    let names = names.collect::<Vec<_>>().join(", ");
    match paths.len().saturating_sub(MAX_NAMED) {
        0 => names,
        more => format!("{names} and {more} more"),
    }
}

fn is_at_or_below(path: &str, key: &str) -> bool {
    path.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
}

/// Paths of the values that differ; a list is one value, and what is missing is `null`.
fn different(one: &Value, other: &Value, at: &str, out: &mut Vec<String>) {
    let members = |value: &Value, name: &str| value.get(name).cloned().unwrap_or(Value::Null);
    match (one, other) {
        (Value::Object(_) | Value::Null, Value::Object(_) | Value::Null) => {
            let names = |value: &Value| {
                value.as_object().map(|map| map.keys().cloned().collect::<Vec<_>>())
            };
            let mut both = names(one).unwrap_or_default();
            both.extend(names(other).unwrap_or_default());
            both.sort();
            both.dedup();
            for name in both {
                different(&members(one, &name), &members(other, &name), &join(at, &name), out);
            }
        }
        _ if one != other => out.push(at.to_owned()),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn keys_that_differ_are_named_by_their_paths() {
        let one = json!({ "a": { "b": 1, "c": [1] }, "d": null, "same": { "x": 1 } });
        let other = json!({ "a": { "c": [2] }, "e": { "f": 1 }, "same": { "x": 1 } });
        let mut paths = Vec::new();
        different(&one, &other, "", &mut paths);
        assert_eq!(paths, ["a.b", "a.c", "e.f"]);
        assert!(
            is_at_or_below("a.b", "a") && is_at_or_below("a[0]", "a") && is_at_or_below("a", "a")
        );
        assert!(!is_at_or_below("ab", "a"));
        let many: Vec<String> = (0..7).map(|number| number.to_string()).collect();
        assert_eq!(named(&many), "0, 1, 2, 3, 4 and 2 more");
    }
}
