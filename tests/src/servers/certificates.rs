//! An authority with certificates for 127.0.0.1 and for a client, made anew for each server with
//! TLS.

use std::path::{Path, PathBuf};

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
};

/// Files in PEM form.
#[derive(Debug, Clone)]
pub struct Certificates {
    /// The authority to trust.
    pub authority: PathBuf,
    /// The server's certificate, for `127.0.0.1` and `localhost`.
    pub certificate: PathBuf,
    /// Its key.
    pub key: PathBuf,
    /// A client's certificate.
    pub client: PathBuf,
    /// Its key.
    pub client_key: PathBuf,
}

impl Certificates {
    /// Makes and writes them.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(folder: &Path) -> anyhow::Result<Self> {
        let authority_key = KeyPair::generate()?;
        let mut authority = CertificateParams::new(Vec::new())?;
        authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        authority.distinguished_name.push(DnType::CommonName, "Authority of one test");
        let authority_pem = authority.self_signed(&authority_key)?.pem();
        let issuer = Issuer::new(authority, authority_key);

        let signed = |names: &[&str], usage, name| {
            let key = KeyPair::generate()?;
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let mut params = CertificateParams::new(names)?;
            params.extended_key_usages.push(usage);
            params.distinguished_name.push(DnType::CommonName, name);
            let pem = params.signed_by(&key, &issuer)?.pem();
            anyhow::Ok((pem, key.serialize_pem()))
        };
        let (server, key) = signed(
            &["127.0.0.1", "localhost"],
            ExtendedKeyUsagePurpose::ServerAuth,
            "Server of one test",
        )?;
        let (client, client_key) =
            signed(&[], ExtendedKeyUsagePurpose::ClientAuth, "Client of one test")?;

        let files = Self {
            authority: folder.join("authority.pem"),
            certificate: folder.join("server.pem"),
            key: folder.join("server.key"),
            client: folder.join("client.pem"),
            client_key: folder.join("client.key"),
        };
        std::fs::write(&files.authority, authority_pem)?;
        for (path, pem) in [
            (&files.certificate, server),
            (&files.key, key),
            (&files.client, client),
            (&files.client_key, client_key),
        ] {
            std::fs::write(path, pem)?;
        }
        Ok(files)
    }
}
