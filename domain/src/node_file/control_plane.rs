//! `control_plane`: the main service of the configuration.

use std::net::SocketAddr;
use std::path::PathBuf;

use super::readers::{boolean, parsed, path, text, whole};
use super::services::{MongoSection, loopback, socket};
use super::walk::{Node, Section, from_empty};
use super::{SecretText, url};
use crate::qos::word_enum;

/// `control_plane`.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlPlaneSection {
    /// REST.
    pub rest: ListenSection,
    /// gRPC.
    pub grpc: GrpcSection,
    /// `/livez`, `/readyz`, `/metrics`.
    pub admin: ListenSection,
    /// Certificates of REST and gRPC.
    pub tls: TlsSection,
    /// Where documents are kept.
    pub store: StoreSection,
    /// Who may do what; absent: as the service decides for a machine of its own.
    pub auth: Option<AuthSection>,
    /// Keys that secrets are encrypted with.
    pub encryption: EncryptionSection,
    /// How much of the past is kept.
    pub history: HistorySection,
    /// What one client may take.
    pub limits: LimitsSection,
}

impl Default for ControlPlaneSection {
    fn default() -> Self {
        from_empty(Self::section)
    }
}

impl ControlPlaneSection {
    pub(super) fn section(s: &mut Section<'_>) -> Self {
        Self {
            rest: s.sub_or_empty("rest", |s| ListenSection::section(s, 8080)),
            grpc: s.sub_or_empty("grpc", |s| GrpcSection {
                listen: s.or("listen", socket, loopback(50_051)),
                reflection: s.or("reflection", boolean, false),
            }),
            admin: s.sub_or_empty("admin", |s| ListenSection::section(s, 9104)),
            tls: s.sub_or_empty("tls", TlsSection::section),
            store: s.sub("store", StoreSection::section).unwrap_or_default(),
            auth: s.sub("auth", AuthSection::section),
            encryption: s.sub_or_empty("encryption", |s| EncryptionSection {
                keys: s.list("keys", |node| node.section(EncryptionKey::section).flatten()),
            }),
            history: s.sub_or_empty("history", HistorySection::section),
            limits: s.sub_or_empty("limits", LimitsSection::section),
        }
    }
}

/// One port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListenSection {
    /// Address and port; port 0 lets the system choose.
    pub listen: SocketAddr,
}

impl ListenSection {
    fn section(s: &mut Section<'_>, port: u16) -> Self {
        Self { listen: s.or("listen", socket, loopback(port)) }
    }
}

/// The gRPC port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrpcSection {
    /// Address and port; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// Whether it describes itself to anybody who asks.
    pub reflection: bool,
}

/// Certificates; all files are read again when they change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsSection {
    /// Own certificate.
    pub cert_file: Option<PathBuf>,
    /// Key of the own certificate.
    pub key_file: Option<PathBuf>,
    /// Authorities whose clients are accepted.
    pub client_ca_file: Option<PathBuf>,
    /// Whether other addresses than loopback may be served without TLS.
    pub allow_plaintext: bool,
}

impl TlsSection {
    fn section(s: &mut Section<'_>) -> Self {
        let tls = Self {
            cert_file: s.opt("cert_file", path),
            key_file: s.opt("key_file", path),
            client_ca_file: s.opt("client_ca_file", path),
            allow_plaintext: s.or("allow_plaintext", boolean, false),
        };
        if tls.cert_file.is_some() != tls.key_file.is_some() {
            s.node.fault::<()>("cert_file and key_file go together");
        }
        tls
    }
}

/// Where documents are kept.
#[derive(Debug, Clone, PartialEq)]
pub enum StoreSection {
    /// A file; one process.
    Sqlite {
        /// Which one.
        path: PathBuf,
    },
    /// A MongoDB replica set.
    MongoDb(MongoSection),
}

impl Default for StoreSection {
    fn default() -> Self {
        Self::Sqlite { path: PathBuf::from("./blaze-config.db") }
    }
}

impl StoreSection {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        s.one_of(&[
            ("sqlite", |s| {
                Some(Self::Sqlite { path: s.or("path", path, PathBuf::from("./blaze-config.db")) })
            }),
            ("mongodb", |s| MongoSection::section(s, "blaze_main").map(Self::MongoDb)),
        ])
    }
}

/// Tokens that are accepted.
#[derive(Debug, Clone, PartialEq)]
pub struct AuthSection {
    /// `iss` that a token must have.
    pub issuer: String,
    /// `aud` that a token must have.
    pub audience: String,
    /// Keys of this machine.
    pub keys: Vec<JwtKey>,
    /// Keys of an identity provider.
    pub jwks: Option<JwksSource>,
}

impl AuthSection {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        Some(Self {
            issuer: s.or("issuer", text, "blaze".to_owned()),
            audience: s.or("audience", text, "blaze-config".to_owned()),
            keys: s.list("keys", |node| node.section(JwtKey::section).flatten()),
            jwks: s.opt("jwks", jwks),
        })
    }
}

word_enum!(
    /// Signature of a token.
    JwtAlgorithm {
        /// HMAC with SHA-256.
        Hs256 = "HS256",
        /// HMAC with SHA-384.
        Hs384 = "HS384",
        /// HMAC with SHA-512.
        Hs512 = "HS512",
        /// RSA with SHA-256.
        Rs256 = "RS256",
        /// RSA-PSS with SHA-256.
        Ps256 = "PS256",
        /// ECDSA on P-256.
        Es256 = "ES256",
        /// ECDSA on P-384.
        Es384 = "ES384",
        /// Ed25519.
        EdDsa = "EdDSA",
    }
);

/// One key for tokens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JwtKey {
    /// `kid` of the token.
    pub id: String,
    /// Signature.
    pub algorithm: JwtAlgorithm,
    /// File that holds the key.
    pub file: PathBuf,
    /// Whether this key signs the tokens that the service gives out.
    pub sign: bool,
}

impl JwtKey {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let (id, algorithm) = (s.need("id", text), s.need("alg", parsed));
        let (file, sign) = (s.need("file", path), s.or("sign", boolean, false));
        Some(Self { id: id?, algorithm: algorithm?, file: file?, sign })
    }
}

/// Where the keys of an identity provider come from.
#[derive(Debug, Clone, PartialEq)]
pub enum JwksSource {
    /// Asked for again and again.
    Url {
        /// `https://…`.
        url: SecretText,
        /// How often, in seconds.
        refresh_s: u32,
    },
    /// A file.
    File(PathBuf),
}

fn jwks(node: &Node<'_>) -> Option<JwksSource> {
    node.section(|s| {
        let url = s.opt("url", url(&["https://", "http://"]));
        let (file, refresh_s) = (s.opt("file", path), s.or("refresh_s", whole(10, 86_400), 300));
        match (url, file) {
            (Some(url), None) => Some(JwksSource::Url { url, refresh_s }),
            (None, Some(file)) => Some(JwksSource::File(file)),
            _ => s.node.fault("needs one of url, file"),
        }
    })
    .flatten()
}

/// Keys that secrets are encrypted with: the first encrypts, all decrypt.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EncryptionSection {
    /// The keys, newest first.
    pub keys: Vec<EncryptionKey>,
}

/// One key for secrets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncryptionKey {
    /// Its name beside what it encrypted.
    pub id: String,
    /// File that holds the key.
    pub file: PathBuf,
}

impl EncryptionKey {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let (id, file) = (s.need("id", text), s.need("file", path));
        Some(Self { id: id?, file: file? })
    }
}

/// How much of the past is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistorySection {
    /// Revisions, at most.
    pub keep_revisions: u64,
    /// Age of a revision, at most, in seconds.
    pub keep_s: u64,
    /// Versions per document, at most.
    pub keep_versions: u32,
    /// Between two clearings, in seconds.
    pub trim_period_s: u32,
}

impl HistorySection {
    fn section(s: &mut Section<'_>) -> Self {
        Self {
            keep_revisions: s.or("keep_revisions", whole(1, 1_000_000_000), 100_000),
            keep_s: s.or("keep_s", whole(1, 10_000_000_000), 2_592_000),
            keep_versions: s.or("keep_versions", whole(1, 100_000), 20),
            trim_period_s: s.or("trim_period_s", whole(1, 86_400), 60),
        }
    }
}

/// What one client may take; 0 is no limit where a rate is meant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LimitsSection {
    /// Requests at work at once.
    pub in_flight: u32,
    /// Watches per subject.
    pub watches_per_subject: u32,
    /// Requests per subject and second; 0: no limit.
    pub requests_per_s: u32,
    /// Refused tokens per address and second; 0: no limit.
    pub auth_failures_per_s: u32,
}

impl LimitsSection {
    fn section(s: &mut Section<'_>) -> Self {
        Self {
            in_flight: s.or("in_flight", whole(1, 1_000_000), 512),
            watches_per_subject: s.or("watches_per_subject", whole(1, 1_000_000), 1000),
            requests_per_s: s.or("requests_per_s", whole(0, 1_000_000), 0),
            auth_failures_per_s: s.or("auth_failures_per_s", whole(0, 1_000_000), 10),
        }
    }
}
