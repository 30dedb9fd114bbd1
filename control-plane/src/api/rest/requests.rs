//! Small bodies of requests (`{"revision":412}`): read strictly; `openapi/parts.yaml` describes the
//! same.

use blaze_domain::LayerName;
use blaze_domain::config::{Code, FieldFault, Problem, json as pointers};
use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer};
use serde_json::Value;
use serde_path_to_error::Segment;

use crate::api::DEFAULT_TOKEN_LIFE_S;

/// Largest revision.
const MAX_REVISION: u64 = blaze_domain::config::MAX_INTEGER.unsigned_abs();
/// Longest life of a token, in seconds: a year.
pub(super) const MAX_LIFE_S: u64 = 31_536_000;
/// Longest subject of a token, in characters.
const MAX_SUBJECT: usize = 256;
/// Longest reason of an aborted roll-out, in characters.
pub(super) const MAX_REASON: usize = 1000;

/// Request of a rollback.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RollbackRequest {
    /// Content as it was at this revision.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    pub(super) revision: u64,
}

/// Request of a revert.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RevertRequest {
    /// The commit whose changes are taken back.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    pub(super) revision: u64,
    /// Also documents that were changed since.
    #[serde(default)]
    pub(super) force: bool,
}

/// Request to trim the history.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TrimRequest {
    /// Commits before this revision are forgotten.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    pub(super) before: u64,
}

/// Request to abort a roll-out.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AbortRequest {
    /// For people.
    #[serde(default, deserialize_with = "text::<_, 0, MAX_REASON>")]
    pub(super) reason: String,
}

/// Request for a token.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TokenRequest {
    #[serde(deserialize_with = "text::<_, 1, MAX_SUBJECT>")]
    pub(super) subject: String,
    pub(super) roles: Vec<String>,
    #[serde(default)]
    pub(super) layer: Option<LayerName>,
    #[serde(default = "default_life_s", deserialize_with = "whole::<_, 1, MAX_LIFE_S>")]
    pub(super) expires_in_s: u64,
}

fn default_life_s() -> u64 {
    DEFAULT_TOKEN_LIFE_S.into()
}

fn whole<'de, D: Deserializer<'de>, const LEAST: u64, const MOST: u64>(
    from: D,
) -> Result<u64, D::Error> {
    let number = u64::deserialize(from)?;
    match (LEAST..=MOST).contains(&number) {
        true => Ok(number),
        false => Err(D::Error::custom(format!("is no whole number from {LEAST} to {MOST}"))),
    }
}

fn text<'de, D: Deserializer<'de>, const LEAST: usize, const MOST: usize>(
    from: D,
) -> Result<String, D::Error> {
    let text = String::deserialize(from)?;
    match (LEAST..=MOST).contains(&text.chars().count()) {
        true => Ok(text),
        false => Err(D::Error::custom(format!("has not {LEAST} to {MOST} characters"))),
    }
}

/// Reads a body.
///
/// # Errors
/// `validation_failed` with the place of the first fault.
pub(super) fn read<T: DeserializeOwned>(body: &Value) -> Result<T, Problem> {
    // A list would be taken as the members in their order.
    if !body.is_object() {
        return Err(fault("", "is not an object"));
    }
    serde_path_to_error::deserialize(body).map_err(|error| {
        let detail = error.inner().to_string();
        let missing =
            detail.strip_prefix("missing field `").and_then(|name| name.strip_suffix('`'));
        let path = error.path().iter().filter_map(|segment| match segment {
            Segment::Map { key } => Some(key.clone()),
            Segment::Seq { index } => Some(index.to_string()),
            Segment::Enum { .. } | Segment::Unknown => None,
        });
        let path = path.chain(missing.map(str::to_owned));
        let pointer = path.fold(String::new(), |pointer, name| pointers::push(&pointer, &name));
        fault(&pointer, &detail)
    })
}

/// One fault of a body.
pub(super) fn fault(pointer: &str, detail: &str) -> Problem {
    Problem::faults(vec![FieldFault {
        pointer: pointer.to_owned(),
        code: Code::ValidationFailed,
        detail: detail.chars().take(300).collect(),
        document: None,
    }])
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn pointer<T: DeserializeOwned + std::fmt::Debug>(body: &Value) -> String {
        read::<T>(body).unwrap_err().errors.remove(0).pointer
    }

    #[test]
    fn a_fault_has_its_place() {
        for (body, place) in [
            (json!({ "revision": -1 }), "/revision"),
            (json!({ "revision": 0 }), "/revision"),
            (json!({ "revision": 1.5 }), "/revision"),
            (json!({ "revision": "1" }), "/revision"),
            (json!({ "revision": 1, "force": "yes" }), "/force"),
            (json!({ "revision": 1, "force": null }), "/force"),
            (json!({ "revision": 1, "a/b": 1 }), "/a~1b"),
            (json!({ "force": true }), "/revision"),
            (json!([1, true]), ""),
            (json!(null), ""),
        ] {
            assert_eq!(pointer::<RevertRequest>(&body), place, "{body}");
        }
        let long = "x".repeat(MAX_REASON + 1);
        assert_eq!(pointer::<AbortRequest>(&json!({ "reason": long })), "/reason");
    }

    #[test]
    fn what_fits_is_read() {
        let read: RevertRequest = read(&json!({ "revision": 7 })).unwrap();
        assert_eq!((read.revision, read.force), (7, false));
        let read: AbortRequest = super::read(&json!({})).unwrap();
        assert_eq!(read.reason, "");
    }
}
