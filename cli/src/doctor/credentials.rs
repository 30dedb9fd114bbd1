//! `token` and `certificates`.

use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use blaze_auth::{Inspected, inspect};
use blaze_domain::node_file::{LayerBroker, NodeBroker, NodeFile, RedisBroker};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;
use rustls::{Error as TlsError, InconsistentKeys};
use serde_json::Value;
use x509_parser::parse_x509_certificate;

use super::check::Finding;
use super::limits::{EXPIRES_SOON_S, MAX_PEM_BYTES};
use super::{Node, on_thread};
use crate::config::text::{now_ms, short_duration};

/// What decides over a token.
#[derive(Debug, Clone)]
struct Token {
    mode: u32,
    content: Inspected,
}

/// Whom the token is for.
struct Holder<'a> {
    file: &'a str,
    layer: &'a str,
    node: &'a str,
}

/// `token`: the one that the worker shows to the main service.
pub(super) async fn token(node: &Node) -> Vec<Finding> {
    let path = node.file.config.as_ref().and_then(|config| config.token_file.clone());
    let Some(path) = path else {
        return vec![Finding::skipped(
            "the node file has no config.token_file",
            format!(
                "nothing to do for a main service that runs with --dev; else set \
                 config.token_file in {}",
                node.name
            ),
        )];
    };
    let id = node.file.flow_id();
    let holder = Holder {
        file: &node.name,
        layer: id.as_ref().map_or("", |id| id.layer.as_str()),
        node: id.as_ref().map_or("", |id| id.node.as_str()),
    };
    let asked = path.clone();
    let read = on_thread(move || read_token(&asked)).await;
    let read = read.unwrap_or_else(|| Err("no thread".to_owned()));
    judge_token(&path, read.as_ref(), &holder, now_ms().div_euclid(1_000))
}

fn read_token(path: &Path) -> Result<Token, String> {
    let mode = std::fs::metadata(path).map_err(|error| error.to_string())?.permissions().mode();
    let bytes = small(path).map_err(|error| error.to_string())?;
    let text = String::from_utf8(bytes).map_err(|_| "it holds no token".to_owned())?;
    // What is wrong is not said with the text: it may be another secret.
    let content = inspect(text.trim()).map_err(|_| "it holds no token".to_owned())?;
    Ok(Token { mode: mode & 0o777, content })
}

fn small(path: &Path) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    File::open(path)?.take(MAX_PEM_BYTES + 1).read_to_end(&mut content)?;
    match content.len() as u64 > MAX_PEM_BYTES {
        true => Err(io::Error::other(format!("it is larger than {MAX_PEM_BYTES} bytes"))),
        false => Ok(content),
    }
}

fn judge_token(
    path: &Path,
    read: Result<&Token, &String>,
    holder: &Holder<'_>,
    now_s: i64,
) -> Vec<Finding> {
    let Holder { file, layer, node } = holder;
    let shown = path.display();
    let renew = format!("blaze node join {node} --layer {layer} --renew --token-out {shown}");
    let token = match read {
        Ok(token) => token,
        Err(reason) => {
            let detail = format!("config.token_file {shown}: {reason}");
            return vec![Finding::fail(
                detail,
                format!("{renew}, or set config.token_file in {file}"),
            )];
        }
    };
    let claims = &token.content.claims;
    let mut findings = Vec::new();
    if token.mode & 0o077 != 0 {
        findings.push(Finding::warn(
            format!("{shown} has mode {:04o}: others may read it", token.mode),
            format!("chmod 600 {shown}"),
        ));
    }
    let of = claims.get("layer").and_then(Value::as_str).unwrap_or_default();
    if of != *layer {
        let detail = format!("{shown} is for layer {of:?}, the node file has layer {layer:?}");
        findings.push(Finding::fail(detail, renew.clone()));
    }
    let roles = claims.get("roles").and_then(Value::as_array);
    if !roles.is_some_and(|roles| roles.iter().any(|role| role == "worker")) {
        findings.push(Finding::fail(format!("{shown} lacks the role worker"), renew.clone()));
    }
    let left_s = claims.get("exp").and_then(Value::as_i64).map(|end| end.saturating_sub(now_s));
    findings.push(match left_s {
        None => Finding::fail(format!("{shown} has no end: no server takes it"), renew),
        Some(left) => judge_end(&shown.to_string(), left, &renew),
    });
    findings
}

/// How a token or certificate stands, by the seconds that it still lives.
fn judge_end(what: &str, left_s: i64, renew: &str) -> Finding {
    match left_s {
        ..=0 => Finding::fail(format!("{what} ran out {} ago", short_duration(-left_s)), renew),
        1..EXPIRES_SOON_S => {
            Finding::warn(format!("{what} runs out in {}", short_duration(left_s)), renew)
        }
        _ => Finding::ok(format!("{what} runs out in {}", short_duration(left_s))),
    }
}

/// Files of one TLS section.
#[derive(Debug, Clone, Default)]
struct Tls {
    section: &'static str,
    ca: Option<PathBuf>,
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
}

fn sections(file: &NodeFile) -> Vec<Tls> {
    let mut all = Vec::new();
    if let Some(config) = &file.config {
        let (ca, certificate, key) = (&config.ca_file, &config.cert_file, &config.key_file);
        all.push(tls("config", ca, certificate, key));
    }
    let mut redis = |section, redis: &RedisBroker| {
        if let Some(of) = &redis.tls {
            all.push(tls(section, &of.ca_file, &of.cert_file, &of.key_file));
        }
    };
    if let Some(NodeBroker::Redis(node)) = &file.brokers.node {
        redis("brokers.node.redis.tls", node);
    }
    if file.cache.is_some()
        && let Some(cache) = file.cache_redis()
    {
        redis("cache.redis.tls", cache);
    }
    if let Some(LayerBroker::Kafka(kafka)) = &file.brokers.layer {
        let path = |name: &str| kafka.properties.get(name).map(|text| text.reveal().into());
        // Those with a password or of another form are left to the client library.
        all.push(tls(
            "brokers.layer.kafka.properties",
            &path("ssl.ca.location"),
            &path("ssl.certificate.location"),
            &None,
        ));
    }
    let main = &file.control_plane.tls;
    all.push(tls("control_plane.tls", &main.client_ca_file, &main.cert_file, &main.key_file));
    all.retain(|tls| tls.ca.is_some() || tls.certificate.is_some());
    all
}

fn tls(
    section: &'static str,
    ca: &Option<PathBuf>,
    certificate: &Option<PathBuf>,
    key: &Option<PathBuf>,
) -> Tls {
    Tls { section, ca: ca.clone(), certificate: certificate.clone(), key: key.clone() }
}

/// `certificates`: those of the file, and whether keys fit.
pub(super) async fn certificates(node: &Node) -> Vec<Finding> {
    let sections = sections(&node.file);
    if sections.is_empty() {
        return vec![Finding::skipped(
            "the node file names no certificates",
            format!("nothing to do; for TLS set config.ca_file in {}", node.name),
        )];
    }
    let now_s = now_ms().div_euclid(1_000);
    let looked =
        on_thread(move || sections.iter().flat_map(|tls| examine(tls, now_s)).collect()).await;
    looked.unwrap_or_default()
}

fn examine(tls: &Tls, now_s: i64) -> Vec<Finding> {
    let section = tls.section;
    let mut findings = Vec::new();
    if let Some(path) = &tls.ca {
        // Of several authorities one may have run out: the last one to go counts.
        let ends = ends(path).map(|ends| ends.into_iter().max());
        findings.push(judge_file(&format!("{section} authority"), path, ends, now_s));
    }
    if let Some(path) = &tls.certificate {
        // The own one comes first, then those that lead to an authority.
        let ends = ends(path).map(|ends| ends.into_iter().min());
        findings.push(judge_file(&format!("{section} certificate"), path, ends, now_s));
    }
    if let (Some(certificate), Some(key)) = (&tls.certificate, &tls.key)
        && let Err(reason) = keys_match(certificate, key)
    {
        let (certificate, shown) = (certificate.display(), key.display());
        findings.push(Finding::fail(
            format!("{section}: key {shown} and certificate {certificate}: {reason}"),
            format!(
                "put the key of that certificate into {shown}: `openssl pkey -in {shown} -pubout` \
                 and `openssl x509 -in {certificate} -noout -pubkey` must print the same"
            ),
        ));
    }
    findings
}

/// When the certificates of a file run out, in seconds since 1970.
fn ends(path: &Path) -> Result<Vec<i64>, String> {
    let pem = small(path).map_err(|error| error.to_string())?;
    let mut ends = Vec::new();
    for certificate in CertificateDer::pem_slice_iter(&pem) {
        let der = certificate.map_err(|error| error.to_string())?;
        let (_, parsed) = parse_x509_certificate(&der).map_err(|error| error.to_string())?;
        ends.push(parsed.validity().not_after.timestamp());
    }
    Ok(ends)
}

fn judge_file(what: &str, path: &Path, end: Result<Option<i64>, String>, now_s: i64) -> Finding {
    let shown = path.display();
    let renew = format!(
        "put a new one into {shown}, it is read again without a restart (openssl x509 -in {shown} \
         -noout -subject -enddate shows the old one)"
    );
    match end {
        Ok(Some(end)) => judge_end(&format!("{what} {shown}"), end.saturating_sub(now_s), &renew),
        Ok(None) => {
            Finding::fail(format!("{what} {shown} holds no certificate in PEM form"), renew)
        }
        Err(reason) => Finding::fail(format!("{what} {shown}: {reason}"), renew),
    }
}

fn keys_match(certificate: &Path, key: &Path) -> Result<(), String> {
    let pem = small(certificate).map_err(|error| error.to_string())?;
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&pem).collect();
    // What is wrong with the certificate alone is told already.
    let Some(chain) = chain.ok().filter(|chain| !chain.is_empty()) else { return Ok(()) };
    let pem = small(key).map_err(|error| error.to_string())?;
    let key = PrivateKeyDer::from_pem_slice(&pem)
        .map_err(|_| "no private key in PEM form without a password".to_owned())?;
    let provider = rustls::crypto::aws_lc_rs::default_provider();
    match CertifiedKey::from_der(chain, key, &provider) {
        Ok(_) => Ok(()),
        Err(TlsError::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            Err("they are not of one pair".to_owned())
        }
        Err(error) => Err(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::check::{Check, Outcome};
    use super::*;

    const NOW_S: i64 = 1_795_000_000;

    fn judge(mode: u32, claims: &Value) -> Check {
        let claims = claims.as_object().unwrap().clone();
        let token = Token { mode, content: Inspected { header: Default::default(), claims } };
        let holder = Holder { file: "blaze.yaml", layer: "edge", node: "robot-1" };
        let found = judge_token(Path::new("/etc/blaze/t"), Ok(&token), &holder, NOW_S);
        Check::of("token", &found)
    }

    #[test]
    fn a_token_is_for_a_worker_of_the_layer_and_still_lives() {
        let claims = |left: i64, layer: &str, role: &str| {
            let end = NOW_S + left;
            json!({"exp": end, "layer": layer, "roles": [role]})
        };
        let good = claims(30 * 86_400, "edge", "worker");
        assert_eq!(judge(0o600, &good).result, Outcome::Ok);
        let open = judge(0o644, &good);
        assert_eq!((open.result, open.remedy.as_str()), (Outcome::Warn, "chmod 600 /etc/blaze/t"));
        assert_eq!(judge(0o600, &claims(86_400, "edge", "worker")).result, Outcome::Warn);
        for bad in [
            claims(-1, "edge", "worker"),
            claims(30 * 86_400, "fog", "worker"),
            claims(30 * 86_400, "edge", "viewer"),
            json!({"layer": "edge", "roles": ["worker"]}),
        ] {
            let check = judge(0o600, &bad);
            assert_eq!(check.result, Outcome::Fail, "{bad}");
            let renew = "blaze node join robot-1 --layer edge --renew --token-out /etc/blaze/t";
            assert_eq!(check.remedy, renew);
        }
    }

    #[test]
    fn no_text_of_a_file_that_holds_something_else_is_shown() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        std::fs::write(&path, "sesame").unwrap();
        let reason = read_token(&path).unwrap_err();
        assert_eq!(reason, "it holds no token");
        assert!(read_token(&folder.path().join("none")).is_err());
    }

    fn certificate(folder: &Path, name: &str, until: (i32, u8, u8)) -> (PathBuf, PathBuf) {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::new(vec!["h".to_owned()]).unwrap();
        params.not_before = rcgen::date_time_ymd(2000, 1, 1);
        params.not_after = rcgen::date_time_ymd(until.0, until.1, until.2);
        let made = params.self_signed(&key).unwrap();
        let (path, key_path) = (folder.join(name), folder.join(format!("{name}.key")));
        std::fs::write(&path, made.pem()).unwrap();
        std::fs::write(&key_path, key.serialize_pem()).unwrap();
        (path, key_path)
    }

    #[test]
    fn certificates_run_out_and_keys_have_to_fit() {
        let folder = tempfile::tempdir().unwrap();
        let (good, key) = certificate(folder.path(), "good", (4000, 1, 1));
        let (old, _) = certificate(folder.path(), "old", (2001, 1, 1));
        let (_, other_key) = certificate(folder.path(), "other", (4000, 1, 1));
        let examine =
            |ca: Option<&PathBuf>, certificate: Option<&PathBuf>, key: Option<&PathBuf>| {
                let tls = tls("config", &ca.cloned(), &certificate.cloned(), &key.cloned());
                Check::of("certificates", &super::examine(&tls, NOW_S))
            };
        assert_eq!(examine(Some(&good), Some(&good), Some(&key)).result, Outcome::Ok);
        let expired = examine(None, Some(&old), None);
        assert_eq!(expired.result, Outcome::Fail);
        assert!(expired.detail.contains("ran out"), "{expired:?}");
        let mismatch = examine(None, Some(&good), Some(&other_key));
        assert_eq!(mismatch.result, Outcome::Fail);
        assert!(mismatch.detail.contains("not of one pair"), "{mismatch:?}");
        // A bundle in which one authority has run out still serves.
        let bundle = folder.path().join("bundle");
        let both = [&good, &old].map(|path| std::fs::read_to_string(path).unwrap()).concat();
        std::fs::write(&bundle, both).unwrap();
        assert_eq!(examine(Some(&bundle), None, None).result, Outcome::Ok);
        let empty = examine(Some(&key), None, None);
        assert!(empty.detail.contains("no certificate"), "{empty:?}");
    }

    #[test]
    fn what_ends_soon_is_a_warning() {
        let left = |left_s| judge_end("x", left_s, "renew").result;
        assert_eq!(left(0), Outcome::Fail);
        assert_eq!(left(1), Outcome::Warn);
        assert_eq!(left(EXPIRES_SOON_S - 1), Outcome::Warn);
        assert_eq!(left(EXPIRES_SOON_S), Outcome::Ok);
    }
}
