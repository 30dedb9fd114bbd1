//! TLS as the command line sees it: which authorities are trusted, which certificate is shown, and
//! what to do when it fails.

use std::path::Path;

use reqwest::{Certificate, Identity};
use rustls::{AlertDescription, CertificateError, Error, InconsistentKeys};

use super::endpoint::{ClientCertificate, Endpoint};
use super::files::small;
use crate::exit::CliError;

/// How a certificate for clients is given.
const GIVE_ONE: &str = "--client-cert FILE --client-key FILE, BLAZE_CLIENT_CERT and \
    BLAZE_CLIENT_KEY, or a context that has them";

/// The authorities in a file.
///
/// # Errors
/// [`CliError::Failed`] when it cannot be read, [`CliError::Invalid`] where there are none.
pub(super) fn authorities(file: &Path) -> Result<Vec<Certificate>, CliError> {
    certificates(file, &small(file, "the authorities in")?)
}

/// The certificate to show, with its key.
///
/// # Errors
/// [`CliError::Failed`] when a file cannot be read, [`CliError::Invalid`] where there is no
/// certificate or key.
pub(super) fn identity(files: &ClientCertificate) -> Result<Identity, CliError> {
    let mut pem = small(&files.cert_file, "the client certificate")?;
    certificates(&files.cert_file, &pem)?;
    if let Some(key_file) = &files.key_file {
        // The last key counts: it is the one that was named.
        pem.push(b'\n');
        pem.extend(small(key_file, "the key of the client certificate")?);
    }
    Identity::from_pem(&pem).map_err(|_| {
        CliError::Invalid(match &files.key_file {
            Some(key_file) => format!(
                "{} holds no private key in PEM form without a password",
                key_file.display()
            ),
            None => format!(
                "{} holds no private key in PEM form without a password: name its file with \
                 --client-key",
                files.cert_file.display()
            ),
        })
    })
}

fn certificates(file: &Path, pem: &[u8]) -> Result<Vec<Certificate>, CliError> {
    match Certificate::from_pem_bundle(pem) {
        Ok(certificates) if !certificates.is_empty() => Ok(certificates),
        Ok(_) | Err(_) => {
            Err(CliError::Invalid(format!("{} holds no certificate in PEM form", file.display())))
        }
    }
}

/// Whether a client cannot be set up because certificate and key are not of one pair.
pub(super) fn is_mismatch(fault: &Error) -> bool {
    matches!(fault, Error::InconsistentKeys(InconsistentKeys::KeyMismatch))
}

/// What TLS said, wherever among the causes it stands.
pub(super) fn fault(error: &reqwest::Error) -> Option<&Error> {
    let mut cause = std::error::Error::source(error);
    while let Some(found) = cause {
        if let Some(fault) = found.downcast_ref::<Error>() {
            return Some(fault);
        }
        // What an error of input and output was made of is not its source.
        let within = found.downcast_ref::<std::io::Error>().and_then(std::io::Error::get_ref);
        cause = match within {
            Some(within) => Some(within as &(dyn std::error::Error + 'static)),
            None => found.source(),
        };
    }
    None
}

/// Whether the server ended the handshake because of the client's certificate. It hears so when it
/// has begun to send already, but nothing of that was looked at.
pub(super) fn is_refused(fault: &Error) -> bool {
    asks_for_one(fault) || refuses_ours(fault)
}

fn asks_for_one(fault: &Error) -> bool {
    // Before TLS 1.3 there was no alert of its own for it.
    matches!(
        fault,
        Error::AlertReceived(
            AlertDescription::CertificateRequired
                | AlertDescription::NoCertificate
                | AlertDescription::HandshakeFailure
        )
    )
}

fn refuses_ours(fault: &Error) -> bool {
    matches!(
        fault,
        Error::AlertReceived(
            AlertDescription::UnknownCA
                | AlertDescription::BadCertificate
                | AlertDescription::UnsupportedCertificate
                | AlertDescription::CertificateRevoked
                | AlertDescription::CertificateExpired
                | AlertDescription::CertificateUnknown
                | AlertDescription::AccessDenied
                | AlertDescription::DecryptError
        )
    )
}

/// What to do about it.
pub(super) fn advice(fault: &Error, endpoint: &Endpoint) -> Option<String> {
    let shown = endpoint.client_certificate.as_ref();
    if let Error::InvalidCertificate(reason) = fault {
        return Some(of_the_servers_certificate(reason).to_owned());
    }
    if is_refused(fault) {
        return Some(match shown {
            // It may have another reason.
            None if matches!(fault, Error::AlertReceived(AlertDescription::HandshakeFailure)) => {
                perhaps()
            }
            None => format!("The server wants to see a certificate of its clients: {GIVE_ONE}."),
            Some(files) => format!(
                "The server does not accept the client certificate {}: an authority of its \
                 tls.client_ca_file must have signed it, for clients, and it must not have run \
                 out.",
                files.cert_file.display()
            ),
        });
    }
    if matches!(fault, Error::AlertReceived(AlertDescription::UnrecognisedName)) {
        return Some(OTHER_NAME.to_owned());
    }
    if matches!(fault, Error::InvalidMessage(_)) {
        return Some(
            "What answers there does not speak TLS: if it is the right one, name it with http://."
                .to_owned(),
        );
    }
    if matches!(
        fault,
        Error::PeerIncompatible(_)
            | Error::AlertReceived(
                AlertDescription::ProtocolVersion | AlertDescription::InsufficientSecurity
            )
    ) {
        return Some(
            "The server speaks no version of TLS that is taken here: 1.2 and 1.3 are.".to_owned(),
        );
    }
    None
}

const OTHER_NAME: &str = "The certificate is for another name: give --server the name or address \
    that it was made for, or have it made for this one, too.";

fn of_the_servers_certificate(reason: &CertificateError) -> &'static str {
    if matches!(
        reason,
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. }
    ) {
        OTHER_NAME
    } else if matches!(reason, CertificateError::Expired | CertificateError::ExpiredContext { .. })
    {
        "The server's certificate has run out and must be renewed there; or the clock of this \
         machine is wrong."
    } else if matches!(
        reason,
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. }
    ) {
        "The server's certificate is not valid yet; or the clock of this machine is wrong."
    } else {
        "The certificate is not trusted: --ca-file FILE names the authority that signed it."
    }
}

/// What to do when a connection over TLS broke off without a word.
pub(super) fn broke_off(endpoint: &Endpoint) -> Option<String> {
    if endpoint.is_tls() && endpoint.client_certificate.is_none() { Some(perhaps()) } else { None }
}

fn perhaps() -> String {
    format!("If the server wants to see a certificate of its clients: {GIVE_ONE}.")
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::config::endpoint::parse_server;

    fn endpoint(with_certificate: bool) -> Endpoint {
        Endpoint {
            client_certificate: with_certificate.then(|| ClientCertificate {
                cert_file: PathBuf::from("client.pem"),
                key_file: None,
            }),
            ..Endpoint::at(parse_server("https://robot.example").unwrap())
        }
    }

    #[test]
    fn each_fault_has_its_own_advice() {
        for (fault, with_certificate, expected) in [
            (
                Error::AlertReceived(AlertDescription::CertificateRequired),
                false,
                "--client-cert FILE --client-key FILE",
            ),
            (Error::AlertReceived(AlertDescription::HandshakeFailure), false, "BLAZE_CLIENT_KEY"),
            (
                Error::AlertReceived(AlertDescription::UnknownCA),
                true,
                "does not accept the client certificate client.pem",
            ),
            (CertificateError::UnknownIssuer.into(), true, "--ca-file FILE names the authority"),
            (CertificateError::NotValidForName.into(), false, "for another name"),
            (CertificateError::Expired.into(), false, "has run out"),
            (CertificateError::NotValidYet.into(), false, "not valid yet"),
            (Error::InvalidMessage(rustls::InvalidMessage::InvalidContentType), false, "http://"),
            (Error::AlertReceived(AlertDescription::ProtocolVersion), true, "1.2 and 1.3"),
        ] {
            let advice = advice(&fault, &endpoint(with_certificate)).unwrap();
            assert!(advice.contains(expected), "{fault}: {advice}");
            assert!(!advice.contains("Name the server with"), "{fault}: {advice}");
        }
        assert_eq!(advice(&Error::General("x".to_owned()), &endpoint(false)), None);
        assert!(broke_off(&endpoint(false)).is_some() && broke_off(&endpoint(true)).is_none());
    }

    #[test]
    fn files_that_hold_something_else_are_named() {
        let directory = tempfile::tempdir().unwrap();
        let made = rcgen::generate_simple_self_signed(["client".to_owned()]).unwrap();
        let cert_file = directory.path().join("client.pem");
        let key_file = directory.path().join("client.key");
        let both =
            ClientCertificate { cert_file: cert_file.clone(), key_file: Some(key_file.clone()) };
        let alone = ClientCertificate { cert_file: cert_file.clone(), key_file: None };
        let told = |files: &ClientCertificate| match identity(files) {
            Ok(_) => String::new(),
            Err(error) => format!("{} {error}", error.exit() as u8),
        };
        assert!(told(&both).starts_with("1 the client certificate"), "{}", told(&both));
        std::fs::write(&cert_file, made.signing_key.serialize_pem()).unwrap();
        assert!(told(&alone).contains("client.pem holds no certificate"), "{}", told(&alone));
        std::fs::write(&cert_file, made.cert.pem()).unwrap();
        assert!(
            told(&alone).starts_with("7 ") && told(&alone).contains("--client-key"),
            "{}",
            told(&alone)
        );
        std::fs::write(&key_file, "nothing").unwrap();
        assert!(told(&both).contains("client.key holds no private key"), "{}", told(&both));
        std::fs::write(&key_file, made.signing_key.serialize_pem()).unwrap();
        assert_eq!(told(&both), "");
        std::fs::write(
            &cert_file,
            format!("{}{}", made.signing_key.serialize_pem(), made.cert.pem()),
        )
        .unwrap();
        assert_eq!(told(&alone), "");
    }
}
