//! Sections of the node file within a configuration: they follow its schema, as far as a part of a
//! whole can.
//!
//! ```text
//! config ──sections alone, removals left out, secrets as text──▶ NodeFile::read ──▶ faults ──what a part may lack
//!                                                                                           is left out──▶ pointers
//! ```
//!
//! A configuration is merged with others before a program reads it, so it may leave out what the
//! node file requires. What stands in a list is complete, for lists are replaced whole. A secret is
//! checked for being where a text may stand.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::fields::Faults;
use crate::config::json::{append, append_index, escape};
use crate::config::secret;
use crate::node_file::NodeFile;

/// Top-level members of a configuration that are sections of the node file.
pub const NODE_FILE_SECTIONS: [&str; 11] = [
    "brokers",
    "cache",
    "config",
    "control_plane",
    "database",
    "flow",
    "layer",
    "log",
    "monitor",
    "node",
    "worker",
];

/// Stands for the text of a secret.
const HIDDEN: &str = "hidden";

/// Checks the sections of a configuration that stands at `pointer`.
pub(super) fn check(config: &Map<String, Value>, pointer: &str, faults: &Faults) {
    let mut tree = Map::new();
    let mut secrets = BTreeSet::new();
    for name in NODE_FILE_SECTIONS {
        if let Some(section) = config.get(name).filter(|section| !section.is_null()) {
            let mut at = format!("/{name}");
            tree.insert(name.to_owned(), without_removals(section, &mut at, &mut secrets));
        }
    }
    if tree.is_empty() {
        return;
    }
    let tree = Value::Object(tree);
    let Err(found) = NodeFile::read(&tree) else { return };
    for fault in found {
        if faults.are_enough() {
            return;
        }
        let place = Place::of(&tree, &fault.path);
        let is_hidden = secrets.contains(&place.pointer) && !fault.detail.starts_with("expected ");
        if !is_hidden && !place.may_lack(&fault.detail) {
            faults.add(&format!("{pointer}{}", place.pointer), fault.detail);
        }
    }
}

/// A section as the node file would have it; notes the pointers to secrets.
fn without_removals(value: &Value, pointer: &mut String, secrets: &mut BTreeSet<String>) -> Value {
    if secret::is_secret(value) {
        secrets.insert(pointer.clone());
        return HIDDEN.into();
    }
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => value.clone(),
        Value::Array(items) => {
            // Removals are members of objects outside lists; within, `null` is a value.
            let mut items = items.clone();
            for (index, item) in items.iter_mut().enumerate() {
                let length = append_index(pointer, index);
                secret::map(item, &mut |below, _| {
                    secrets.insert(format!("{pointer}{below}"));
                    Some(HIDDEN.into())
                });
                pointer.truncate(length);
            }
            Value::Array(items)
        }
        Value::Object(members) => {
            let mut out = Map::new();
            for (name, member) in members.iter().filter(|(_, member)| !member.is_null()) {
                let length = append(pointer, name);
                out.insert(name.clone(), without_removals(member, pointer, secrets));
                pointer.truncate(length);
            }
            Value::Object(out)
        }
    }
}

/// Where a path of the node file, such as `flow.topics[0].match`, leads in a tree.
struct Place<'v> {
    pointer: String,
    /// The value there, if there is one.
    value: Option<&'v Value>,
    /// Whether it is within a list.
    in_list: bool,
}

impl<'v> Place<'v> {
    fn of(tree: &'v Value, path: &str) -> Self {
        if let Some(place) = Self::find(tree, path) {
            return place;
        }
        // Only the last key of a path may be missing in the tree, and then it is one of the schema.
        let (parent, name) = path.rsplit_once('.').unwrap_or(("", path));
        let parent = Self::find(tree, parent);
        let (pointer, in_list) =
            parent.map_or((String::new(), false), |parent| (parent.pointer, parent.in_list));
        Self { pointer: format!("{pointer}/{}", escape(name)), value: None, in_list }
    }

    /// Keys may hold points and brackets themselves, so the tree tells where one ends.
    fn find(value: &'v Value, path: &str) -> Option<Self> {
        if path.is_empty() {
            return Some(Self { pointer: String::new(), value: Some(value), in_list: false });
        }
        let (segment, mut place) = match value {
            Value::Object(members) => {
                let path = path.strip_prefix('.').unwrap_or(path);
                members.iter().find_map(|(name, member)| {
                    let rest = path.strip_prefix(name.as_str())?;
                    let ends = rest.is_empty() || rest.starts_with(['.', '[']);
                    ends.then(|| Self::find(member, rest))?
                        .map(|place| (escape(name).into_owned(), place))
                })?
            }
            Value::Array(items) => {
                let (index, rest) = path.strip_prefix('[')?.split_once(']')?;
                let mut place = Self::find(items.get(index.parse::<usize>().ok()?)?, rest)?;
                place.in_list = true;
                (index.to_owned(), place)
            }
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => return None,
        };
        place.pointer = format!("/{segment}{}", place.pointer);
        Some(place)
    }

    /// Whether a fault is that something is missing which another part of the configuration may
    /// give.
    fn may_lack(&self, detail: &str) -> bool {
        if self.in_list {
            return false;
        }
        match detail.strip_prefix("needs one of ") {
            Some(choices) => {
                let is_given =
                    |name: &str| self.value.is_some_and(|value| value.get(name).is_some());
                !choices.split(", ").any(is_given)
            }
            None => matches!(detail, "is required" | "cert_file and key_file go together"),
        }
    }
}
