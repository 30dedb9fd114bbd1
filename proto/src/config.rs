//! Documents of the configuration as they travel over gRPC, and back.
//!
//! ```text
//! blaze_domain::config::{Key, Document, Timestamp, Kind} ◄──► v1::{Ref, Document, Kind}, google::Timestamp
//! ```
//!
//! What comes in is checked here for its form only (names, JSON, known kinds); whether a document
//! makes sense is for those who keep it.

use std::sync::Arc;

use blaze_domain::NameError;
use blaze_domain::config::{Document, Key, KeyError, Kind, Timestamp, json};
use serde_json::{Map, Value};

use crate::{google, v1};

/// A message that says nothing sensible.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A member that must be there is not.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// The number of a kind that is not known here.
    #[error("kind {0} is not known")]
    Kind(i32),
    /// Kind, name and service do not go together, or break the rules of names.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// Text that is to be JSON and is not, or breaks a rule of ours for it.
    #[error("{member}: {detail}")]
    Json {
        /// Which member.
        member: &'static str,
        /// What is wrong with it, and where.
        detail: String,
    },
}

impl From<NameError> for WireError {
    fn from(error: NameError) -> Self {
        Self::Key(KeyError::Name(error))
    }
}

impl From<Kind> for v1::Kind {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Layer => Self::Layer,
            Kind::Node => Self::Node,
            Kind::Service => Self::Service,
            Kind::Instance => Self::Instance,
            Kind::Rollout => Self::Rollout,
        }
    }
}

/// The kind of a number; `None` for the one that means that none is given.
///
/// # Errors
/// [`WireError::Kind`].
pub fn kind_from_wire(number: i32) -> Result<Option<Kind>, WireError> {
    match v1::Kind::try_from(number) {
        Ok(v1::Kind::Unspecified) => Ok(None),
        Ok(v1::Kind::Layer) => Ok(Some(Kind::Layer)),
        Ok(v1::Kind::Node) => Ok(Some(Kind::Node)),
        Ok(v1::Kind::Service) => Ok(Some(Kind::Service)),
        Ok(v1::Kind::Instance) => Ok(Some(Kind::Instance)),
        Ok(v1::Kind::Rollout) => Ok(Some(Kind::Rollout)),
        Err(_) => Err(WireError::Kind(number)),
    }
}

impl From<&Key> for v1::Ref {
    fn from(key: &Key) -> Self {
        Self {
            kind: v1::Kind::from(key.kind()).into(),
            name: key.name().as_str().to_owned(),
            service: key.service_name().map_or_else(String::new, |name| name.as_str().to_owned()),
        }
    }
}

impl TryFrom<&v1::Ref> for Key {
    type Error = WireError;
    fn try_from(wire: &v1::Ref) -> Result<Self, WireError> {
        let kind = kind_from_wire(wire.kind)?.ok_or(WireError::Missing("kind"))?;
        let service = match wire.service.as_str() {
            "" => None,
            name => Some(name.parse()?),
        };
        Ok(Self::new(kind, service, wire.name.parse()?)?)
    }
}

/// A time as it travels.
#[must_use]
pub fn timestamp_to_wire(time: Timestamp) -> google::Timestamp {
    let millis = time.as_millis();
    google::Timestamp {
        seconds: millis.div_euclid(1000),
        // Below 1,000,000,000, whatever the milliseconds are.
        nanos: i32::try_from(millis.rem_euclid(1000) * 1_000_000).unwrap_or_default(),
    }
}

/// A time that came, cut to milliseconds; one that is not given is the beginning of 1970, one that
/// is out of range the nearest that is not.
#[must_use]
pub fn timestamp_from_wire(wire: Option<&google::Timestamp>) -> Timestamp {
    let Some(wire) = wire else {
        return Timestamp::default();
    };
    let millis = i64::from(wire.nanos).div_euclid(1_000_000);
    Timestamp::from_millis(wire.seconds.saturating_mul(1000).saturating_add(millis))
}

impl From<&Document> for v1::Document {
    fn from(document: &Document) -> Self {
        Self {
            r#ref: Some((&document.key).into()),
            labels: document.labels.clone(),
            annotations: document.annotations.clone(),
            spec_json: document.spec.to_string(),
            uid: document.uid.clone(),
            revision: document.revision,
            create_time: Some(timestamp_to_wire(document.create_time)),
            update_time: Some(timestamp_to_wire(document.update_time)),
            updated_by: document.updated_by.clone(),
            status_json: document.status.as_ref().map_or_else(String::new, Value::to_string),
        }
    }
}

impl TryFrom<v1::Document> for Document {
    type Error = WireError;
    fn try_from(wire: v1::Document) -> Result<Self, WireError> {
        let status = match wire.status_json.as_str() {
            "" => None,
            text => Some(parse("status_json", text)?),
        };
        Ok(Self {
            key: wire.r#ref.as_ref().ok_or(WireError::Missing("ref"))?.try_into()?,
            uid: wire.uid,
            revision: wire.revision,
            create_time: timestamp_from_wire(wire.create_time.as_ref()),
            update_time: timestamp_from_wire(wire.update_time.as_ref()),
            updated_by: wire.updated_by,
            labels: wire.labels,
            annotations: wire.annotations,
            spec: Arc::new(object_from_wire("spec_json", &wire.spec_json)?),
            status,
        })
    }
}

/// JSON in a member of a message, read as strictly as a request of REST; empty text is an empty
/// object.
///
/// # Errors
/// [`WireError::Json`].
pub fn object_from_wire(member: &'static str, text: &str) -> Result<Value, WireError> {
    if text.is_empty() {
        return Ok(Value::Object(Map::new()));
    }
    parse(member, text)
}

fn parse(member: &'static str, text: &str) -> Result<Value, WireError> {
    json::parse(text.as_bytes())
        .map_err(|error| WireError::Json { member, detail: error.to_string() })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::Message;

    fn key() -> impl Strategy<Value = Key> {
        let name = "[a-z0-9]([a-z0-9-]{0,20}[a-z0-9])?";
        prop_oneof![
            ("Layer|Node|Service|Rollout", name).prop_map(|(kind, name)| format!("{kind}/{name}")),
            (name, name).prop_map(|(service, name)| format!("Instance/{service}/{name}")),
        ]
        .prop_map(|text| text.parse().unwrap())
    }

    fn labels() -> impl Strategy<Value = blaze_domain::config::Labels> {
        proptest::collection::btree_map("[a-z/.]{1,8}", "\\PC{0,8}", 0..5)
    }

    fn document() -> impl Strategy<Value = Document> {
        let times = (any::<i64>(), any::<i64>());
        (key(), labels(), labels(), any::<u64>(), times, any::<Option<i32>>()).prop_map(
            |(key, labels, annotations, revision, (create, update), number)| Document {
                key,
                uid: "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11".into(),
                revision,
                create_time: Timestamp::from_millis(create),
                update_time: Timestamp::from_millis(update),
                updated_by: "ops".into(),
                labels,
                annotations,
                spec: Arc::new(json!({"z": {"a": number}, "b": [null, "ä", 1.5]})),
                status: number.map(|number| json!({"phase": number})),
            },
        )
    }

    proptest! {
        #[test]
        fn a_document_comes_back_as_it_went(document in document()) {
            let bytes = v1::Document::from(&document).encode_to_vec();
            let wire = v1::Document::decode(bytes.as_slice()).unwrap();
            // The same document is the same bytes: a hash of a request relies on it.
            prop_assert_eq!(wire.encode_to_vec(), bytes);
            prop_assert_eq!(Document::try_from(wire).unwrap(), document);
        }

        #[test]
        fn any_time_becomes_one_in_range(seconds in any::<i64>(), nanos in any::<i32>()) {
            let time = timestamp_from_wire(Some(&google::Timestamp { seconds, nanos }));
            prop_assert_eq!(timestamp_from_wire(Some(&timestamp_to_wire(time))), time);
        }
    }

    fn reference(kind: i32, service: &str, name: &str) -> v1::Ref {
        v1::Ref { kind, name: name.into(), service: service.into() }
    }

    #[test]
    fn every_kind_has_its_number_and_others_are_refused() {
        for kind in Kind::ALL {
            assert_eq!(kind_from_wire(v1::Kind::from(*kind).into()), Ok(Some(*kind)));
        }
        assert_eq!(kind_from_wire(0), Ok(None));
        assert_eq!(kind_from_wire(6), Err(WireError::Kind(6)));
        assert_eq!(kind_from_wire(-1), Err(WireError::Kind(-1)));
    }

    #[test]
    fn what_is_no_name_is_refused_with_its_reason() {
        for (wire, reason) in [
            (reference(0, "", "a"), "kind is missing"),
            (reference(9, "", "a"), "kind 9 is not known"),
            (reference(4, "", "0"), "an Instance needs its service"),
            (reference(2, "slam", "a"), "a Node has no service"),
        ] {
            assert_eq!(Key::try_from(&wire).unwrap_err().to_string(), reason);
        }
        for name in ["", "A", "a/b", "-a"] {
            assert!(Key::try_from(&reference(1, "", name)).is_err(), "{name:?}");
        }
    }

    #[test]
    fn json_is_read_strictly_and_empty_text_is_an_empty_object() {
        assert_eq!(object_from_wire("spec_json", ""), Ok(json!({})));
        assert_eq!(object_from_wire("spec_json", r#"{"a":1}"#), Ok(json!({"a": 1})));
        for text in [r#"{"a":1,"a":2}"#, "{", "{} {}", r#"{"a":9007199254740992}"#, " "] {
            let error = object_from_wire("spec_json", text).unwrap_err();
            assert!(error.to_string().starts_with("spec_json: "), "{text}: {error}");
        }
    }

    #[test]
    fn the_descriptors_hold_all_services_whole() {
        let set = google::FileDescriptorSet::decode(crate::CONFIG_DESCRIPTORS).unwrap();
        let mut services: Vec<_> = set
            .file
            .iter()
            .flat_map(|file| &file.service)
            .map(google::ServiceDescriptorProto::name)
            .collect();
        services.sort_unstable();
        assert_eq!(services, ["ConfigService", "StatusService", "SyncService"]);
        assert!(set.file.iter().any(|file| file.name() == "google/protobuf/timestamp.proto"));
        assert!(!set.file.iter().any(|file| file.name().contains("control.proto")));
    }
}
