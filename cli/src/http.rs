//! How the command line asks admin ports.

use std::time::Duration;

use blaze_runtime::http::{GetError, GetLimits, get};
use serde_json::Value;

use crate::args::FlowAddress;
use crate::exit::CliError;

/// What a question may take.
pub const LIMITS: GetLimits = GetLimits {
    connect: Duration::from_secs(3),
    answer: Duration::from_secs(10),
    bytes: 16 * 1024 * 1024,
};

/// Gets one JSON object. `path` begins with a slash and may have a query; it is sent as it is.
///
/// # Errors
/// [`CliError::CannotConnect`], [`CliError::Refused`] for any status but 200, [`CliError::Answer`]
/// for what is no JSON object or too large.
pub async fn get_json(address: &FlowAddress, path: &str) -> Result<Value, CliError> {
    let unexpected = |reason: String| CliError::Answer { address: address.to_string(), reason };
    let answer = get(&address.to_string(), path, LIMITS).await;
    let (status, body) = answer.map_err(|error| match error {
        GetError::Unreachable(reason) => {
            CliError::CannotConnect { address: address.to_string(), reason }
        }
        GetError::Answer(reason) => unexpected(reason),
    })?;
    if status != 200 {
        return Err(CliError::Refused {
            address: address.to_string(),
            status,
            detail: detail_of(&body),
        });
    }
    let value: Value =
        serde_json::from_slice(&body).map_err(|error| unexpected(format!("no JSON: {error}")))?;
    if value.is_object() {
        Ok(value)
    } else {
        Err(unexpected("the answer is no JSON object".to_owned()))
    }
}

/// The server's own words: `{"error":{"detail":…}}`, else the beginning of its text.
fn detail_of(body: &[u8]) -> String {
    let parsed: Option<Value> = serde_json::from_slice(body).ok();
    let detail = parsed.as_ref().and_then(|value| value.pointer("/error/detail")?.as_str());
    match detail {
        Some(detail) => detail.to_owned(),
        None => String::from_utf8_lossy(body).trim().chars().take(200).collect(),
    }
}
