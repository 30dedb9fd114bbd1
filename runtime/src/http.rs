//! One GET or POST over plain HTTP, with deadlines and a largest answer: how programs of a node and
//! the command line ask admin ports.

use std::time::Duration;

use axum::body::Bytes;
use http_body_util::{BodyExt as _, Full, LengthLimitError, Limited};
use hyper::header::{ACCEPT, CONTENT_TYPE, HOST};
use hyper::{Method, Request};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::time::timeout;

/// What a request may take.
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
    /// What came is no answer.
    #[error("{0}")]
    Answer(String),
    /// The answer has more bytes than are allowed.
    #[error("the answer has more than {0} bytes")]
    TooLarge(usize),
}

/// Gets `path`, which begins with a slash and may have a query, from `HOST:PORT`; IPv6 in brackets.
/// Gives the status code and the body.
///
/// # Errors
/// No answer within the limits.
pub async fn get(address: &str, path: &str, limits: GetLimits) -> Result<(u16, Bytes), GetError> {
    ask(address, (Method::GET, path, None), limits).await
}

/// As [`get`], with a POST of JSON.
///
/// # Errors
/// As [`get`].
pub async fn post(
    address: &str,
    path: &str,
    json: Bytes,
    limits: GetLimits,
) -> Result<(u16, Bytes), GetError> {
    ask(address, (Method::POST, path, Some(json)), limits).await
}

/// Method, path and query, JSON to send.
type Question<'q> = (Method, &'q str, Option<Bytes>);

async fn ask(
    address: &str,
    question: Question<'_>,
    limits: GetLimits,
) -> Result<(u16, Bytes), GetError> {
    let late = |what: &str, within: Duration| {
        GetError::Unreachable(format!("no {what} within {} s", within.as_secs_f64()))
    };
    let stream = timeout(limits.connect, TcpStream::connect(address))
        .await
        .map_err(|_| late("connection", limits.connect))?
        .map_err(|error| GetError::Unreachable(error.to_string()))?;
    timeout(limits.answer, exchange(stream, address, question, limits.bytes))
        .await
        .map_err(|_| late("answer", limits.answer))?
}

async fn exchange(
    stream: TcpStream,
    address: &str,
    (method, path, json): Question<'_>,
    most: usize,
) -> Result<(u16, Bytes), GetError> {
    let unexpected = |reason: String| GetError::Answer(reason);
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
        .await
        .map_err(|error| unexpected(error.to_string()))?;
    let request = Request::builder()
        .method(method)
        .uri(path)
        .header(HOST, address)
        .header(ACCEPT, "application/json");
    let request = match &json {
        Some(_) => request.header(CONTENT_TYPE, "application/json"),
        None => request,
    };
    let request = request
        .body(Full::new(json.unwrap_or_default()))
        .map_err(|error| unexpected(format!("the request cannot be made: {error}")))?;
    let answer = async {
        let response =
            sender.send_request(request).await.map_err(|error| unexpected(error.to_string()))?;
        let status = response.status().as_u16();
        let body = Limited::new(response.into_body(), most).collect().await;
        let body = body.map_err(|error| match error.is::<LengthLimitError>() {
            true => GetError::TooLarge(most),
            false => unexpected(error.to_string()),
        })?;
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
