//! How kinds and documents are written on the command line, and where they are in the API.

use blaze_domain::config::{Document, Key, KeyError, Kind};
use blaze_domain::{DocumentName, ServiceName};
use serde_json::Value;

use crate::admin::closest;
use crate::exit::CliError;

/// Base of all paths.
pub(crate) const BASE: &str = "/api/v1";

/// The words for each kind; the first is the one that is printed.
const WORDS: [(Kind, [&str; 3]); 5] = [
    (Kind::Layer, ["layer", "layers", "ly"]),
    (Kind::Node, ["node", "nodes", "no"]),
    (Kind::Service, ["service", "services", "svc"]),
    (Kind::Instance, ["instance", "instances", "inst"]),
    (Kind::Rollout, ["rollout", "rollouts", "ro"]),
];

/// `KIND` or `KIND/NAME`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Target {
    /// Which kind.
    pub kind: Kind,
    /// What stands behind the slash.
    pub name: Option<String>,
}

impl Target {
    /// The document that is meant, with what stands as NAME.
    ///
    /// # Errors
    /// [`CliError::Usage`]: no name, two names, or a bad one.
    pub fn key(&self, name: Option<&str>) -> Result<Key, CliError> {
        let word = self.kind.word();
        self.optional_key(name)?.ok_or_else(|| {
            let form = match self.kind {
                Kind::Instance => "SERVICE/NAME, such as slam/0",
                Kind::Layer | Kind::Node | Kind::Service | Kind::Rollout => "NAME",
            };
            CliError::Usage(format!("which {word}? Give {form}; `blaze get {word}s` lists them"))
        })
    }

    /// The document that is meant, if one is.
    ///
    /// # Errors
    /// [`CliError::Usage`]: two names, or a bad one.
    pub fn optional_key(&self, name: Option<&str>) -> Result<Option<Key>, CliError> {
        match (self.name.as_deref(), name) {
            (None, None) => Ok(None),
            (Some(name), None) | (None, Some(name)) => {
                parse_key(self.kind, name).map(Some).map_err(CliError::Usage)
            }
            (Some(first), Some(second)) => Err(CliError::Usage(format!(
                "{}/{first} and {second}: only one name is allowed",
                self.kind.word()
            ))),
        }
    }
}

/// Reads `KIND` or `KIND/NAME`.
///
/// # Errors
/// In words, with what may have been meant.
pub(crate) fn parse_target(text: &str) -> Result<Target, String> {
    let (word, name) = match text.split_once('/') {
        Some((word, name)) => (word, Some(name.to_owned())),
        None => (text, None),
    };
    let kind = parse_kind(word)?;
    Ok(Target { kind, name })
}

/// Reads the word of a kind: singular, plural or short, in any case.
///
/// # Errors
/// In words, with what may have been meant.
pub(crate) fn parse_kind(word: &str) -> Result<Kind, String> {
    let wanted = word.to_ascii_lowercase();
    let found = WORDS.iter().find(|(_, words)| words.contains(&wanted.as_str()));
    found.map(|(kind, _)| *kind).ok_or_else(|| {
        let words = WORDS.iter().flat_map(|(_, words)| words.iter().copied());
        let meant = closest(&wanted, words)
            .map_or_else(String::new, |word| format!("; did you mean {word}?"));
        format!(
            "{word:?} is no kind: layer (ly), node (no), service (svc), instance (inst), rollout \
             (ro){meant}",
        )
    })
}

/// The key of a document from its name; of an instance from `SERVICE/NAME`.
///
/// # Errors
/// In words, with what may have been meant.
pub(crate) fn parse_key(kind: Kind, text: &str) -> Result<Key, String> {
    let (service, name) = match (kind, text.split_once('/')) {
        (Kind::Instance, Some((service, name))) => (Some(parse_service(service)?), name),
        (Kind::Instance, None) if text.is_empty() => {
            return Err(
                "an instance is SERVICE/NAME, such as slam/0; `blaze get instances` lists all"
                    .to_owned(),
            );
        }
        (Kind::Instance, None) => {
            return Err(format!(
                "an instance is SERVICE/NAME, such as {text}/0; `blaze get instances --service \
                 {text}` lists those of {text}"
            ));
        }
        (Kind::Layer | Kind::Node | Kind::Service | Kind::Rollout, _) => (None, text),
    };
    let name = name.parse::<DocumentName>().map_err(|error| bad_name(name, &error))?;
    Key::new(kind, service, name).map_err(|error| error.to_string())
}

/// The name of a service.
///
/// # Errors
/// In words, with what may have been meant.
pub(crate) fn parse_service(text: &str) -> Result<ServiceName, String> {
    text.parse::<ServiceName>().map_err(|error| bad_name(text, &error))
}

fn bad_name(text: &str, error: &dyn std::fmt::Display) -> String {
    let meant = text.trim().to_ascii_lowercase().replace(['_', ' ', '.'], "-");
    match meant.parse::<DocumentName>() {
        Ok(meant) if meant.as_str() != text => format!("{text:?} {error}; did you mean {meant}?"),
        _ => format!("{text:?} {error}"),
    }
}

/// How a document is called on the command line: `node/robot-1`, `instance/slam/0`.
pub(crate) fn name_of(key: &Key) -> String {
    match key.service_name() {
        Some(service) => format!("{}/{service}/{}", key.kind().word(), key.name()),
        None => format!("{}/{}", key.kind().word(), key.name()),
    }
}

/// The key in the members `kind`, `name` and `service` of a document or result.
///
/// # Errors
/// In words: what is missing or bad.
pub(crate) fn key_of(value: &Value) -> Result<Key, String> {
    let text = |name: &str| value.get(name).and_then(Value::as_str);
    let kind =
        text("kind").ok_or("has no kind; it is Layer, Node, Service, Instance or Rollout")?;
    let kind = kind.parse::<Kind>().map_err(|_| unknown_kind(kind))?;
    let name = text("name").ok_or("has no name")?;
    let name =
        name.parse::<DocumentName>().map_err(|error| format!("name {}", bad_name(name, &error)))?;
    let service = text("service")
        .map(parse_service)
        .transpose()
        .map_err(|error| format!("service {error}"))?;
    Key::new(kind, service, name).map_err(|error: KeyError| error.to_string())
}

/// A document of the server as far as the rules of the domain need it: what it refers to, and where
/// it counts.
///
/// # Errors
/// In words: what is missing or bad.
pub(crate) fn document_of(value: &Value) -> Result<Document, String> {
    Ok(Document {
        status: value.get("status").cloned(),
        ..Document::new(key_of(value)?, value.get("spec").cloned().unwrap_or_default())
    })
}

fn unknown_kind(found: &str) -> String {
    let kinds = Kind::ALL.iter().map(|kind| kind.as_str());
    let near = parse_kind(found).map(Kind::as_str).ok().or_else(|| closest(found, kinds));
    let meant = near.map_or_else(String::new, |kind| format!("; did you mean {kind}?"));
    format!("kind {found:?} is not Layer, Node, Service, Instance or Rollout{meant}")
}

/// Path of a collection. Instances of `None` are those of all services.
pub(crate) fn collection_path(kind: Kind, service: Option<&ServiceName>) -> String {
    match (kind, service) {
        (Kind::Instance, Some(service)) => format!("{BASE}/services/{service}/instances"),
        (Kind::Instance, None) => format!("{BASE}/services/-/instances"),
        (Kind::Layer | Kind::Node | Kind::Service | Kind::Rollout, _) => {
            format!("{BASE}/{}", kind.collection())
        }
    }
}

/// Path of a document.
pub(crate) fn document_path(key: &Key) -> String {
    format!("{}/{}", collection_path(key.kind(), key.service_name()), key.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn kinds_have_three_words_in_any_case() {
        for (kind, words) in WORDS {
            for word in words {
                assert_eq!(parse_kind(word), Ok(kind));
                assert_eq!(parse_kind(&word.to_uppercase()), Ok(kind));
            }
            assert_eq!(parse_kind(kind.as_str()), Ok(kind));
        }
    }

    #[test]
    fn unknown_kinds_get_a_suggestion() {
        assert!(parse_kind("ndoes").unwrap_err().ends_with("did you mean nodes?"));
        let error = parse_kind("zebra").unwrap_err();
        assert!(error.contains("instance (inst)") && !error.contains("did you mean"), "{error}");
    }

    #[test]
    fn documents_are_written_in_two_ways() {
        let key = |target: &str, name: Option<&str>| parse_target(target).unwrap().key(name);
        for (target, name, path) in [
            ("node", Some("robot-1"), "/api/v1/nodes/robot-1"),
            ("no/robot-1", None, "/api/v1/nodes/robot-1"),
            ("instance", Some("slam/0"), "/api/v1/services/slam/instances/0"),
            ("inst/slam/0", None, "/api/v1/services/slam/instances/0"),
            ("ro/slower", None, "/api/v1/rollouts/slower"),
        ] {
            assert_eq!(document_path(&key(target, name).unwrap()), path);
        }
        for (target, name, why) in [
            ("node", None, "`blaze get nodes` lists them"),
            ("instance", None, "such as slam/0"),
            ("instance", Some("slam"), "such as slam/0"),
            ("instance", Some(""), "such as slam/0"),
            ("node/a", Some("b"), "only one name"),
            ("node", Some("Robot_1"), "did you mean robot-1?"),
            ("node", Some("a/b"), "holds '/'"),
            ("node/", None, "is empty"),
            ("instance/slam/0/1", None, "holds '/'"),
        ] {
            let error = key(target, name).unwrap_err();
            assert!(matches!(error, CliError::Usage(_)));
            assert!(error.to_string().contains(why), "{target} {name:?}: {error}");
        }
    }

    #[test]
    fn a_document_says_its_key() {
        let key = key_of(&json!({"kind": "Instance", "service": "slam", "name": "0"})).unwrap();
        assert_eq!(name_of(&key), "instance/slam/0");
        for (value, why) in [
            (json!({"name": "a"}), "has no kind"),
            (json!({"kind": "node", "name": "a"}), "did you mean Node?"),
            (json!({"kind": "Serivce", "name": "a"}), "did you mean Service?"),
            (json!({"kind": "Node"}), "has no name"),
            (json!({"kind": "Node", "name": "A"}), "did you mean a?"),
            (json!({"kind": "Instance", "name": "0"}), "needs its service"),
            (json!({"kind": "Node", "name": "a", "service": "slam"}), "has no service"),
        ] {
            let error = key_of(&value).unwrap_err();
            assert!(error.contains(why), "{value}: {error}");
        }
    }

    #[test]
    fn instances_of_all_services_have_a_path() {
        assert_eq!(collection_path(Kind::Instance, None), "/api/v1/services/-/instances");
    }
}
