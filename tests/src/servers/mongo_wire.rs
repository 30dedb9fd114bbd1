//! Just enough of MongoDB's protocol to ask a server whether it can be used, and to make it a
//! replica set of one.
//!
//! The driver would do as well, but it is asynchronous, and its server selection hides when the
//! server came back.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use bson::{Document, doc};

use super::endpoint::Endpoint;

const TIMEOUT: Duration = Duration::from_secs(10);
const OP_MSG: i32 = 2013;
/// The most that an answer may hold.
const MAX_ANSWER: usize = 4 << 20;
const ALREADY_INITIALIZED: i32 = 23;

/// Process that answers.
///
/// # Errors
/// When there is no answer within ten seconds, or one that is not MongoDB's.
pub(super) fn pid(server: &Endpoint) -> anyhow::Result<i64> {
    let answer =
        command(server, &doc! { "serverStatus": 1, "repl": 0, "metrics": 0, "$db": "admin" })?;
    match answer.get("pid") {
        Some(bson::Bson::Int64(pid)) => Ok(*pid),
        Some(bson::Bson::Int32(pid)) => Ok(i64::from(*pid)),
        other => anyhow::bail!("a process called {other:?}"),
    }
}

/// Makes the server a replica set of one. A set that is one already stays as it is.
///
/// # Errors
/// As [`pid`], and when the server refuses.
pub(super) fn initiate(server: &Endpoint) -> anyhow::Result<()> {
    let member = doc! { "_id": 0, "host": format!("{}:{}", server.ip(), server.port) };
    let set = doc! { "_id": "rs0", "members": [member] };
    let answer = command(server, &doc! { "replSetInitiate": set, "$db": "admin" })?;
    let done =
        is_ok(&answer) || answer.get_i32("code").is_ok_and(|code| code == ALREADY_INITIALIZED);
    anyhow::ensure!(done, "replSetInitiate: {answer}");
    Ok(())
}

/// Whether it takes writes.
pub(super) fn is_writable(server: &Endpoint) -> bool {
    let answer = command(server, &doc! { "hello": 1, "$db": "admin" });
    answer.is_ok_and(|answer| answer.get_bool("isWritablePrimary").unwrap_or(false))
}

/// Whether the server did what it was asked.
pub(super) fn is_ok(answer: &Document) -> bool {
    answer.get_f64("ok").is_ok_and(|ok| ok > 0.5)
}

/// One command, on a connection of its own. The answer may be a refusal.
///
/// # Errors
/// As [`pid`].
pub(super) fn command(server: &Endpoint, command: &Document) -> anyhow::Result<Document> {
    exchange(&mut connect(server)?, command)
}

/// Begins a transaction as the client that the driver calls by a name, does one command in it, and
/// goes without a word: what a process leaves that is killed.
///
/// # Errors
/// As [`pid`], and when the server refuses.
pub(super) fn abandon(
    server: &Endpoint,
    app_name: &str,
    mut command: Document,
) -> anyhow::Result<()> {
    let mut stream = connect(server)?;
    let parts = doc! { "name": "blaze-tests", "version": "1" };
    let client =
        doc! { "application": { "name": app_name }, "driver": parts, "os": { "type": "any" } };
    exchange(&mut stream, &doc! { "hello": 1, "client": client, "$db": "admin" })?;
    command.insert("lsid", doc! { "id": bson::Uuid::new() });
    command.insert("txnNumber", 1_i64);
    command.insert("startTransaction", true);
    command.insert("autocommit", false);
    let answer = exchange(&mut stream, &command)?;
    anyhow::ensure!(is_ok(&answer) && !answer.contains_key("writeErrors"), "{command}: {answer}");
    Ok(())
}

fn connect(server: &Endpoint) -> anyhow::Result<TcpStream> {
    let stream = server.connect(TIMEOUT)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    Ok(stream)
}

fn exchange(stream: &mut TcpStream, command: &Document) -> anyhow::Result<Document> {
    stream.write_all(&request(command)?)?;
    let length = usize::try_from(number(stream)?)?;
    anyhow::ensure!((16 + 5..=MAX_ANSWER).contains(&length), "an answer of {length} bytes");
    let mut answer = vec![0; length - 4];
    stream.read_exact(&mut answer)?;
    // Twelve bytes of header are left, then four of flags, and the kind of the first section.
    let body = answer.get(17..).unwrap_or_default();
    Ok(Document::from_reader(body)?)
}

fn request(command: &Document) -> anyhow::Result<Vec<u8>> {
    let body = command.to_vec()?;
    let length = i32::try_from(16 + 5 + body.len())?;
    let mut request = Vec::new();
    for number in [length, 1, 0, OP_MSG, 0] {
        request.extend(number.to_le_bytes());
    }
    request.push(0);
    request.extend(body);
    Ok(request)
}

fn number(stream: &mut TcpStream) -> anyhow::Result<i32> {
    let mut bytes = [0; 4];
    stream.read_exact(&mut bytes)?;
    Ok(i32::from_le_bytes(bytes))
}
