//! Documents that a main service within this process begins with, and changes to it, over the same
//! REST that everybody has.

use std::net::SocketAddr;

use serde_json::Value;

use super::apply::{Request, send, send_array};
use super::call::Call;
use super::client::Client;
use super::endpoint::{Endpoint, parse_server};
use super::files::Source;
use super::kinds::{document_path, key_of};
use super::text::whole;
use crate::exit::CliError;

/// A client of a main service without tokens.
///
/// # Errors
/// As [`Client::new`].
pub(crate) fn client(rest: SocketAddr) -> Result<Client, CliError> {
    let url = parse_server(&format!("http://{rest}")).map_err(CliError::Failed)?;
    Client::new(Endpoint::at(url))
}

/// Makes those of `own` that are not there, then applies `sources`. Gives the revision after it.
///
/// # Errors
/// As [`Client::send`]; what is wrong with a source is told with its file and line.
pub(crate) async fn apply(
    rest: SocketAddr,
    own: &[Value],
    sources: &[Source],
) -> Result<u64, CliError> {
    let client = client(rest)?;
    let mut missing = Vec::new();
    let mut revision = 0;
    for document in own {
        let key = key_of(document).map_err(CliError::Failed)?;
        match client.existing(&key).await? {
            Some(answer) => revision = revision.max(answer.revision.unwrap_or(0)),
            None => missing.push(document.clone()),
        }
    }
    if !missing.is_empty() {
        let answer = send_array(&client, &Value::Array(missing), &Request::default()).await?;
        revision = revision.max(whole(&answer, "revision"));
    }
    if !sources.is_empty() {
        let answer = send(&client, sources, &Request::default()).await?;
        revision = revision.max(whole(&answer, "revision"));
    }
    Ok(revision)
}

/// Replaces a document, whoever changed it before. Gives the revision of it.
///
/// # Errors
/// As [`Client::send`].
pub(crate) async fn replace(client: &Client, document: &Value) -> Result<u64, CliError> {
    let key = key_of(document).map_err(CliError::Failed)?;
    let call = Call::put(document_path(&key), document).if_match(Some("*".to_owned()));
    let answer = client.send(&call).await?;
    answer.revision.ok_or_else(|| client.odd("a change has no revision"))
}
