//! Small bodies of requests (`{"revision":412}`): read strictly, and described in the OpenAPI document by the same types.

use blaze_domain::LayerName;
use blaze_domain::config::{Code, FieldFault, Problem, json as pointers};
use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer};
use serde_json::Value;
use serde_path_to_error::Segment;
use utoipa::ToSchema;

use super::openapi::{layer_or_null, roles};
use crate::api::DEFAULT_TOKEN_LIFE_S;

/// Largest revision.
const MAX_REVISION: u64 = blaze_domain::config::MAX_INTEGER.unsigned_abs();
/// Longest life of a token, in seconds: a year.
const MAX_LIFE_S: u64 = 31_536_000;
/// Longest subject of a token, in characters.
const MAX_SUBJECT: usize = 256;
/// Longest reason of an aborted roll-out, in characters.
const MAX_REASON: usize = 1000;

/// Request of a rollback.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(examples(json!({ "revision": 7 })))]
pub(super) struct RollbackRequest {
    /// Content as it was at this revision.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    #[schema(minimum = 1, maximum = 9007199254740991i64)]
    pub(super) revision: u64,
}

/// Request of a revert.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(examples(json!({ "revision": 7, "force": false })))]
pub(super) struct RevertRequest {
    /// The commit whose changes are taken back.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    #[schema(minimum = 1, maximum = 9007199254740991i64)]
    pub(super) revision: u64,
    /// Also documents that were changed since.
    #[serde(default)]
    #[schema(default = false)]
    pub(super) force: bool,
}

/// Request to trim the history.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(examples(json!({ "before": 1 })))]
pub(super) struct TrimRequest {
    /// Commits before this revision are forgotten.
    #[serde(deserialize_with = "whole::<_, 1, MAX_REVISION>")]
    #[schema(minimum = 1, maximum = 9007199254740991i64)]
    pub(super) before: u64,
}

/// Request to abort a roll-out.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(examples(json!({ "reason": "too slow" })))]
pub(super) struct AbortRequest {
    /// For people.
    #[serde(default, deserialize_with = "text::<_, 0, MAX_REASON>")]
    #[schema(max_length = 1000)]
    pub(super) reason: String,
}

/// Request for a token.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(examples(json!({ "subject": "ops@example.org", "roles": ["operator"], "layer": null, "expires_in_s": 86400 })))]
pub(super) struct TokenRequest {
    #[serde(deserialize_with = "text::<_, 1, MAX_SUBJECT>")]
    #[schema(min_length = 1, max_length = 256)]
    pub(super) subject: String,
    #[schema(schema_with = roles)]
    pub(super) roles: Vec<String>,
    #[serde(default)]
    #[schema(schema_with = layer_or_null)]
    pub(super) layer: Option<LayerName>,
    #[serde(default = "default_life_s", deserialize_with = "whole::<_, 1, MAX_LIFE_S>")]
    #[schema(default = 86400, minimum = 1, maximum = 31536000)]
    pub(super) expires_in_s: u64,
}

fn default_life_s() -> u64 {
    DEFAULT_TOKEN_LIFE_S.into()
}

fn whole<'de, D: Deserializer<'de>, const LEAST: u64, const MOST: u64>(from: D) -> Result<u64, D::Error> {
    let number = u64::deserialize(from)?;
    match (LEAST..=MOST).contains(&number) {
        true => Ok(number),
        false => Err(D::Error::custom(format!("is no whole number from {LEAST} to {MOST}"))),
    }
}

fn text<'de, D: Deserializer<'de>, const LEAST: usize, const MOST: usize>(from: D) -> Result<String, D::Error> {
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
        let missing = detail
            .strip_prefix("missing field `")
            .and_then(|name| name.strip_suffix('`'));
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
