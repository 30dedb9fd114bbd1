//! From the section of the node file to a client of the library, and the names on the server.

use std::sync::Arc;
use std::time::Duration;

use blaze_domain::names::ChannelName;
use blaze_domain::node_file::RedisBroker as Section;
use blaze_runtime::read_password;
use redis::io::tcp::TcpSettings;
use redis::{ConnectionInfo, IntoConnectionInfo, ProtocolVersion};

use crate::open::OpenError;

/// After this time without a sign from the other host a connection is dead.
const USER_TIMEOUT: Duration = Duration::from_secs(10);

/// How the server is reached.
#[derive(Debug, Clone)]
pub(super) struct Settings {
    section: Section,
    pub(super) names: Names,
    /// Host and port, or path: for people, without secrets.
    pub(super) place: String,
}

impl Settings {
    /// Reads the files that the section names. Connects nowhere.
    pub(super) fn read(section: &Section) -> Result<Self, OpenError> {
        let place = client(section)?.get_connection_info().addr().to_string();
        Ok(Self { section: section.clone(), names: Names::new(&section.prefix), place })
    }

    /// A client for one more connection, with what the files hold by now: a password or a
    /// certificate may have been exchanged.
    pub(super) fn client(&self) -> Result<redis::Client, OpenError> {
        client(&self.section)
    }
}

/// What is wrong with the section of a node scope; reads the files that it names. Channels are the
/// same ones in all databases of a server, so that a number would not keep two nodes apart.
pub(super) fn check_scope(section: &Section) -> Result<(), OpenError> {
    match client(section)?.get_connection_info().redis_settings().db() {
        0 => Ok(()),
        number => Err(fault(
            "redis.url",
            format!(
                "names database {number}, and channels are the same ones in all databases: leave \
                 it out, and give each node a prefix of its own"
            ),
        )),
    }
}

fn client(section: &Section) -> Result<redis::Client, OpenError> {
    let url = section.url.reveal();
    let tls = section.tls.is_some() || url.starts_with("rediss://");
    if tls && !cfg!(feature = "tls") {
        return Err(OpenError::NotBuilt { feature: "tls" });
    }
    // The library's words for a bad URL name its part, never its text.
    let info = url.into_connection_info().map_err(|error| fault("redis.url", error.to_string()))?;
    let info = with_login(info, section)?;
    let info = info.set_tcp_settings(tcp_settings());
    if tls { secure(info, section) } else { plain(info) }
}

fn fault(key: &str, reason: impl Into<String>) -> OpenError {
    OpenError::Setting { key: key.to_owned(), reason: reason.into() }
}

fn tcp_settings() -> TcpSettings {
    let settings = TcpSettings::default().set_nodelay(true);
    #[cfg(target_os = "linux")]
    let settings = settings.set_user_timeout(USER_TIMEOUT);
    settings
}

/// Push messages need the third version of the protocol.
fn with_login(info: ConnectionInfo, section: &Section) -> Result<ConnectionInfo, OpenError> {
    let mut login = info
        .redis_settings()
        .clone()
        .set_protocol(ProtocolVersion::RESP3)
        .set_lib_name("blaze", env!("CARGO_PKG_VERSION"));
    if let Some(user) = &section.user {
        login = login.set_username(user);
    }
    if let Some(path) = &section.password_file {
        let password = read_password(path).map_err(|error| fault("redis.password_file", error))?;
        login = login.set_password(password);
    }
    Ok(info.set_redis_settings(login))
}

fn plain(info: ConnectionInfo) -> Result<redis::Client, OpenError> {
    redis::Client::open(info).map_err(|error| fault("redis.url", error.to_string()))
}

#[cfg(not(feature = "tls"))]
fn secure(_info: ConnectionInfo, _section: &Section) -> Result<redis::Client, OpenError> {
    Err(OpenError::NotBuilt { feature: "tls" })
}

#[cfg(feature = "tls")]
fn secure(info: ConnectionInfo, section: &Section) -> Result<redis::Client, OpenError> {
    // Without effect where the program has chosen one already.
    let _ = rustls::crypto::aws_lc_rs::default_provider().install_default();
    let address = match info.addr() {
        redis::ConnectionAddr::Tcp(host, port) => redis::ConnectionAddr::TcpTls {
            host: host.clone(),
            port: *port,
            insecure: false,
            tls_params: None,
        },
        redis::ConnectionAddr::Unix(_) => {
            return Err(fault("redis.tls", "a unix socket has no TLS"));
        }
        other => other.clone(),
    };
    let files = section.tls.clone().unwrap_or_default();
    let bytes = |key: &str, path: &Option<std::path::PathBuf>| {
        let Some(path) = path else { return Ok(None) };
        let read = std::fs::read(path);
        read.map(Some).map_err(|error| fault(key, format!("{}: {error}", path.display())))
    };
    let root_cert = bytes("redis.tls.ca_file", &files.ca_file)?;
    let client_cert = bytes("redis.tls.cert_file", &files.cert_file)?;
    let client_key = bytes("redis.tls.key_file", &files.key_file)?;
    let client_tls = client_cert
        .zip(client_key)
        .map(|(client_cert, client_key)| redis::ClientTlsConfig { client_cert, client_key });
    let certificates = redis::TlsCertificates { client_tls, root_cert };
    redis::Client::build_with_tls(info.set_addr(address), certificates)
        .map_err(|error| fault("redis.tls", error.to_string()))
}

/// Names on the server: the prefix stands before each.
#[derive(Debug, Clone)]
pub(super) struct Names {
    prefix: Arc<str>,
}

impl Names {
    pub(super) fn new(prefix: &str) -> Self {
        Self { prefix: Arc::from(prefix) }
    }

    /// The channel itself.
    pub(super) fn channel(&self, channel: &ChannelName) -> Arc<str> {
        Arc::from(format!("{}{channel}", self.prefix))
    }

    /// A key that is none of a channel's.
    pub(super) fn key(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    /// Hash of what is kept of a channel for late joiners: writer → its last frames.
    pub(super) fn last(&self, channel: &ChannelName) -> Arc<str> {
        Arc::from(format!("{}blaze:last:{channel}", self.prefix))
    }

    /// Hash of the flow's leases.
    pub(super) fn leases(&self) -> Arc<str> {
        Arc::from(format!("{}blaze:flow:leases", self.prefix))
    }

    /// Key that says whose scope this is.
    pub(super) fn owner(&self) -> String {
        format!("{}blaze:flow:owner", self.prefix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blaze_domain::names::ChannelName;

    #[test]
    fn the_prefix_stands_before_every_name() {
        let names = Names::new("site:");
        let topic: ChannelName = "imu/data".parse().unwrap();
        assert_eq!(&*names.channel(&topic), "site:imu/data");
        assert_eq!(&*names.last(&topic), "site:blaze:last:imu/data");
        assert_eq!(&*names.leases(), "site:blaze:flow:leases");
        assert_eq!(names.owner(), "site:blaze:flow:owner");
    }
}
