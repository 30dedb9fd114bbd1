//! What the copy in MongoDB writes: one head record, and rows.
//!
//! A row is a version of one document: its text, or none where the document is gone from this turn on. User keys are
//! within the text and never become members that the database looks at.
//!
//! ```text
//! _id of a head   edge  or  edge.robot-1                          (copy)
//! _id of a row    edge/0000019a…-4f…/Service/slam@000000000000001c   (copy/generation/key@turn)
//! ```

use blaze_domain::config::Timestamp;
use mongodb::bson::{Bson, Document, doc};

use super::{CopyError, Position};

/// What is written here, and the newest that is read.
const FORMAT: i64 = 1;
/// Stands for the notes where rows of documents have their key. No key begins so.
pub(super) const NOTES: &str = "~notes";

/// Which rows count: those of the generation, of each key the one with the highest turn up to this.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Head {
    pub(super) generation: String,
    pub(super) turn: i64,
    /// How many documents there are then: more or fewer rows are a broken copy.
    pub(super) documents: i64,
    pub(super) position: Position,
}

/// One version of a document, or of the notes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Row {
    pub(super) key: String,
    /// None: gone.
    pub(super) text: Option<String>,
}

/// A generation that sorts behind those that began earlier. `after` is the present one, for clocks may go back.
pub(super) fn new_generation(now_ms: u64, after: Option<&str>) -> String {
    let known = after.and_then(|text| u64::from_str_radix(text.split('-').next()?, 16).ok());
    let start = known.map_or(now_ms, |known| now_ms.max(known.saturating_add(1)));
    format!("{start:016x}-{:016x}", rand::random::<u64>())
}

/// `_id` of a row.
pub(super) fn row_id(copy: &str, generation: &str, key: &str, turn: i64) -> String {
    format!("{copy}/{generation}/{key}@{turn:016x}")
}

/// Filter for all rows of a generation. `0` is the character after `/`.
pub(super) fn of_generation(copy: &str, generation: &str) -> Document {
    doc! { "_id": { "$gte": format!("{copy}/{generation}/"), "$lt": format!("{copy}/{generation}0") } }
}

/// Filter for all rows of earlier generations.
pub(super) fn of_earlier(copy: &str, generation: &str) -> Document {
    doc! { "_id": { "$gte": format!("{copy}/"), "$lt": format!("{copy}/{generation}/") } }
}

/// Filter for the rows of a key before a turn.
pub(super) fn before_turn(copy: &str, generation: &str, key: &str, turn: i64) -> Document {
    let (first, end) = (row_id(copy, generation, key, 0), row_id(copy, generation, key, turn));
    doc! { "_id": { "$gte": first, "$lt": end } }
}

/// A row as it is inserted.
pub(super) fn write_row(copy: &str, generation: &str, turn: i64, row: &Row) -> Document {
    let text = row.text.clone().map_or(Bson::Null, Bson::String);
    doc! { "_id": row_id(copy, generation, &row.key, turn), "text": text }
}

/// Key, turn and text of a row.
pub(super) fn read_row<'f>(
    found: &'f Document,
    copy: &str,
    generation: &str,
) -> Option<(&'f str, i64, Option<&'f str>)> {
    let id = found.get_str("_id").ok()?;
    let rest = id.strip_prefix(copy)?.strip_prefix('/')?;
    let (key, turn) = rest.strip_prefix(generation)?.strip_prefix('/')?.rsplit_once('@')?;
    let text = match found.get("text") {
        Some(Bson::Null) => None,
        Some(Bson::String(text)) => Some(text.as_str()),
        _ => return None,
    };
    Some((key, i64::from_str_radix(turn, 16).ok()?, text))
}

/// The members of a head but its `_id`.
pub(super) fn write_head(head: &Head) -> Document {
    let position = &head.position;
    doc! {
        "format": FORMAT, "generation": &head.generation, "turn": head.turn, "documents": head.documents,
        "store_id": &position.store_id, "layer": position.layer.as_str(),
        "revision": i64::try_from(position.revision).unwrap_or(i64::MAX), "as_of": position.as_of.as_millis(),
    }
}

/// Filter for a head that this one may take the place of, with whatever is in it, unless it is of a later generation, or of a
/// later revision of the same store.
pub(super) fn older_head(copy: &str, head: &Head) -> Document {
    let revision = i64::try_from(head.position.revision).unwrap_or(i64::MAX);
    doc! {
        "_id": copy, "generation": { "$not": { "$gte": &head.generation } },
        "$or": [
            { "store_id": { "$ne": &head.position.store_id } },
            { "revision": { "$not": { "$gt": revision } } },
        ],
    }
}

/// Reads a head.
///
/// # Errors
/// [`CopyError::NewerFormat`], [`CopyError::Broken`].
pub(super) fn read_head(found: &Document, place: &str) -> Result<Head, CopyError> {
    let broken = |member: &str| CopyError::Broken {
        place: place.to_owned(),
        detail: format!("{member} of its head is missing or of another form"),
    };
    let number = |name: &str| integer(found, name).ok_or_else(|| broken(name));
    let text = |name: &str| found.get_str(name).map_err(|_| broken(name));
    let format = number("format")?;
    if format > FORMAT {
        return Err(CopyError::NewerFormat {
            place: place.to_owned(),
            found: format.unsigned_abs(),
            known: FORMAT.unsigned_abs(),
        });
    }
    Ok(Head {
        generation: text("generation")?.to_owned(),
        turn: number("turn")?,
        documents: number("documents")?,
        position: Position {
            store_id: text("store_id")?.to_owned(),
            layer: text("layer")?.parse().map_err(|_| broken("layer"))?,
            revision: u64::try_from(number("revision")?).map_err(|_| broken("revision"))?,
            as_of: Timestamp::from_millis(number("as_of")?),
        },
    })
}

/// In any width, as tools that copy databases do not keep it.
fn integer(found: &Document, name: &str) -> Option<i64> {
    match found.get(name) {
        Some(Bson::Int64(value)) => Some(*value),
        Some(Bson::Int32(value)) => Some(i64::from(*value)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::copy::samples::position;

    #[test]
    fn a_head_and_a_row_read_as_they_were_written() {
        let head = Head {
            generation: new_generation(5, None),
            turn: 3,
            documents: 2,
            position: position(7),
        };
        let mut written = write_head(&head);
        assert_eq!(read_head(&written, "x"), Ok(head));
        written.insert("format", 2);
        assert!(matches!(
            read_head(&written, "x"),
            Err(CopyError::NewerFormat { found: 2, .. })
        ));
        for name in [
            "format",
            "generation",
            "turn",
            "documents",
            "store_id",
            "layer",
            "revision",
            "as_of",
        ] {
            let mut without = written.clone();
            without.insert("format", FORMAT);
            without.insert(name, Bson::Null);
            assert!(
                matches!(read_head(&without, "x"), Err(CopyError::Broken { .. })),
                "{name}"
            );
        }
        for text in [None, Some("{}")] {
            let row = Row {
                key: "Instance/slam/0".to_owned(),
                text: text.map(str::to_owned),
            };
            let written = write_row("edge", "g", 26, &row);
            assert_eq!(read_row(&written, "edge", "g"), Some(("Instance/slam/0", 26, text)));
            assert_eq!(read_row(&written, "edge", "h"), None);
        }
    }

    #[test]
    fn rows_of_one_copy_generation_or_key_are_apart_from_others() {
        let within = |filter: &Document, id: &str| {
            let range = filter.get_document("_id").unwrap();
            (range.get_str("$gte").unwrap()..range.get_str("$lt").unwrap()).contains(&id)
        };
        let (one, two) = (new_generation(5, None), new_generation(6, None));
        let id = |copy: &str, generation: &str, key: &str| row_id(copy, generation, key, 3);
        assert!(within(&of_generation("edge", &one), &id("edge", &one, "Node/a")));
        assert!(within(&of_generation("edge", &one), &id("edge", &one, NOTES)));
        assert!(!within(&of_generation("edge", &one), &id("edge", &two, "Node/a")));
        assert!(within(&of_earlier("edge", &two), &id("edge", &one, NOTES)));
        for (copy, generation) in [("edge", &two), ("edge.robot-1", &one), ("edge-1", &one), ("e", &one)] {
            assert!(
                !within(&of_earlier("edge", &two), &id(copy, generation, "Node/a")),
                "{copy}"
            );
        }
        let before = before_turn("edge", &one, "Node/a", 3);
        assert!(within(&before, &row_id("edge", &one, "Node/a", 2)));
        assert!(!within(&before, &row_id("edge", &one, "Node/a", 3)));
        assert!(!within(&before, &row_id("edge", &one, "Node/a-1", 2)));
    }

    #[test]
    fn a_new_generation_sorts_behind_the_present_one_whatever_the_clock_says() {
        let present = new_generation(1_000, None);
        for now in [0, 999, 1_000, 1_001] {
            assert!(new_generation(now, Some(&present)) > present);
        }
        assert!(new_generation(1, Some("nonsense")) > new_generation(0, None));
    }
}
