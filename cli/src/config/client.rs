//! HTTP to the main service: deadlines, a largest answer, no redirects, and the token kept to
//! itself.

use std::error::Error as _;
use std::time::Duration;

use reqwest::header::{
    ACCEPT, AUTHORIZATION, CONTENT_TYPE, ETAG, HeaderMap, HeaderName, HeaderValue, IF_MATCH,
};
use reqwest::{Certificate, Method, Response};
use serde_json::Value;
use tokio::time::timeout;

use super::call::Call;
use super::endpoint::{Endpoint, Surroundings, Token, TokenSource, resolve};
use super::options::ServerOptions;
use super::refusal::Refusal;
use super::tls;
use crate::exit::CliError;

/// Largest answer that is read, in bytes.
const MAX_ANSWER_BYTES: usize = 64 * 1024 * 1024;
/// How long a connection may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// How long a request and its answer may take.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);
/// An older connection is not used again: the server may be closing it just then, and a change sent
/// over it would be lost.
const IDLE: Duration = Duration::from_secs(10);
/// The store revision that an answer reflects.
const REVISION: HeaderName = HeaderName::from_static("blaze-revision");
/// The last event that was seen of a stream.
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

/// A successful answer.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Answer {
    /// `Blaze-Revision`.
    pub(crate) revision: Option<u64>,
    /// `ETag`, as it is.
    pub(crate) etag: Option<String>,
    /// The JSON; `null` for an empty answer.
    pub(crate) body: Value,
}

/// Why no answer was read.
enum Fault {
    Http(reqwest::Error),
    Late,
    TooLarge,
    /// Before anything was sent.
    Before(CliError),
}

impl From<reqwest::Error> for Fault {
    fn from(error: reqwest::Error) -> Self {
        // The URL is told by whoever reports the fault.
        Self::Http(error.without_url())
    }
}

/// A client of one server.
#[derive(Debug)]
pub(crate) struct Client {
    http: reqwest::Client,
    endpoint: Endpoint,
}

impl Client {
    /// A client for what options, environment and context say.
    ///
    /// # Errors
    /// As [`resolve`] and [`Self::new`].
    pub(crate) fn of(options: &ServerOptions) -> Result<Self, CliError> {
        Self::new(resolve(options, &Surroundings::of_process())?)
    }

    /// A client for a server; nothing is sent yet.
    ///
    /// # Errors
    /// [`CliError::Invalid`] for a bad file of authorities, of a certificate or its key,
    /// [`CliError::Failed`] when TLS cannot be set up.
    pub(crate) fn new(endpoint: Endpoint) -> Result<Self, CliError> {
        let builder = reqwest::Client::builder()
            .user_agent(concat!("blaze/", env!("CARGO_PKG_VERSION")))
            .redirect(reqwest::redirect::Policy::none())
            // What may be tried again is decided here, not below.
            .retry(reqwest::retry::never())
            .no_proxy()
            // With HTTP/2, what the server said last of all is lost when it ends a connection: an
            // alert of TLS says why.
            .http1_only()
            .connect_timeout(CONNECT_TIMEOUT)
            .pool_idle_timeout(IDLE);
        let builder = match (&endpoint.ca_file, endpoint.is_tls()) {
            (Some(file), true) => builder.tls_certs_only(tls::authorities(file)?),
            (None, true) => builder,
            // Nothing is verified, so a machine without certificates of its own will do.
            (_, false) => builder.tls_certs_only(Vec::<Certificate>::new()),
        };
        let shown = endpoint.client_certificate.as_ref().filter(|_| endpoint.is_tls());
        let builder = match shown {
            Some(files) => builder.identity(tls::identity(files)?),
            None => builder,
        };
        let http = builder.build().map_err(|error| match shown {
            Some(files) if tls::fault(&error).is_some_and(tls::is_mismatch) => {
                CliError::Invalid(format!(
                    "the client certificate {} and its key {} do not belong together",
                    files.cert_file.display(),
                    files.key_file.as_ref().unwrap_or(&files.cert_file).display()
                ))
            }
            _ => CliError::Failed(format!("the HTTP client cannot be set up: {}", reason(&error))),
        })?;
        Ok(Self { http, endpoint })
    }

    /// The server as people write it.
    pub(crate) fn server(&self) -> &str {
        self.endpoint.server()
    }

    /// Sends a request and reads its answer. A read is tried again once when the connection breaks;
    /// a write never is.
    ///
    /// # Errors
    /// [`CliError::Problem`] when the server refuses, [`CliError::NoServer`],
    /// [`CliError::OutcomeUnknown`] for a write whose answer did not come, [`CliError::Foreign`]
    /// for what is no JSON or larger than 64 MiB.
    pub(crate) async fn send(&self, call: &Call) -> Result<Answer, CliError> {
        let token = self.token()?;
        let mut again = call.method == Method::GET;
        loop {
            let fault = match timeout(REQUEST_TIMEOUT, self.exchange(call, token.as_ref())).await {
                Ok(Ok((status, headers, body))) => {
                    return self.judge(status, &headers, &body, token.as_ref());
                }
                Ok(Err(fault)) => fault,
                Err(_) => Fault::Late,
            };
            match fault {
                Fault::Http(error) if again && broke(&error) => again = false,
                fault => return Err(self.no_answer(call, fault, token.as_ref())),
            }
        }
    }

    /// Opens a stream of events. The revision is that of the store when it began.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub(crate) async fn open(&self, call: &Call) -> Result<(Response, Option<u64>), CliError> {
        let token = self.token()?;
        let begin = async {
            let request = self.request(call, token.as_ref())?.header(ACCEPT, "text/event-stream");
            let mut response = request.send().await?;
            let body = if response.status().is_success() {
                Vec::new()
            } else {
                read(&mut response).await?
            };
            Ok::<_, Fault>((response, body))
        };
        let (response, body) = match timeout(REQUEST_TIMEOUT, begin).await {
            Ok(Ok(begun)) => begun,
            Ok(Err(fault)) => return Err(self.no_answer(call, fault, token.as_ref())),
            Err(_) => return Err(self.no_answer(call, Fault::Late, token.as_ref())),
        };
        if !response.status().is_success() {
            return Err(self.refused(response.status().as_u16(), &body, token.as_ref()));
        }
        let kind = header(response.headers(), &CONTENT_TYPE).unwrap_or_default();
        if !kind.starts_with("text/event-stream") {
            return Err(self.odd(format!("the answer is {kind:?} and no stream of events")));
        }
        let revision = revision(response.headers());
        Ok((response, revision))
    }

    fn token(&self) -> Result<Option<Token>, CliError> {
        self.endpoint.token.as_ref().map(TokenSource::read).transpose()
    }

    fn request(
        &self,
        call: &Call,
        token: Option<&Token>,
    ) -> Result<reqwest::RequestBuilder, Fault> {
        let mut request = self.http.request(call.method.clone(), call.url(&self.endpoint.url));
        if let Some(token) = token {
            let mut value =
                HeaderValue::from_str(&format!("Bearer {}", token.text())).map_err(|_| {
                    Fault::Before(CliError::Invalid(
                        "the token cannot stand in a header".to_owned(),
                    ))
                })?;
            value.set_sensitive(true);
            request = request.header(AUTHORIZATION, value);
        }
        if let Some(tag) = &call.if_match {
            request = request.header(IF_MATCH, tag);
        }
        if let Some(id) = &call.last_event_id {
            request = request.header(LAST_EVENT_ID, id);
        }
        if let Some((kind, body)) = &call.body {
            request = request.header(CONTENT_TYPE, *kind).body(body.clone());
        }
        Ok(request)
    }

    async fn exchange(
        &self,
        call: &Call,
        token: Option<&Token>,
    ) -> Result<(u16, HeaderMap, Vec<u8>), Fault> {
        let request = self.request(call, token)?;
        let request = request.header(ACCEPT, "application/json, application/problem+json");
        let mut response = request.send().await?;
        let body = read(&mut response).await?;
        Ok((response.status().as_u16(), response.headers().clone(), body))
    }

    fn judge(
        &self,
        status: u16,
        headers: &HeaderMap,
        body: &[u8],
        token: Option<&Token>,
    ) -> Result<Answer, CliError> {
        if !(200..300).contains(&status) {
            return Err(self.refused(status, body, token));
        }
        let value = if body.is_empty() {
            Value::Null
        } else {
            serde_json::from_slice(body)
                .map_err(|error| self.odd(format!("the answer is no JSON: {error}")))?
        };
        Ok(Answer { revision: revision(headers), etag: header(headers, &ETAG), body: value })
    }

    fn refused(&self, status: u16, body: &[u8], token: Option<&Token>) -> CliError {
        let body = redact(&String::from_utf8_lossy(body), token);
        let mut refusal = Refusal::read(self.server(), status, body.as_bytes());
        if (300..400).contains(&status) {
            refusal = refusal.with_hint("Redirects are not followed: name the server itself");
        }
        if status == 401 {
            refusal = refusal.with_hint(match token {
                None => {
                    "no token was sent: give --token-file FILE, BLAZE_TOKEN_FILE, BLAZE_TOKEN, or \
                     a context that has one"
                }
                Some(_) => {
                    "the token was not accepted; `blaze token inspect` shows what it says \
                    and whether it has run out"
                }
            });
        }
        CliError::Problem(Box::new(refusal))
    }

    fn no_answer(&self, call: &Call, fault: Fault, token: Option<&Token>) -> CliError {
        let mut advice = None;
        let (reason, unreached) = match fault {
            Fault::Before(error) => return error,
            Fault::TooLarge => {
                return self.odd(format!(
                    "the answer is larger than {} MiB",
                    MAX_ANSWER_BYTES / 1024 / 1024
                ));
            }
            Fault::Late => (format!("no answer within {} s", REQUEST_TIMEOUT.as_secs()), false),
            Fault::Http(error) => {
                let of_tls = tls::fault(&error);
                advice = of_tls.and_then(|fault| tls::advice(fault, &self.endpoint));
                if advice.is_none() && broke(&error) {
                    advice = tls::broke_off(&self.endpoint);
                }
                let before =
                    error.is_connect() || error.is_builder() || of_tls.is_some_and(tls::is_refused);
                (redact(&reason(&error), token), before)
            }
        };
        let server = self.server().to_owned();
        if !unreached && !call.harmless {
            let lost = CliError::OutcomeUnknown { server, reason };
            return match advice {
                Some(advice) => lost.advised(advice),
                None => lost,
            };
        }
        let advice = advice.unwrap_or_else(|| {
            if !unreached && !self.endpoint.is_tls() {
                "If it speaks TLS, name it with https://.".to_owned()
            } else {
                "Name the server with --server URL, BLAZE_SERVER or a context (`blaze context \
                 list`)."
                    .to_owned()
            }
        });
        CliError::NoServer { server, reason, advice }
    }
}

/// Whether a connection broke in the middle, as it does when a server ends between two requests.
fn broke(error: &reqwest::Error) -> bool {
    !error.is_connect() && !error.is_timeout() && !error.is_builder()
}

async fn read(response: &mut Response) -> Result<Vec<u8>, Fault> {
    let mut body = Vec::new();
    while let Some(chunk) = response.chunk().await? {
        if body.len() + chunk.len() > MAX_ANSWER_BYTES {
            return Err(Fault::TooLarge);
        }
        body.extend_from_slice(&chunk);
    }
    Ok(body)
}

fn header(headers: &HeaderMap, name: &HeaderName) -> Option<String> {
    Some(headers.get(name)?.to_str().ok()?.to_owned())
}

fn revision(headers: &HeaderMap) -> Option<u64> {
    header(headers, &REVISION)?.parse().ok()
}

/// The innermost cause in words; what is around it only says that a request failed.
pub(crate) fn reason(error: &reqwest::Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        words = inner.to_string();
        source = inner.source();
    }
    words
}

/// A text without the token, whoever repeated it there.
fn redact(text: &str, token: Option<&Token>) -> String {
    match token {
        Some(token) => text.replace(token.text(), "[token]"),
        None => text.to_owned(),
    }
}

#[cfg(test)]
#[path = "client_tests.rs"]
mod tests;
