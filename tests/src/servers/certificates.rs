//! An authority and a certificate for 127.0.0.1, made anew for each server with TLS.

use std::path::{Path, PathBuf};

use rcgen::{BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};

/// Files in PEM form.
#[derive(Debug, Clone)]
pub(super) struct Certificates {
    /// The authority to trust.
    pub(super) authority: PathBuf,
    /// The server's certificate, for `127.0.0.1` and `localhost`.
    pub(super) certificate: PathBuf,
    /// Its key.
    pub(super) key: PathBuf,
}

impl Certificates {
    /// Makes and writes them.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub(super) fn write(folder: &Path) -> anyhow::Result<Self> {
        let authority_key = KeyPair::generate()?;
        let mut authority = CertificateParams::new(Vec::new())?;
        authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        authority
            .distinguished_name
            .push(DnType::CommonName, "Authority of one test");
        let authority_pem = authority.self_signed(&authority_key)?.pem();
        let issuer = Issuer::new(authority, authority_key);

        let key = KeyPair::generate()?;
        let mut server = CertificateParams::new(vec!["127.0.0.1".to_owned(), "localhost".to_owned()])?;
        server.extended_key_usages.push(ExtendedKeyUsagePurpose::ServerAuth);
        server.distinguished_name.push(DnType::CommonName, "Server of one test");
        let server_pem = server.signed_by(&key, &issuer)?.pem();

        let files = Self {
            authority: folder.join("authority.pem"),
            certificate: folder.join("server.pem"),
            key: folder.join("server.key"),
        };
        std::fs::write(&files.authority, authority_pem)?;
        std::fs::write(&files.certificate, server_pem)?;
        std::fs::write(&files.key, key.serialize_pem())?;
        Ok(files)
    }
}
