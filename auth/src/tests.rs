use std::sync::OnceLock;

use aws_lc_rs::encoding::{AsDer, PublicKeyX509Der};
use aws_lc_rs::rsa::KeySize;
use aws_lc_rs::signature::{KeyPair as _, RsaKeyPair, RsaPublicKeyComponents};
use jsonwebtoken::{EncodingKey, Header};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::text::{pem, to_base64url};

const NOW_S: i64 = 1_795_244_472;
const SECRET: &[u8] = b"0123456789abcdef0123456789abcdef";

/// An RSA key of 2048 bit, made once: PKCS#8 and SPKI as PEM.
fn rsa_files() -> &'static (String, String) {
    static FILES: OnceLock<(String, String)> = OnceLock::new();
    FILES.get_or_init(|| {
        let pair = RsaKeyPair::generate(KeySize::Rsa2048).unwrap();
        let private: aws_lc_rs::encoding::Pkcs8V1Der<'_> = pair.as_der().unwrap();
        let public: PublicKeyX509Der<'_> = pair.public_key().as_der().unwrap();
        (
            pem("PRIVATE KEY", private.as_ref()).to_string(),
            pem("PUBLIC KEY", public.as_ref()).to_string(),
        )
    })
}

fn ed_files() -> &'static GeneratedKey {
    static FILES: OnceLock<GeneratedKey> = OnceLock::new();
    FILES.get_or_init(|| generate_key(Algorithm::EdDsa).unwrap())
}

/// Private and public file of an algorithm.
fn files(algorithm: Algorithm) -> (&'static [u8], &'static [u8]) {
    match algorithm {
        Algorithm::Hs256 => (SECRET, SECRET),
        Algorithm::Rs256 => (rsa_files().0.as_bytes(), rsa_files().1.as_bytes()),
        Algorithm::EdDsa => {
            (ed_files().private.as_bytes(), ed_files().public.as_ref().unwrap().as_bytes())
        }
    }
}

fn set(keys: &[(&str, Algorithm)]) -> KeySet {
    let mut set = KeySet::new();
    for (id, algorithm) in keys {
        let key = read_key(*algorithm, files(*algorithm).1, false).unwrap();
        assert!(set.add(Some((*id).to_owned()), key.verify));
    }
    set
}

fn roles(roles: &[&str]) -> Vec<String> {
    roles.iter().map(|role| (*role).to_owned()).collect()
}

fn good(algorithm: Algorithm, kid: Option<&str>) -> String {
    let roles = roles(&["operator"]);
    let token = NewToken {
        subject: "ops@example.org",
        roles: &roles,
        layer: None,
        issued_s: NOW_S,
        expires_s: NOW_S + 60,
        id: "t-1",
    };
    sign_locally(&Realm::default(), files(algorithm).0, algorithm, kid, &token).unwrap()
}

fn good_claims() -> Value {
    json!({
        "iss": "blaze",
        "aud": "blaze-config",
        "sub": "ops",
        "exp": NOW_S + 60,
        "roles": ["viewer"],
    })
}

/// A token of any form, signed with [`SECRET`].
fn raw(header: &Value, claims: &str) -> String {
    let message = format!(
        "{}.{}",
        to_base64url(header.to_string().as_bytes()),
        to_base64url(claims.as_bytes())
    );
    let key = EncodingKey::from_secret(SECRET);
    let signature =
        jsonwebtoken::crypto::sign(message.as_bytes(), &key, jsonwebtoken::Algorithm::HS256)
            .unwrap();
    format!("{message}.{signature}")
}

fn check(claims: &Value) -> Result<Claims, Refusal> {
    let token = raw(&json!({ "alg": "HS256" }), &claims.to_string());
    verify(&token, &set(&[("k1", Algorithm::Hs256)]), &Realm::default(), NOW_S)
}

/// The good claims with one other member; `null` takes it away.
fn with(name: &str, value: Value) -> Result<Claims, Refusal> {
    let mut claims = good_claims();
    let members = claims.as_object_mut().unwrap();
    if value.is_null() {
        members.remove(name);
    } else {
        members.insert(name.to_owned(), value);
    }
    check(&claims)
}

#[test]
fn what_is_signed_is_accepted() {
    for algorithm in Algorithm::ALL {
        let token = good(*algorithm, Some("k1"));
        let claims = verify(&token, &set(&[("k1", *algorithm)]), &Realm::default(), NOW_S).unwrap();
        assert_eq!(claims.subject, "ops@example.org", "{algorithm}");
        assert_eq!(claims.roles, ["operator"]);
        assert_eq!((claims.layer.clone(), claims.token_id.as_deref()), (None, Some("t-1")));
        assert_eq!(claims.expires_s, Some(NOW_S + 60));
        let inspected = inspect(&token).unwrap();
        assert_eq!(inspected.header["alg"], algorithm.as_str());
        assert_eq!(inspected.header["kid"], "k1");
        assert_eq!(inspected.claims["sub"], "ops@example.org");
        assert_eq!(algorithm.as_str().parse(), Ok(*algorithm));
    }
    assert!("ES256".parse::<Algorithm>().is_err());
}

#[test]
fn generated_keys_can_be_read() {
    for algorithm in Algorithm::ALL {
        let made = generate_key(*algorithm).unwrap();
        let private = read_key(*algorithm, made.private.as_bytes(), true).unwrap();
        assert_eq!(private.sign.unwrap().algorithm(), *algorithm);
        if let Some(public) = made.public {
            let key = read_key(*algorithm, public.as_bytes(), false).unwrap();
            assert!(key.sign.is_none());
            assert_eq!(
                read_key(*algorithm, public.as_bytes(), true).unwrap_err(),
                KeyError::CannotSign
            );
        }
    }
    assert_ne!(
        *generate_key(Algorithm::Hs256).unwrap().private,
        *generate_key(Algorithm::Hs256).unwrap().private
    );
    assert_eq!(generate_encryption_key().unwrap().trim_end().len(), 44);
    assert_ne!(random_id().unwrap(), random_id().unwrap());
}

#[test]
fn the_newline_at_the_end_of_a_secret_is_not_part_of_it() {
    let mut file = SECRET.to_vec();
    file.push(b'\n');
    let key = read_key(Algorithm::Hs256, &file, true).unwrap();
    let mut keys = KeySet::new();
    keys.add(None, key.verify);
    assert!(verify(&good(Algorithm::Hs256, None), &keys, &Realm::default(), NOW_S).is_ok());
    file.push(b'\n');
    let other = read_key(Algorithm::Hs256, &file, true).unwrap();
    let mut keys = KeySet::new();
    keys.add(None, other.verify);
    assert!(verify(&good(Algorithm::Hs256, None), &keys, &Realm::default(), NOW_S).is_err());
}

#[test]
fn bad_key_files_are_refused() {
    let (rsa, ed) = (files(Algorithm::Rs256), files(Algorithm::EdDsa));
    let short = &SECRET[1..];
    assert_eq!(
        read_key(Algorithm::Hs256, short, false).unwrap_err(),
        KeyError::ShortSecret { found: 31 }
    );
    assert_eq!(read_key(Algorithm::Hs256, rsa.1, false).unwrap_err(), KeyError::SecretIsPem);
    for (algorithm, file) in [(Algorithm::Rs256, ed), (Algorithm::EdDsa, rsa)] {
        for file in [file.0, file.1] {
            assert_eq!(
                read_key(algorithm, file, false).unwrap_err(),
                KeyError::Unusable(algorithm)
            );
        }
    }
    let both = [rsa.1, ed.1].concat();
    for file in [SECRET, b"", &both[..], &rsa.1[..rsa.1.len() / 2]] {
        assert!(matches!(read_key(Algorithm::Rs256, file, false), Err(KeyError::Pem(_))));
    }
    for label in ["CERTIFICATE", "RSA PRIVATE KEY"] {
        let other = pem(label, b"not looked at");
        let found = read_key(Algorithm::Rs256, other.as_bytes(), false).unwrap_err();
        assert_eq!(found, KeyError::Section { algorithm: Algorithm::Rs256, found: label });
        assert!(found.to_string().starts_with(&format!("holds a PEM section {label}; RS256 ")));
    }
}

#[test]
fn a_small_rsa_key_is_refused() {
    let modulus = [0xb5_u8; 128];
    let small = RsaPublicKeyComponents { n: &modulus[..], e: &[1, 0, 1][..] };
    let spki: PublicKeyX509Der<'_> = small.as_der().unwrap();
    let file = pem("PUBLIC KEY", spki.as_ref());
    let found = read_key(Algorithm::Rs256, file.as_bytes(), false).unwrap_err();
    assert_eq!(found, KeyError::Unusable(Algorithm::Rs256));
    assert!(found.to_string().contains("2048"));
}

#[test]
fn the_algorithm_belongs_to_the_key() {
    let claims = good_claims();
    let rsa_only = set(&[("k1", Algorithm::Rs256)]);
    // HS256 with the public RSA key as the secret: every byte of it is known to everybody.
    let public = files(Algorithm::Rs256).1;
    let mut forged_header = Header::new(jsonwebtoken::Algorithm::HS256);
    forged_header.kid = Some("k1".to_owned());
    let forged =
        jsonwebtoken::encode(&forged_header, &claims, &EncodingKey::from_secret(public)).unwrap();
    let refusal = verify(&forged, &rsa_only, &Realm::default(), NOW_S).unwrap_err();
    assert!(refusal.to_string().contains("alg"), "{refusal}");

    let keys = set(&[("k1", Algorithm::Hs256)]);
    for algorithm in ["none", "None", "NONE", "", "HS384", "hs256", "RS256"] {
        let token = raw(&json!({ "alg": algorithm }), &claims.to_string());
        assert!(verify(&token, &keys, &Realm::default(), NOW_S).is_err(), "{algorithm}");
        let unsigned = format!("{}.", token.rsplit_once('.').unwrap().0);
        assert!(verify(&unsigned, &keys, &Realm::default(), NOW_S).is_err(), "{algorithm}");
    }
}

#[test]
fn headers_are_read_strictly() {
    let claims = good_claims().to_string();
    let keys = set(&[("k1", Algorithm::Hs256)]);
    for header in [
        json!({}),
        json!([]),
        json!("HS256"),
        json!({ "alg": 5 }),
        json!({ "alg": ["HS256"] }),
        json!({ "alg": "HS256", "crit": ["exp"] }),
        json!({ "alg": "HS256", "crit": [] }),
        json!({ "alg": "HS256", "kid": 1 }),
        json!({ "alg": "HS256", "kid": "" }),
        json!({ "alg": "HS256", "kid": "k1\n" }),
        json!({ "alg": "HS256", "kid": "k".repeat(300) }),
    ] {
        let token = raw(&header, &claims);
        assert!(verify(&token, &keys, &Realm::default(), NOW_S).is_err(), "{header}");
    }
    let token = raw(&json!({ "alg": "HS256", "typ": "at+jwt", "kid": "k1" }), &claims);
    assert!(verify(&token, &keys, &Realm::default(), NOW_S).is_ok());
    // The same claims twice in one object, once as the attacker wants them.
    let double = claims.replace("\"roles\"", "\"roles\":[\"admin\"],\"roles\"");
    let token = raw(&json!({ "alg": "HS256" }), &double);
    assert!(verify(&token, &keys, &Realm::default(), NOW_S).is_err());
    let long = raw(&json!({ "alg": "HS256", "x": "y".repeat(8_000) }), &claims);
    assert!(
        verify(&long, &keys, &Realm::default(), NOW_S).unwrap_err().to_string().contains("8192")
    );
    for text in ["", ".", "..", "...", "a.b.c", "a.b", "Bearer x.y.z", "ä.ö.ü"] {
        assert!(verify(text, &keys, &Realm::default(), NOW_S).is_err(), "{text}");
        assert!(inspect(text).is_err(), "{text}");
    }
}

#[test]
fn with_several_keys_a_kid_is_needed() {
    let one = set(&[("k1", Algorithm::Hs256)]);
    let two = set(&[("k1", Algorithm::Hs256), ("k2", Algorithm::EdDsa)]);
    let realm = Realm::default();
    let plain = good(Algorithm::Hs256, None);
    assert!(verify(&plain, &one, &realm, NOW_S).is_ok());
    assert!(verify(&plain, &two, &realm, NOW_S).is_err());
    assert!(verify(&plain, &KeySet::new(), &realm, NOW_S).is_err());
    assert!(verify(&good(Algorithm::Hs256, Some("k1")), &two, &realm, NOW_S).is_ok());
    assert!(verify(&good(Algorithm::EdDsa, Some("k2")), &two, &realm, NOW_S).is_ok());
    assert!(verify(&good(Algorithm::EdDsa, Some("k1")), &two, &realm, NOW_S).is_err());
    let unknown = verify(&good(Algorithm::Hs256, Some("k3")), &one, &realm, NOW_S);
    assert_eq!(unknown, Err(Refusal::UnknownKey("k3".to_owned())));
    let mut first = KeySet::new();
    let (hs, ed) = (files(Algorithm::Hs256).1, files(Algorithm::EdDsa).1);
    assert!(
        first.add(Some("k1".to_owned()), read_key(Algorithm::Hs256, hs, false).unwrap().verify)
    );
    assert!(
        !first.add(Some("k1".to_owned()), read_key(Algorithm::EdDsa, ed, false).unwrap().verify)
    );
    assert_eq!((first.len(), first.is_empty()), (1, false));
}

#[test]
fn claims_are_read_strictly() {
    assert_eq!(check(&good_claims()).unwrap().subject, "ops");
    for (name, bad) in [
        ("iss", json!(null)),
        ("iss", json!("Blaze")),
        ("iss", json!(["blaze"])),
        ("aud", json!(null)),
        ("aud", json!("blaze-config ")),
        ("aud", json!([])),
        ("aud", json!(["other"])),
        ("aud", json!(["blaze-config", 5])),
        ("aud", json!({ "blaze-config": true })),
        ("sub", json!(null)),
        ("sub", json!("")),
        ("sub", json!(5)),
        ("sub", json!("a\nb")),
        ("sub", json!("s".repeat(257))),
        ("exp", json!(null)),
        ("exp", json!("2030")),
        ("exp", json!(NOW_S - 30)),
        ("exp", json!(0)),
        ("exp", json!(-1)),
        ("nbf", json!(NOW_S + 31)),
        ("nbf", json!("now")),
        ("iat", json!(NOW_S + 31)),
        ("iat", json!({})),
        ("roles", json!(null)),
        ("roles", json!("viewer")),
        ("roles", json!([1])),
        ("roles", json!(["v".repeat(65)])),
        ("roles", json!(vec!["viewer"; 33])),
        ("roles", json!(["worker"])),
        ("layer", json!("")),
        ("layer", json!("Edge")),
        ("layer", json!(5)),
        ("layer", json!(["edge"])),
        ("jti", json!("")),
        ("jti", json!(7)),
    ] {
        assert!(with(name, bad.clone()).is_err(), "{name} {bad}");
    }
    for (name, fine) in [
        ("aud", json!(["other", "blaze-config"])),
        ("sub", json!("s".repeat(256))),
        ("exp", json!(NOW_S - 29)),
        ("exp", json!(NOW_S as f64 + 0.5)),
        ("nbf", json!(NOW_S + 30)),
        ("iat", json!(NOW_S + 30)),
        ("iat", json!(NOW_S - 1_000_000)),
        ("roles", json!([])),
        ("roles", json!(["unheard-of"])),
        ("layer", json!("edge")),
        ("jti", json!("t-1")),
        ("other", json!({ "a": [1, 2] })),
    ] {
        assert!(with(name, fine.clone()).is_ok(), "{name} {fine}");
    }
    let mut worker = good_claims();
    worker["roles"] = json!(["worker"]);
    worker["layer"] = json!("edge");
    let claims = check(&worker).unwrap();
    assert_eq!(claims.layer, Some("edge".parse().unwrap()));
    assert!(allowed(&claims, Right::Sync).is_ok());
}

#[test]
fn a_token_runs_out_with_leeway() {
    let claims = check(&good_claims()).unwrap();
    assert!(!claims.is_expired(NOW_S + 89));
    assert!(claims.is_expired(NOW_S + 90));
    assert!(claims.is_expired(i64::MAX));
}

#[test]
fn useless_tokens_are_not_signed() {
    let key = read_key(Algorithm::Hs256, SECRET, true).unwrap().sign.unwrap();
    let (viewer, worker) = (roles(&["viewer"]), roles(&["worker"]));
    let (twice, unknown, none) = (roles(&["viewer", "viewer"]), roles(&["root"]), roles(&[]));
    let fine = NewToken {
        subject: "ops",
        roles: &viewer,
        layer: None,
        issued_s: NOW_S,
        expires_s: NOW_S + 1,
        id: "t",
    };
    assert!(sign(&Realm::default(), None, &key, &fine).is_ok());
    for bad in [
        NewToken { subject: "", ..fine },
        NewToken { subject: "a\tb", ..fine },
        NewToken { roles: &worker, ..fine },
        NewToken { roles: &twice, ..fine },
        NewToken { roles: &unknown, ..fine },
        NewToken { roles: &none, ..fine },
        NewToken { layer: Some("A"), ..fine },
        NewToken { expires_s: NOW_S, ..fine },
    ] {
        assert!(sign(&Realm::default(), None, &key, &bad).is_err(), "{bad:?}");
    }
    let bound = NewToken { roles: &worker, layer: Some("edge"), ..fine };
    assert!(sign(&Realm::default(), None, &key, &bound).is_ok());
    let error =
        sign_locally(&Realm::default(), b"short", Algorithm::Hs256, None, &fine).unwrap_err();
    assert!(error.starts_with("the key file holds 5 bytes"), "{error}");
}

#[test]
fn only_fit_keys_of_a_jwk_set_are_used() {
    let pair = RsaKeyPair::from_pkcs8(&der_of(files(Algorithm::Rs256).0)).unwrap();
    let (modulus, exponent) = rsa_numbers(pair.public_key().as_ref());
    let rsa = |more: Value| jwk(json!({ "kty": "RSA", "n": modulus, "e": exponent }), &more);
    let ed_bytes = der_of(files(Algorithm::EdDsa).1);
    let x = to_base64url(&ed_bytes[ed_bytes.len() - 32..]);
    let ed = |more: Value| jwk(json!({ "kty": "OKP", "crv": "Ed25519", "x": x }), &more);
    let small = to_base64url(&[0xb5; 128]);
    let text = json!({ "keys": [
        rsa(json!({ "kid": "r1", "alg": "RS256", "use": "sig", "x5c": ["…"] })),
        ed(json!({ "kid": "e1", "key_ops": ["verify"] })),
        rsa(json!({ "kid": "enc", "use": "enc" })),
        rsa(json!({ "kid": "ops", "key_ops": ["encrypt"] })),
        rsa(json!({ "kid": "alg", "alg": "PS256" })),
        rsa(json!({ "kid": "private", "d": "AA" })),
        rsa(json!({ "kid": "small", "n": small })),
        rsa(json!({ "kid": "odd", "n": "***" })),
        ed(json!({ "kid": "short", "x": "AAAA" })),
        ed(json!({ "kid": "curve", "crv": "Ed448" })),
        { "kty": "oct", "kid": "shared", "k": to_base64url(SECRET) },
        { "kty": "EC", "crv": "P-256", "kid": "ec", "x": "AA", "y": "AA" },
        { "kid": "nothing" },
        "text",
    ] });
    let read = read_jwks(text.to_string().as_bytes()).unwrap();
    let ids: Vec<Option<&str>> = read.keys.iter().map(|(id, _)| id.as_deref()).collect();
    assert_eq!(ids, [Some("r1"), Some("e1")]);
    assert_eq!(read.ignored.len(), 12);
    assert!(!read.ignored.join(" ").contains(&to_base64url(SECRET)));
    let mut keys = KeySet::new();
    for (id, key) in read.keys {
        keys.add(id, key);
    }
    for (algorithm, kid) in [(Algorithm::Rs256, "r1"), (Algorithm::EdDsa, "e1")] {
        assert!(verify(&good(algorithm, Some(kid)), &keys, &Realm::default(), NOW_S).is_ok());
    }
    for text in ["", "{}", "[]", "{\"keys\":{}}", "{\"keys\":[],\"keys\":[]}", "<html>"] {
        assert!(read_jwks(text.as_bytes()).is_err(), "{text}");
    }
    let many = json!({ "keys": vec![json!({}); 65] }).to_string();
    assert!(read_jwks(many.as_bytes()).is_err());
    assert!(read_jwks(b"{\"keys\":[]}").unwrap().keys.is_empty());
}

fn jwk(mut base: Value, more: &Value) -> Value {
    for (name, value) in more.as_object().unwrap() {
        base[name] = value.clone();
    }
    base
}

fn der_of(file: &[u8]) -> Vec<u8> {
    use rustls_pki_types::pem::{PemObject as _, SectionKind};
    <(SectionKind, Vec<u8>)>::from_pem_slice(file).unwrap().1
}

/// `n` and `e` from an `RSAPublicKey` of 2048 bit with an exponent of three bytes.
fn rsa_numbers(der: &[u8]) -> (String, String) {
    // SEQUENCE (4) INTEGER (4) 0 n[256] INTEGER (2) e[3]
    assert_eq!(der.len(), 4 + 4 + 257 + 2 + 3);
    (to_base64url(&der[8..265]), to_base64url(&der[267..]))
}

proptest! {
    #[test]
    fn no_text_breaks_the_check(text in ".{0,200}",
        parts in "[A-Za-z0-9_-]{0,40}([.][A-Za-z0-9_-]{0,40}){2}") {
        let keys = set(&[("k1", Algorithm::Hs256)]);
        prop_assert!(verify(&text, &keys, &Realm::default(), NOW_S).is_err());
        prop_assert!(verify(&parts, &keys, &Realm::default(), NOW_S).is_err());
        let _ = read_jwks(text.as_bytes());
    }

    #[test]
    fn no_changed_token_is_accepted(place in 0_usize..10_000, other in any::<u8>(),
        which in 0_usize..3) {
        let algorithm = Algorithm::ALL[which];
        let keys = set(&[("k1", algorithm)]);
        let token = good(algorithm, Some("k1"));
        let mut bytes = token.clone().into_bytes();
        let place = place % bytes.len();
        bytes[place] = other;
        if let Ok(changed) = String::from_utf8(bytes) {
            let found = verify(&changed, &keys, &Realm::default(), NOW_S);
            prop_assert_eq!(found.is_ok(), changed == token);
        }
    }
}
