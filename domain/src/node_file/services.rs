//! Sections of the worker and of every program: `admin`, `log`, `config`, `cache`,
//! `database`.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use super::readers::{formed, parsed, path, whole};
use super::walk::{Node, Section, from_empty};
use super::{AutoBool, RedisBroker, SecretText, auto_bool, url};
use crate::qos::word_enum;

/// Where each program answers `/livez`, `/readyz` and `/metrics`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdminSection {
    /// Of `blaze-flow`.
    pub flow: SocketAddr,
    /// Of `blaze-worker`.
    pub worker: SocketAddr,
    /// Of `blaze-monitor`.
    pub monitor: SocketAddr,
}

impl Default for AdminSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl AdminSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            flow: s.or("flow", socket, loopback(9101)),
            worker: s.or("worker", socket, loopback(9102)),
            monitor: s.or("monitor", socket, loopback(9103)),
        }
    }
}

/// A port of this machine alone: what listens is not reachable from outside unless the file says
/// so.
pub(super) fn loopback(port: u16) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::LOCALHOST, port))
}

pub(super) fn socket(node: &Node<'_>) -> Option<SocketAddr> {
    formed("an address with a port, such as 127.0.0.1:9101", |text| text.parse().ok())(node)
}

/// How the worker reaches the main service.
#[derive(Debug, Clone, PartialEq)]
pub struct ConfigSection {
    /// `https://HOST:PORT` of its gRPC port.
    pub server: SecretText,
    /// Authorities that are trusted instead of the system's; read again when it changes.
    pub ca_file: Option<PathBuf>,
    /// File that holds the token; read again when it changes.
    pub token_file: Option<PathBuf>,
    /// Own certificate, for a main service that asks for one; read again when it changes.
    pub cert_file: Option<PathBuf>,
    /// Key of the own certificate.
    pub key_file: Option<PathBuf>,
}

impl ConfigSection {
    pub(super) fn section(s: &mut Section<'_>) -> Option<Self> {
        let server = s.need("server", url(&["https://", "http://"]));
        let (ca_file, token_file) = (s.opt("ca_file", path), s.opt("token_file", path));
        let (cert_file, key_file) = (s.opt("cert_file", path), s.opt("key_file", path));
        if cert_file.is_some() != key_file.is_some() {
            return s.node.fault("cert_file and key_file go together");
        }
        Some(Self { server: server?, ca_file, token_file, cert_file, key_file })
    }
}

/// Where services of the node find copies of data.
#[derive(Debug, Clone, PartialEq)]
pub enum CacheSection {
    /// A Redis server.
    Redis(RedisBroker),
}

impl CacheSection {
    pub(super) fn section(s: &mut Section<'_>) -> Option<Self> {
        s.one_of(&[("redis", |s| RedisBroker::section(s).map(Self::Redis))])
    }
}

/// Where the worker keeps its copy of the configuration.
#[derive(Debug, Clone, PartialEq)]
pub enum DatabaseSection {
    /// A MongoDB server.
    MongoDb(MongoSection),
    /// A directory of this machine.
    Embedded {
        /// Which one.
        path: PathBuf,
    },
}

impl DatabaseSection {
    pub(super) fn section(s: &mut Section<'_>) -> Option<Self> {
        s.one_of(&[
            ("mongodb", |s| MongoSection::section(s, "blaze").map(Self::MongoDb)),
            ("embedded", |s| Some(Self::Embedded { path: s.need("path", path)? })),
        ])
    }
}

/// A database of MongoDB.
#[derive(Debug, Clone, PartialEq)]
pub struct MongoSection {
    /// `mongodb://` or `mongodb+srv://`.
    pub uri: SecretText,
    /// Name of the database.
    pub database: String,
    /// File with the password of the URI's user, if that is not in the URI.
    pub password_file: Option<PathBuf>,
}

impl MongoSection {
    /// A database, with what the URI says alone.
    #[must_use]
    pub fn of(uri: &str, database: &str) -> Self {
        Self { uri: uri.to_owned().into(), database: database.to_owned(), password_file: None }
    }

    /// The URI with a password for its user, if there is one.
    #[must_use]
    pub fn uri_with(&self, password: Option<&SecretText>) -> SecretText {
        let uri = self.uri.reveal();
        let (Some(password), Some((user, hosts))) = (password, uri.split_once('@')) else {
            return self.uri.clone();
        };
        let mut out = format!("{user}:");
        for byte in password.reveal().bytes() {
            match byte.is_ascii_alphanumeric() {
                true => out.push(char::from(byte)),
                false => out.push_str(&format!("%{byte:02X}")),
            }
        }
        format!("{out}@{hosts}").into()
    }

    pub(super) fn section(s: &mut Section<'_>, default: &str) -> Option<Self> {
        let uri: Option<SecretText> = s.need("uri", url(&["mongodb://", "mongodb+srv://"]));
        let database = s.or("database", database_name, default.to_owned());
        let password_file = s.opt("password_file", path);
        let uri = uri?;
        if password_file.is_some() && !names_user_alone(uri.reveal()) {
            return s.node.fault(
                "password_file needs a uri with a user and without a password: mongodb://USER@HOST",
            );
        }
        Some(Self { uri, database, password_file })
    }
}

/// Less than MongoDB takes, so that it can stand in a URI, a log line and a metric as it is.
fn database_name(node: &Node<'_>) -> Option<String> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    formed("the name of a database: 1 to 63 of A-Z, a-z, 0-9, _ and -", |name| {
        let is_one = (1..=63).contains(&name.len()) && name.chars().all(allowed);
        is_one.then(|| name.to_owned())
    })(node)
}

/// Whether a URI has a user and no password.
fn names_user_alone(uri: &str) -> bool {
    let place = uri.split_once("://").map_or(uri, |(_, place)| place);
    let hosts = place.split(['/', '?']).next().unwrap_or_default();
    hosts.rsplit_once('@').is_some_and(|(user, _)| !user.is_empty() && !user.contains([':', '@']))
}

word_enum!(
    /// How a log line is written.
    LogFormat {
        /// For people.
        Text = "text",
        /// For machines: one JSON object a line.
        Json = "json",
    }
);

/// `log`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogSection {
    /// A level, or directives such as `info,blaze_flow=debug`; reloads.
    pub level: String,
    /// How a line is written.
    pub format: LogFormat,
}

impl Default for LogSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl LogSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            level: s.or("level", level, "info".to_owned()),
            format: s.or("format", parsed, LogFormat::Text),
        }
    }
}

fn level(node: &Node<'_>) -> Option<String> {
    let directive = |text: &str| {
        let level = text.rsplit_once('=').map_or(text, |(_, level)| level).trim();
        ["off", "error", "warn", "info", "debug", "trace"].contains(&level)
    };
    formed(
        "error, warn, info, debug, trace, off, or directives such as info,blaze_flow=debug",
        |text| text.split(',').all(directive).then(|| text.to_owned()),
    )(node)
}

/// `worker`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerSection {
    /// Documents to start from when there is neither a database nor a last good copy.
    pub defaults_file: Option<PathBuf>,
    /// Where the last good copy lies; below the node's `state_dir` if absent.
    pub state_dir: Option<PathBuf>,
    /// Key that the last good copy is encrypted with.
    pub key_file: Option<PathBuf>,
    /// Whether services get secrets as their text.
    pub deliver_secrets: AutoBool,
    /// How long the worker answers alone on its broker, in ms.
    pub lease_ms: u32,
}

impl Default for WorkerSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl WorkerSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            defaults_file: s.opt("defaults_file", path),
            state_dir: s.opt("state_dir", path),
            key_file: s.opt("key_file", path),
            deliver_secrets: s.or("deliver_secrets", auto_bool, AutoBool::Auto),
            lease_ms: s.or("lease_ms", whole(100, 600_000), 5000),
        }
    }
}
