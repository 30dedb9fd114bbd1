//! The admin port of a running flow, asked as an operator's script would.

use std::io::{Read, Write};
use std::net::SocketAddr;
use std::time::Duration;

use anyhow::Context;

use crate::network::connect;

/// One admin port, reached from this process or from inside a namespace.
#[derive(Debug, Clone)]
pub struct Admin {
    /// Its address.
    pub address: SocketAddr,
    /// The namespace to ask from, if not this process's own.
    pub namespace: Option<String>,
}

impl Admin {
    /// Status and body of `GET path`.
    ///
    /// # Errors
    /// When nothing answers within five seconds, or the answer is no HTTP.
    pub fn get(&self, path: &str) -> anyhow::Result<(u16, String)> {
        let answer = self.ask(path)?;
        let (head, body) = answer.split_once("\r\n\r\n").context("no end of the HTTP header")?;
        let status = head.split_whitespace().nth(1).context("no HTTP status")?.parse()?;
        Ok((status, body.to_owned()))
    }

    /// The JSON of `GET path`.
    ///
    /// # Errors
    /// As [`Admin::get`], and when the body is no JSON.
    pub fn json(&self, path: &str) -> anyhow::Result<serde_json::Value> {
        let (_, body) = self.get(path)?;
        serde_json::from_str(&body).with_context(|| format!("{path}: {body}"))
    }

    /// Whether `/readyz` says 200.
    #[must_use]
    pub fn ready(&self) -> bool {
        self.get("/readyz").is_ok_and(|(status, _)| status == 200)
    }

    /// The value of a metric line that starts with `name` and holds all `labels`; `None` when there
    /// is none.
    #[must_use]
    pub fn metric(&self, name: &str, labels: &[&str]) -> Option<f64> {
        let (_, text) = self.get("/metrics").ok()?;
        let line = text.lines().find(|line| {
            line.starts_with(name)
                && line.as_bytes().get(name.len()).is_some_and(|b| matches!(b, b'{' | b' '))
                && labels.iter().all(|label| line.contains(label))
        })?;
        line.rsplit(' ').next()?.parse().ok()
    }

    fn ask(&self, path: &str) -> anyhow::Result<String> {
        let timeout = Duration::from_secs(5);
        let mut stream = connect(self.namespace.as_deref(), self.address, timeout)?;
        stream.set_read_timeout(Some(timeout))?;
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
            self.address
        )?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    }
}
