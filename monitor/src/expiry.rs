//! When the token and the certificates of the monitor's way to the main service end.

use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use blaze_runtime::main_service::MainService;
use serde_json::Value;
use x509_parser::pem::Pem;
use x509_parser::prelude::{FromDer as _, X509Certificate};

use crate::metric::metrics;

metrics! {
    TOKEN_ENDS Gauge "blaze_token_expiration_timestamp_seconds" [] "seconds"
        "When the token in `config.token_file` ends, since 1970; no series without an end."
    CERTIFICATE_ENDS Gauge "blaze_certificate_expiration_timestamp_seconds" ["file"] "seconds"
        "When the first certificate of `config.ca_file` or `config.cert_file` ends, since 1970."
}

/// Largest file that is read, in bytes.
const MAX_BYTES: u64 = 1024 * 1024;

/// Ends, in seconds since 1970.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ends {
    /// Of the token.
    pub token: Option<i64>,
    /// Of the first certificate that ends in each file.
    pub certificates: Vec<(PathBuf, i64)>,
}

/// Reads the files that are named. What cannot be read is left out: the status stream says why.
#[must_use]
pub fn ends(main: &MainService) -> Ends {
    let token = main.token_file.as_deref().and_then(read).and_then(|text| token_end(&text));
    let own = main.certificate.as_ref().map(|(certificate, _)| certificate);
    let files = main.ca_file.iter().chain(own);
    let certificates = files.filter_map(|file| {
        let end = read(file).and_then(|text| certificates_end(&text))?;
        Some((file.clone(), end))
    });
    Ends { token, certificates: certificates.collect() }
}

fn read(path: &Path) -> Option<Vec<u8>> {
    let is_small = std::fs::metadata(path).is_ok_and(|file| file.len() <= MAX_BYTES);
    if is_small { std::fs::read(path).ok() } else { None }
}

/// `exp` of a token; its signature is for the main service to check.
fn token_end(text: &[u8]) -> Option<i64> {
    let text = std::str::from_utf8(text).ok()?.trim();
    let claims = URL_SAFE_NO_PAD.decode(text.split('.').nth(1)?).ok()?;
    serde_json::from_slice::<Value>(&claims).ok()?["exp"].as_i64()
}

fn certificates_end(text: &[u8]) -> Option<i64> {
    let ends = Pem::iter_from_buffer(text).filter_map(|pem| {
        let pem = pem.ok()?;
        let (_, certificate) = X509Certificate::from_der(&pem.contents).ok()?;
        Some(certificate.validity().not_after.timestamp())
    });
    ends.min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_a_token_is_in_its_claims() {
        let token = |claims: &str| format!("e30.{}.c2ln\n", URL_SAFE_NO_PAD.encode(claims));
        assert_eq!(token_end(token(r#"{"exp":1767225600}"#).as_bytes()), Some(1_767_225_600));
        assert_eq!(token_end(token("{}").as_bytes()), None);
        for garbage in [&b""[..], b"a.b", b"a.!!.c", b"\xff.\xff"] {
            assert_eq!(token_end(garbage), None);
        }
    }

    #[test]
    fn the_first_certificate_to_end_counts() {
        let of_year = |year: i32| {
            let mut parameters = rcgen::CertificateParams::new(vec!["a".to_owned()]).unwrap();
            parameters.not_after = rcgen::date_time_ymd(year, 1, 1);
            parameters.self_signed(&rcgen::KeyPair::generate().unwrap()).unwrap().pem()
        };
        let both = of_year(2031) + &of_year(2030);
        assert_eq!(certificates_end(both.as_bytes()), Some(1_893_456_000));
        assert_eq!(certificates_end(b"nothing"), None);
    }

    #[test]
    fn files_that_are_not_there_have_no_end() {
        let main = MainService { token_file: Some("/not/there".into()), ..MainService::default() };
        assert_eq!(ends(&main), Ends::default());
    }
}
