//! A server for tests: it answers as it is told, cuts connections, and remembers what it was asked.

use std::sync::Arc;

use parking_lot::Mutex;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use super::client::Client;
use super::endpoint::{Endpoint, Token, TokenSource, parse_server};
use crate::args::FlowAddress;

/// A request as it came.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Asked {
    pub(crate) method: String,
    /// Path and query.
    pub(crate) target: String,
    pub(crate) headers: Vec<(String, String)>,
    pub(crate) body: String,
}

impl Asked {
    /// A header by its name in small letters.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        let found = self.headers.iter().find(|(known, _)| known == name);
        found.map(|(_, value)| value.as_str())
    }

    /// `GET /path?query`.
    pub(crate) fn line(&self) -> String {
        format!("{} {}", self.method, self.target)
    }

    /// The body as JSON.
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }
}

/// What is answered.
#[derive(Debug, Clone)]
pub(crate) enum Reply {
    /// Status, headers, body.
    Full(u16, Vec<(&'static str, String)>, String),
    /// A stream of events that ends after this text.
    Events(String),
    /// The connection ends without an answer.
    Cut,
}

impl Reply {
    pub(crate) fn json(value: &Value) -> Self {
        Self::Full(200, vec![("content-type", "application/json".to_owned())], value.to_string())
    }

    /// With a revision in `Blaze-Revision` and, for a document, in `ETag`.
    pub(crate) fn at(revision: u64, value: &Value) -> Self {
        let headers = vec![
            ("content-type", "application/json".to_owned()),
            ("blaze-revision", revision.to_string()),
            ("etag", format!("\"{revision}\"")),
        ];
        Self::Full(200, headers, value.to_string())
    }

    pub(crate) fn problem(status: u16, code: &str, detail: &str) -> Self {
        let problem = json!({
            "type": format!("/docs/errors/{code}"), "title": "Title.", "status": status,
            "detail": detail,
            "code": code, "request_id": "r-1",
            "applied": if code == "outcome_unknown" { "unknown" } else { "no" },
        });
        Self::Full(
            status,
            vec![("content-type", "application/problem+json".to_owned())],
            problem.to_string(),
        )
    }
}

/// The server; it ends when it is dropped.
pub(crate) struct Stub {
    url: String,
    asked: Arc<Mutex<Vec<Asked>>>,
    _task: JoinSet<()>,
}

impl Stub {
    /// Starts it. `answer` gets each request and how many came before it.
    pub(crate) async fn start(
        answer: impl Fn(&Asked, usize) -> Reply + Send + Sync + 'static,
    ) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let asked = Arc::new(Mutex::new(Vec::new()));
        let mut task = JoinSet::new();
        let remembered = Arc::clone(&asked);
        task.spawn(async move {
            loop {
                let (mut stream, _) = listener.accept().await.unwrap();
                let Some(request) = read(&mut stream).await else {
                    continue;
                };
                let before = remembered.lock().len();
                let reply = answer(&request, before);
                remembered.lock().push(request);
                write(&mut stream, reply).await;
            }
        });
        Self { url, asked, _task: task }
    }

    /// What it was asked so far.
    pub(crate) fn asked(&self) -> Vec<Asked> {
        self.asked.lock().clone()
    }

    /// What it was asked so far, as `GET /path?query`.
    pub(crate) fn lines(&self) -> Vec<String> {
        self.asked.lock().iter().map(Asked::line).collect()
    }

    /// It as an admin port.
    pub(crate) fn admin(&self) -> FlowAddress {
        self.url.parse().unwrap()
    }

    /// A client of it, without a token.
    pub(crate) fn client(&self) -> Client {
        self.client_with(None)
    }

    /// A client of it.
    pub(crate) fn client_with(&self, token: Option<&str>) -> Client {
        Client::new(Endpoint {
            token: token.map(|text| TokenSource::Variable(Token::of(text))),
            ..Endpoint::at(parse_server(&self.url).unwrap())
        })
        .unwrap()
    }
}

async fn read(stream: &mut TcpStream) -> Option<Asked> {
    let mut bytes = Vec::new();
    let head_end = loop {
        if let Some(end) = bytes.windows(4).position(|window| window == b"\r\n\r\n") {
            break end;
        }
        if stream.read_buf(&mut bytes).await.ok()? == 0 {
            return None;
        }
    };
    let head = String::from_utf8(bytes[..head_end].to_vec()).unwrap();
    let mut lines = head.split("\r\n");
    let mut words = lines.next()?.split(' ');
    let (method, target) = (words.next()?.to_owned(), words.next()?.to_owned());
    let headers: Vec<(String, String)> = lines
        .filter_map(|line| line.split_once(": "))
        .map(|(name, value)| (name.to_ascii_lowercase(), value.to_owned()))
        .collect();
    let length = headers.iter().find(|(name, _)| name == "content-length");
    let length: usize = length.map_or(0, |(_, value)| value.parse().unwrap());
    let mut body = bytes.split_off(head_end + 4);
    while body.len() < length {
        if stream.read_buf(&mut body).await.ok()? == 0 {
            return None;
        }
    }
    Some(Asked { method, target, headers, body: String::from_utf8(body).unwrap() })
}

async fn write(stream: &mut TcpStream, reply: Reply) {
    let text = match reply {
        Reply::Cut => return,
        Reply::Full(status, headers, body) => {
            let mut text = format!(
                "HTTP/1.1 {status} X\r\nconnection: close\r\ncontent-length: {}\r\n",
                body.len()
            );
            for (name, value) in headers {
                text.push_str(&format!("{name}: {value}\r\n"));
            }
            format!("{text}\r\n{body}")
        }
        Reply::Events(events) => {
            format!(
                "HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-type: text/event-stream\r\n\r\n{events}"
            )
        }
    };
    // A client that has gone is no concern of the test.
    let _ = stream.write_all(text.as_bytes()).await;
    let _ = stream.shutdown().await;
}
