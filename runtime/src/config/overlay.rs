//! A tree from elsewhere that counts over the file, and may change while the program runs.

use std::fmt;
use std::sync::Arc;

use serde_json::{Map, Value};

use super::value_origin::{LocatedFault, Places, ValueOrigin, join};

/// A tree that counts over the file and below environment and options.
#[derive(Clone, PartialEq)]
pub struct Overlay {
    /// Who gives it, in a word for faults.
    pub origin: Arc<str>,
    /// Which state of it this is: larger is newer.
    pub revision: u64,
    /// Another one for another tree.
    pub hash: Arc<str>,
    /// Merged over the tree of the file (RFC 7396): objects member by member, all else is replaced,
    /// `null` removes.
    pub tree: Arc<Value>,
}

/// Without the tree, for it may hold texts of secrets.
impl fmt::Debug for Overlay {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Overlay")
            .field("origin", &self.origin)
            .field("revision", &self.revision)
            .field("hash", &self.hash)
            .finish_non_exhaustive()
    }
}

/// What became of an overlay.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// The newest one.
    pub overlay: Overlay,
    /// Why it does not count; `None`: it does.
    pub faults: Option<Arc<[LocatedFault]>>,
}

impl Overlay {
    pub(super) fn place(&self) -> ValueOrigin {
        ValueOrigin::Overlay { origin: Arc::clone(&self.origin), revision: self.revision }
    }
}

/// Merges a tree over another one; what it says has its place from then on.
pub(super) fn merge(slot: &mut Value, places: &mut Places, patch: &Value, place: &ValueOrigin) {
    merge_at(slot, places, patch, place, "");
}

fn merge_at(slot: &mut Value, places: &mut Places, patch: &Value, place: &ValueOrigin, at: &str) {
    let Value::Object(members) = patch else {
        *slot = patch.clone();
        places.forget_below(at);
        places.set(at, place.clone());
        return;
    };
    if !slot.is_object() {
        *slot = Value::Object(Map::new());
        places.forget_below(at);
        places.set(at, place.clone());
    }
    let Value::Object(out) = slot else { return };
    for (name, member) in members {
        let below = join(at, name);
        if member.is_null() {
            out.shift_remove(name);
            places.forget_below(&below);
            places.set(&below, place.clone());
        } else {
            merge_at(out.entry(name.clone()).or_insert(Value::Null), places, member, place, &below);
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn an_overlay_is_a_merge_patch_and_what_it_says_has_its_place() {
        let file = |line| ValueOrigin::File { file: Arc::from("a.yaml"), line };
        let mut value = json!({
            "flow": {
                "bandwidth": { "limit_mbps": 1, "overhead": 2 },
                "topics": [ { "match": "a" } ],
            },
            "gone": { "a": 1 },
        });
        let mut places = Places::default();
        for (path, line) in
            [("", 1), ("flow.bandwidth.overhead", 2), ("flow.topics[0].match", 3), ("gone.a", 4)]
        {
            places.set(path, file(line));
        }
        let overlay = Overlay {
            origin: Arc::from("BlazeConfig"),
            revision: 431,
            hash: Arc::from("sha256:a"),
            tree: Arc::new(json!({
                "flow": {
                    "bandwidth": { "limit_mbps": 40 },
                    "topics": [ { "match": "b" }, { "match": "c" } ],
                },
                "gone": null, "log": { "level": "debug" },
            })),
        };
        merge(&mut value, &mut places, &overlay.tree, &overlay.place());
        assert_eq!(
            value,
            json!({
                "flow": {
                    "bandwidth": { "limit_mbps": 40, "overhead": 2 },
                    "topics": [ { "match": "b" }, { "match": "c" } ],
                },
                "log": { "level": "debug" },
            })
        );
        for (path, place) in [
            ("flow.bandwidth.limit_mbps", "BlazeConfig revision 431"),
            ("flow.bandwidth.overhead", "a.yaml:2"),
            ("flow.bandwidth", "a.yaml:1"),
            ("flow.topics[0].match", "BlazeConfig revision 431"),
            ("gone.a", "BlazeConfig revision 431"),
            ("log.level", "BlazeConfig revision 431"),
        ] {
            assert_eq!(places.locate(path).to_string(), place, "{path}");
        }
        assert!(!format!("{overlay:?}").contains("debug"));
    }
}
