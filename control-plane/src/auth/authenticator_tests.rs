use std::fs;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::Router;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Redirect};
use axum::routing::get;
use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use blaze_auth::{Algorithm, GeneratedKey, NewToken, Realm, generate_key, read_key, sign_locally};
use blaze_domain::node_file::{AuthSection, JwksSource, JwtAlgorithm, JwtKey, TlsSection};
use blaze_runtime::Supervisor;
use parking_lot::Mutex;
use rcgen::{CertificateParams, KeyPair};
use serde_json::{Value, json};

use super::jwks::Provider;
use super::{Authenticator, NamedKey};
use crate::listen::{ListenLimits, Listener, Protocols, Tls};
use crate::metrics::ApiMetrics;

const NOW_S: i64 = 1_795_244_472;
const SOON: Duration = Duration::from_secs(10);
const OFTEN: Duration = Duration::from_millis(10);

fn roles() -> Vec<String> {
    vec!["viewer".to_owned()]
}

fn new_token<'a>(roles: &'a [String], id: &'a str) -> NewToken<'a> {
    NewToken { subject: "ops", roles, layer: None, issued_s: NOW_S, expires_s: NOW_S + 60, id }
}

fn token(algorithm: Algorithm, private: &str, kid: &str) -> String {
    let roles = roles();
    let token = new_token(&roles, "t");
    sign_locally(&Realm::default(), private.as_bytes(), algorithm, Some(kid), &token).unwrap()
}

fn key(id: &str, algorithm: JwtAlgorithm, file: &Path, sign: bool) -> JwtKey {
    JwtKey { id: id.to_owned(), algorithm, file: file.to_owned(), sign }
}

fn section(keys: Vec<JwtKey>, jwks: Option<JwksSource>) -> AuthSection {
    AuthSection { issuer: "blaze".to_owned(), audience: "blaze-config".to_owned(), keys, jwks }
}

/// The key of an Ed25519 file as a JWK.
fn jwk(kid: &str, made: &GeneratedKey) -> Value {
    let body: String =
        made.public.as_ref().unwrap().lines().filter(|line| !line.starts_with("--")).collect();
    let spki = STANDARD.decode(body).unwrap();
    let x = URL_SAFE_NO_PAD.encode(&spki[spki.len() - 32..]);
    json!({ "kty": "OKP", "crv": "Ed25519", "kid": kid, "x": x })
}

async fn accepted(authenticator: &Authenticator, token: &str) {
    let reached = async {
        while authenticator.verify(token, NOW_S).is_err() {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    let found = tokio::time::timeout(SOON, reached).await;
    assert!(found.is_ok(), "{:?}", authenticator.verify(token, NOW_S));
}

#[test]
fn what_it_signs_it_accepts_until_it_runs_out() {
    let made = generate_key(Algorithm::Hs256).unwrap();
    let local = NamedKey {
        id: "k1".to_owned(),
        key: read_key(Algorithm::Hs256, made.private.as_bytes(), true).unwrap(),
        sign: true,
    };
    let authenticator = Authenticator::with_keys(Realm::default(), vec![local.clone()]);
    assert!(authenticator.has_keys());
    let roles = roles();
    let text = authenticator.sign(&new_token(&roles, "t-1")).unwrap().unwrap();
    let first = authenticator.verify(&text, NOW_S).unwrap();
    assert_eq!((first.subject.as_str(), first.token_id.as_deref()), ("ops", Some("t-1")));
    let again = authenticator.verify(&text, NOW_S + 89).unwrap();
    assert!(Arc::ptr_eq(&first, &again), "it is remembered");
    assert!(authenticator.verify(&text, NOW_S + 90).is_err(), "though remembered");
    assert!(authenticator.verify(&format!("{text}A"), NOW_S).is_err());
    assert!(authenticator.verify(&text.repeat(100), NOW_S).unwrap_err().contains("8192"));
    let closed = Authenticator::closed();
    assert!(!closed.has_keys());
    assert!(closed.verify(&text, NOW_S).is_err());
    assert!(closed.sign(&new_token(&roles, "t")).is_none());
    let checks_only =
        Authenticator::with_keys(Realm::default(), vec![NamedKey { sign: false, ..local }]);
    assert!(checks_only.sign(&new_token(&roles, "t")).is_none());
    assert!(checks_only.verify(&text, NOW_S).is_ok());
    assert!(!format!("{authenticator:?}").contains(made.private.trim()));
}

#[tokio::test]
async fn keys_rotate_while_it_runs() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("k1"), folder.path().join("k2"));
    let old = generate_key(Algorithm::Hs256).unwrap();
    let new = generate_key(Algorithm::Hs256).unwrap();
    let ed = generate_key(Algorithm::EdDsa).unwrap();
    fs::write(&first, &*old.private).unwrap();
    fs::write(&second, ed.public.as_ref().unwrap()).unwrap();
    let keys = vec![
        key("k1", JwtAlgorithm::Hs256, &first, true),
        key("k2", JwtAlgorithm::EdDsa, &second, false),
    ];
    let authenticator = Authenticator::load(&section(keys, None)).unwrap();
    let supervisor = Supervisor::new("test");
    authenticator.watch_every(&supervisor, OFTEN, SOON);
    let old_token = token(Algorithm::Hs256, &old.private, "k1");
    let ed_token = token(Algorithm::EdDsa, &ed.private, "k2");
    assert!(
        authenticator.verify(&old_token, NOW_S).is_ok()
            && authenticator.verify(&ed_token, NOW_S).is_ok()
    );
    // One file is replaced, the other spoilt: the first holds, of the second what it was.
    fs::write(&second, "no key").unwrap();
    fs::write(&first, &*new.private).unwrap();
    accepted(&authenticator, &token(Algorithm::Hs256, &new.private, "k1")).await;
    assert!(
        authenticator.verify(&old_token, NOW_S).is_err(),
        "remembered tokens go with their key"
    );
    assert!(authenticator.verify(&ed_token, NOW_S).is_ok());
    assert!(supervisor.shutdown(SOON).await.is_clean());
}

#[tokio::test]
async fn a_key_set_comes_from_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("jwks.json");
    let (one, two) =
        (generate_key(Algorithm::EdDsa).unwrap(), generate_key(Algorithm::EdDsa).unwrap());
    fs::write(&file, json!({ "keys": [jwk("p1", &one)] }).to_string()).unwrap();
    let source = || Some(JwksSource::File(file.clone()));
    let authenticator = Authenticator::load(&section(Vec::new(), source())).unwrap();
    let supervisor = Supervisor::new("test");
    authenticator.watch_every(&supervisor, OFTEN, SOON);
    accepted(&authenticator, &token(Algorithm::EdDsa, &one.private, "p1")).await;
    let both = json!({ "keys": [jwk("p1", &one), jwk("p2", &two)] });
    fs::write(&file, both.to_string()).unwrap();
    accepted(&authenticator, &token(Algorithm::EdDsa, &two.private, "p2")).await;
    fs::write(&file, "{").unwrap();
    assert!(
        Authenticator::load(&section(Vec::new(), source())).unwrap_err()[0].contains("jwks.json")
    );
    assert!(supervisor.shutdown(SOON).await.is_clean());
    accepted(&authenticator, &token(Algorithm::EdDsa, &one.private, "p1")).await;
}

#[test]
fn all_faulty_files_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("k1");
    fs::write(&file, "short").unwrap();
    let keys = vec![
        key("k1", JwtAlgorithm::Hs256, &file, false),
        key("k2", JwtAlgorithm::Rs256, &folder.path().join("gone"), false),
        key("k3", JwtAlgorithm::Es256, &file, false),
    ];
    let source = JwksSource::Url { url: "http://127.0.0.1/keys".to_owned().into(), refresh_s: 300 };
    let faults = Authenticator::load(&section(keys, Some(source))).unwrap_err().join("\n");
    for part in [
        "control_plane.auth.keys[0].file: ",
        "(key k1) holds 5 bytes",
        "gone cannot be read",
        "ES256",
        "https://",
    ] {
        assert!(faults.contains(part), "{part} in {faults}");
    }
}

/// An identity provider: what it answers, and how often it was asked.
struct Served {
    supervisor: Supervisor,
    keys: Arc<Mutex<Value>>,
    asked: Arc<AtomicUsize>,
    base: String,
    root: String,
}

async fn identity_provider() -> Served {
    let folder = tempfile::tempdir().unwrap();
    let own = KeyPair::generate().unwrap();
    let params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
    let root = params.self_signed(&own).unwrap().pem();
    let (cert_file, key_file) = (folder.path().join("cert.pem"), folder.path().join("key.pem"));
    fs::write(&cert_file, &root).unwrap();
    fs::write(&key_file, own.serialize_pem()).unwrap();
    let tls = TlsSection {
        cert_file: Some(cert_file),
        key_file: Some(key_file),
        client_ca_file: None,
        allow_plaintext: false,
    };
    let (keys, asked) =
        (Arc::new(Mutex::new(json!({ "keys": [] }))), Arc::new(AtomicUsize::new(0)));
    let (given, count) = (Arc::clone(&keys), Arc::clone(&asked));
    let answer = move || {
        count.fetch_add(1, Ordering::Relaxed);
        let text = given.lock().to_string();
        async move { text }
    };
    let router = Router::new()
        .route("/keys", get(answer))
        .route("/moved", get(|| async { Redirect::temporary("/keys") }))
        .route("/large", get(|| async { "x".repeat(256 * 1024 + 1) }))
        .route("/broken", get(|| async { StatusCode::INTERNAL_SERVER_ERROR.into_response() }));
    let supervisor = Supervisor::new("test");
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let tls = Tls::load(&tls).unwrap();
    let listener =
        Listener::bind("rest", any, tls, Protocols::Both, ListenLimits::default()).await.unwrap();
    let base = format!("https://localhost:{}", listener.local_addr().port());
    listener.serve(&supervisor, router, &ApiMetrics::new().unwrap());
    Served { supervisor, keys, asked, base, root }
}

impl Served {
    fn provider(&self, path: &str) -> Provider {
        let root = reqwest::Certificate::from_pem(self.root.as_bytes()).unwrap();
        Provider::new(format!("{}{path}", self.base).into(), Some(vec![root])).unwrap()
    }
}

#[tokio::test]
async fn a_key_set_is_fetched_and_fetched_again_for_an_unknown_key() {
    let served = identity_provider().await;
    let (one, two) =
        (generate_key(Algorithm::EdDsa).unwrap(), generate_key(Algorithm::EdDsa).unwrap());
    *served.keys.lock() = json!({ "keys": [jwk("p1", &one)] });
    let authenticator =
        Authenticator::with_provider(served.provider("/keys"), Duration::from_secs(3600));
    assert!(!authenticator.has_keys());
    authenticator.watch_every(&served.supervisor, OFTEN, OFTEN);
    accepted(&authenticator, &token(Algorithm::EdDsa, &one.private, "p1")).await;
    let before = served.asked.load(Ordering::Relaxed);
    for _ in 0..100 {
        assert!(authenticator.verify(&token(Algorithm::EdDsa, &one.private, "p1"), NOW_S).is_ok());
    }
    *served.keys.lock() = json!({ "keys": [jwk("p2", &two)] });
    // Nothing but the unknown key makes it ask within the hour.
    accepted(&authenticator, &token(Algorithm::EdDsa, &two.private, "p2")).await;
    assert!(served.asked.load(Ordering::Relaxed) > before);
    assert!(authenticator.verify(&token(Algorithm::EdDsa, &one.private, "p1"), NOW_S).is_err());
    // What is no key set leaves the keys as they were.
    *served.keys.lock() = json!([]);
    let before = served.asked.load(Ordering::Relaxed);
    let unknown = token(Algorithm::EdDsa, &one.private, "p3");
    let asked_again = async {
        while served.asked.load(Ordering::Relaxed) < before + 2 {
            assert!(authenticator.verify(&unknown, NOW_S).is_err());
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    tokio::time::timeout(SOON, asked_again).await.unwrap();
    assert!(authenticator.verify(&token(Algorithm::EdDsa, &two.private, "p2"), NOW_S).is_ok());
    assert!(served.supervisor.shutdown(SOON).await.is_clean());
}

#[tokio::test]
async fn unknown_keys_do_not_make_it_ask_often() {
    let served = identity_provider().await;
    let authenticator =
        Authenticator::with_provider(served.provider("/keys"), Duration::from_secs(3600));
    authenticator.watch_every(&served.supervisor, OFTEN, Duration::from_secs(3600));
    let unknown = token(Algorithm::EdDsa, &generate_key(Algorithm::EdDsa).unwrap().private, "p9");
    let asked = async {
        while served.asked.load(Ordering::Relaxed) == 0 {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    tokio::time::timeout(SOON, asked).await.unwrap();
    for _ in 0..200 {
        assert!(authenticator.verify(&unknown, NOW_S).is_err());
        tokio::task::yield_now().await;
    }
    assert_eq!(served.asked.load(Ordering::Relaxed), 1);
    assert!(served.supervisor.shutdown(SOON).await.is_clean());
}

#[tokio::test]
async fn answers_that_cannot_be_trusted_are_refused() {
    let served = identity_provider().await;
    for (path, part) in
        [("/moved", "307"), ("/large", "262144"), ("/broken", "500"), ("/none", "404")]
    {
        let reason = served.provider(path).fetch().await.unwrap_err();
        assert!(reason.contains(part), "{path}: {reason}");
        assert!(!reason.contains("localhost"), "{reason}");
    }
    assert!(served.provider("/keys").fetch().await.is_ok());
    // Without its certificate nobody believes it, and nothing is asked without encryption.
    let stranger = Provider::new(format!("{}/keys", served.base).into(), Some(Vec::new())).unwrap();
    assert!(stranger.fetch().await.is_err());
    let plain = format!("http{}/keys", served.base.trim_start_matches("https"));
    assert!(Provider::new(plain.into(), None).is_err());
    assert!(served.supervisor.shutdown(SOON).await.is_clean());
}
