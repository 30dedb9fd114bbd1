//! What must hold before the service opens a port. All faults are told at once.

use std::collections::BTreeSet;

use blaze_auth::Algorithm;
use blaze_domain::node_file::{AuthSection, ControlPlaneSection, JwksSource, JwtAlgorithm};

/// Longest id of a key, in bytes: it stands beside everything that the key encrypted.
const MAX_KEY_ID_BYTES: usize = 64;

/// Checks the section of the node file; `dev` is the option `--dev`.
///
/// # Errors
/// Every reason not to start, each with the place in the node file and what to do.
pub fn check_startup(section: &ControlPlaneSection, dev: bool) -> Result<(), Vec<String>> {
    let mut faults = Vec::new();
    check_listeners(section, dev, &mut faults);
    match &section.auth {
        Some(auth) => check_auth(auth, dev, &mut faults),
        None if dev => {}
        None => faults.push(
            "control_plane.auth: no key to check tokens with, so nobody could be told from \
             anybody. Name one in \
             control_plane.auth.keys (`blaze token keygen` makes one) or control_plane.auth.jwks; \
             to try things out on \
             this machine alone, start with --dev"
                .to_owned(),
        ),
    }
    let ids = section.encryption.keys.iter().map(|key| key.id.as_str());
    check_ids("control_plane.encryption.keys", ids, &mut faults);
    if faults.is_empty() { Ok(()) } else { Err(faults) }
}

fn check_listeners(section: &ControlPlaneSection, dev: bool, faults: &mut Vec<String>) {
    let tls = &section.tls;
    let has_tls = tls.cert_file.is_some() && tls.key_file.is_some();
    if tls.client_ca_file.is_some() && !has_tls {
        faults.push(
            "control_plane.tls.client_ca_file: client certificates need TLS; set cert_file and \
             key_file too"
                .to_owned(),
        );
    }
    let with_tokens = [("rest", section.rest.listen), ("grpc", section.grpc.listen)];
    for (name, address) in with_tokens {
        if !address.ip().to_canonical().is_loopback() && !has_tls && !tls.allow_plaintext && !dev {
            faults.push(format!(
                "control_plane.{name}.listen: {address} would carry tokens in clear over the \
                 network. Set \
                 control_plane.tls.cert_file and key_file, listen on loopback, or (where something \
                 else encrypts) set \
                 control_plane.tls.allow_plaintext: true"
            ));
        }
    }
    if !dev {
        return;
    }
    for (name, address) in with_tokens.into_iter().chain([("admin", section.admin.listen)]) {
        if !address.ip().to_canonical().is_loopback() {
            faults.push(format!(
                "control_plane.{name}.listen: {address} is reached from outside, and --dev asks \
                 nobody for a token; \
                 listen on 127.0.0.1"
            ));
        }
    }
}

fn check_auth(auth: &AuthSection, dev: bool, faults: &mut Vec<String>) {
    if auth.keys.is_empty() && auth.jwks.is_none() && !dev {
        faults.push(
            "control_plane.auth: names neither keys nor jwks, so no token could be checked"
                .to_owned(),
        );
    }
    for (name, text) in [("issuer", &auth.issuer), ("audience", &auth.audience)] {
        if text.is_empty() {
            faults.push(format!("control_plane.auth.{name}: is empty"));
        }
    }
    check_ids("control_plane.auth.keys", auth.keys.iter().map(|key| key.id.as_str()), faults);
    for (index, key) in auth.keys.iter().enumerate() {
        if let Err(reason) = algorithm(key.algorithm) {
            faults.push(format!("control_plane.auth.keys[{index}].alg: {reason}"));
        }
    }
    let signing: Vec<&str> =
        auth.keys.iter().filter(|key| key.sign).map(|key| key.id.as_str()).collect();
    if signing.len() > 1 {
        let names = signing.join(", ");
        faults.push(format!(
            "control_plane.auth.keys: {names} have sign: true; one key signs new tokens"
        ));
    }
    if let Some(JwksSource::Url { url, .. }) = &auth.jwks
        && !url.reveal().starts_with("https://")
    {
        // The URL itself may hold a password.
        faults.push(
            "control_plane.auth.jwks.url: must start with https://; keys that come in clear prove \
             nothing"
                .to_owned(),
        );
    }
}

fn check_ids<'a>(place: &str, ids: impl Iterator<Item = &'a str>, faults: &mut Vec<String>) {
    let mut seen = BTreeSet::new();
    for (index, id) in ids.enumerate() {
        if id.is_empty() || id.len() > MAX_KEY_ID_BYTES || id.chars().any(char::is_control) {
            faults.push(format!(
                "{place}[{index}].id: 1 to {MAX_KEY_ID_BYTES} bytes without control characters"
            ));
        } else if !seen.insert(id) {
            faults.push(format!("{place}[{index}].id: {id:?} is the id of another key too"));
        }
    }
}

/// The algorithm of a key for tokens. The node file knows more words than are accepted here.
///
/// # Errors
/// That it is not accepted, and what is.
pub(super) fn algorithm(word: JwtAlgorithm) -> Result<Algorithm, String> {
    match word {
        JwtAlgorithm::Hs256 => Ok(Algorithm::Hs256),
        JwtAlgorithm::Rs256 => Ok(Algorithm::Rs256),
        JwtAlgorithm::EdDsa => Ok(Algorithm::EdDsa),
        JwtAlgorithm::Hs384
        | JwtAlgorithm::Hs512
        | JwtAlgorithm::Ps256
        | JwtAlgorithm::Es256
        | JwtAlgorithm::Es384 => {
            Err(format!("{word} is not taken for tokens; take HS256, RS256 or EdDSA"))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use blaze_domain::node_file::{EncryptionKey, JwtKey};

    use super::*;

    fn key(id: &str, algorithm: JwtAlgorithm, sign: bool) -> JwtKey {
        JwtKey { id: id.to_owned(), algorithm, file: PathBuf::from("jwt.key"), sign }
    }

    fn with_keys(keys: Vec<JwtKey>) -> ControlPlaneSection {
        ControlPlaneSection {
            auth: Some(AuthSection {
                issuer: "blaze".to_owned(),
                audience: "blaze-config".to_owned(),
                keys,
                jwks: None,
            }),
            ..ControlPlaneSection::default()
        }
    }

    fn faults(section: &ControlPlaneSection, dev: bool) -> String {
        check_startup(section, dev).err().unwrap_or_default().join("\n")
    }

    #[test]
    fn without_a_key_it_does_not_start_unless_for_development() {
        let nothing = ControlPlaneSection::default();
        assert!(faults(&nothing, false).contains("--dev"));
        assert!(faults(&with_keys(Vec::new()), false).contains("neither keys nor jwks"));
        assert_eq!(check_startup(&nothing, true), Ok(()));
        let good = with_keys(vec![
            key("k1", JwtAlgorithm::EdDsa, true),
            key("k2", JwtAlgorithm::Rs256, false),
        ]);
        assert_eq!(check_startup(&good, false), Ok(()));
    }

    #[test]
    fn what_leaves_the_machine_is_encrypted() {
        let mut section = with_keys(vec![key("k1", JwtAlgorithm::Hs256, true)]);
        section.rest.listen = "0.0.0.0:8080".parse().unwrap();
        section.grpc.listen = "[::]:50051".parse().unwrap();
        let found = check_startup(&section, false).unwrap_err();
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].contains("allow_plaintext"));
        // Nobody is asked for a token: plaintext or not, it stays on the machine.
        section.tls.allow_plaintext = true;
        assert_eq!(check_startup(&section, false), Ok(()));
        assert!(faults(&section, true).contains("control_plane.grpc.listen"));
        section.tls.allow_plaintext = false;
        section.tls.client_ca_file = Some(PathBuf::from("ca.pem"));
        assert!(faults(&section, false).contains("client_ca_file"));
        section.tls.cert_file = Some(PathBuf::from("cert.pem"));
        section.tls.key_file = Some(PathBuf::from("key.pem"));
        assert_eq!(check_startup(&section, false), Ok(()));
        assert!(check_startup(&section, true).is_err());
        let mut admin = ControlPlaneSection::default();
        admin.admin.listen = "0.0.0.0:9104".parse().unwrap();
        assert!(faults(&admin, true).contains("control_plane.admin.listen"));
    }

    #[test]
    fn all_faults_are_told_at_once() {
        let mut section = with_keys(vec![
            key("k1", JwtAlgorithm::Es256, true),
            key("k1", JwtAlgorithm::Hs512, true),
            key("", JwtAlgorithm::Hs256, false),
        ]);
        section.encryption.keys = ["e1", "e1"]
            .map(|id| EncryptionKey { id: id.to_owned(), file: PathBuf::from("enc.key") })
            .to_vec();
        if let Some(auth) = &mut section.auth {
            auth.issuer.clear();
            auth.jwks = Some(JwksSource::Url {
                url: "http://user:canary@example.org/jwks".to_owned().into(),
                refresh_s: 300,
            });
        }
        let found = faults(&section, false);
        for part in [
            "keys[0].alg: ES256",
            "keys[1].alg: HS512",
            "auth.keys[1].id",
            "auth.keys[2].id",
            "encryption.keys[1].id",
            "sign: true",
            "auth.issuer",
            "https://",
        ] {
            assert!(found.contains(part), "{part} in {found}");
        }
        assert!(!found.contains("canary"));
    }
}
