//! From one state of the documents to the next.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use blaze_domain::config::Key;
use blaze_domain::config::state::{Held, State};

/// What one commit, or a snapshot, did to the documents.
#[derive(Clone, Default)]
pub struct Change {
    /// The documents that it concerns, each once, in their order.
    pub keys: Vec<Key>,
    /// All documents after it.
    pub new: State,
}

/// Without the documents: they may hold secrets in clear.
impl fmt::Debug for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Change")
            .field("keys", &self.keys)
            .field("revision", &self.new.revision())
            .finish()
    }
}

/// The keys of documents that are not the same in two states: absent in one, made anew, or changed.
pub(super) fn difference(old: &State, new: &State) -> Vec<Key> {
    let all = old.all().chain(new.all()).map(|(key, _)| key);
    let keys: BTreeSet<&Key> = all.collect();
    let differing = keys.into_iter().filter(|key| !is_same(old.get(key), new.get(key)));
    differing.cloned().collect()
}

/// A uid and a revision stand for one content, but only where the main service gave them: documents
/// of a mounted file have none, and those of another store may have the same by chance.
fn is_same(one: Option<&Arc<Held>>, other: Option<&Arc<Held>>) -> bool {
    match (one, other) {
        (Some(one), Some(other)) => Arc::ptr_eq(one, other) || *one.document == *other.document,
        (one, other) => one.is_none() && other.is_none(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::testing::{document, keys, state};
    use super::*;

    #[test]
    fn what_came_went_or_changed_is_a_difference_and_the_rest_is_not() {
        let old = state(
            7,
            [
                document("Layer/edge", 1, json!({})),
                document("Node/a", 2, json!({"layer": "edge"})),
                document("Service/slam", 3, json!({"config": {"a": 1}})),
            ],
        );
        let new = state(
            9,
            [
                document("Layer/edge", 1, json!({})),
                document("Service/slam", 8, json!({"config": {"a": 2}})),
                document("Instance/slam/0", 9, json!({})),
            ],
        );
        assert_eq!(difference(&old, &new), keys(["Node/a", "Service/slam", "Instance/slam/0"]));
        assert_eq!(difference(&new, &old), keys(["Node/a", "Service/slam", "Instance/slam/0"]));
        assert!(difference(&old, &old.clone()).is_empty());
        assert_eq!(difference(&State::default(), &old).len(), 3);
    }

    #[test]
    fn a_document_made_anew_or_without_revision_is_a_difference_too() {
        let old = state(7, [document("Layer/edge", 0, json!({"config": {"a": 1}}))]);
        let new = state(7, [document("Layer/edge", 0, json!({"config": {"a": 2}}))]);
        assert_eq!(difference(&old, &new), keys(["Layer/edge"]));
        let mut anew = document("Layer/edge", 0, json!({"config": {"a": 1}}));
        anew.uid = "other".to_owned();
        assert_eq!(difference(&old, &state(7, [anew])), keys(["Layer/edge"]));
    }
}
