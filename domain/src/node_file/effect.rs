//! What this version reads but does not act on yet: the file may hold it, and a warning says so.

use serde_json::Value;

use super::walk::Node;

const NOT_YET: &str = "not in effect in this version";

/// Sections without effect, each worth one warning.
const SECTIONS: &[&str] = &["monitor"];

/// Keys without effect in sections that have one: one warning per section.
const KEYS: &[(&str, &[&str])] = &[("admin", &["monitor"])];

pub(super) fn warn_of_what_is_not_in_effect(tree: &Value, root: &Node<'_>) {
    let at = |path: String| root.at(path);
    for path in SECTIONS {
        if find(tree, path).is_some() {
            at((*path).to_owned()).warn(NOT_YET);
        }
    }
    for (path, keys) in KEYS {
        if let Some(section) = find(tree, path) {
            warn_of_keys(section, keys, &at((*path).to_owned()));
        }
    }
}

fn warn_of_keys(section: &Value, keys: &[&str], node: &Node<'_>) {
    let given: Vec<&str> =
        keys.iter().copied().filter(|key| section.get(key).is_some_and(|v| !v.is_null())).collect();
    if !given.is_empty() {
        node.warn(format!("{}: {NOT_YET}", given.join(", ")));
    }
}

/// The value at a path of plain keys; nothing where it is `null` or missing.
fn find<'v>(tree: &'v Value, path: &str) -> Option<&'v Value> {
    path.split('.').try_fold(tree, |value, key| value.get(key)).filter(|value| !value.is_null())
}
