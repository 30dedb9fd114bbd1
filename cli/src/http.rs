//! How the command line asks admin ports.

use std::fmt;
use std::time::Duration;

use blaze_runtime::http::{GetError, GetLimits, get, post};
use serde_json::Value;

use crate::args::FlowAddress;
use crate::exit::CliError;

/// What a question may take.
pub const LIMITS: GetLimits = GetLimits {
    connect: Duration::from_secs(3),
    answer: Duration::from_secs(10),
    bytes: 16 * 1024 * 1024,
};

/// Which program has the admin port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Program {
    /// blaze-flow.
    Flow,
    /// blaze-monitor.
    Monitor,
}

impl fmt::Display for Program {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Flow => "flow",
            Self::Monitor => "monitor",
        })
    }
}

impl Program {
    /// What to do where it does not answer.
    #[must_use]
    pub fn advice(self) -> &'static str {
        match self {
            Self::Flow => {
                "A flow names its admin port in its line `ready admin=HOST:PORT`; give it with \
                 --flow HOST:PORT."
            }
            Self::Monitor => {
                "Start it with `blaze-monitor --config FILE`; --monitor HOST:PORT names another \
                 one (admin.monitor of its node file)."
            }
        }
    }
}

/// Gets one JSON object of a flow. `path` begins with a slash and may have a query; it is sent as
/// it is.
///
/// # Errors
/// [`CliError::CannotConnect`], [`CliError::Refused`] for any status but 200, [`CliError::Answer`]
/// for what is no JSON object or too large.
pub async fn get_json(address: &FlowAddress, path: &str) -> Result<Value, CliError> {
    let answer = get(&address.to_string(), path, LIMITS).await;
    object(Program::Flow, address, answer)
}

/// Gets one JSON object of a monitor.
///
/// # Errors
/// As [`get_json`].
pub async fn get_of_monitor(address: &FlowAddress, path: &str) -> Result<Value, CliError> {
    let answer = get(&address.to_string(), path, LIMITS).await;
    object(Program::Monitor, address, answer)
}

/// Posts JSON to a monitor, which may take so long to answer.
///
/// # Errors
/// As [`get_json`].
pub async fn post_to_monitor(
    address: &FlowAddress,
    path: &str,
    body: &Value,
    answer_within: Duration,
) -> Result<Value, CliError> {
    let limits = GetLimits { answer: answer_within, ..LIMITS };
    let answer = post(&address.to_string(), path, body.to_string().into(), limits).await;
    object(Program::Monitor, address, answer)
}

/// Gets text of a flow, such as its metrics; what is no UTF-8 is replaced.
///
/// # Errors
/// As [`get_json`].
pub(crate) async fn get_text(address: &FlowAddress, path: &str) -> Result<String, CliError> {
    let answer = get(&address.to_string(), path, LIMITS).await;
    let body = body_of(Program::Flow, address, answer)?;
    Ok(String::from_utf8_lossy(body.as_ref()).into_owned())
}

fn body_of<B>(
    program: Program,
    address: &FlowAddress,
    answer: Result<(u16, B), GetError>,
) -> Result<B, CliError>
where
    B: AsRef<[u8]>,
{
    let address = address.to_string();
    let (status, body) = answer.map_err(|error| {
        let (address, reason) = (address.clone(), error.to_string());
        match error {
            GetError::Unreachable(_) => CliError::CannotConnect { program, address, reason },
            GetError::Answer(_) | GetError::TooLarge(_) => {
                CliError::Answer { program, address, reason }
            }
        }
    })?;
    match status {
        200 => Ok(body),
        _ => Err(CliError::Refused { address, status, detail: detail_of(body.as_ref()) }),
    }
}

fn object(
    program: Program,
    address: &FlowAddress,
    answer: Result<(u16, impl AsRef<[u8]>), GetError>,
) -> Result<Value, CliError> {
    let body = body_of(program, address, answer)?;
    let unexpected =
        |reason: String| CliError::Answer { program, address: address.to_string(), reason };
    let value: Value = serde_json::from_slice(body.as_ref())
        .map_err(|error| unexpected(format!("no JSON: {error}")))?;
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
