//! One GET over plain HTTP, with deadlines and a largest answer: how programs of a node and the
//! command line ask admin ports.

use std::time::Duration;

use axum::body::Bytes;
use http_body_util::{BodyExt as _, Empty, Limited};
use hyper::Request;
use hyper::header::{ACCEPT, HOST};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::time::timeout;

/// What a GET may take.
#[derive(Debug, Clone, Copy)]
pub struct GetLimits {
    /// For the connection.
    pub connect: Duration,
    /// For the answer, once connected.
    pub answer: Duration,
    /// Body of the answer, in bytes.
    pub bytes: usize,
}

/// Why there is no answer. The texts do not repeat the address.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GetError {
    /// No connection, or no answer in time.
    #[error("{0}")]
    Unreachable(String),
    /// What came is no answer, or is too large.
    #[error("{0}")]
    Answer(String),
}

/// Gets `path`, which begins with a slash and may have a query, from `HOST:PORT`; IPv6 in brackets.
/// Gives the status code and the body.
///
/// # Errors
/// No answer within the limits.
pub async fn get(address: &str, path: &str, limits: GetLimits) -> Result<(u16, Bytes), GetError> {
    let late = |what: &str, within: Duration| {
        GetError::Unreachable(format!("no {what} within {} s", within.as_secs_f64()))
    };
    let stream = timeout(limits.connect, TcpStream::connect(address))
        .await
        .map_err(|_| late("connection", limits.connect))?
        .map_err(|error| GetError::Unreachable(error.to_string()))?;
    timeout(limits.answer, exchange(stream, address, path, limits.bytes))
        .await
        .map_err(|_| late("answer", limits.answer))?
}

async fn exchange(
    stream: TcpStream,
    address: &str,
    path: &str,
    most: usize,
) -> Result<(u16, Bytes), GetError> {
    let unexpected = |reason: String| GetError::Answer(reason);
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
        .await
        .map_err(|error| unexpected(error.to_string()))?;
    let request = Request::get(path)
        .header(HOST, address)
        .header(ACCEPT, "application/json")
        .body(Empty::<Bytes>::new())
        .map_err(|error| unexpected(format!("the request cannot be made: {error}")))?;
    let answer = async {
        let response =
            sender.send_request(request).await.map_err(|error| unexpected(error.to_string()))?;
        let status = response.status().as_u16();
        let body = Limited::new(response.into_body(), most)
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
