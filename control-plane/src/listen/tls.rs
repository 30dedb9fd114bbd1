//! Certificates of the ports, read again when their files change.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum_server::tls_rustls::RustlsConfig;
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

/// Makes aws-lc-rs the cryptography of every TLS connection of this process. First thing in `main`;
/// again is harmless.
pub fn install_crypto_provider() {
    // An error says that there is one already.
    let _ = default_provider().install_default();
}

/// TLS of all ports. Clones share it.
#[derive(Debug, Clone)]
pub struct Tls {
    files: Arc<Files>,
    both: RustlsConfig,
    http2: RustlsConfig,
}

#[derive(Debug)]
struct Files {
    certificate: PathBuf,
    key: PathBuf,
    client_authorities: Option<PathBuf>,
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
        let [both, http2] = files.read()?.map(RustlsConfig::from_config);
        Ok(Some(Self { files: Arc::new(files), both, http2 }))
    }

    /// Reads the files again when they change. Connections that are open stay; if the files are
    /// faulty, what held before holds on.
    pub fn watch(&self, supervisor: &Supervisor) {
        self.watch_every(supervisor, reload::PERIOD);
    }

    pub(super) fn watch_every(&self, supervisor: &Supervisor, period: Duration) {
        let files = &self.files;
        let paths = [&files.certificate, &files.key].into_iter().chain(&files.client_authorities);
        let (paths, tls) = (paths.cloned().collect(), self.clone());
        watch_files(supervisor, "certificates", paths, period, move || match tls.files.read() {
            Ok([both, http2]) => {
                tls.both.reload_from_config(both);
                tls.http2.reload_from_config(http2);
                Vec::new()
            }
            Err(faults) => faults,
        });
    }

    /// What the connections of a port are encrypted with, now and after each reload.
    pub(super) fn config(self, protocols: Protocols) -> RustlsConfig {
        match protocols {
            Protocols::Both => self.both,
            Protocols::Http2 => self.http2,
        }
    }
}

impl Files {
    /// For [`Protocols::Both`], and for [`Protocols::Http2`].
    fn read(&self) -> Result<[Arc<ServerConfig>; 2], Vec<String>> {
        let at = |name: &str| {
            let place = format!("control_plane.tls.{name}: ");
            move |fault: String| place.clone() + &fault
        };
        let chain = certificates(&self.certificate).map_err(at("cert_file"));
        let key = private_key(&self.key).map_err(at("key_file"));
        let authorities = self.client_authorities.as_deref().map(authorities).transpose();
        match (chain, key, authorities.map_err(at("client_ca_file"))) {
            (Ok(chain), Ok(key), Ok(clients)) => build(chain, key, clients)
                .map_err(|fault| vec![at("cert_file")(self.mismatch(&fault))]),
            (chain, key, clients) => {
                Err([chain.err(), key.err(), clients.err()].into_iter().flatten().collect())
            }
        }
    }

    fn mismatch(&self, fault: &str) -> String {
        let (certificate, key) = (self.certificate.display(), self.key.display());
        format!("{certificate} and {key} do not go together: {fault}")
    }
}

fn build(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    clients: Option<Arc<dyn ClientCertVerifier>>,
) -> Result<[Arc<ServerConfig>; 2], String> {
    let builder = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| error.to_string())?;
    let builder = match clients {
        None => builder.with_no_client_auth(),
        Some(verifier) => builder.with_client_cert_verifier(verifier),
    };
    let mut both = builder.with_single_cert(chain, key).map_err(|error| error.to_string())?;
    let mut http2 = both.clone();
    both.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    http2.alpn_protocols = vec![b"h2".to_vec()];
    Ok([both, http2].map(Arc::new))
}

/// Who may sign certificates of clients.
fn authorities(path: &Path) -> Result<Arc<dyn ClientCertVerifier>, String> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(path)? {
        let added = roots.add(certificate);
        added.map_err(|error| {
            format!("{}: no certificate of an authority: {error}", path.display())
        })?;
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
        Ok(found) if found.is_empty() => {
            Err(format!("{} holds no certificate in PEM form", path.display()))
        }
        Ok(found) => Ok(found),
        Err(error) => Err(format!("{} is no PEM file: {error}", path.display())),
    }
}

fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, String> {
    let text = read_file(path)?;
    // The text of the fault could hold a part of the key.
    PrivateKeyDer::from_pem_slice(&text)
        .map_err(|_| format!("{} holds no private key in PEM form", path.display()))
}
