//! Keys of an identity provider, fetched over HTTPS again and again.
//!
//! No redirects, no proxy, bounded time and size: an attacker who could redirect this request
//! could sign tokens.

use std::error::Error;
use std::time::Duration;

use blaze_auth::{Jwks, read_jwks};
use blaze_domain::node_file::SecretText;
use reqwest::header::{ACCEPT, HeaderValue};
use reqwest::redirect::Policy;
use reqwest::{Certificate, Client, StatusCode};
use tokio::sync::Notify;
use tokio::time::Instant;

/// Largest key set, in bytes.
const MAX_BYTES: usize = 256 * 1024;
/// For the whole answer.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Between two requests, also when a token names an unknown key or the last one failed.
pub(super) const LEAST_PERIOD: Duration = Duration::from_secs(10);

/// Where the keys come from.
pub(super) struct Provider {
    client: Client,
    url: SecretText,
}

impl Provider {
    /// With `roots` only certificates of these authorities are trusted, else those of the system.
    ///
    /// # Errors
    /// If the URL is not `https://`, or TLS cannot be set up.
    pub(super) fn new(url: SecretText, roots: Option<Vec<Certificate>>) -> Result<Self, String> {
        if !url.reveal().starts_with("https://") {
            return Err("must start with https://".to_owned());
        }
        let mut client = Client::builder()
            .https_only(true)
            .redirect(Policy::none())
            .no_proxy()
            .referer(false)
            .connect_timeout(TIMEOUT)
            .timeout(TIMEOUT);
        if let Some(roots) = roots {
            client = client.tls_certs_only(roots);
        }
        let client = client.build().map_err(told)?;
        Ok(Self { client, url })
    }

    /// Asks once.
    ///
    /// # Errors
    /// Why there are no keys, for the log.
    pub(super) async fn fetch(&self) -> Result<Jwks, String> {
        let request = self
            .client
            .get(self.url.reveal())
            .header(ACCEPT, HeaderValue::from_static("application/json"));
        let mut response = request.send().await.map_err(told)?;
        let status = response.status();
        if status != StatusCode::OK {
            return Err(format!("the answer is {status}"));
        }
        let mut body = Vec::new();
        while let Some(chunk) = response.chunk().await.map_err(told)? {
            if body.len() + chunk.len() > MAX_BYTES {
                return Err(format!("the answer has more than {MAX_BYTES} bytes"));
            }
            body.extend_from_slice(&chunk);
        }
        read_jwks(&body).map_err(|reason| format!("the answer {reason}"))
    }
}

/// Fetches for ever: every `every`, soon after a failure, and when a token names an unknown key;
/// never two within `least`.
pub(super) async fn keep_fresh(
    provider: &Provider,
    every: Duration,
    least: Duration,
    unknown_key: &Notify,
    apply: impl Fn(Jwks),
) {
    let mut told: Option<String> = None;
    loop {
        let began = Instant::now();
        let failure = match provider.fetch().await {
            Ok(keys) => {
                apply(keys);
                None
            }
            Err(reason) => Some(reason),
        };
        if let Some(reason) = &failure
            && told != failure
        {
            tracing::warn!(
                reason,
                "keys of the identity provider cannot be fetched; those that are known stay"
            );
        }
        let wait = if failure.is_some() { every.min(least) } else { every };
        told = failure;
        tokio::select! {
            () = tokio::time::sleep_until(began + wait) => {}
            () = unknown_key.notified() => tokio::time::sleep_until(began + least).await,
        }
    }
}

/// A failure with its causes, without the URL: it may hold a password.
fn told(error: reqwest::Error) -> String {
    let error = error.without_url();
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(because) = cause {
        text.push_str(": ");
        text.push_str(&because.to_string());
        cause = because.source();
    }
    text
}
