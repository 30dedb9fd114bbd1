//! Whose secret an edited item of a list keeps.
//!
//! ```text
//! versions of its secrets are those of        one item of the list, which went away       that one
//!                                             several                                      the one at the same place, if no
//!                                                                                          other could be meant
//!                                             none: they are old                           the one at the same place, if it
//!                                                                                          alone went away
//! ```
//!
//! "The same place" means something only in a list that is as long as it was and in which nothing
//! moved. In doubt nobody is meant: the secret of one item must not come to stand beside the
//! members of another.

use std::collections::{HashMap, HashSet};

use blaze_domain::config::secret::{self, Secret};
use blaze_domain::config::{canonical, json};
use serde_json::Value;

/// Items that a member may be common to and still tell them apart.
const FEW: usize = 8;

/// A place within an item, indices left out, and a version of a secret there.
type Mark = (String, u64);

/// What is known of a list with edited items.
pub(super) struct Edited {
    /// Marks of the secrets of each item.
    marks: Vec<Vec<Mark>>,
    /// Items that went away or were edited.
    left: HashSet<usize>,
    /// Items by the marks of their secrets.
    marked: HashMap<Mark, Vec<usize>>,
    /// Items that went away or were edited, by their members.
    members: HashMap<String, Vec<usize>>,
    /// None of the others moved.
    is_in_place: bool,
    /// As many items keep secrets as are left: none was replaced.
    is_complete: bool,
}

impl Edited {
    /// Of a list as it is now with indices of items that are not written as they were, and of what
    /// is written instead.
    pub(super) fn new(
        current: &[Value],
        left: HashSet<usize>,
        changed: &[&Value],
        is_in_place: bool,
    ) -> Self {
        let keeping = changed.iter().filter(|item| !kept(item).is_empty()).count();
        let mut out = Self {
            marks: Vec::new(),
            marked: HashMap::new(),
            members: HashMap::new(),
            is_in_place,
            is_complete: false,
            left,
        };
        if keeping == 0 {
            return out;
        }
        let mut secret_left = 0;
        for (index, item) in current.iter().enumerate() {
            let marks = stored(item);
            let is_left = out.left.contains(&index);
            secret_left += usize::from(is_left && !marks.is_empty());
            let mut distinct = marks.clone();
            distinct.dedup();
            for mark in distinct {
                out.marked.entry(mark).or_default().push(index);
            }
            out.marks.push(marks);
            if is_left {
                for member in members(item) {
                    out.members.entry(member).or_default().push(index);
                }
            }
        }
        out.is_complete = keeping == secret_left;
        out
    }

    /// The item that an edited one stands for, if that is certain.
    pub(super) fn place_of(&self, item: &Value, index: usize) -> Option<usize> {
        let wanted = kept(item);
        let here = (self.is_in_place && self.left.contains(&index)).then_some(index);
        // With texts alone nothing is kept: the same place tells whether a text is still the same.
        if wanted.is_empty() {
            return here;
        }
        let rarest = wanted.iter().map(|mark| self.marked.get(mark).map_or(&[][..], Vec::as_slice));
        let rarest = rarest.min_by_key(|found| found.len()).unwrap_or_default();
        let is_match =
            |place: usize| self.marks.get(place).is_some_and(|marks| covers(marks, &wanted));
        if rarest.len() <= FEW {
            let all: Vec<usize> = rarest.iter().copied().filter(|place| is_match(*place)).collect();
            let left: Vec<usize> =
                all.iter().copied().filter(|place| self.left.contains(place)).collect();
            match (all.as_slice(), left.as_slice()) {
                // An older version: it is known by its place alone.
                ([], _) => return here.filter(|_| self.left.len() == 1),
                ([only], [_]) => return Some(*only),
                (_, []) => return None,
                (_, [only]) => return here.filter(|here| here == only),
                _ => {}
            }
        }
        let here = here.filter(|here| is_match(*here))?;
        self.is_nearest(item, here).then_some(here)
    }

    /// Whether no other item that went away is more like it; or, where items were replaced, each
    /// other is less like it.
    fn is_nearest(&self, item: &Value, here: usize) -> bool {
        let mut common: HashMap<usize, usize> = HashMap::new();
        let found = members(item).into_iter().filter_map(|member| self.members.get(&member));
        for place in found.filter(|found| found.len() <= FEW).flatten() {
            *common.entry(*place).or_default() += 1;
        }
        let own = common.remove(&here).unwrap_or_default();
        let most = common.values().copied().max().unwrap_or_default();
        own > most || (own == most && self.is_complete)
    }
}

/// Secrets that an item keeps as they are stored, in order.
fn kept(item: &Value) -> Vec<Mark> {
    marks(item, |secret| matches!(secret, Secret::Redacted { .. }))
}

/// Secrets that an item holds, in order.
fn stored(item: &Value) -> Vec<Mark> {
    marks(item, |secret| matches!(secret, Secret::Stored { .. }))
}

fn marks(item: &Value, counts: impl Fn(&Secret<'_>) -> bool) -> Vec<Mark> {
    let mut out = Vec::new();
    secret::walk(item, &mut |pointer, value| {
        if let Some(Ok(secret)) = Secret::of(value)
            && counts(&secret)
        {
            out.push((without_indices(pointer), secret.version()));
        }
    });
    out.sort();
    out
}

/// Items of a list within the item may have moved.
fn without_indices(pointer: &str) -> String {
    let is_index = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    let parts = pointer.split('/').map(|part| if is_index(part) { "-" } else { part });
    parts.collect::<Vec<_>>().join("/")
}

/// Whether the one list holds the other, both in order.
fn covers(all: &[Mark], wanted: &[Mark]) -> bool {
    let mut all = all.iter();
    wanted.iter().all(|mark| all.any(|found| found == mark))
}

/// Members of an item that are no secrets, with their values.
fn members(item: &Value) -> HashSet<String> {
    let mut out = HashSet::new();
    collect("", item, &mut out);
    out
}

fn collect(pointer: &str, value: &Value, out: &mut HashSet<String>) {
    match value {
        value if secret::is_secret(value) => {}
        Value::Object(members) => {
            for (name, member) in members {
                collect(&json::push(pointer, name), member, out);
            }
        }
        Value::Array(items) => {
            for item in items {
                collect(&json::push(pointer, "-"), item, out);
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {
            out.insert(format!("{pointer} {}", canonical::to_string(value)));
        }
    }
}
