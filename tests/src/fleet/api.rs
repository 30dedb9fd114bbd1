//! The REST interface of a main service, asked as a user's program would.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use reqwest::Method;
use serde_json::{Value, json};

/// An answer that takes longer counts as none.
const ANSWER: Duration = Duration::from_secs(20);

/// What became of a request.
#[derive(Debug)]
pub enum Told {
    /// It is done; the body of the answer.
    Done(Value),
    /// It is not done, for a reason in the request or in what is there.
    Refused {
        /// Status of HTTP.
        status: u16,
        /// The problem.
        problem: Value,
    },
    /// It is not done, for the service cannot do it now: again later.
    NotNow(String),
    /// Nobody knows: the connection broke, or the service says so.
    Unknown(String),
}

/// A write that is done.
#[derive(Debug, Clone, Copy)]
pub struct Written {
    /// Its revision.
    pub revision: u64,
    /// When the request was sent.
    pub sent: Instant,
    /// When the status of the answer was there.
    pub answered: Instant,
}

/// A client; clones share its connections.
#[derive(Debug, Clone)]
pub struct Api {
    http: reqwest::Client,
    base: String,
}

impl Api {
    /// Of a main service that needs no token.
    ///
    /// # Errors
    /// When no client can be made.
    pub fn new(rest: SocketAddr) -> anyhow::Result<Self> {
        let http = reqwest::Client::builder()
            .no_proxy()
            .http1_only()
            .tcp_nodelay(true)
            .timeout(ANSWER)
            .build()?;
        Ok(Self { http, base: format!("http://{rest}/api/v1") })
    }

    /// Any request; a precondition is given that everything fulfils.
    pub async fn send(&self, method: Method, path: &str, body: Option<&Value>) -> Told {
        let is_post = method == Method::POST;
        let mut request = self.http.request(method, format!("{}{path}", self.base));
        if !is_post {
            request = request.header("if-match", "*");
        }
        if let Some(body) = body {
            request = request.json(body);
        }
        match request.send().await {
            Ok(response) => read(response).await,
            // Nothing was sent.
            Err(error) if error.is_connect() => Told::NotNow(error.to_string()),
            Err(error) => Told::Unknown(error.to_string()),
        }
    }

    /// A request that must succeed; gives the body.
    ///
    /// # Errors
    /// When it does not.
    pub async fn must(
        &self,
        method: Method,
        path: &str,
        body: Option<&Value>,
    ) -> anyhow::Result<Value> {
        match self.send(method.clone(), path, body).await {
            Told::Done(answer) => Ok(answer),
            other => anyhow::bail!("{method} {path}: {other:?}"),
        }
    }

    /// What is at a path.
    ///
    /// # Errors
    /// As [`Api::must`].
    pub async fn get(&self, path: &str) -> anyhow::Result<Value> {
        self.must(Method::GET, path, None).await
    }

    /// Makes or replaces a document that is there already; gives its revision.
    ///
    /// # Errors
    /// As [`Api::must`].
    pub async fn replace(&self, path: &str, spec: Value) -> anyhow::Result<u64> {
        let answer = self.must(Method::PUT, path, Some(&json!({ "spec": spec }))).await?;
        revision(&answer)
    }

    /// The same, with when it was sent and when the status came.
    ///
    /// # Errors
    /// As [`Api::must`].
    pub async fn replace_timed(&self, path: &str, spec: Value) -> anyhow::Result<Written> {
        let request = self.http.put(format!("{}{path}", self.base));
        let request = request.header("if-match", "*").json(&json!({ "spec": spec }));
        let sent = Instant::now();
        let response = request.send().await?;
        let answered = Instant::now();
        match read(response).await {
            Told::Done(answer) => Ok(Written { revision: revision(&answer)?, sent, answered }),
            other => anyhow::bail!("PUT {path}: {other:?}"),
        }
    }

    /// Applies documents, as many as there are; gives the last revision.
    ///
    /// # Errors
    /// As [`Api::must`].
    pub async fn apply(&self, documents: &[Value]) -> anyhow::Result<u64> {
        let mut last = 0;
        for documents in documents.chunks(1000) {
            let body = Value::Array(documents.to_vec());
            let answer = self.must(Method::POST, "/apply", Some(&body)).await?;
            last = revision(&answer)?;
        }
        Ok(last)
    }

    /// Digest of what a layer sees.
    ///
    /// # Errors
    /// As [`Api::must`].
    pub async fn digest(&self, layer: &str) -> anyhow::Result<String> {
        let answer = self.get(&format!("/digest?layer={layer}")).await?;
        Ok(answer["digest"].as_str().context("no digest")?.to_owned())
    }
}

fn revision(answer: &Value) -> anyhow::Result<u64> {
    answer["revision"].as_u64().with_context(|| format!("no revision: {answer}"))
}

async fn read(response: reqwest::Response) -> Told {
    let status = response.status();
    let text = match response.text().await {
        Ok(text) => text,
        Err(error) => return Told::Unknown(error.to_string()),
    };
    let body: Value = match text.as_str() {
        "" => Value::Null,
        text => serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned())),
    };
    match status {
        status if status.is_success() => Told::Done(body),
        _ if body["applied"] == "unknown" => Told::Unknown(body.to_string()),
        status if status.is_server_error() => Told::NotNow(body.to_string()),
        status => Told::Refused { status: status.as_u16(), problem: body },
    }
}
