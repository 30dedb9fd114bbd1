//! What this version reads but does not act on yet: the file may hold it, and a warning says so.

use serde_json::Value;

use super::walk::Node;

/// Sections without effect, each worth one warning. At present all have one.
const SECTIONS: &[&str] = &[];

pub(super) fn warn_of_what_is_not_in_effect(tree: &Value, root: &Node<'_>) {
    for section in SECTIONS {
        if tree.get(section).is_some_and(|value| !value.is_null()) {
            root.at((*section).to_owned()).warn("not in effect in this version");
        }
    }
}
