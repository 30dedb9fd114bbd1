//! The little HTTP that the command line needs: one GET, with deadlines and a largest answer.

use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::Request;
use hyper::header::{ACCEPT, HOST};
use hyper_util::rt::TokioIo;
use serde_json::Value;
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::args::FlowAddress;
use crate::exit::CliError;

/// Largest answer that is read, in bytes.
pub const MAX_ANSWER_BYTES: usize = 16 * 1024 * 1024;
/// How long a connection may take.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// How long the answer may take, once connected.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Gets one JSON object. `path` begins with a slash and may have a query; it is sent as it is.
///
/// # Errors
/// [`CliError::CannotConnect`], [`CliError::Refused`] for any status but 200, [`CliError::Answer`]
/// for what is no JSON object or too large.
pub async fn get_json(address: &FlowAddress, path: &str) -> Result<Value, CliError> {
    let body = get(address, path).await?;
    let unexpected = |reason: String| CliError::Answer { address: address.to_string(), reason };
    let value: Value =
        serde_json::from_slice(&body).map_err(|error| unexpected(format!("no JSON: {error}")))?;
    if value.is_object() {
        Ok(value)
    } else {
        Err(unexpected("the answer is no JSON object".to_owned()))
    }
}

/// The same for text, as that of metrics; what is no UTF-8 is replaced.
///
/// # Errors
/// As [`get_json`].
pub(crate) async fn get_text(address: &FlowAddress, path: &str) -> Result<String, CliError> {
    let body = get(address, path).await?;
    Ok(String::from_utf8_lossy(&body).into_owned())
}

async fn get(address: &FlowAddress, path: &str) -> Result<Bytes, CliError> {
    let cannot = |reason: String| CliError::CannotConnect { address: address.to_string(), reason };
    let stream =
        timeout(CONNECT_TIMEOUT, TcpStream::connect((address.host.as_str(), address.port)))
            .await
            .map_err(|_| cannot(format!("no connection within {} s", CONNECT_TIMEOUT.as_secs())))?
            .map_err(|error| cannot(error.to_string()))?;
    let (status, body) = timeout(ANSWER_TIMEOUT, exchange(stream, address, path))
        .await
        .map_err(|_| cannot(format!("no answer within {} s", ANSWER_TIMEOUT.as_secs())))??;
    if status != 200 {
        return Err(CliError::Refused {
            address: address.to_string(),
            status,
            detail: detail_of(&body),
        });
    }
    Ok(body)
}

async fn exchange(
    stream: TcpStream,
    address: &FlowAddress,
    path: &str,
) -> Result<(u16, Bytes), CliError> {
    let unexpected = |reason: String| CliError::Answer { address: address.to_string(), reason };
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
        .await
        .map_err(|error| unexpected(error.to_string()))?;
    let request = Request::get(path)
        .header(HOST, address.to_string())
        .header(ACCEPT, "application/json, text/plain")
        .body(Empty::<Bytes>::new())
        .map_err(|error| CliError::Failed(format!("the request cannot be made: {error}")))?;
    let answer = async {
        let response =
            sender.send_request(request).await.map_err(|error| unexpected(error.to_string()))?;
        let status = response.status().as_u16();
        let body = Limited::new(response.into_body(), MAX_ANSWER_BYTES)
            .collect()
            .await
            .map_err(|error| unexpected(error.to_string()))?;
        Ok((status, body.to_bytes()))
    };
    tokio::pin!(answer, connection);
    // The connection is driven here and not in a task of its own; when it ends first, the answer is
    // already buffered.
    tokio::select! {
        answer = &mut answer => answer,
        _ = &mut connection => answer.await,
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
