//! The way to the main service of BlazeConfig: its address, the files that identify this program,
//! one connection, and the pauses between tries.

mod backoff;

use std::path::{Path, PathBuf};
use std::time::Duration;

use tonic::Status;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

pub use backoff::Backoff;

/// Time for one connection to come about.
const CONNECT: Duration = Duration::from_millis(1500);
/// Time for files to be read, a connection to come about and TLS to be agreed upon.
const REACH: Duration = Duration::from_secs(5);
/// Between two looks whether the other end is still there. A cut link loses packets without a word,
/// and TCP sends again in steps that double: after 30 s the next one comes only 25 s later. So this
/// end notices by itself, and connects anew.
const ALIVE: Duration = Duration::from_secs(3);
/// Time for the answer to such a look.
const ALIVE_ANSWER: Duration = Duration::from_secs(3);
/// Token files are small.
const MAX_TOKEN_BYTES: u64 = 8192;
/// So are files of authorities, certificates and keys.
const MAX_PEM_BYTES: u64 = 1024 * 1024;

/// How each part of a file in PEM form begins.
const PEM: &[u8] = b"-----BEGIN ";

/// Where the main service is and how it knows this worker. Files are read anew for each connection.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MainService {
    /// `https://HOST:PORT`, or `http://` on this machine.
    pub server: String,
    /// Authorities that are trusted instead of the system's.
    pub ca_file: Option<PathBuf>,
    /// File with the token.
    pub token_file: Option<PathBuf>,
    /// Files with the own certificate and its key, for a main service that asks for one.
    pub certificate: Option<(PathBuf, PathBuf)>,
}

impl MainService {
    /// Whether nobody else can read what is said: over TLS, or within this machine.
    #[must_use]
    pub fn is_safe(&self) -> bool {
        match self.server.strip_prefix("http://") {
            Some(rest) => is_this_machine(rest),
            None => self.server.starts_with("https://"),
        }
    }

    /// A connection and the token that goes with each call, within 5 s.
    ///
    /// # Errors
    /// An address or a file that cannot be used, and a main service that does not answer.
    pub async fn connect(
        &self,
    ) -> Result<(Channel, Option<MetadataValue<Ascii>>), ConnectError> {
        let connecting = async {
            let token = token(self).await?;
            Ok((channel(self).await?, token))
        };
        tokio::time::timeout(REACH, connecting).await.unwrap_or_else(|_| {
            let reason = format!("no connection within {} s", REACH.as_secs());
            Err(ConnectError::Transport(reason))
        })
    }
}

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The address is none.
    #[error("config.server: {0}")]
    Address(String),
    /// A file cannot be used.
    #[error("{key}: {path}: {reason}", path = path.display())]
    File {
        /// Key in the node file.
        key: &'static str,
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Nobody answers.
    #[error("no connection: {0}")]
    Transport(String),
}

/// Whether what follows `scheme://` in an address is on this machine.
#[must_use]
pub fn is_this_machine(rest: &str) -> bool {
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let host = authority.rsplit_once('@').map_or(authority, |(_, host)| host);
    let host = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    match host.parse::<std::net::IpAddr>() {
        Ok(address) => address.to_canonical().is_loopback(),
        Err(_) => host.eq_ignore_ascii_case("localhost"),
    }
}

async fn token(main: &MainService) -> Result<Option<MetadataValue<Ascii>>, ConnectError> {
    let Some(path) = &main.token_file else { return Ok(None) };
    let refuse = |reason: String| ConnectError::File {
        key: "config.token_file",
        path: path.clone(),
        reason,
    };
    let text = read(path, MAX_TOKEN_BYTES).await.map_err(&refuse)?;
    let text = String::from_utf8(text).map_err(|_| refuse("it is no text".to_owned()))?;
    let mut value: MetadataValue<Ascii> = format!("Bearer {}", text.trim())
        .parse()
        .map_err(|_| refuse("it holds no token".to_owned()))?;
    value.set_sensitive(true);
    Ok(Some(value))
}

async fn channel(main: &MainService) -> Result<Channel, ConnectError> {
    let endpoint = Endpoint::from_shared(main.server.clone())
        .map_err(|error| ConnectError::Address(error.to_string()))?;
    let endpoint = endpoint
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(ALIVE)
        .keep_alive_timeout(ALIVE_ANSWER)
        .keep_alive_while_idle(true);
    let endpoint = match main.server.starts_with("https://") {
        false => endpoint,
        true => {
            let tls = ClientTlsConfig::new().timeout(CONNECT);
            let tls = match &main.ca_file {
                None => tls.with_native_roots(),
                Some(path) => {
                    tls.ca_certificate(Certificate::from_pem(pem("config.ca_file", path).await?))
                }
            };
            let tls = match &main.certificate {
                None => tls,
                Some((certificate, key)) => {
                    let certificate = pem("config.cert_file", certificate).await?;
                    tls.identity(Identity::from_pem(
                        certificate,
                        pem("config.key_file", key).await?,
                    ))
                }
            };
            endpoint.tls_config(tls).map_err(|error| ConnectError::Transport(chain(&error)))?
        }
    };
    endpoint.connect().await.map_err(|error| ConnectError::Transport(chain(&error)))
}

/// What a file in PEM form holds; `key` names it in the node file.
async fn pem(key: &'static str, path: &Path) -> Result<Vec<u8>, ConnectError> {
    let refuse = |reason| ConnectError::File { key, path: path.to_owned(), reason };
    let text = read(path, MAX_PEM_BYTES).await.map_err(refuse)?;
    // The library takes a file without any for one with none, and then only the other end says that
    // something is missing.
    let has_some = text.windows(PEM.len()).any(|start| start == PEM);
    has_some.then_some(text).ok_or_else(|| refuse("it holds nothing in PEM form".to_owned()))
}

/// What a refusal says, with what caused it where the connection broke.
#[must_use]
pub fn words(status: &Status) -> String {
    let cause = std::error::Error::source(status).map(chain);
    let text = match cause {
        Some(cause) => format!("{} ({:?}): {cause}", status.message(), status.code()),
        None => format!("{} ({:?})", status.message(), status.code()),
    };
    // As TLS names it. It comes after the connection does, in answer to the first call.
    match text.contains("CertificateRequired") {
        true => format!(
            "the main service asks for a client certificate: name it with config.cert_file and \
             config.key_file [{text}]"
        ),
        false => text,
    }
}

/// The library's errors say little; what caused them says more.
fn chain(error: &(dyn std::error::Error + 'static)) -> String {
    let causes: Vec<String> = anyhow::Chain::new(error).map(ToString::to_string).collect();
    causes.join(": ")
}

async fn read(path: &Path, most: u64) -> Result<Vec<u8>, String> {
    let bytes = tokio::fs::read(path).await.map_err(|error| error.to_string())?;
    if bytes.len() as u64 > most {
        return Err(format!("it has {} bytes, at most {most} are read", bytes.len()));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tls_and_this_machine_are_safe() {
        for (server, is_safe) in [
            ("https://config.example.org:50051", true),
            ("http://127.0.0.1:50051", true),
            ("http://[::1]:50051", true),
            ("http://localhost", true),
            ("http://10.0.3.1:50051", false),
            ("http://localhost.example.org", false),
            ("http://127.0.0.1@evil.example.org", false),
            ("ftp://127.0.0.1", false),
        ] {
            let main = MainService { server: server.to_owned(), ..MainService::default() };
            assert_eq!(main.is_safe(), is_safe, "{server}");
        }
    }
}
