//! From one state of the documents to the next.

use std::cmp::Ordering;
use std::fmt;
use std::sync::Arc;

use blaze_domain::config::Key;
use blaze_domain::config::state::{Held, State};

/// What one commit, or a snapshot, did to the documents.
#[derive(Clone, Default)]
pub struct Change {
    /// The documents that it concerns, each once, in their order.
    pub keys: Vec<Key>,
    /// All documents before.
    pub old: State,
    /// All documents after.
    pub new: State,
}

/// Without the documents: they may hold secrets in clear.
impl fmt::Debug for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Change")
            .field("keys", &self.keys)
            .field("from", &self.old.revision())
            .field("to", &self.new.revision())
            .finish()
    }
}

/// The keys of documents that are not the same in two states: absent in one, made anew, or changed. One pass over both.
pub(super) fn difference(old: &State, new: &State) -> Vec<Key> {
    let mut out = Vec::new();
    let (mut olds, mut news) = (old.all().peekable(), new.all().peekable());
    loop {
        let order = match (olds.peek(), news.peek()) {
            (None, None) => return out,
            (Some(_), None) => Ordering::Less,
            (None, Some(_)) => Ordering::Greater,
            (Some((one, _)), Some((other, _))) => one.cmp(other),
        };
        match order {
            Ordering::Less => out.extend(olds.next().map(|(key, _)| key.clone())),
            Ordering::Greater => out.extend(news.next().map(|(key, _)| key.clone())),
            Ordering::Equal => {
                if let (Some((key, was)), Some((_, is))) = (olds.next(), news.next())
                    && !is_same(was, is)
                {
                    out.push(key.clone());
                }
            }
        }
    }
}

/// A uid and a revision stand for one content, but only where the main service gave them: documents of a mounted file have
/// none, and those of another store may have the same by chance.
fn is_same(one: &Arc<Held>, other: &Arc<Held>) -> bool {
    if Arc::ptr_eq(one, other) {
        return true;
    }
    let (one, other) = (&one.document, &other.document);
    one.uid == other.uid && one.revision == other.revision && **one == **other
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
        assert_eq!(
            difference(&old, &new),
            keys(["Node/a", "Service/slam", "Instance/slam/0"])
        );
        assert_eq!(
            difference(&new, &old),
            keys(["Node/a", "Service/slam", "Instance/slam/0"])
        );
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

    #[test]
    fn no_secret_is_shown() {
        let secret = json!({"config": {"pw": {"$secret": {"text": "canary", "version": 3}}}});
        let change = Change {
            keys: keys(["Layer/edge"]),
            old: State::default(),
            new: state(3, [document("Layer/edge", 3, secret)]),
        };
        let text = format!("{change:?}");
        assert!(text.contains("Layer/edge") || text.contains("edge"), "{text}");
        assert!(!text.contains("canary"));
    }
}
