//! Documents, positions and notes as JSON, and back.
//!
//! ```text
//! Document ──[Document::to_json]──▶ Value ──[document_from_json]──▶ Document
//! ```
//!
//! What is read was written by this program, and may have been changed by anybody since: nothing is taken for granted, but
//! the rules for what users write are not asked again.

use std::str::FromStr;
use std::sync::Arc;

use blaze_domain::config::{Document, Key, Kind, Labels, Timestamp};
use blaze_domain::{InstanceName, NodeName};
use serde_json::{Map, Value, json};

use super::{Notes, Position};
use crate::core::Place;

/// Which member is missing or of another form. Never repeats a value, for it may be a secret.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{member} {detail}")]
pub struct FormError {
    /// Which member.
    pub member: &'static str,
    /// What is wrong with it.
    pub detail: &'static str,
}

const fn wrong(member: &'static str, detail: &'static str) -> FormError {
    FormError { member, detail }
}

type Members = Map<String, Value>;

fn members(value: Value, member: &'static str) -> Result<Members, FormError> {
    match value {
        Value::Object(members) => Ok(members),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) | Value::Array(_) => {
            Err(wrong(member, "is no object"))
        }
    }
}

fn text<'m>(members: &'m Members, name: &'static str) -> Result<&'m str, FormError> {
    members
        .get(name)
        .and_then(Value::as_str)
        .ok_or(wrong(name, "is no text"))
}

fn parsed<T: FromStr>(members: &Members, name: &'static str) -> Result<T, FormError> {
    text(members, name)?
        .parse()
        .map_err(|_| wrong(name, "breaks the rules for it"))
}

fn optional<T: FromStr>(members: &Members, name: &'static str) -> Result<Option<T>, FormError> {
    match members.get(name) {
        None | Some(Value::Null) => Ok(None),
        Some(_) => parsed(members, name).map(Some),
    }
}

fn whole(members: &Members, name: &'static str) -> Result<u64, FormError> {
    members
        .get(name)
        .and_then(Value::as_u64)
        .ok_or(wrong(name, "is no whole number"))
}

fn labels(members: &mut Members, name: &'static str) -> Result<Labels, FormError> {
    let Some(Value::Object(found)) = members.remove(name) else {
        return Err(wrong(name, "is no object"));
    };
    let entry = |(key, value): (String, Value)| match value {
        Value::String(text) => Ok((key, text)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::Array(_) | Value::Object(_) => {
            Err(wrong(name, "holds what is no text"))
        }
    };
    found.into_iter().map(entry).collect()
}

/// A document with the members that the server sets, as [`Document::to_json`] writes it.
///
/// # Errors
/// [`FormError`]: the first member that is missing or of another form.
pub fn document_from_json(value: Value) -> Result<Document, FormError> {
    let mut members = members(value, "document")?;
    let kind: Kind = parsed(&members, "kind")?;
    let key = Key::new(kind, optional(&members, "service")?, parsed(&members, "name")?)
        .map_err(|_| wrong("service", "does not go with the kind"))?;
    Ok(Document {
        key,
        uid: text(&members, "uid")?.to_owned(),
        revision: whole(&members, "revision")?,
        create_time: parsed(&members, "create_time")?,
        update_time: parsed(&members, "update_time")?,
        updated_by: text(&members, "updated_by")?.to_owned(),
        labels: labels(&mut members, "labels")?,
        annotations: labels(&mut members, "annotations")?,
        spec: Arc::new(members.remove("spec").ok_or(wrong("spec", "is missing"))?),
        status: members.remove("status"),
    })
}

/// A document from its text.
///
/// # Errors
/// As [`document_from_json`].
pub(super) fn document_from_text(text: &[u8]) -> Result<Document, FormError> {
    document_from_json(value_from_text(text)?)
}

/// Any value from its text.
///
/// # Errors
/// [`FormError`] that repeats nothing of it.
pub(super) fn value_from_text(text: &[u8]) -> Result<Value, FormError> {
    serde_json::from_slice(text).map_err(|_| wrong("text", "is no JSON"))
}

pub(super) fn position_to_json(position: &Position) -> Value {
    json!({
        "store_id": position.store_id, "layer": position.layer.as_str(), "revision": position.revision,
        "as_of": position.as_of.to_string(),
    })
}

pub(super) fn position_from_json(value: Value) -> Result<Position, FormError> {
    let members = members(value, "position")?;
    Ok(Position {
        store_id: text(&members, "store_id")?.to_owned(),
        layer: parsed(&members, "layer")?,
        revision: whole(&members, "revision")?,
        as_of: parsed::<Timestamp>(&members, "as_of")?,
    })
}

pub(super) fn notes_to_json(notes: &Notes) -> Value {
    let place = |place: &Place| {
        json!({
            "service": place.service.as_str(), "instance": place.instance.as_ref().map(InstanceName::as_str),
            "node": place.node.as_ref().map(NodeName::as_str),
        })
    };
    let places: Vec<Value> = notes.places.iter().map(place).collect();
    json!({ "failed": notes.failed, "places": places, "floor": notes.floor })
}

pub(super) fn notes_from_json(value: Value) -> Result<Notes, FormError> {
    let mut members = members(value, "notes")?;
    let floor = whole(&members, "floor")?;
    let mut list = |name: &'static str| match members.remove(name) {
        Some(Value::Array(items)) => Ok(items),
        _ => Err(wrong(name, "is no list")),
    };
    let uid = |uid: Value| match uid {
        Value::String(uid) => Ok(uid),
        _ => Err(wrong("failed", "holds what is no text")),
    };
    let place = |place: Value| {
        let place = self::members(place, "places")?;
        Ok(Place {
            service: parsed(&place, "service")?,
            instance: optional(&place, "instance")?,
            node: optional(&place, "node")?,
        })
    };
    Ok(Notes {
        failed: list("failed")?.into_iter().map(uid).collect::<Result<_, _>>()?,
        places: list("places")?.into_iter().map(place).collect::<Result<_, _>>()?,
        floor,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::copy::samples::{any_bytes_of, any_document, any_notes, loaded};

    proptest! {
        #[test]
        fn a_document_reads_as_it_was_written(document in any_document()) {
            let text = document.to_json().to_string();
            prop_assert_eq!(document_from_text(text.as_bytes()).unwrap(), document);
        }

        #[test]
        fn notes_read_as_they_were_written(notes in any_notes()) {
            let text = notes_to_json(&notes).to_string();
            let value = value_from_text(text.as_bytes()).unwrap();
            prop_assert_eq!(notes_from_json(value).unwrap(), notes);
        }

        #[test]
        fn what_is_cut_off_or_changed_is_no_reason_to_panic(
            bytes in any_document().prop_flat_map(|document| any_bytes_of(document.to_json().to_string().into_bytes())),
        ) {
            let _ = document_from_text(&bytes);
        }
    }

    #[test]
    fn each_member_is_needed_and_has_a_form() {
        let document = crate::copy::samples::service("slam", 7, json!({ "config": {} })).to_json();
        for name in [
            "kind",
            "name",
            "uid",
            "revision",
            "create_time",
            "update_time",
            "updated_by",
            "labels",
            "annotations",
            "spec",
        ] {
            let mut without = document.clone();
            without.as_object_mut().unwrap().remove(name);
            assert!(document_from_json(without).is_err(), "{name}");
            if name != "spec" {
                let mut other = document.clone();
                other[name] = json!([{}]);
                assert_eq!(document_from_json(other).unwrap_err().member, name);
            }
        }
        let mut placed = document;
        placed["service"] = json!("slam");
        assert_eq!(document_from_json(placed).unwrap_err().member, "service");
        assert!(document_from_json(json!([])).is_err());
    }

    #[test]
    fn a_position_reads_as_it_was_written() {
        let position = loaded(7, []).position;
        assert_eq!(position_from_json(position_to_json(&position)), Ok(position));
        assert!(position_from_json(json!({ "store_id": "a" })).is_err());
    }
}
