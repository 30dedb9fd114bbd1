//! Certificates of the ports, read again when their files change.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use blaze_domain::node_file::TlsSection;
use blaze_runtime::Supervisor;
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::server::WebPkiClientVerifier;
use rustls::server::danger::ClientCertVerifier;
use rustls::{RootCertStore, ServerConfig};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

use super::Protocols;
use crate::reload::{self, read_file, watch_files};

/// Makes aws-lc-rs the cryptography of every TLS connection of this process. First thing in `main`; again is harmless.
pub fn install_crypto_provider() {
    // An error says that there is one already.
    let _ = default_provider().install_default();
}

/// TLS of all ports. Clones share it.
#[derive(Clone)]
pub struct Tls {
    shared: Arc<Shared>,
}

struct Shared {
    files: Files,
    now: ArcSwap<Configs>,
}

struct Files {
    certificate: PathBuf,
    key: PathBuf,
    client_authorities: Option<PathBuf>,
}

struct Configs {
    both: Arc<ServerConfig>,
    http2: Arc<ServerConfig>,
}

impl Tls {
    /// Reads the files; `None` without a certificate.
    ///
    /// # Errors
    /// Every fault, with its place in the node file and the file that has it.
    pub fn load(section: &TlsSection) -> Result<Option<Self>, Vec<String>> {
        let (Some(certificate), Some(key)) = (&section.cert_file, &section.key_file) else {
            return Ok(None);
        };
        let files = Files {
            certificate: certificate.clone(),
            key: key.clone(),
            client_authorities: section.client_ca_file.clone(),
        };
        let now = ArcSwap::from_pointee(files.read()?);
        Ok(Some(Self {
            shared: Arc::new(Shared { files, now }),
        }))
    }

    /// Reads the files again when they change. Connections that are open stay; if the files are faulty, what held before
    /// holds on.
    pub fn watch(&self, supervisor: &Supervisor) {
        self.watch_every(supervisor, reload::PERIOD);
    }

    pub(super) fn watch_every(&self, supervisor: &Supervisor, period: Duration) {
        let files = &self.shared.files;
        let paths = [&files.certificate, &files.key]
            .into_iter()
            .chain(&files.client_authorities);
        let paths = paths.cloned().collect();
        let shared = Arc::clone(&self.shared);
        watch_files(supervisor, "certificates", paths, period, move || {
            match shared.files.read() {
                Ok(configs) => {
                    shared.now.store(Arc::new(configs));
                    Vec::new()
                }
                Err(faults) => faults,
            }
        });
    }

    /// For the next connection.
    pub(super) fn config(&self, protocols: Protocols) -> Arc<ServerConfig> {
        let now = self.shared.now.load();
        match protocols {
            Protocols::Both => Arc::clone(&now.both),
            Protocols::Http2 => Arc::clone(&now.http2),
        }
    }
}

impl std::fmt::Debug for Tls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let files = &self.shared.files;
        f.debug_struct("Tls")
            .field("certificate", &files.certificate)
            .field("client_authorities", &files.client_authorities)
            .finish_non_exhaustive()
    }
}

impl Files {
    fn read(&self) -> Result<Configs, Vec<String>> {
        let at = |name: &str| {
            let place = format!("control_plane.tls.{name}: ");
            move |fault: String| place.clone() + &fault
        };
        let chain = certificates(&self.certificate).map_err(at("cert_file"));
        let key = private_key(&self.key).map_err(at("key_file"));
        let authorities = self.client_authorities.as_deref().map(authorities).transpose();
        match (chain, key, authorities.map_err(at("client_ca_file"))) {
            (Ok(chain), Ok(key), Ok(clients)) => {
                build(chain, key, clients).map_err(|fault| vec![at("cert_file")(self.told(&fault))])
            }
            (chain, key, clients) => Err([chain.err(), key.err(), clients.err()].into_iter().flatten().collect()),
        }
    }

    fn told(&self, fault: &str) -> String {
        let (certificate, key) = (self.certificate.display(), self.key.display());
        format!("{certificate} and {key} do not go together: {fault}")
    }
}

fn build(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    clients: Option<Arc<dyn ClientCertVerifier>>,
) -> Result<Configs, String> {
    let builder = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| error.to_string())?;
    let builder = match clients {
        None => builder.with_no_client_auth(),
        Some(verifier) => builder.with_client_cert_verifier(verifier),
    };
    let mut both = builder
        .with_single_cert(chain, key)
        .map_err(|error| error.to_string())?;
    let mut http2 = both.clone();
    both.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    http2.alpn_protocols = vec![b"h2".to_vec()];
    Ok(Configs {
        both: Arc::new(both),
        http2: Arc::new(http2),
    })
}

/// Who may sign certificates of clients.
fn authorities(path: &Path) -> Result<Arc<dyn ClientCertVerifier>, String> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(path)? {
        let added = roots.add(certificate);
        added.map_err(|error| format!("{}: no certificate of an authority: {error}", path.display()))?;
    }
    let provider = Arc::new(default_provider());
    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
    verifier.map_err(|error| format!("{}: {error}", path.display()))
}

/// At least one.
fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let text = read_file(path)?;
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    match found {
        Ok(found) if found.is_empty() => Err(format!("{} holds no certificate in PEM form", path.display())),
        Ok(found) => Ok(found),
        Err(error) => Err(format!("{} is no PEM file: {error}", path.display())),
    }
}

fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, String> {
    let text = read_file(path)?;
    // The text of the fault could hold a part of the key.
    PrivateKeyDer::from_pem_slice(&text).map_err(|_| format!("{} holds no private key in PEM form", path.display()))
}
