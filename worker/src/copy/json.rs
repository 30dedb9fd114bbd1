//! Documents of a copy from JSON, as [`Document::to_json`] writes them.
//!
//! What is read was written by this program, and may have been changed by anybody since: nothing is
//! taken for granted, but the rules for what users write are not asked again.

use std::sync::Arc;

use blaze_domain::config::{Document, Key, Kind, Labels, Timestamp};
use blaze_domain::{DocumentName, ServiceName};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

#[derive(Deserialize)]
struct Written {
    kind: Kind,
    service: Option<ServiceName>,
    name: DocumentName,
    uid: String,
    revision: u64,
    #[serde(with = "time")]
    create_time: Timestamp,
    #[serde(with = "time")]
    update_time: Timestamp,
    updated_by: String,
    labels: Labels,
    annotations: Labels,
    spec: Value,
    status: Option<Value>,
}

/// A document from its text.
///
/// # Errors
/// As [`read`].
pub(super) fn document(text: &[u8]) -> Result<Document, String> {
    let written: Written = read(text)?;
    let key = Key::new(written.kind, written.service, written.name);
    Ok(Document {
        key: key.map_err(|_| "its service does not go with its kind")?,
        uid: written.uid,
        revision: written.revision,
        create_time: written.create_time,
        update_time: written.update_time,
        updated_by: written.updated_by,
        labels: written.labels,
        annotations: written.annotations,
        spec: Arc::new(written.spec),
        status: written.status,
    })
}

/// A value from its text.
///
/// # Errors
/// Where it has another form. Never repeats what is there, for it may be a secret.
pub(super) fn read<T: DeserializeOwned>(text: &[u8]) -> Result<T, String> {
    serde_json::from_slice(text)
        .map_err(|error| format!("has another form at column {}", error.column()))
}

/// Times as they are written elsewhere.
pub(super) mod time {
    use blaze_domain::config::Timestamp;
    use serde::{Deserialize as _, Deserializer, Serializer, de};

    pub(in crate::copy) fn serialize<S: Serializer>(
        time: &Timestamp,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_str(time)
    }

    pub(in crate::copy) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Timestamp, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::copy::samples::{any_bytes_of, any_document, service};

    proptest! {
        #[test]
        fn what_is_cut_off_or_changed_is_no_reason_to_panic(
            bytes in any_document()
                .prop_flat_map(|document| any_bytes_of(document.to_json().to_string()
                .into_bytes())),
        ) {
            let _ = document(&bytes);
        }
    }

    #[test]
    fn what_is_missing_is_found_and_no_value_is_repeated() {
        let whole = service("slam", 7, json!({ "config": {} })).to_json();
        for name in ["kind", "uid", "revision", "create_time", "labels", "spec"] {
            let mut without = whole.clone();
            without.as_object_mut().unwrap().remove(name);
            assert!(document(without.to_string().as_bytes()).is_err(), "{name}");
        }
        let mut other = whole.clone();
        other["labels"] = json!("canary");
        let error = document(other.to_string().as_bytes()).unwrap_err();
        assert!(error.contains("column") && !error.contains("canary"), "{error}");
        let mut placed = whole;
        placed["service"] = json!("slam");
        assert!(document(placed.to_string().as_bytes()).is_err());
    }
}
