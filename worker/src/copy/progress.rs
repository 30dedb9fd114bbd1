//! What it takes to add a commit to a copy, or to replace what it holds.

use std::collections::BTreeMap;
use std::sync::Arc;

use blaze_domain::config::{Document, Key};

use super::{CopyError, Loaded, Notes, Position};

/// Whether a copy at `held` can take over what leads to `to`.
///
/// # Errors
/// [`CopyError::Behind`].
pub(super) fn check(held: Option<&Position>, to: &Position, place: &str) -> Result<(), CopyError> {
    let detail = match held {
        None => "it is empty".to_owned(),
        Some(held) if held.store_id != to.store_id => "it is of another store".to_owned(),
        Some(held) if held.revision > to.revision => format!("it is at revision {} already", held.revision),
        Some(_) => return Ok(()),
    };
    Err(CopyError::Behind {
        place: place.to_owned(),
        revision: to.revision,
        detail,
    })
}

/// Whether what a copy holds may be replaced by a whole state.
///
/// # Errors
/// [`CopyError::Newer`].
pub(super) fn check_whole(held: Option<&Position>, to: &Position, place: &str) -> Result<(), CopyError> {
    match held {
        Some(held) if held.store_id == to.store_id && held.revision > to.revision => Err(CopyError::Newer {
            place: place.to_owned(),
            held: held.revision,
            offered: to.revision,
        }),
        Some(_) | None => Ok(()),
    }
}

/// A copy with commits added to it.
///
/// # Errors
/// [`CopyError::Behind`].
pub(super) fn advanced(
    held: Option<Loaded>,
    position: Position,
    puts: &[Arc<Document>],
    removes: &[Key],
    notes: Option<Notes>,
    place: &str,
) -> Result<Loaded, CopyError> {
    check(held.as_ref().map(|held| &held.position), &position, place)?;
    let (documents, old_notes) = held.map(|held| (held.documents, held.notes)).unwrap_or_default();
    let by_key = documents.into_iter().map(|document| (document.key.clone(), document));
    let mut documents: BTreeMap<Key, Arc<Document>> = by_key.collect();
    for key in removes {
        documents.remove(key);
    }
    for document in puts {
        documents.insert(document.key.clone(), Arc::clone(document));
    }
    Ok(Loaded {
        position,
        documents: documents.into_values().collect(),
        notes: notes.map_or(old_notes, Arc::new),
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::copy::samples::{loaded, notes, position, service};

    #[test]
    fn a_commit_is_added_to_an_older_one_of_its_store_alone() {
        let held = position(5);
        for revision in [5, 6, 9] {
            assert_eq!(check(Some(&held), &position(revision), "x"), Ok(()));
        }
        let other = Position {
            store_id: "store-b".to_owned(),
            ..position(9)
        };
        for (held, to) in [(None, &position(6)), (Some(&held), &position(4)), (Some(&held), &other)] {
            assert!(matches!(check(held, to, "x"), Err(CopyError::Behind { .. })), "{to:?}");
        }
    }

    #[test]
    fn documents_and_notes_follow() {
        let (a, b) = (service("a", 1, json!({})), service("b", 2, json!({})));
        let held = Loaded {
            notes: Arc::new(notes("uid", 1)),
            ..loaded(2, [a.clone(), b.clone()])
        };
        let c = Arc::new(service("c", 3, json!({})));
        let next = advanced(Some(held.clone()), position(3), &[Arc::clone(&c)], &[a.key], None, "x").unwrap();
        assert_eq!(next.documents, [Arc::new(b), c]);
        assert_eq!((next.notes, next.position), (held.notes, position(3)));
    }
}
